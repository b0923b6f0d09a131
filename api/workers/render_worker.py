"""A render process: it owns the one OpenGL context, takes jobs over a pipe and answers with values.

It is started by ``spawn`` and draws with ``render_frame`` like anyone else. It ends when its pipe is closed.
"""

from __future__ import annotations

import logging
import os
import signal
import time as clock
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from skugga.api.device_calibration import calibration
from skugga.api.layers import LAYERS, PASS_LAYERS, encode_picture, frame_layer, viewable
from skugga.api.picture_cost import check_cost
from skugga.api.sun_hours_layer import SUN_HOURS_LAYER, sun_hours_picture
from skugga.api.workers.block_tiles import cut_tiles, encoded_tiles
from skugga.api.workers.drawn_blocks import drawn_block
from skugga.api.workers.film_jobs import film_picture, first_plan
from skugga.api.workers.jobs import (
    Answer,
    BlockJob,
    BlockTiles,
    DescribedPlanJob,
    DescriptorAnswer,
    DescriptorJob,
    Failure,
    FilmChecked,
    FilmCheckJob,
    FrameJob,
    Job,
    LevelKey,
    MapJob,
    Ping,
    PlanAnswer,
    PlanJob,
    PointJob,
    PointsJob,
    Pong,
    Preparing,
    Ready,
    Result,
    Snapshot,
    SnapshotJob,
    SunHoursJob,
    Tiles,
)
from skugga.api.workers.map_jobs import HEIGHTS, drawn_map, heights_picture
from skugga.api.workers.map_plans import plan_in_service, unprobed_class
from skugga.api.workers.plan_basis import PlanBasis
from skugga.api.workers.point_jobs import point_answer, points_answer
from skugga.api.workers.preparation import import_pvlib, prepare_level
from skugga.api.workers.process_life import stand_back
from skugga.api.workers.worker_config import WorkerConfig
from skugga.api.workers.worker_state import MAX_SCENES, WorkerState, block_view, plan_of_tiles, tiles_view
from skugga.selector.choices import StandaloneRequest
from skugga.selector.select import select
from skugga.shadows.ground_pictures import ShownMap
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import Missing
from skugga.terrain.compiled import CORES
from skugga.terrain.compiling.ahead import MAPS, MAPS_OF_CASTERS, PICTURES, POINTS, PRODUCTS, SUN_HOURS, VIEWS, compile_ahead
from skugga.terrain.compiling.farm import missing_tasks
from skugga.terrain.compiling.hooks import compiled_by, need
from skugga.terrain.compiling.loop_cache import loop_store
from skugga.terrain.compiling.parent_process import end_with_parent
from skugga.terrain.describe import describe
from skugga.terrain.errors import GraphicsError, NoOpenGLError, RenderError, SkuggaError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.covered_nodes import is_bare
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.gl import device as gl
from skugga.terrain.gl.egl_devices import take_turn
from skugga.terrain.level.level import SUN, Shadows
from skugga.terrain.scene import Scene

IDLE_S = 1.0
"""How long a process that is ready waits for a job before it prepares for later ones."""

log = logging.getLogger("skugga.worker")


def run_job(job: Job, state: WorkerState) -> Result:
    """Do a job. Raises ``SkuggaError``."""
    if isinstance(job, DescribedPlanJob):
        return _plan_of_facts(job, state)
    scene = job.request.seen(state.scenes.get(job.level))
    overrides = job.request.overrides.for_selector()
    need(product_of(job, scene))
    match job:
        case DescriptorJob():
            return DescriptorAnswer(describe(scene, *_seen(scene, job.view)).model_dump_json())
        case PlanJob():
            plan = plan_in_service(scene, *_seen(scene, job.view), overrides, job.level, state.basis, job.policy)
            return PlanAnswer(plan.model_dump_json())
        case PointJob():
            return point_answer(job, scene)
        case PointsJob():
            return points_answer(job, scene)
        case BlockJob():
            return _block_tiles(job, scene, state)
        case SunHoursJob():
            picture = partial(sun_hours_picture, scene, block_view(job), job.query)
            return _pictured_tiles(job, SUN_HOURS_LAYER, state, picture)
        case MapJob():
            return _map(job, scene, state)
        case FilmCheckJob():
            plan, moment = first_plan(job, scene, state.basis)
            _check_cost(plan, f"{moment.view.cols}x{moment.view.rows}", state)
            return FilmChecked(None if plan.predicted is None else plan.predicted.ms)
        case FrameJob():
            return film_picture(job, scene, state.basis)
        case SnapshotJob():
            scene = scene.at_second(job.seconds)
            view = scene.view(job.view, size=job.size) if job.seen_from is None else scene.view_from(job.seen_from, job.size)
            plan = plan_in_service(scene, view, job.view, overrides, job.level, state.basis)
            _check_cost(plan, f"{view.cols}x{view.rows}", state)
            frame = render_frame(scene, view, plan, layers=PASS_LAYERS & {job.layer})
            start = clock.perf_counter()
            array = frame_layer(scene, frame.under(job.light), job.layer)
            body = encode_picture(viewable(job.layer, array, frame.color), f".{job.format}")
            return Snapshot(
                body=body, encode_ms=(clock.perf_counter() - start) * 1000.0, **_facts(frame.plan, frame, state, job.level)
            )


