"""``render_frame``: a plan executed on a scene and a view. Deferred: geometry, then visibility, then shading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shadows import shadow_map, truth
from shadows.attached import attached
from shadows.passes import PassLog, PassRecord
from shadows.plan import Plan
from terrain.errors import InputError, RenderError
from terrain.geometry import map_geometry
from terrain.grid import MapView, blocks_of
from terrain.reach import Reach, casters_of
from terrain.scene import Scene
from terrain.shading import shade

GEOMETRY_PASS = "geometry"
CASTERS_PASS = "casters"
SHADING_PASS = "shading"

FILLS = {"shadow_map": shadow_map.fill, "truth": truth.fill}
"""Algorithm -> what fills the visibility of one light for a buffer's points; ``none`` needs nothing."""

MAX_PIXELS = 64_000_000
"""Largest frame: about 1.3 GB of layers."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered view. Arrays are (rows, cols, ...), row 0 the northern one.

    ``color`` uint8 sRGB; ``visibility`` float32 of the sun in [0, 1], NaN where there is no surface; ``height_m`` float32
    likewise; ``passes`` what really ran.
    """

    view: MapView
    plan: Plan
    color: np.ndarray
    visibility: np.ndarray
    height_m: np.ndarray
    passes: tuple[PassRecord, ...]
    reach: Reach

    @property
    def there(self) -> np.ndarray:
        """Where there is a surface."""
        return ~np.isnan(self.visibility)

    @property
    def nbytes(self) -> int:
        """Bytes of the layers."""
        return self.color.nbytes + self.visibility.nbytes + self.height_m.nbytes


def render_frame(scene: Scene, view: MapView, plan: Plan, on_block: Callable[[int, int], None] | None = None) -> Frame:
    """Execute a plan; ``on_block(done, total)`` is called after each block.

    Raises ``RenderError`` where the work fails or where other passes ran than the plan lists.
    """
    if view.rows * view.cols > MAX_PIXELS:
        raise InputError("size", f"{view.cols}x{view.rows}", f"at most {MAX_PIXELS} pixels")
    color = np.zeros((view.rows, view.cols, 3), np.uint8)
    visibility = np.full((view.rows, view.cols), np.nan, np.float32)
    height = np.full((view.rows, view.cols), np.nan, np.float32)
    log, reach = PassLog(), Reach(0.0, 0.0, False)
    blocks = blocks_of(view)
    for done, (block, row, col) in enumerate(blocks, start=1):
        *layers, block_reach = _render_block(scene, block, plan, log)
        reach = _worse(reach, block_reach)
        ours = (
            slice(max(row, 0), min(row + block.rows, view.rows)),
            slice(max(col, 0), min(col + block.cols, view.cols)),
        )
        theirs = tuple(slice(s.start - o, s.stop - o) for s, o in zip(ours, (row, col), strict=True))
        for whole, part in zip((color, visibility, height), layers, strict=True):
            whole[ours] = part[theirs]
        if on_block is not None:
            on_block(done, len(blocks))
    if log.names != plan.passes:
        raise RenderError(f"the passes that ran ({', '.join(log.names)}) are not the plan's ({', '.join(plan.passes)})")
    return Frame(view, plan, color, visibility, height, tuple(log.records.values()), reach)


def _render_block(scene: Scene, block: MapView, plan: Plan, log: PassLog) -> tuple[np.ndarray, np.ndarray, np.ndarray, Reach]:
    with log.run(GEOMETRY_PASS):
        frame = scene.world.frame_near(block.grid.crs, *block.centre)
        buffer = map_geometry(scene.surface(block.grid), block, frame)
    with log.run(CASTERS_PASS):
        casters = casters_of(scene, buffer)
    visibility = np.ones(buffer.there.shape, np.float32)
    for kind, name in plan.algorithm["sun"].items():
        if name in FILLS:
            visibility *= FILLS[name](buffer, scene, casters, plan.settings["sun"][kind], log)
    with log.run(SHADING_PASS):
        visibility[attached(buffer, scene)] = 0.0
        color = shade(buffer, scene, visibility)
        visibility[~buffer.there] = np.nan
    return color, visibility, buffer.height_m, casters.reach


def _worse(a: Reach, b: Reach) -> Reach:
    """The reach to report of two blocks: a clipped one before a whole one, then the farther one."""
    return max(a, b, key=lambda reach: (reach.clipped, reach.needed_m, -reach.used_m))
