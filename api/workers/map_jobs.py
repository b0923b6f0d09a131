"""Compute and encode maps of any extent in a render process."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.api.compute import compute
from skugga.api.encoding import ARRAY_FORMATS, apply_color_scale, composite_over, encode
from skugga.api.workers.jobs import MapJob
from skugga.shadows.passes import PassRecord
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.terrain.casters.caster_types import NO_CASTERS, Reach
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.geo.grid import BLOCK_PX, MapView, map_view
from skugga.terrain.scene import Scene

PIXEL_STEP_DIGITS = 9
"""Significant digits of a map's pixel steps in the key of its plan.

Maps of one scale share a plan, although their steps differ by rounding errors."""


@dataclass(frozen=True, eq=False)
class EncodedMap:
    """The encoded file of a map, with facts about its rendering.

    Attributes
    ----------
    body : bytes
        The file.
    encode_ms : float
        Duration of encoding in milliseconds.
    headline : str
        Algorithms of the plan, or the name of a product that needs no plan.
    passes : tuple of PassRecord
        Name and milliseconds of each render pass.
    reach : Reach or None
        Distance towards the sun in which shadow casters were searched; ``None`` unless a single sun lit the map.
    """

    body: bytes
    encode_ms: float
    headline: str
    passes: tuple[PassRecord, ...] = ()
    reach: Reach | None = None


def requested_map_view(scene: Scene, job: MapJob) -> tuple[MapView, bool]:
    """Return the view that a map job requests, and whether its extent overlaps the level's data. Raises ``InputError``."""
    if job.bounds is not None and job.crs is not None:
        crs = CRS.from_user_input(job.crs)
        if not scene.overlaps(crs, job.bounds):
            return map_view(scene.world, crs, job.bounds, rows=job.size[1], cols=job.size[0]), False
    view = scene.view("map", job.bounds, job.crs, job.size)
    assert isinstance(view, MapView)
    return view, True


def representative_part(scene: Scene, view: MapView) -> tuple[Hashable, MapView]:
    """Return the key of a map's CRS and scale, and a block at the level's middle in that CRS and scale.

    All maps of the level with this key share the plan of this block, as the tiles of a zoom share one plan. The block is a
    map view of ``BLOCK_PX`` pixels a side.
    """
    row_step, col_step = (float(f"{step:.{PIXEL_STEP_DIGITS}g}") for step in (view.row_step, view.col_step))
    rows, cols = extent_on_grid(scene.world, scene.elevation, view.grid)
    row0, col0 = (
        float(sum(ends) / 2 // (BLOCK_PX * step)) * BLOCK_PX * step for ends, step in ((rows, row_step), (cols, col_step))
    )
    part = MapView(view.grid, row0, col0, row_step, col_step, BLOCK_PX, BLOCK_PX)
    return (view.grid, row_step, col_step), part


def map_file(scene: Scene, job: MapJob, plan_of: Callable[[Hashable, MapView], Plan]) -> EncodedMap:
    """Compute and encode a map. Raises ``SkuggaError``.

    ``plan_of`` returns the plan for the key and the block of ``representative_part``.
    """
    request, (view, has_data) = job.request, requested_map_view(scene, job)
    product, start = request.product_record, time.perf_counter()
    if not has_data:
        empty = product.empty_array if job.format in ARRAY_FORMATS else product.empty_picture
        array = empty(request.options, view.rows, view.cols, scene.height_range_m[0])
        if product.needs:
            return _map_file(job, array, view, NO_SHADOWS, (), NO_CASTERS.reach)
        return _map_file(job, array, view, product.name, (_only_pass(product.name, start),), None)
    product.check(scene)
    plan = plan_of(*representative_part(scene, view)) if product.needs else None
    computed = compute(scene, view, request, plan)
    array = apply_color_scale(computed.array, product, request.options, scene.world, job.format)
    if plan is None:
        return _map_file(job, array, view, product.name, (_only_pass(product.name, start),), None)
    return _map_file(job, array, view, plan.algorithms_text, computed.passes, computed.reach)


def _only_pass(name: str, start_s: float) -> PassRecord:
    """Return the only pass record of a product without render passes, with the name ``name``.

    ``start_s`` is the begin of its computation, in seconds of the performance counter.
    """
    return PassRecord(name, (time.perf_counter() - start_s) * 1000.0)


def _map_file(
    job: MapJob, array: np.ndarray, view: MapView, headline: str, passes: tuple[PassRecord, ...], reach: Reach | None
) -> EncodedMap:
    """Encode a map as a file. ``array`` has its values, and ``headline`` names the algorithms of its plan or its product."""
    start = time.perf_counter()
    body = encode(_composite_over(array, job.background), job.request.product_record, job.request.options, job.format, view)
    return EncodedMap(body, (time.perf_counter() - start) * 1000.0, headline, passes, reach)


def _composite_over(array: np.ndarray, background: str | None) -> np.ndarray:
    """Composite a picture with alpha over the colour ``background`` (``RRGGBB``). Return any other array unchanged."""
    if background is None or array.ndim != 3 or array.shape[2] != 4:
        return array
    red, green, blue = bytes.fromhex(background)
    return composite_over(array, (red, green, blue))