def product_of(job: Job, scene: Scene) -> str:
    """Return the product of a job, whose loops are compiled together where one is missing."""
    match job:
        case PointJob() | PointsJob():
            return POINTS
        case SunHoursJob():
            return SUN_HOURS
        case SnapshotJob() | FrameJob() | FilmCheckJob() if _is_perspective(job, scene):
            return VIEWS
        case MapJob() | SnapshotJob() | FrameJob() | FilmCheckJob() if is_bare(scene):
            return PICTURES
    return MAPS if is_bare(scene) else MAPS_OF_CASTERS


def _is_perspective(job: SnapshotJob | FrameJob | FilmCheckJob, scene: Scene) -> bool:
    """Whether a job is of a camera: of one that the request places, or of a level's own view."""
    named = scene.loaded.level.views.get(job.view)
    return job.view != "map" if named is None else named.kind == "perspective"


def _plan_of_facts(job: DescribedPlanJob, state: WorkerState) -> PlanAnswer:
    described = Descriptor.model_validate_json(job.descriptor_json)
    asked = StandaloneRequest(Shadows(), (SUN, *(lamp for lamp in described.light_kinds if lamp != SUN)))
    plan = select(described, asked, job.request.overrides.for_selector(), job.policy, state.device)
    return PlanAnswer(plan.model_dump_json())


def _check_cost(plan: Plan, subject: str, state: WorkerState) -> None:
    """Raise ``TooCostlyError`` where a calibrated device is expected to take longer than a picture may."""
    check_cost(plan, subject, state.most_ms, "SKUGGA_RENDER_TIMEOUT_S")


def _block_tiles(job: BlockJob, scene: Scene, state: WorkerState) -> BlockTiles:
    encoding = LAYERS[job.layer].encoding
    if encoding is not None:
        return _pictured_tiles(job, HEIGHTS, state, lambda: heights_picture(scene, block_view(job), encoding))
    points = LAYERS[job.layer].of_points
    version = state.basis.version_of(job.level)
    key = job.level, version, job.matrix_set, job.zoom, job.block_x, job.block_y, job.request, points
    kept = state.blocks.get(*key)
    if isinstance(kept, Missing):
        plan = plan_of_tiles(job, scene, state)
        _check_cost(plan, f"a block of {BLOCK_PX}x{BLOCK_PX}", state)
        block, shown = drawn_block(scene, block_view(job), plan, job.layer)
        overrides = job.request.overrides.for_selector()
        unprobed = unprobed_class(scene, block_view(job), overrides, job.level, state.basis)
        kept = block, {**_facts(plan, shown, state, job.level), "unprobed": unprobed}
        state.blocks.put(*key, value=kept)
        drawn = True
    else:
        drawn = False
    block, facts = kept
    start = clock.perf_counter()
    tiles = encoded_tiles(block, job.layer, job.format, job.tiles, block_view(job))
    return BlockTiles(tiles=tiles, encode_ms=(clock.perf_counter() - start) * 1000.0, drawn=drawn, **facts)


def _pictured_tiles(job: BlockJob | SunHoursJob, name: str, state: WorkerState, picture: Callable[[], np.ndarray]) -> BlockTiles:
    """Tiles of a block's picture that no one sun drew."""
    start = clock.perf_counter()
    drawn = picture()
    found = clock.perf_counter()
    layer = job.layer if isinstance(job, BlockJob) else SUN_HOURS_LAYER
    tiles = cut_tiles(drawn, layer, job.format, job.tiles, block_view(job))
    return BlockTiles(
        tiles=tiles, encode_ms=(clock.perf_counter() - found) * 1000.0, headline=name,
        passes=((name, (found - start) * 1000.0),), reach_used_m=None, reach_needed_m=None, reach_clipped=False,
        renderer=state.renderer, plan_version=state.basis.version_of(job.level),
    )  # fmt: skip


