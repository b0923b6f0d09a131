"""Light without air: a constant beam on planes that face the sun, and no light of the sky. So geometry is tested alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import numpy as np

from skugga.shadows.irradiation import irradiation as irradiation_module
from skugga.shadows.irradiation.light import SkyLight
from skugga.shadows.irradiation.suns import SunIntervals

BEAM_W_M2 = 1000.0
"""The constant beam."""


def light_without_air(
    suns: SunIntervals, lon_deg: float, lat_deg: float, height_m: np.ndarray, linke_turbidity: float | None = None
) -> SkyLight:
    """Return the constant beam at heights (k,), with the arguments of ``clear_sky_light``."""
    beam, none = np.full((len(height_m), len(suns)), BEAM_W_M2), np.zeros((len(height_m), len(suns)))
    return SkyLight(beam, none, none, none, beam * np.sin(np.radians(suns.altitude_deg)))


@contextmanager
def without_air() -> Iterator[None]:
    """Let irradiation be that of the constant beam, within the context."""
    with mock.patch.object(irradiation_module, "clear_sky_light", light_without_air):
        yield
