"""What a render process does of maps of any extent, and of heights in colours: it has their levels open."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.api.layers import LAYERS, HeightEncoding, encoded_heights, map_layer, nodata_height_m
from skugga.api.sun_hours_layer import SUN_HOURS_LAYER, sun_hours_picture
from skugga.api.workers.block_tiles import empty_layer, encode
from skugga.api.workers.jobs import MapJob
from skugga.shadows.passes import PassRecord
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.render import render_frame
from skugga.terrain.casters.reach import NO_CASTERS, Reach
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.geo.grid import BLOCK_PX, MapView, blocks_of, map_view
from skugga.terrain.scene import Scene

HEIGHTS = "heights"
"""What a picture of heights says that drew it."""

STEP_DIGITS = 9
"""Of a map's steps, by which its plan goes: two maps of one scale differ by rounding alone."""


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """A map's file, and what is said of what drew it; ``reach`` is ``None`` where no one sun did."""

    body: bytes
    encode_ms: float
    headline: str
    passes: tuple[PassRecord, ...] = ()
    reach: Reach | None = None


def map_asked(scene: Scene, job: MapJob) -> tuple[MapView, bool]:
    """The view of a map of a level, and whether it shows any of its data. Raises ``InputError``."""
    if job.bounds is not None and job.crs is not None:
        crs = CRS.from_user_input(job.crs)
        if not scene.shows(crs, job.bounds):
            return map_view(scene.world, crs, job.bounds, rows=job.size[1], cols=job.size[0]), False
    view = scene.view("map", job.bounds, job.crs, job.size)
    assert isinstance(view, MapView)
    return view, True


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


def drawn_map(scene: Scene, job: MapJob, plan_of: Callable[[Hashable, MapView], Plan]) -> DrawnMap:
    """Draw a map; ``plan_of`` gives the plan of a part of a scale. Raises ``SkuggaError``."""
    view, shown = map_asked(scene, job)
    start = clock.perf_counter()
    encoding = None if job.layer == SUN_HOURS_LAYER else LAYERS[job.layer].encoding
    if encoding is not None:
        heights = heights_picture(scene, view, encoding, shown)
        return _encoded(job, heights, view, HEIGHTS, (PassRecord(HEIGHTS, _ms(start)),))
    if job.sun_hours is not None:
        picture = (
            sun_hours_picture(scene, view.as_nodes(), job.sun_hours) if shown else empty_layer(job.layer, view.rows, view.cols, 0.0)
        )
        return _encoded(job, picture, view, SUN_HOURS_LAYER, (PassRecord(SUN_HOURS_LAYER, _ms(start)),))
    if not shown:
        return _encoded(job, empty_layer(job.layer, view.rows, view.cols, 0.0), view, NO_SHADOWS, (), NO_CASTERS.reach)
    plan = plan_of(*planned_part(scene, view))
    frame = render_frame(scene, view, plan)
    return _encoded(job, map_layer(frame, job.layer), view, plan.headline, frame.passes, frame.reach)


def heights_picture(scene: Scene, view: MapView, encoding: HeightEncoding, shown: bool = True) -> np.ndarray:
    """The heights of a map's ground in an encoding; of one that is not ``shown``, of none. Holes are filled as they
    are for casting shadows; off the data the height is that of ``skugga.api.layers.nodata_height_m``.
    """
    nodes, height_m = view.as_nodes(), np.full((view.rows, view.cols), np.nan, np.float32)
    surface = scene.surface(nodes.grid)
    for part, row, col in blocks_of(nodes) if shown else ():
        known, _ = surface.heights(int(part.row0), int(part.col0), part.rows, part.cols)
        into = height_m[max(row, 0) : row + part.rows, max(col, 0) : col + part.cols]
        into[...] = known[max(-row, 0) :, max(-col, 0) :][: into.shape[0], : into.shape[1]]
    return encoded_heights(height_m, nodata_height_m(scene.height_range_m[0]), encoding)


def _encoded(
    job: MapJob, array: np.ndarray, view: MapView, headline: str, passes: tuple[PassRecord, ...], reach: Reach | None = None
) -> DrawnMap:
    start = clock.perf_counter()
    if job.background is not None and array.ndim == 3 and array.shape[2] == 4:
        array = _over(array, job.background)
    return DrawnMap(encode(array, job.layer, job.format, view), _ms(start), headline, passes, reach)


def _over(picture: np.ndarray, background: str) -> np.ndarray:
    """A picture RGBA over an opaque colour ``RRGGBB``, as RGBA."""
    alpha = picture[..., 3:].astype(np.float32) / 255.0
    behind = np.array([int(background[i : i + 2], 16) for i in (0, 2, 4)], np.float32)
    color = np.rint(picture[..., :3] * alpha + behind * (1.0 - alpha)).astype(np.uint8)
    return np.concatenate([color, np.full_like(picture[..., 3:], 255)], axis=-1)


def _ms(start: float) -> float:
    return (clock.perf_counter() - start) * 1000.0
