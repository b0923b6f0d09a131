"""The main loop of a render process, which receives jobs through a pipe and sends back their results.

The service's own process never uses OpenGL; each render process has one OpenGL context. A render process is started by the method
``spawn`` of ``multiprocessing``. It computes products with the same functions as the command line. It ends when its pipe is
closed.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from skugga.api.compute import compute, draw_picture
from skugga.api.device_calibration import calibration
from skugga.api.encoding import as_picture, encode_exactly
from skugga.api.picture_cost import check_cost
from skugga.api.products.visibility import NEEDS_VISIBILITY
from skugga.api.resource_exhaustion import exhausted_error
from skugga.api.workers.block_tiles import TilePosition, empty_tile, tiles_of_array, tiles_of_picture
from skugga.api.workers.film_jobs import draw_film_frame, plan_first_frame
from skugga.api.workers.jobs import (
    Answer,
    BlockJob,
    BlockTiles,
    DescriptorJob,
    DescriptorPlanJob,
    DescriptorResult,
    Failure,
    FilmCheckJob,
    FilmCheckResult,
    FrameJob,
    HeartbeatRequest,
    HeartbeatResponse,
    Job,
    LevelKey,
    MapJob,
    PlanJob,
    PlanResult,
    PointJob,
    PointsJob,
    PreparationProgress,
    Result,
    Snapshot,
    SnapshotJob,
    WorkerReady,
    ZoomTiles,
)
from skugga.api.workers.map_jobs import map_file
from skugga.api.workers.map_plans import select_view_plan, unprobed_class
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.point_jobs import point_result, points_result
from skugga.api.workers.preparation import import_pvlib, prepare_level
from skugga.api.workers.process_life import lower_priority
from skugga.api.workers.worker_config import WorkerConfig
from skugga.api.workers.worker_state import MAX_SCENES, WorkerState, block_view, plan_of_tiles, representative_block
from skugga.selector.choices import StandaloneRequest
from skugga.selector.select import select
from skugga.shadows.passes import PassRecord
from skugga.shadows.plan import Plan
from skugga.terrain.cache import Missing
from skugga.terrain.casters.caster_types import Reach
from skugga.terrain.compiled import CORES
from skugga.terrain.compiling.ahead_of_time import (
    MAPS,
    MAPS_OF_CASTERS,
    MASKS,
    PICTURES,
    POINTS,
    PRODUCTS,
    SUN_HOURS,
    VIEWS,
    compile_ahead,
)
from skugga.terrain.compiling.farm import missing_tasks
from skugga.terrain.compiling.hooks import declare_product, missing_loop_compiler
from skugga.terrain.compiling.loop_cache import loop_store
from skugga.terrain.compiling.parent_process import end_with_parent
from skugga.terrain.describe import describe
from skugga.terrain.errors import GraphicsError, NoOpenGLError, RenderError, SkuggaError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.gl import device as gl
from skugga.terrain.gl.egl_devices import set_process_number
from skugga.terrain.level.level import SUN, Shadows
from skugga.terrain.scene import Scene

IDLE_STEP_DELAY_S = 1.0
"""Idle seconds before the next step of preparation for later jobs, such as opening a level."""

log = logging.getLogger("skugga.worker")


def run_job(job: Job, state: WorkerState) -> Result:
    """Run a job and return its result. Raises ``SkuggaError``."""
    if isinstance(job, DescriptorPlanJob):
        return _plan_of_descriptor(job, state)
    scene = job.request.applied_to(state.scenes.get(job.level))
    overrides = job.request.overrides.for_selector()
    declare_product(loop_group_of(job, scene))
    match job:
        case DescriptorJob():
            return DescriptorResult(describe(scene, *_view_with_name(scene, job.view)).model_dump_json())
        case PlanJob():
            plan = select_view_plan(scene, *_view_with_name(scene, job.view), overrides, job.level, state.measurements, job.policy)
            return PlanResult(plan.model_dump_json())
        case PointJob():
            return point_result(job, scene)
        case PointsJob():
            return points_result(job, scene)
        case BlockJob():
            return _block_tiles(job, scene, state)
        case MapJob():
            return _map_snapshot(job, scene, state)
        case FilmCheckJob():
            plan, moment = plan_first_frame(job, scene, state.measurements)
            _check_cost(plan, f"{moment.view.cols}x{moment.view.rows}", state)
            return FilmCheckResult(None if plan.predicted is None else plan.predicted.ms)
        case FrameJob():
            return draw_film_frame(job, scene, state.measurements)
        case SnapshotJob():
            scene = scene.at_second(job.seconds)
            view = scene.view(job.view, size=job.size) if job.camera is None else scene.view_from(job.camera, job.size)
            plan = select_view_plan(scene, view, job.view, overrides, job.level, state.measurements)
            _check_cost(plan, f"{view.cols}x{view.rows}", state)
            computed = compute(scene, view, job.request, plan, job.light)
            start = time.perf_counter()
            body = encode_exactly(
                as_picture(computed.array, job.request.product_record, computed.picture),
                job.request.product_record,
                job.request.options,
                job.format,
            )
            facts = _picture_record(plan.algorithms_text, computed.passes, computed.reach, state, job.level)
            return Snapshot(body=body, encode_ms=(time.perf_counter() - start) * 1000.0, **facts)


def loop_group_of(job: Job, scene: Scene) -> str:
    """Return the group of loops that a job needs: one of ``skugga.terrain.compiling.ahead_of_time.PRODUCTS``.

    A loop is a function that numba compiles. If the cache on disk lacks a loop of a group, all missing loops of the group are
    compiled together.
    """
    match job:
        case PointJob() | PointsJob():
            return POINTS
        case BlockJob() | MapJob() if job.request.product_record.when == "days":
            return SUN_HOURS
        case BlockJob() if job.request.product_record.needs == NEEDS_VISIBILITY and is_terrain_only(scene):
            return MASKS
        case SnapshotJob() | FrameJob() | FilmCheckJob() if _is_perspective(job, scene):
            return VIEWS
        case MapJob() | SnapshotJob() | FrameJob() | FilmCheckJob() if is_terrain_only(scene):
            return PICTURES
    return MAPS if is_terrain_only(scene) else MAPS_OF_CASTERS


def _is_perspective(job: SnapshotJob | FrameJob | FilmCheckJob, scene: Scene) -> bool:
    """Return whether a job draws a perspective view, either one of the level or that of a camera in the request."""
    view_spec = scene.loaded.level.views.get(job.view)
    return job.view != "map" if view_spec is None else view_spec.kind == "perspective"


def _plan_of_descriptor(job: DescriptorPlanJob, state: WorkerState) -> PlanResult:
    """Return the plan for a client's descriptor, with default shadow settings except those of the request."""
    descriptor = Descriptor.model_validate_json(job.descriptor_json)
    plan_request = StandaloneRequest(Shadows(), (SUN, *(lamp for lamp in descriptor.light_kinds if lamp != SUN)))
    plan = select(descriptor, plan_request, job.request.overrides.for_selector(), job.policy, state.device)
    return PlanResult(plan.model_dump_json())


