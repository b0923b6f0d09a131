"""Refraction: the atmosphere lifts the sun, by half a degree at the horizon and 0.02 degrees at 45.

Called for where this moves the end of the longest shadow by more than a pixel, or changes how light falls on a slope by more than
a step: n.l changes by the lift at most, in radians, which exposure and the slope of sRGB make a change of the picture. That slope
is at most ``SRGB_SLOPE`` on what the sky's light alone leaves by day.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.effects.effect import CHANNEL_STEP, Effect, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.shading import exposure_of

SRGB_SLOPE = 3.5
"""Slope of sRGB at a linear value of 0.03: white ground on a slope that sees half of the sky, and its dark side."""


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out where the sun is given as it is seen, and where it is high."""
    if descriptor.highest_sun_deg is None:
        return Verdict(False, "the level has no sun")
    facts = descriptor.facts["refraction"]
    lift_deg, moves_m = float(facts["lift_deg"] or 0.0), float(facts["moves_m"] or 0.0)
    if lift_deg == 0.0:
        return Verdict(False, "the sun is given by angles, which already include refraction")
    pixel_m = descriptor.pixel_m
    if descriptor.bands and descriptor.pixel is not None:
        pixel_m = descriptor.bands[0].near_m * descriptor.pixel
    moves_px = moves_m / pixel_m
    steps = exposure_of(descriptor.sun_altitude_deg) * np.radians(lift_deg) * SRGB_SLOPE / CHANNEL_STEP
    text = f"refraction lifts the sun by {lift_deg:.2g} degrees"
    if 0.0 < descriptor.weather.cloud_cover < 1.0:
        return Verdict(True, f"{text}, which moves the shadows of clouds")
    if moves_px > 1.0:
        return Verdict(True, f"{text}, which moves the end of the longest shadow by {moves_px:.2g} pixels")
    if steps > 1.0:
        return Verdict(True, f"{text}, which changes the light on slopes by {steps:.2g} steps of 255")
    return Verdict(False, f"{text}, which moves no shadow by more than {moves_px:.2g} pixels")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """``lift_deg``, and ``moves_m``: how much longer the longest shadow of the level would be without it."""
    if scene.sun is None:
        return {}
    tallest_m = float(np.ptp(scene.height_range_m)) + scene.objects.tallest_m
    altitude, curved = scene.sun.altitude_deg, not scene.world.flat
    longer_m = longest_shadow_m(tallest_m, altitude - scene.sun.lift_deg, curved) - longest_shadow_m(tallest_m, altitude, curved)
    return {"lift_deg": scene.sun.lift_deg, "moves_m": longer_m}


EFFECT = Effect("atmospheric refraction", called_for, facts)
