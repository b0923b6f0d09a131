"""Roofs of small houses: two or four slopes over a nearly rectangular footprint.

- The straight skeleton of a rectangle (O. Aichholzer and others 1995, "A novel type of skeleton for polygons") is one ridge along
  its middle.
- A *hipped* roof has the same slope on all sides. Its ridge ends half a width before either end of the rectangle.
- A *pitched* roof extends the ridge to the gables.
- The ridge lies at the building's height, since surveys and maps give that height. The eaves lie lower by the rise of the ridge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.level.parts import RoofForm

ROOF_SLOPE = 0.7
"""Rise over run of roofs: 35 degrees, usual for tiles."""

MAX_RISE_SHARE = 0.45
"""Maximum share of a building's height that its roof takes."""

MAX_CORNER_COSINE = 0.17
"""Maximum cosine between neighbouring sides of a nearly rectangular footprint: 10 degrees off a right angle."""

MAX_SIDE_DIFFERENCE_SHARE = 0.12
"""Maximum difference between opposite sides of a nearly rectangular footprint, as a share of the longer one."""

HOUSE_WIDTH_RANGE_M, MAX_HOUSE_LENGTH_M, MAX_HOUSE_HEIGHT_M = (2.5, 14.0), 32.0, 13.0
"""Range of widths, maximum length and maximum height of a building that the roof form ``auto`` takes for a house."""

MAX_RIDGE_INSET_SHARE = 0.49
"""Maximum distance of a hipped roof's ridge from the end of the rectangle, as a share of the rectangle's length.

Beyond it the roof has an apex in place of a ridge (a tent roof).
"""

PITCHED_TRIANGLES = np.array([[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]])
"""Triangles of two slopes and two ends. Vertices 0 to 3 are the corners; 4 (between corners 3 and 0) and 5 are the ridge."""

PYRAMID_TRIANGLES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
"""Triangles of four slopes to an apex, vertex 4."""

PITCHED_SLOPE_TRIANGLES = 4
"""Number of triangles of ``PITCHED_TRIANGLES`` on its slopes. The others are gables or hips."""


class Roof(NamedTuple):
    """A roof over four corners.

    Attributes
    ----------
    first_corner
        Index of the footprint's corner that is corner 0 of the roof.
    ridge_weights
        float64 (k, 4): weights of the four corners in each of the one or two points of the ridge.
    triangles
        int (m, 3): indices of the four corners (0 to 3) and of the points of the ridge (from 4 on).
    roof_triangle_count
        Number of triangles on the roof, which come first in ``triangles``. The others are parts of walls.
    rise_m
        Height of the ridge above the eaves, metres.
    """

    first_corner: int
    ridge_weights: np.ndarray
    triangles: np.ndarray
    roof_triangle_count: int
    rise_m: float


def roof_over(corners_m: np.ndarray, height_m: float, form: RoofForm) -> Roof | None:
    """Return the roof over a footprint, or ``None`` if it is flat.

    ``corners_m`` (n, 3) are counter-clockwise seen from above; ``height_m`` is the building's height. The roof is flat if ``form``
    is ``flat``, the footprint is not nearly rectangular or, for ``auto``, the building is not a house.
    """
    if form == "flat" or len(corners_m) != 4:
        return None
    sides = np.roll(corners_m, -1, axis=0) - corners_m
    length = np.linalg.norm(sides, axis=1)
    side_directions = sides / np.maximum(length, 1e-12)[:, None]
    max_corner_cosine = np.abs(np.einsum("ij,ij->i", side_directions, np.roll(side_directions, -1, axis=0))).max()
    side_difference = np.abs(length[:2] - length[2:]) / np.maximum(length[:2], length[2:])
    if max_corner_cosine > MAX_CORNER_COSINE or side_difference.max() > MAX_SIDE_DIFFERENCE_SHARE:
        return None
    pairs = (length[:2] + length[2:]) / 2.0
    first, width, long = (0, pairs[1], pairs[0]) if pairs[0] >= pairs[1] else (1, pairs[0], pairs[1])
    is_house = (
        HOUSE_WIDTH_RANGE_M[0] <= width <= HOUSE_WIDTH_RANGE_M[1] and long <= MAX_HOUSE_LENGTH_M and height_m <= MAX_HOUSE_HEIGHT_M
    )
    if form == "auto" and not is_house:
        return None
    rise_m = float(min(ROOF_SLOPE * width / 2.0, MAX_RISE_SHARE * height_m))
    ridge_inset = 0.5 * width / long if form == "hipped" else 0.0
    if ridge_inset > MAX_RIDGE_INSET_SHARE:
        return Roof(first, np.full((1, 4), 0.25), PYRAMID_TRIANGLES, len(PYRAMID_TRIANGLES), rise_m)
    start, end = np.array([0.5, 0.0, 0.0, 0.5]), np.array([0.0, 0.5, 0.5, 0.0])
    weights = np.stack([start + (end - start) * ridge_inset, end + (start - end) * ridge_inset])
    return Roof(first, weights, PITCHED_TRIANGLES, len(PITCHED_TRIANGLES) if form == "hipped" else PITCHED_SLOPE_TRIANGLES, rise_m)