def _check_cost(plan: Plan, subject: str, state: WorkerState) -> None:
    """Raise ``TooCostlyError`` if a picture by ``plan`` is expected to exceed the time limit of pictures.

    ``subject`` names the picture in the message. A plan by fixed rules has no expected time, so nothing is raised.
    """
    check_cost(plan, subject, state.max_picture_ms, "SKUGGA_RENDER_TIMEOUT_S")


def _block_tiles(job: BlockJob, scene: Scene, state: WorkerState) -> BlockTiles:
    """Return the encoded tiles of a block, drawn or from the cache of drawn blocks."""
    product = job.request.product_record
    if not product.needs or product.margin_px:
        return _tiles_of_array(job, scene, state)
    version = state.measurements.version_of(job.level)
    key = job.level, version, job.matrix_set, job.zoom, job.block_x, job.block_y, job.request.picture, product.needs
    cached = state.blocks.get(*key)
    is_new = isinstance(cached, Missing)
    if isinstance(cached, Missing):
        plan = _checked_plan(job, scene, state)
        picture = draw_picture(scene, block_view(job), product, plan)
        cached = picture, _block_record(job, plan, picture.passes, picture.reach, scene, state)
        state.blocks.put(*key, value=cached)
    picture, facts = cached
    start = time.perf_counter()
    tiles = tiles_of_picture(picture, job.request, scene, block_view(job), job.format, job.tiles_per_side)
    files = {place: body or empty_tile(job.request, job.format, job.tiles_per_side) for place, body in tiles.items()}
    return BlockTiles(tiles=files, encode_ms=(time.perf_counter() - start) * 1000.0, is_newly_drawn=is_new, **facts)


