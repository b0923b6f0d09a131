"""Decide whether the sun's rays count as straight lines of a map across the area that is drawn at once."""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.grid import BLOCK_PX
from skugga.terrain.geo.world import EARTH_RADIUS_M
from skugga.terrain.level.level import SUN

MAX_STRAIGHT_RAYS_EXTENT_M = 200e3
"""Largest extent of the round earth in metres across which the sun's rays count as parallel lines.

On another celestial body the limit is the same angle, seen from the body's centre.

In Web Mercator, the straight lines that the algorithm ``sweep`` follows match the rays across 250 km at 84 degrees of latitude and
across 1,000 km at 65, in windows of 1,024 nodes a side.
"""

MAX_SUMMIT_SHIFT_PX = 1.0
"""Tolerance in pixels for the shift of a summit across the sun's rays from the ground below it.

The algorithm ``sweep`` computes the rays' positions for one height. Verticals lean away from the middle of the ground, so a shadow
falls beside its place by this shift.
"""

MAX_ROW_WIDTH_RATIO = 2.3
"""Largest ratio of the widths of two rows of nodes across which the sun's rays count as straight lines.

In windows of 2,050 x 2,050 nodes near a pole of a map in degrees, the cubics of the algorithm ``sweep`` fit up to a ratio of 2.38.
"""


def rays_bend(descriptor: Descriptor) -> bool:
    """Return whether the area drawn at once is too wide, too high, or its rows are too uneven, for straight rays.

    Where the extent of the area is unknown, its width does not count.
    """
    max_straight_m = MAX_STRAIGHT_RAYS_EXTENT_M * descriptor.radius_m / EARTH_RADIUS_M
    return (
        (sunlit_ground_extent_m(descriptor) or 0.0) > max_straight_m
        or descriptor.row_width_ratio > MAX_ROW_WIDTH_RATIO
        or _summit_shift_px(descriptor) > MAX_SUMMIT_SHIFT_PX
    )


def _summit_shift_px(descriptor: Descriptor) -> float:
    """Return the largest shift of a block's summits across the sun's rays from the ground below them, in pixels of a map.

    The shift is the block's relief times the angle between verticals in the middle and at a corner of the ground. In perspective
    views pixels have no one size, and the result is 0.
    """
    if descriptor.flat_world or descriptor.sun_altitude_deg is None or descriptor.view_kind != "map":
        return 0.0
    block_m = BLOCK_PX * descriptor.pixel_m
    level_m = _level_extent_m(descriptor)
    side_m = block_m if level_m is None else min(block_m, level_m)
    return float(side_m / np.sqrt(2.0) / descriptor.radius_m * descriptor.block_relief_m / descriptor.pixel_m)


def sunlit_ground_extent_m(descriptor: Descriptor) -> float | None:
    """Return the side, in metres, of the ground over which the sun's shadows are computed at once; ``None`` if it is unknown.

    A perspective view covers the level's whole ground. A map covers at most one block and the length of its longest shadow. A flat
    world has extent 0, since it bends no rays.
    """
    if descriptor.sun_altitude_deg is None:
        return None
    if descriptor.flat_world:
        return 0.0
    level_m = _level_extent_m(descriptor)
    if descriptor.view_kind == "perspective":
        return level_m
    block_m = BLOCK_PX * descriptor.pixel_m + longest_shadow_m(descriptor.relief_m, descriptor.sun_altitude_deg)
    return block_m if level_m is None else min(block_m, level_m)


def _level_extent_m(descriptor: Descriptor) -> float | None:
    """Return the side, in metres, of a square with the area of the level's ground; ``None`` if it is unknown.

    The area follows from the visible ground's area and its share of the whole.
    """
    sun_facts = descriptor.lights.get(SUN)
    if (
        descriptor.sun_altitude_deg is None
        or descriptor.receivers_light_m is None
        or sun_facts is None
        or sun_facts.area_share <= 0.0
    ):
        return None
    right_m, up_m, _ = descriptor.receivers_light_m
    sine = np.sin(np.radians(max(descriptor.sun_altitude_deg, 0.5)))
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # an overflow is infinitely wide
        return float(np.sqrt(right_m * up_m / (sun_facts.area_share * sine)))
