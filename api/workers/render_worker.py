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
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np

from api.device_calibration import calibration
from api.layers import LAYERS, PASS_LAYERS, encode_picture, frame_layer, viewable
from api.picture_cost import check_cost
from api.sun_hours_layer import SUN_HOURS_LAYER, sun_hours_picture
from api.workers.block_tiles import PicturedBlock, cut_tiles, encoded_tiles
from api.workers.drawn_blocks import block_of_grid, drawn_block, grid_of_zoom
from api.workers.film_jobs import film_picture, first_plan
from api.workers.jobs import (
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
from api.workers.map_jobs import HEIGHTS, drawn_map, heights_picture
from api.workers.map_plans import plan_in_service, unprobed_class
from api.workers.plan_basis import PlanBasis
from api.workers.point_jobs import point_answer, points_answer
from api.workers.process_life import resident_bytes, stand_back
from api.workers.worker_main import WorkerConfig
from selector.choices import StandaloneRequest
from selector.select import select
from shadows.ground_pictures import ShownMap
from shadows.plan import Plan
from shadows.render import Frame, render_frame
from terrain.cache import MIB, Cache, Missing
from terrain.casters.slopes import extent_on_grid
from terrain.compiled import CORES
from terrain.compiling.ahead import MAPS, MAPS_OF_CASTERS, PICTURES, POINTS, PRODUCTS, SUN_HOURS, VIEWS, compile_ahead
from terrain.compiling.farm import missing_tasks
from terrain.compiling.hooks import compiled_by, need
from terrain.compiling.loop_cache import loop_store
from terrain.compiling.parent_process import end_with_parent
from terrain.describe import describe
from terrain.errors import GraphicsError, NoOpenGLError, RenderError, SkuggaError
from terrain.facts.descriptor import Descriptor
from terrain.gbuffer.covered_nodes import is_bare
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import BLOCK_PX, MapView
from terrain.gl import device as gl
from terrain.gl.egl_devices import take_turn
from terrain.level.level import SUN, Shadows, load_level
from terrain.scene import Scene, build_scene

if TYPE_CHECKING:
    from selector.cost.device_profile import DeviceProfile

MAX_SCENES = 16
"""Levels that a process keeps open: an overview (some MB), a file handle, trees and meshes (up to hundreds of MB) each."""

SCENES_BYTES = 2**30
"""Bytes of their overviews, at most."""

TILE_PLANS_BYTES = 16 * MIB
"""Bytes of the plans of tiles that a process keeps: some 30 KiB each."""

BLOCKS_BYTES = 48 * MIB
"""Bytes of the blocks drawn last, some 5 MiB each, of which other layers or formats may be asked for."""

IDLE_S = 1.0
"""How long a process that is ready waits for a job before it prepares for later ones."""

MAX_PROCESS_BYTES = 3 * 2**30
"""Memory of a process beyond which it keeps only the level that it draws; with a software rasteriser it takes about 1.5 GB."""

log = logging.getLogger("skugga.worker")


class SceneCache:
    """The scenes used last, by level file; a level of which a file has changed is opened anew."""

    def __init__(self, limit: int = MAX_SCENES, process_bytes: Callable[[], int] = resident_bytes) -> None:
        self._process_bytes = process_bytes
        self._scenes: Cache[tuple[str, Scene]] = Cache(
            "api.workers.scenes",
            "process",
            SCENES_BYTES,
            lambda entry: entry[1].elevation.nbytes,
            lambda entry: entry[1].close(),
            limit,
        )

    def __len__(self) -> int:
        return len(self._scenes)

    def get(self, key: LevelKey) -> Scene:
        """The scene of a level at a version. Raises ``LevelError`` or ``SourceError``."""
        path = str(key.path)
        entry = self._scenes.get(path)
        if isinstance(entry, Missing) or entry[0] != key.version:
            self._scenes.drop(path)
            loaded = load_level(key)
            need(MAPS_OF_CASTERS if loaded.level.forest or loaded.level.meshes else MAPS)
            entry = key.version, build_scene(loaded)
            self._scenes.put(path, value=entry)
        if self._process_bytes() > MAX_PROCESS_BYTES:
            self._scenes.trim(1)
        return entry[1]


class TilePlanCache:
    """Plans of tiles, one for a level's version, zoom and sun and what is asked: neighbours share it, and it is made once."""

    def __init__(self, limit_bytes: int = TILE_PLANS_BYTES) -> None:
        self._plans: Cache[Plan] = Cache("api.workers.tile_plans", "process", limit_bytes)

    def get(self, key: Hashable, make: Callable[[], Plan]) -> Plan:
        """The plan that was made for a key, or is made now."""
        plan = self._plans.get(key)
        if isinstance(plan, Missing):
            plan = make()
            self._plans.put(key, value=plan)
        return plan


DrawnAndFacts = tuple[PicturedBlock, dict[str, Any]]
"""A block and what is said of what drew it."""


@dataclass(eq=False)
class WorkerState:
    """What a render process keeps while it lives: its renderer, what plans go by, scenes, plans of tiles, blocks.

    Plans and blocks are kept by the version of their plans: those of another one are not found.
    """

    renderer: str
    basis: PlanBasis = field(default_factory=PlanBasis)
    most_ms: float | None = None
    missing_loops: int = 0
    scenes: SceneCache = field(default_factory=SceneCache)
    plans: TilePlanCache = field(default_factory=TilePlanCache)
    blocks: Cache[DrawnAndFacts] = field(default_factory=lambda: Cache("api.workers.blocks", "process", BLOCKS_BYTES))

    @property
    def device(self) -> DeviceProfile | None:
        """The device's calibration."""
        return self.basis.device


def block_view(job: BlockJob | SunHoursJob) -> MapView:
    """The view of a block: its pixels are the tile matrix's own."""
    return block_of_grid(grid_of_zoom(job.matrix_set, job.zoom), job.block_x, job.block_y)


def tiles_view(scene: Scene, tiles: Tiles) -> MapView:
    """The view of the block that holds the level's middle: what is planned for all tiles of the zoom is planned for this one."""
    grid = grid_of_zoom(tiles.matrix_set, tiles.zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    return block_of_grid(grid, int((west + east) / 2 // BLOCK_PX), int((north + south) / 2 // BLOCK_PX))


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


def plan_of_tiles(job: BlockJob, scene: Scene, state: WorkerState) -> Plan:
    """The plan that all tiles of a block's zoom have."""
    tiles = Tiles(matrix_set=job.matrix_set, zoom=job.zoom)

    def make() -> Plan:
        overrides = job.request.overrides.for_selector()
        return plan_in_service(scene, tiles_view(scene, tiles), "map", overrides, job.level, state.basis)

    return state.plans.get((job.level, state.basis.version_of(job.level), tiles, job.request), make)


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
    from api.workers.preparation import import_pvlib
    from api.workers.warm_up import warm_up

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
    from api.workers.preparation import prepare_level

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