def _tiles_of_array(job: BlockJob, scene: Scene, state: WorkerState) -> BlockTiles:
    """Compute a whole block of a product as an array, and cut it into encoded tiles."""
    product, start = job.request.product_record, time.perf_counter()
    product.check(scene)
    plan = _checked_plan(job, scene, state) if product.needs else None
    computed = compute(scene, block_view(job), job.request, plan)
    encode_start = time.perf_counter()
    tiles: dict[TilePosition, bytes] = tiles_of_array(
        computed.array, job.request, scene.world, block_view(job), job.format, job.tiles_per_side
    )
    if plan is None:
        passes = (PassRecord(product.name, (encode_start - start) * 1000.0),)
        facts = _picture_record(product.name, passes, None, state, job.level)
    else:
        facts = _block_record(job, plan, computed.passes, computed.reach, scene, state)
    return BlockTiles(tiles=tiles, encode_ms=(time.perf_counter() - encode_start) * 1000.0, **facts)


def _checked_plan(job: BlockJob, scene: Scene, state: WorkerState) -> Plan:
    """Return the plan of a block. Raises ``TooCostlyError`` if the block is expected to take too long."""
    plan = plan_of_tiles(job, scene, state)
    _check_cost(plan, f"a block of {BLOCK_PX}x{BLOCK_PX}", state)
    return plan


def _block_record(
    job: BlockJob, plan: Plan, passes: Sequence[PassRecord], reach: Reach | None, scene: Scene, state: WorkerState
) -> dict[str, Any]:
    """Return the fields of ``BlockTiles`` on how a block was drawn: those of ``_picture_record``, and ``unprobed_class``."""
    map_class = unprobed_class(scene, block_view(job), job.request.overrides.for_selector(), job.level, state.measurements)
    return {**_picture_record(plan.algorithms_text, passes, reach, state, job.level), "unprobed_class": map_class}


def _map_snapshot(job: MapJob, scene: Scene, state: WorkerState) -> Snapshot:
    """Return the encoded map of a job. Maps of one CRS and scale share a plan."""
    overrides = job.request.overrides.for_selector()

    def plan_of(scale: Hashable, part: MapView) -> Plan:
        key = job.level, state.measurements.version_of(job.level), job.crs, scale, job.request.picture
        return state.plans.get(key, lambda: select_view_plan(scene, part, "map", overrides, job.level, state.measurements))

    encoded_map = map_file(scene, job, plan_of)
    facts = _picture_record(encoded_map.headline, encoded_map.passes, encoded_map.reach, state, job.level)
    return Snapshot(body=encoded_map.body, encode_ms=encoded_map.encode_ms, **facts)


def _view_with_name(scene: Scene, view: str | ZoomTiles) -> tuple[MapView | PerspectiveView, str]:
    """Return the view that stands for a request (a view's name, or the tiles of a zoom), and the view's name in its plan."""
    return (representative_block(scene, view), "map") if isinstance(view, ZoomTiles) else (scene.view(view), view)


def _picture_record(
    headline: str, passes: Sequence[PassRecord], reach: Reach | None, state: WorkerState, level: LevelKey
) -> dict[str, Any]:
    """Return the fields of ``BlockTiles`` and ``Snapshot`` that describe how a picture was drawn.

    ``reach`` is ``None`` unless a single sun lit the picture.
    """
    return {
        "headline": headline, "passes": tuple((pass_record.name, pass_record.ms) for pass_record in passes),
        "renderer": state.renderer, "plan_version": state.measurements.version_of(level),
        "reach_used_m": None if reach is None else reach.used_m, "reach_needed_m": None if reach is None else reach.needed_m,
        "reach_clipped": reach is not None and bool(reach.clipped),
    }  # fmt: skip


