"""Refraction: the atmosphere raises the sun's apparent altitude, by half a degree at the horizon and 0.02 degrees at 45 degrees.

The lift is this increase of the altitude. The effect is needed if the lift moves the end of the longest shadow or the shadows of
clouds by more than a pixel, or changes the light on a slope by more than a step of 1/255. The cosine between a slope's normal and
the light changes by at most the lift in radians. The change of the picture is this change times the exposure and the slope of the
sRGB curve. By day the slope of the curve is at most ``MAX_SRGB_SLOPE``, on surfaces that only sky light reaches.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.effects import cloud_layer, clouds
from skugga.terrain.effects.effect import SRGB_CHANNEL_STEP, Effect, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.shading import exposure_of

MAX_SRGB_SLOPE = 3.5
"""Slope of the sRGB curve at a linear value of 0.03, the colour of white ground in shadow that sees half of the sky."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: the sun is given by a time, and the lift moves the end of the longest shadow by more than a pixel, changes the light on
    slopes by more than a step of 255, or moves the shadows of clouds by more than a pixel.

    Left out: no sun; apparent angles; a high sun.
    """
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
    steps = exposure_of(descriptor.sun_altitude_deg) * np.radians(lift_deg) * MAX_SRGB_SLOPE / SRGB_CHANNEL_STEP
    text = f"refraction lifts the sun by {lift_deg:.2g} degrees"
    if clouds.EFFECT.verdict("clouds", descriptor).is_needed:
        sine = max(np.sin(np.radians(descriptor.sun_altitude_deg or 0.0)), cloud_layer.MIN_SUN_ALTITUDE_SINE)
        height_m = cloud_layer.CLOUD_HEIGHT_M + cloud_layer.CLOUD_CLEARANCE_M + descriptor.relief_m
        clouds_px = height_m * np.radians(lift_deg) / sine**2 / pixel_m
        if clouds_px > 1.0:
            return Verdict(True, f"{text}, which moves the shadows of clouds by {clouds_px:.2g} pixels")
    if moves_px > 1.0:
        return Verdict(True, f"{text}, which moves the end of the longest shadow by {moves_px:.2g} pixels")
    if steps > 1.0:
        return Verdict(True, f"{text}, which changes the light on slopes by {steps:.2g} steps of 255")
    return Verdict(False, f"{text}, which moves no shadow by more than {moves_px:.2g} pixels")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of refraction.

    - ``lift_deg``: increase of the sun's altitude by refraction, degrees.
    - ``moves_m``: difference between the lengths of the level's longest shadow without and with refraction, metres.
    """
    if scene.sun is None:
        return {}
    tallest_m = float(np.ptp(scene.height_range_m)) + scene.objects.tallest_object_m
    altitude, curved = scene.sun.altitude_deg, not scene.world.is_flat
    longer_m = longest_shadow_m(tallest_m, altitude - scene.sun.refraction_deg, curved) - longest_shadow_m(
        tallest_m, altitude, curved
    )
    return {"lift_deg": scene.sun.refraction_deg, "moves_m": longer_m}


EFFECT = Effect("the air lifts the sun: half a degree at the horizon, 0.02 at 45 degrees", judge, facts)
