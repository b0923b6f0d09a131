"""The part of a level that stands for all its maps of a scale: plans are made for it, and it is probed."""

from __future__ import annotations

from collections.abc import Hashable

from terrain.casters.slopes import extent_on_grid
from terrain.geo.grid import BLOCK_PX, MapView
from terrain.scene import Scene

STEP_DIGITS = 9
"""Of a map's steps, by which its plan goes: two maps of one scale differ by rounding alone."""


def planned_part(scene: Scene, view: MapView) -> tuple[Hashable, MapView]:
    """The part of a level that stands for all its maps of a scale in a CRS, by which they are planned, as tiles of a zoom are; and
    what tells the scale.
    """
    row_step, col_step = (float(f"{step:.{STEP_DIGITS}g}") for step in (view.row_step, view.col_step))
    rows, cols = extent_on_grid(scene.world, scene.elevation, view.grid)
    row0, col0 = (
        float(sum(ends) / 2 // (BLOCK_PX * step)) * BLOCK_PX * step for ends, step in ((rows, row_step), (cols, col_step))
    )
    part = MapView(view.grid, row0, col0, row_step, col_step, BLOCK_PX, BLOCK_PX)
    return (view.grid, row_step, col_step), part
