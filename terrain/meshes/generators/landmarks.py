"""Two landmarks of a landscape: a figure of two tetrahedra, and the body of a wood."""

from __future__ import annotations

import numpy as np

from skugga.terrain.meshes.body import Body
from skugga.terrain.meshes.generators.shapes import hull

FIGURE_HEIGHT_M = 30.0
HOVER_HEIGHT_M = 3.0
TIP_OVERLAP_M = 1.5
"""Overlap of the figure's tips."""

WOOD_SIZE_M = (170.0, 110.0)
WOOD_HEIGHT_M, WOOD_DEPTH_BELOW_GROUND_M = 13.0, 15.0
"""Height above the ground, and depth below it, which avoids gaps on slopes."""

WOOD_CORNER_COUNT = 11


def tetrahedra() -> list[Body]:
    """Return two hovering regular tetrahedra tip to tip, 30 m high. The upper one mirrors the lower one."""
    height = FIGURE_HEIGHT_M / 2 + TIP_OVERLAP_M / 2
    radius = height / np.sqrt(2)  # from the centre of a face to its corners
    azimuth = np.radians([90, 210, 330])
    foot = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.zeros(3)])
    lower = np.vstack([foot, [0, 0, height]])
    upper = [0, 0, FIGURE_HEIGHT_M] - lower
    return [hull(lower + [0, 0, HOVER_HEIGHT_M], (0.72, 0.30, 0.22)), hull(upper + [0, 0, HOVER_HEIGHT_M], (0.25, 0.42, 0.62))]


def wood_hill() -> list[Body]:
    """Return a wood as one convex body, 170 m long and 13 m high: eleven uneven sides that lean in, and a vaulted top."""
    rng = np.random.default_rng(7)
    azimuth = 2 * np.pi * (np.arange(WOOD_CORNER_COUNT) + rng.uniform(-0.2, 0.2, WOOD_CORNER_COUNT)) / WOOD_CORNER_COUNT
    rim = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.array(WOOD_SIZE_M) / 2
    top = WOOD_HEIGHT_M
    rings = [(1.0, -WOOD_DEPTH_BELOW_GROUND_M), (1.0, 0.0), (0.93, 0.72 * top), (0.55, 0.96 * top)]
    points = [np.column_stack([rim * share, np.full(WOOD_CORNER_COUNT, up)]) for share, up in rings]
    return [hull(np.vstack([*points, [[0, 0, top]]]), (0.24, 0.33, 0.17))]
