"""A grid of a thousand hovering boxes: many silhouettes and overlapping shadows from 12,000 triangles."""

from __future__ import annotations

from itertools import product

from skugga.terrain.meshes.body import Body
from skugga.terrain.meshes.generators.shapes import cuboid

BOXES_PER_SIDE = 10
BOX_SPACING_M = 3.0
BOX_SIDE_M = 0.9
LOWEST_BOX_HEIGHT_M = 12.0

LOW_COLOR, HIGH_COLOR = (0.62, 0.33, 0.22), (0.90, 0.80, 0.66)


def boxgrid() -> list[Body]:
    """Return 10 x 10 x 10 boxes of 12 triangles each, terracotta at the bottom to sand at the top."""
    first = -BOX_SPACING_M * (BOXES_PER_SIDE - 1) / 2
    bodies = []
    for layer, row, col in product(range(BOXES_PER_SIDE), repeat=3):
        low = (
            first + col * BOX_SPACING_M - BOX_SIDE_M / 2,
            first + row * BOX_SPACING_M - BOX_SIDE_M / 2,
            LOWEST_BOX_HEIGHT_M + layer * BOX_SPACING_M,
        )
        share = layer / (BOXES_PER_SIDE - 1)
        red, green, blue = (a + (b - a) * share for a, b in zip(LOW_COLOR, HIGH_COLOR, strict=True))
        high = (low[0] + BOX_SIDE_M, low[1] + BOX_SIDE_M, low[2] + BOX_SIDE_M)
        bodies.append(cuboid(low, high, (red, green, blue)))
    return bodies