def _map(job: MapJob, scene: Scene, state: WorkerState) -> Snapshot:
    overrides = job.request.overrides.for_selector()

    def plan_of(scale: Hashable, part: MapView) -> Plan:
        key = job.level, state.basis.version_of(job.level), job.crs, scale, job.request
        return state.plans.get(key, lambda: plan_in_service(scene, part, "map", overrides, job.level, state.basis))

    drawn = drawn_map(scene, job, plan_of)
    reach = drawn.reach
    return Snapshot(
        body=drawn.body, encode_ms=drawn.encode_ms, headline=drawn.headline,
        passes=tuple((record.name, record.ms) for record in drawn.passes),
        reach_used_m=None if reach is None else reach.used_m, reach_needed_m=None if reach is None else reach.needed_m,
        reach_clipped=reach is not None and bool(reach.clipped), renderer=state.renderer,
        plan_version=state.basis.version_of(job.level),
    )  # fmt: skip


def _seen(scene: Scene, view: str | Tiles) -> tuple[MapView | PerspectiveView, str]:
    """A view, and the name that its plan has."""
    return (tiles_view(scene, view), "map") if isinstance(view, Tiles) else (scene.view(view), view)


def _facts(plan: Plan, frame: Frame | ShownMap, state: WorkerState, level: LevelKey) -> dict[str, Any]:
    """What a picture says of what drew it."""
    return {
        "headline": plan.headline, "passes": tuple((record.name, record.ms) for record in frame.passes),
        "renderer": state.renderer, "plan_version": state.basis.version_of(level),
        "reach_used_m": frame.reach.used_m, "reach_needed_m": frame.reach.needed_m, "reach_clipped": bool(frame.reach.clipped),
    }  # fmt: skip


def run_worker(pipe: Connection, config: WorkerConfig) -> None:
    """Warm up, say so, then answer jobs until the pipe is closed or an error leaves OpenGL in doubt."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's interrupt is for the service, which ends this process
    end_with_parent()
    if pipe.poll(0):  # nothing is sent before this process is ready: the service has ended before that could be noted
        return
    stand_back()
    os.environ.setdefault("LP_NUM_THREADS", str(config.gl_threads))
    take_turn(config.number)
    from skugga.api.workers.warm_up import warm_up

    def say(task: str, done: int = 0, total: int = 0) -> None:
        pipe.send(Preparing(task, done, total))

    compiled: list[str] = []

    def compile_products(products: Sequence[str]) -> None:
        compiled.extend(products)
        say(f"compiling loops for {products[0]}")
        compile_ahead(products, CORES, say)

    try:
        with compiled_by(compile_products):
            renderer = warm_up(config.expect_renderer, config.needs_opengl, say)
            if problem := loop_store().problem:
                say(problem)
            state = WorkerState(renderer, config.basis or PlanBasis(calibration()), config.most_ms)
            if compiled:  # a first start: more is missing. Else that is looked for while nothing is asked
                count_missing_loops(state)
            version, egl_device = gl.renderer_and_version()[1], gl.egl_device_name()
            pipe.send(Ready(state.renderer, state.device, version, egl_device, state.missing_loops))
            _answer_jobs(pipe, state, [partial(count_missing_loops, state), import_pvlib])
    except SkuggaError as error:
        pipe.send(Failure.of(error, fatal=True))
    except (EOFError, OSError):
        return


def count_missing_loops(state: WorkerState) -> None:
    """Count the recorded loops that are stored nowhere; this imports the modules of all loops."""
    state.missing_loops = len(missing_tasks(PRODUCTS))


def _answer_jobs(pipe: Connection, state: WorkerState, idle_steps: Sequence[Callable[[], None]]) -> None:
    """Answer jobs until one ends the process. Do one idle step after the other while none comes.

    Raises ``EOFError`` or ``OSError`` when the pipe is closed.
    """
    steps = deque(idle_steps)
    while True:
        while steps and not pipe.poll(IDLE_S):
            steps.popleft()()
        job = pipe.recv()
        if isinstance(job, Ping):
            pipe.send(Pong(state.missing_loops))
            # While loops are missing they are compiled in the background, on all cores: that is no idle time.
            blocks = () if state.missing_loops else job.first_blocks[:MAX_SCENES]
            steps.extend(partial(prepare_level, block, state) for block in blocks)
            continue
        if isinstance(job, PlanBasis):
            state.basis = job
            continue
        answer = _answer(job, state)
        pipe.send(answer)
        if isinstance(answer, Failure) and answer.fatal:
            return


def _answer(job: Job, state: WorkerState) -> Answer:
    try:
        return run_job(job, state)
    except SkuggaError as error:
        in_doubt = isinstance(error, GraphicsError) and not isinstance(error, NoOpenGLError)
        return Failure.of(error, fatal=in_doubt)
    except Exception as error:  # a bug, or a driver's own exception: the job fails, and the process with it
        log.exception("a job failed unexpectedly")
        fatal = not isinstance(job, DescribedPlanJob)  # arithmetic on what a client sent leaves nothing behind in OpenGL
        return Failure.of(RenderError(f"{type(error).__name__}: {error}"), fatal=fatal)
