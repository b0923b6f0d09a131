"""Soft edges: shadow maps filter the edges of shadows if a penumbra of the sun's disc (0.53 degrees) may be a pixel wide.

The width of a penumbra is proportional to the distance between occluder and receiver. The maximum distance follows from the longest
shadow of the level's relief and of the objects on it.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.effects.effect import Effect, Verdict
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.sun import SUN_RADIUS_DEG

SUN_DIAMETER_RAD = float(2.0 * np.radians(SUN_RADIUS_DEG))
"""Angular diameter of the sun, radians.

It is the width of a penumbra, perpendicular to the light, divided by the distance between caster and receiver.
"""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: the widest penumbra of the level (its longest shadow under the sun's disc of 0.53 degrees) is a pixel wide or more; or a
    ``filter`` other than 1 is requested.

    Left out: narrower penumbrae; no sun; ``filter: 1``. Where they are called for but the chosen algorithms have hard edges,
    ``left_out`` says so, and which algorithms these are.
    """
    if descriptor.sun_altitude_deg is None:
        return Verdict(False, "the level has no sun")
    wide_m = max_penumbra_width_m(descriptor)
    pixel_m = descriptor.pixel_m
    if descriptor.bands and descriptor.pixel is not None:
        pixel_m = descriptor.bands[0].near_m * descriptor.pixel
    wide_px = wide_m / pixel_m
    if wide_px < 1.0:
        return Verdict(False, f"no penumbra is wider than {wide_px:.2g} pixels")
    return Verdict(True, f"penumbras are up to {wide_px:{'.3g' if wide_px < 999.5 else '.0f'}} pixels wide")


def max_penumbra_width_m(descriptor: Descriptor) -> float:
    """Return the maximum width of a penumbra on level ground, metres.

    It is the width at the end of the longest shadow, perpendicular to the light, divided by the sine of the sun's altitude.
    """
    assert descriptor.sun_altitude_deg is not None
    sine = np.sin(np.radians(max(descriptor.sun_altitude_deg, 0.5)))
    along_m = longest_shadow_m(descriptor.relief_m + descriptor.tallest_m, descriptor.sun_altitude_deg, not descriptor.flat_world)
    thrown_m = min(float(np.hypot(along_m, descriptor.relief_m + descriptor.tallest_m)), 1e7)
    return thrown_m * SUN_DIAMETER_RAD / float(sine)


EFFECT = Effect("penumbrae of the sun's disc, or of taps in shadow maps", judge, required_effects=("cast_shadows",))
