"""Across how wide a piece of the round earth the sun's rays are taken as straight lines of a map."""

from __future__ import annotations

import numpy as np

from terrain.casters.reach import longest_shadow_m
from terrain.facts.descriptor import Descriptor
from terrain.geo.grid import BLOCK_PX
from terrain.level.level import SUN

MAX_STRAIGHT_M = 200e3
"""Across a wider piece of the round earth the sun's rays bend too much for lines that run side by side. In Web Mercator the lines
of a sweep follow the rays across 250 km at 84 degrees of latitude and across 1,000 km at 65, in windows of 1,024 nodes a side.
"""


def rays_bend(descriptor: Descriptor) -> bool:
    """Whether what is drawn at once is too wide; not where that is unknown."""
    return (sun_extent_m(descriptor) or 0.0) > MAX_STRAIGHT_M


def sun_extent_m(descriptor: Descriptor) -> float | None:
    """How far across the ground is that the sun's rays cross at once, if that is known: a map's block and the way of its longest
    shadow, in perspective all of the level, whose area follows from the share of it that is seen. A flat world bends nothing.
    """
    seen = descriptor.lights.get(SUN)
    if descriptor.sun_altitude_deg is None:
        return None
    if descriptor.flat_world:
        return 0.0
    if descriptor.view_kind == "map":
        return BLOCK_PX * descriptor.pixel_m + longest_shadow_m(descriptor.relief_m, descriptor.sun_altitude_deg)
    if descriptor.receivers_light_m is None or seen is None or seen.area_share <= 0.0:
        return None
    right_m, up_m, _ = descriptor.receivers_light_m
    sine = np.sin(np.radians(max(descriptor.sun_altitude_deg, 0.5)))
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # wider than can be said is too wide
        return float(np.sqrt(right_m * up_m / (seen.area_share * sine)))
