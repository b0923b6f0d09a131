"""Soft edges: where the penumbra of the sun's disc (0.53 degrees) is a pixel wide somewhere, shadow maps filter their edges.

How wide depends on how far a shadow is thrown: at most as far as the level's relief and what stands on it throw it.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.effects.effect import Effect, Verdict
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.sun import SUN_RADIUS_DEG

DISC = float(2.0 * np.radians(SUN_RADIUS_DEG))
"""The sun's diameter, radians: the penumbra's width as a share of the distance from caster to receiver, across the light."""


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out where every penumbra is narrower than a pixel."""
    if descriptor.sun_altitude_deg is None:
        return Verdict(False, "no sun in the level")
    wide_m = penumbra_m(descriptor)
    pixel_m = descriptor.pixel_m
    if descriptor.bands and descriptor.pixel is not None:
        pixel_m = descriptor.bands[0].near_m * descriptor.pixel
    wide_px = wide_m / pixel_m
    if wide_px < 1.0:
        return Verdict(False, f"no penumbra is wider than {wide_px:.2g} pixels")
    return Verdict(True, f"penumbras are up to {wide_px:{'.3g' if wide_px < 999.5 else '.0f'}} pixels wide")


def penumbra_m(descriptor: Descriptor) -> float:
    """The widest penumbra on level ground, metres: that of the longest shadow, drawn out by the sun's altitude."""
    assert descriptor.sun_altitude_deg is not None
    sine = np.sin(np.radians(max(descriptor.sun_altitude_deg, 0.5)))
    along_m = longest_shadow_m(descriptor.relief_m + descriptor.tallest_m, descriptor.sun_altitude_deg, not descriptor.flat_world)
    thrown_m = min(float(np.hypot(along_m, descriptor.relief_m + descriptor.tallest_m)), 1e7)
    return thrown_m * DISC / float(sine)


EFFECT = Effect("penumbrae of the sun's disc", called_for, needs=("cast_shadows",))
