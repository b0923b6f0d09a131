"""Roofs of small houses: two or four slopes over a footprint that is nearly a rectangle.

The straight skeleton of a rectangle (O. Aichholzer and others 1995, "A novel type of skeleton for polygons") is one ridge along
its middle: a *hipped* roof of one slope all round has it, half a width short of either end, and a *pitched* one draws it out to
the gables. The ridge lies at the building's height, which is what is measured and mapped; the eaves lie lower by the ridge's
rise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.level.parts import RoofForm

SLOPE = 0.7
"""Rise over run of roofs: 35 degrees, as tiles want it."""

MOST_RISE = 0.45
"""Share of a building's height that its roof takes at the most."""

MOST_OFF_SQUARE = 0.17
"""Largest cosine between neighbouring sides (10 degrees off a right angle) of what is nearly a rectangle ..."""

MOST_OFF_EQUAL = 0.12
"""... and the largest difference between opposite sides, as a share of them."""

HOUSE_WIDTH_M, HOUSE_LENGTH_M, HOUSE_HEIGHT_M = (2.5, 14.0), 32.0, 13.0
"""Widths, the largest length and the largest height of what ``auto`` takes for a house."""

APEX_SHARE = 0.49
"""A hipped roof whose ridge begins beyond this share of the length has an apex instead."""

PITCHED = np.array([[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]])
"""Triangles of two slopes and two ends over corners 0 to 3, and a ridge from 4, between corners 3 and 0, to 5."""

TENT = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
"""Four slopes to an apex, 4."""

ON_SLOPES = 4
"""So many triangles of ``PITCHED`` lie on its slopes; the others are gables, or hips."""


class Roof(NamedTuple):
    """A roof over four corners, of which the first is corner ``first`` of the footprint.

    ``weights`` (k, 4) make its one or two ridge points of those corners; ``triangles`` (m, 3) count the corners, then these; the
    first ``covered`` of them are roof, the others wall; the eaves lie ``rise_m`` below the ridge.
    """

    first: int
    weights: np.ndarray
    triangles: np.ndarray
    covered: int
    rise_m: float


def roof_over(corners_m: np.ndarray, height_m: float, form: RoofForm) -> Roof | None:
    """The roof of a form over a footprint's corners (n, 3), counter-clockwise seen from above, of a building of some height.

    ``None`` where it is flat: asked for so, not nearly a rectangle, or, for ``auto``, no house.
    """
    if form == "flat" or len(corners_m) != 4:
        return None
    sides = np.roll(corners_m, -1, axis=0) - corners_m
    length = np.linalg.norm(sides, axis=1)
    along = sides / np.maximum(length, 1e-12)[:, None]
    off_square = np.abs(np.einsum("ij,ij->i", along, np.roll(along, -1, axis=0))).max()
    off_equal = np.abs(length[:2] - length[2:]) / np.maximum(length[:2], length[2:])
    if off_square > MOST_OFF_SQUARE or off_equal.max() > MOST_OFF_EQUAL:
        return None
    pairs = (length[:2] + length[2:]) / 2.0
    first, width, long = (0, pairs[1], pairs[0]) if pairs[0] >= pairs[1] else (1, pairs[0], pairs[1])
    house = HOUSE_WIDTH_M[0] <= width <= HOUSE_WIDTH_M[1] and long <= HOUSE_LENGTH_M and height_m <= HOUSE_HEIGHT_M
    if form == "auto" and not house:
        return None
    rise_m = float(min(SLOPE * width / 2.0, MOST_RISE * height_m))
    inwards = 0.5 * width / long if form == "hipped" else 0.0
    if inwards > APEX_SHARE:
        return Roof(first, np.full((1, 4), 0.25), TENT, len(TENT), rise_m)
    near, far = np.array([0.5, 0.0, 0.0, 0.5]), np.array([0.0, 0.5, 0.5, 0.0])
    weights = np.stack([near + (far - near) * inwards, far + (near - far) * inwards])
    return Roof(first, weights, PITCHED, len(PITCHED) if form == "hipped" else ON_SLOPES, rise_m)
