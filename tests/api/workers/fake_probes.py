"""Fake probes that draw nothing: they return observations at two scales, or fail."""

from __future__ import annotations

from skugga.api.workers.jobs import LevelKey
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.map_probes import MapProbes, ProbedClass
from skugga.selector.observation import Observation
from skugga.terrain.errors import RenderError


def observation(choice: str = "shadow_map 1024", error: float = 0.01, ms: float = 20.0) -> Observation:
    """Return an observation of a choice of algorithms. ``error`` is a share in [0, 1]."""
    return Observation(choice=choice, error=error, error_noise=0.1, interior=0.0, interior_noise=0.1, ms=ms, ms_noise=0.1)


def probe_two_scales(level: LevelKey, sun: int, device: DeviceProfile) -> MapProbes:
    """Return an observation at each of two scales."""
    return MapProbes(classes=tuple(ProbedClass(scale=scale, sun=sun, seen={"sun": (observation(),)}) for scale in (4, 5)))


def failing(level: LevelKey, sun: int, device: DeviceProfile) -> MapProbes:
    """Raise an error about a missing raster."""
    raise RenderError("the raster is gone")
