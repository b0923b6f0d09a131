"""Maps of any extent, drawn in a render process."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.api.compute import compute
from skugga.api.encoding import ARRAY_FORMATS, colored, encode, over
from skugga.api.workers.jobs import MapJob
from skugga.shadows.passes import PassRecord
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.terrain.casters.reach import NO_CASTERS, Reach
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.geo.grid import BLOCK_PX, MapView, map_view
from skugga.terrain.scene import Scene

STEP_DIGITS = 9
"""Significant digits of a map's pixel steps in the key of its plan: steps of one scale differ by rounding only."""


@dataclass(frozen=True, eq=False)
class EncodedMap:
    """A map's file with facts about its drawing; ``reach`` is ``None`` unless a single sun lit it."""

    body: bytes
    encode_ms: float
    headline: str
    passes: tuple[PassRecord, ...] = ()
    reach: Reach | None = None


def requested_map_view(scene: Scene, job: MapJob) -> tuple[MapView, bool]:
    """Return the view of a map, and whether it shows any data of the level. Raises ``InputError``."""
    if job.bounds is not None and job.crs is not None:
        crs = CRS.from_user_input(job.crs)
        if not scene.overlaps(crs, job.bounds):
            return map_view(scene.world, crs, job.bounds, rows=job.size[1], cols=job.size[0]), False
    view = scene.view("map", job.bounds, job.crs, job.size)
    assert isinstance(view, MapView)
    return view, True


def representative_part(scene: Scene, view: MapView) -> tuple[Hashable, MapView]:
    """Return the key of a map's scale, and the part of the level that stands for all its maps of that scale and CRS.

    All these maps share the plan of that part, like the tiles of a zoom.
    """
    row_step, col_step = (float(f"{step:.{STEP_DIGITS}g}") for step in (view.row_step, view.col_step))
    rows, cols = extent_on_grid(scene.world, scene.elevation, view.grid)
    row0, col0 = (
        float(sum(ends) / 2 // (BLOCK_PX * step)) * BLOCK_PX * step for ends, step in ((rows, row_step), (cols, col_step))
    )
    part = MapView(view.grid, row0, col0, row_step, col_step, BLOCK_PX, BLOCK_PX)
    return (view.grid, row_step, col_step), part


def map_file(scene: Scene, job: MapJob, plan_of: Callable[[Hashable, MapView], Plan]) -> EncodedMap:
    """Compute a map; ``plan_of`` returns the plan of a scale from its key and part. Raises ``SkuggaError``."""
    request, (view, has_data) = job.request, requested_map_view(scene, job)
    product, start = request.product_record, clock.perf_counter()
    if not has_data:
        empty = product.empty_array if job.format in ARRAY_FORMATS else product.empty_picture
        array = empty(view.rows, view.cols, scene.height_range_m[0])
        if product.needs:
            return _map_file(job, array, view, NO_SHADOWS, (), NO_CASTERS.reach)
        return _map_file(job, array, view, product.name, (_single_pass(product.name, start),), None)
    product.check(scene)
    plan = plan_of(*representative_part(scene, view)) if product.needs else None
    computed = compute(scene, view, request, plan)
    array = colored(computed.array, product, request.options, scene.world, job.format)
    if plan is None:
        return _map_file(job, array, view, product.name, (_single_pass(product.name, start),), None)
    return _map_file(job, array, view, plan.headline, computed.passes, computed.reach)


def _single_pass(name: str, start: float) -> PassRecord:
    """Return the record of a product without passes, which started at ``start`` of the performance counter."""
    return PassRecord(name, (clock.perf_counter() - start) * 1000.0)


def _map_file(
    job: MapJob, array: np.ndarray, view: MapView, headline: str, passes: tuple[PassRecord, ...], reach: Reach | None
) -> EncodedMap:
    start = clock.perf_counter()
    body = encode(_over(array, job.background), job.request.product_record, job.format, view)
    return EncodedMap(body, (clock.perf_counter() - start) * 1000.0, headline, passes, reach)


def _over(array: np.ndarray, background: str | None) -> np.ndarray:
    """Composite a picture with alpha over a background ``RRGGBB``, if one is given."""
    if background is None or array.ndim != 3 or array.shape[2] != 4:
        return array
    red, green, blue = bytes.fromhex(background)
    return over(array, (red, green, blue))
