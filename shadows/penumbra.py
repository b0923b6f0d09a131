"""How wide the penumbra of a lamp's ball is in a picture, and how many points of the ball show it.

A ball of radius R casts a penumbra of width 2 R t / (d - t) at a distance d from the lamp, behind a caster that is t before the
receiver. The facts of a view say d and the median t, by kind of caster.
"""

from __future__ import annotations

from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import LampFacts
from skugga.terrain.level.level import SUN

MAX_POINTS, MIN_POINTS = 32, 4
"""Points of a light that algorithms of hard edges are averaged over: a penumbra has as many steps."""

POINTS_PER_PX = 4.0
"""Steps of a penumbra for each pixel of its width: a step is then at most a quarter of what a pixel's own edge is."""

NEAREST_CASTER = 0.8
"""Where a caster is taken to be on the way from a receiver to the lamp where that is not known, and no nearer to the lamp where it
is: half of all casters are nearer than the median.
"""


def penumbra_px(descriptor: Descriptor, light: str) -> float | None:
    """How many pixels the penumbrae of a lamp are wide, about the widest of them; ``None`` where it is not known."""
    lamp = next((lamp for lamp in descriptor.lamps if lamp.name == light), None)
    if lamp is None:
        return None
    facts = descriptor.lights.get(light)
    widths = [
        _width_m(lamp, band.light_m, casting.thrown_m) / band.pixel_m
        for casting in (facts.casts.values() if facts is not None else ())
        for band in casting.bands
        if band.light_m
    ]
    if descriptor.view_kind == "map":
        widths.append(_width_m(lamp, lamp.reference_m, None) / descriptor.pixel_m)
    return max(widths, default=None)


def light_points(descriptor: Descriptor, light: str) -> int:
    """How many points of a light show its penumbrae: 1 where those of a lamp are narrower than a pixel."""
    if light == SUN:
        return MAX_POINTS
    width_px = penumbra_px(descriptor, light)
    if width_px is None:
        return MAX_POINTS
    return 1 if width_px < 1.0 else min(max(round(POINTS_PER_PX * width_px), MIN_POINTS), MAX_POINTS)


def _width_m(lamp: LampFacts, light_m: float, thrown_m: float | None) -> float:
    share = NEAREST_CASTER if thrown_m is None else max(min(2.0 * thrown_m / light_m, NEAREST_CASTER), 0.0)
    return 2.0 * lamp.radius_m * share / (1.0 - share)