def run_worker(pipe: Connection, config: WorkerConfig) -> None:
    """Warm up, send ``WorkerReady``, then answer jobs from the pipe.

    The function returns when the pipe is closed, or after a fatal ``Failure``, which may have corrupted the OpenGL context.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the service, which ends this process
    end_with_parent()
    # The service has sent nothing yet, so a readable pipe has been closed: the service ended before ``end_with_parent`` was called.
    if pipe.poll(0):
        return
    lower_priority()
    os.environ.setdefault("LP_NUM_THREADS", str(config.gl_threads))
    set_process_number(config.number)
    from skugga.api.workers.warm_up import warm_up

    def report(task: str, done: int = 0, total: int = 0) -> None:
        pipe.send(PreparationProgress(task, done, total))

    compiled: list[str] = []

    def compile_products(products: Sequence[str]) -> None:
        compiled.extend(products)
        report(f"compiling loops for {products[0]}")
        compile_ahead(products, CORES, report)

    try:
        with missing_loop_compiler(compile_products):
            renderer = warm_up(config.expect_renderer, config.needs_opengl, report)
            if problem := loop_store().problem:
                report(problem)
            state = WorkerState(renderer, config.measurements or PlanMeasurements(calibration()), config.max_picture_ms)
            if compiled:  # a first start; later starts count missing loops in idle time
                count_missing_loops(state)
            version, egl_device = gl.renderer_and_version()[1], gl.egl_device_name()
            pipe.send(WorkerReady(state.renderer, state.device, version, egl_device, state.missing_loop_count))
            _process_jobs_of_pipe(pipe, state, [partial(count_missing_loops, state), import_pvlib])
    except SkuggaError as error:
        pipe.send(Failure.from_error(error, is_fatal=True))
    except (EOFError, OSError):
        return


def count_missing_loops(state: WorkerState) -> None:
    """Set ``state.missing_loop_count`` to the number of loops without machine code in the cache on disk.

    Importing the modules of all loops takes time.
    """
    state.missing_loop_count = len(missing_tasks(PRODUCTS))


def _process_jobs_of_pipe(pipe: Connection, state: WorkerState, idle_steps: Sequence[Callable[[], None]]) -> None:
    """Answer jobs, heartbeat requests and new ``PlanMeasurements`` from the pipe, until a job fails fatally.

    While nothing arrives, run the functions ``idle_steps`` one after another. Raises ``EOFError`` or ``OSError`` when the pipe is
    closed.
    """
    steps = deque(idle_steps)
    while True:
        while steps and not pipe.poll(IDLE_STEP_DELAY_S):
            steps.popleft()()
        job = pipe.recv()
        if isinstance(job, HeartbeatRequest):
            pipe.send(HeartbeatResponse(state.missing_loop_count))
            # Missing loops are being compiled in the background on all cores, so this time is not idle.
            blocks = () if state.missing_loop_count else job.preload_blocks[:MAX_SCENES]
            steps.extend(partial(prepare_level, block, state) for block in blocks)
            continue
        if isinstance(job, PlanMeasurements):
            state.measurements = job
            continue
        answer = _try_job(job, state)
        pipe.send(answer)
        if isinstance(answer, Failure) and answer.is_fatal:
            return


def _try_job(job: Job, state: WorkerState) -> Answer:
    """Run a job and return its result, or its error as data. After an error of OpenGL or an unexpected one the process must end."""
    try:
        return run_job(job, state)
    except SkuggaError as error:
        is_fatal = isinstance(error, GraphicsError) and not isinstance(error, NoOpenGLError)
        return Failure.from_error(exhausted_error(error) or error, is_fatal=is_fatal)
    except Exception as error:  # a bug or an exception of a driver: the job fails and the process ends
        log.exception("a job failed unexpectedly")
        is_fatal = not isinstance(job, DescriptorPlanJob)  # these jobs do not touch OpenGL
        return Failure.from_error(exhausted_error(error) or RenderError(f"{type(error).__name__}: {error}"), is_fatal=is_fatal)
