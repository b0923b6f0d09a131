"""Estimate the width of a lamp's penumbrae in a picture, and the number of points of the lamp's ball that show them.

A ball of radius R casts a penumbra of width 2 R t / (d - t) at a distance d from the lamp, from a caster at the distance t in front
of the receiver. The facts of a view contain d and the median of t, by kind of caster.
"""

from __future__ import annotations

from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import LampFacts
from skugga.terrain.level.level import SUN

MAX_LIGHT_POINTS, MIN_LIGHT_POINTS = 32, 4
"""Numbers of points of a light over which algorithms with hard edges are averaged. A penumbra has as many steps."""

LIGHT_POINTS_PER_PENUMBRA_PX = 4.0
"""Steps of a penumbra per pixel of its width. From pixel to pixel, visibility then changes by several small steps."""

MAX_CASTER_DISTANCE_SHARE = 0.8
"""Upper bound of a caster's position, as a share of the way from a receiver to the lamp. It is used where the position is unknown.

Known positions are twice the median, since half of all casters are nearer to the lamp than the median.
"""


def penumbra_px(descriptor: Descriptor, light: str) -> float | None:
    """Return the approximate largest width of a lamp's penumbrae in pixels; ``None`` if it is unknown."""
    lamp = next((lamp for lamp in descriptor.lamps if lamp.name == light), None)
    if lamp is None:
        return None
    facts = descriptor.lights.get(light)
    widths = [
        _penumbra_width_m(lamp, band.light_m, casting.thrown_m) / band.pixel_m
        for casting in (facts.casts.values() if facts is not None else ())
        for band in casting.bands
        if band.light_m
    ]
    if descriptor.view_kind == "map":
        widths.append(_penumbra_width_m(lamp, lamp.reference_m, None) / descriptor.pixel_m)
    return max(widths, default=None)


def light_point_count(descriptor: Descriptor, light: str) -> int:
    """Return the number of points of a light that show its penumbrae; 1 for a lamp with penumbrae narrower than a pixel."""
    if light == SUN:
        return MAX_LIGHT_POINTS
    width_px = penumbra_px(descriptor, light)
    if width_px is None:
        return MAX_LIGHT_POINTS
    return 1 if width_px < 1.0 else min(max(round(LIGHT_POINTS_PER_PENUMBRA_PX * width_px), MIN_LIGHT_POINTS), MAX_LIGHT_POINTS)


def _penumbra_width_m(lamp: LampFacts, lamp_distance_m: float, caster_distance_m: float | None) -> float:
    """Return the width of a lamp's penumbra at the distance ``lamp_distance_m`` from the lamp, metres.

    ``caster_distance_m`` is the median distance of the casters in front of the receiver. If it is ``None`` (unknown), the result is
    an upper bound.
    """
    share = (
        MAX_CASTER_DISTANCE_SHARE
        if caster_distance_m is None
        else max(min(2.0 * caster_distance_m / lamp_distance_m, MAX_CASTER_DISTANCE_SHARE), 0.0)
    )
    return 2.0 * lamp.radius_m * share / (1.0 - share)
