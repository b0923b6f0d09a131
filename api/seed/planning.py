"""Plan a run: its tasks, the inputs that their tiles depend on, their plans and their expected durations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmtiles.tile import zxy_to_tileid

from skugga.api.device_calibration import calibration
from skugga.api.file_stamps import Stamp, file_stamps, level_version, watched_files
from skugga.api.matrices import (
    MAX_OVERZOOM,
    LonLatBounds,
    ZoomRange,
    finest_detail_m,
    is_extent_without_data,
    matrix_set_of,
    tile_limits,
    zoom_range,
)
from skugga.api.products.product import MapFormat
from skugga.api.request import PictureRequest, ProductRequest
from skugga.api.seed.archive import first_tile_id
from skugga.api.seed.ground_dependencies import GroundDependencies
from skugga.api.seed.identity import cached_ground_chunks, digest_of_json, level_digest, plan_digest
from skugga.api.seed.run_spec import MATRIX_SET, PlannedZoom, RunSpec
from skugga.api.seed.task_table import InputDigests, PlannedTask, TaskTable
from skugga.api.workers.block_tiles import BLOCK_SIDE_TILES
from skugga.api.workers.block_views import block_of_grid
from skugga.api.workers.jobs import LevelKey, ZoomTiles
from skugga.api.workers.map_plans import select_view_plan
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.worker_state import representative_block
from skugga.selector.probe_store import load_probes, probes_folder
from skugga.shadows.plan import Plan
from skugga.shadows.render import RENDERER_VERSION
from skugga.terrain.errors import InputError, NoOpenGLError, RenderError, UnsupportedError
from skugga.terrain.geo.grid import tile_grid
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer
from skugga.terrain.gl import device as gl
from skugga.terrain.gl.egl_devices import NO_OPENGL_RENDERER
from skugga.terrain.level.level import LoadedLevel, load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

DEFAULT_TASK_S = 0.25
"""Expected seconds of a task whose block is full of data, if there is no prediction."""

SHADING_OVERHEAD_S = 0.15
"""Seconds that ground, shading and files add to the predicted duration of a task whose block is full of data."""

MIN_TASK_COST_RATIO = 0.05
"""Minimum duration of a task, relative to a task whose block is full of data."""


@dataclass(frozen=True)
class SeedRequest:
    """The request for a pyramid.

    Attributes
    ----------
    level : LevelSource
        The level.
    zooms : ZoomRange or None
        Zooms; ``None``: from the zoom that shows the whole level to the zoom of its cells.
    suns : tuple
        Suns; ``None`` is the level's own.
    product_request : ProductRequest
        The product and its options, independent of the sun.
    format : str
        Format of the tiles.
    """

    level: LevelSource
    zooms: ZoomRange | None
    suns: tuple[SunSpec | None, ...]
    product_request: ProductRequest
    format: MapFormat


@dataclass(frozen=True)
class PlannedRun:
    """A run whose tasks are in the table.

    Attributes
    ----------
    spec : RunSpec
        The run as workers read it.
    loaded : LoadedLevel
        The level.
    sun_names : tuple of str
        Names of its suns in the table.
    zooms : ZoomRange
        Zooms of the pyramid.
    bounds : tuple of float
        Bounds of the data in degrees.
    files : tuple of Path
        Files of the level.
    stamps : tuple
        Stamps of these files, taken before they were read.
    """

    spec: RunSpec
    loaded: LoadedLevel
    sun_names: tuple[str, ...]
    zooms: ZoomRange
    bounds: LonLatBounds
    files: tuple[Path, ...]
    stamps: tuple[Stamp, ...]

    @property
    def is_unchanged(self) -> bool:
        """Whether the level's files are unchanged since the run was planned."""
        return file_stamps(self.files) == self.stamps


def local_renderer() -> str:
    """Return the name of the OpenGL renderer of this process."""
    try:
        return gl.device().renderer
    except NoOpenGLError:
        return NO_OPENGL_RENDERER


def plan_run(table: TaskTable, request: SeedRequest, on_status: Callable[[str], None]) -> PlannedRun:
    """Fill a table with the tasks of a run. Tasks whose inputs have not changed keep their state, done or failed.

    ``on_status`` is called with each step in words. Raises ``SkuggaError`` and ``OSError``.
    """
    loaded = load_level(request.level)
    files = watched_files(loaded)
    stamps = file_stamps(files)  # before reading, so that a later change is detected
    renderer = _renderer_of(table)
    scene = build_scene(loaded)
    try:
        zooms, bounds = _zooms_and_bounds(scene, request.zooms)
        version = level_version(loaded, stamps)
        request_digest = digest_of_json([RENDERER_VERSION, renderer, version, str(zooms), repr(request)])
        suns = tuple(PictureRequest(sun=sun).query() for sun in request.suns)
        stored_spec, planned_digest = table.get("spec"), table.get("asked")
        if stored_spec is not None and planned_digest == request_digest.encode():
            spec = RunSpec.model_validate_json(stored_spec)
        else:
            spec = _make_spec(table, request, scene, loaded, version, renderer, zooms, bounds, suns, on_status)
            table.put(spec=spec.model_dump_json().encode(), asked=request_digest.encode())
    finally:
        scene.close()
    return PlannedRun(spec, loaded, suns, zooms, bounds, files, stamps)


def _make_spec(
    table: TaskTable,
    request: SeedRequest,
    scene: Scene,
    loaded: LoadedLevel,
    version: str,
    renderer: str,
    zooms: ZoomRange,
    bounds: LonLatBounds,
    suns: Sequence[str],
    on_status: Callable[[str], None],
) -> RunSpec:
    """Fill the table with the tasks of a run, and return the run as workers read it.

    ``scene`` is the level's, and ``version`` is the version of its files. ``renderer`` is the OpenGL renderer of the plans.
    ``bounds`` are those of the level's data in degrees. ``suns`` are the names of the request's suns in the table, in the
    same order. ``on_status`` is called with each step in words.
    """
    table.put(asked=b"")  # an interrupted planning is repeated
    on_status("Reading the ground")
    ground = GroundDependencies(scene, cached_ground_chunks(loaded, scene, table))
    product, overrides = request.product_request.product_record, request.product_request.overrides
    request_values = [
        level_digest(loaded, scene, table),
        request.format,
        request.product_request.model_dump(mode="json", exclude_none=True),
    ]
    # The range of heights scales colours, and its middle places lines towards the sun.
    drawn_by, heights = digest_of_json([RENDERER_VERSION, renderer]), digest_of_json(scene.height_range_m)
    level_key = LevelKey(**{**request.level.model_dump(), "version": version})
    planner = _Planner(table, loaded, level_key, overrides.for_selector(), request.product_request.picture)
    tasks, plans, measured_costs = [], [], table.measured_costs()
    for number, (sun, name) in enumerate(zip(request.suns, suns, strict=True)):
        lit_scene = request.product_request.with_sun(sun).applied_to(scene)
        ground_under_sun, settings = (
            ground.with_sun(lit_scene),
            digest_of_json([*request_values, None if sun else _level_sun_values(scene)]),
        )
        for zoom in range(zooms.first, zooms.last + 1):
            on_status(f"Planning zoom {zoom}" + (f" under sun {number + 1} of {len(suns)}" if len(suns) > 1 else ""))
            plan = planner.plan(lit_scene, name, zoom) if product.needs else None
            if plan is not None:
                plans.append(PlannedZoom(sun=number, zoom=zoom, plan=plan.model_dump_json()))
            grid, blocks = tile_grid(matrix_set_of(MATRIX_SET), zoom), blocks_of_zoom(zoom, bounds)
            digests = ground_under_sun.digests(grid, blocks, plan, product)
            shares = ground_under_sun.data_fractions(grid, blocks)
            whole_s, planned = _full_block_task_s(plan, zoom, measured_costs), plan_digest(plan)
            for (x, y), digest, on_data in zip(blocks, digests, shares, strict=True):
                parts, share = InputDigests(drawn_by, settings, planned, heights, digest.hex()), max(on_data, MIN_TASK_COST_RATIO)
                tasks.append(PlannedTask(name, zoom, x, y, first_tile_of_block(zoom, x, y), parts, share, whole_s * share))
    table.set_tasks(tasks)
    return RunSpec(
        level=request.level, ground=version, renderer=renderer, asked=request.product_request, format=request.format,
        suns=request.suns, plans=tuple(plans),
    )  # fmt: skip


class _Planner:
    """Make the plan of each zoom of a level, as a service would. Plans that the table stores are reused."""

    def __init__(
        self, table: TaskTable, loaded: LoadedLevel, level: LevelKey, overrides: dict[str, Any], picture: PictureRequest
    ) -> None:
        self._table, self._level, self._overrides = table, level, overrides
        settings = loaded.level.model_dump(mode="json", exclude={"title", "attribution", "views", "archive"})
        self._request_digest = digest_of_json([settings, repr(sorted(overrides.items())), picture.query()])
        self._plan_measurements: PlanMeasurements | None = None

    def plan(self, scene: Scene, sun: str, zoom: int) -> Plan:
        """Return the plan of a zoom under a scene's sun. ``sun`` is the sun's name in the table. Raises ``SkuggaError``."""
        stored_plan = self._table.plan(sun, zoom, self._request_digest)
        if stored_plan is not None:
            return Plan.model_validate_json(stored_plan)
        if self._plan_measurements is None:
            self._plan_measurements = _plan_measurements(self._level)
        view = representative_block(scene, ZoomTiles(matrix_set=MATRIX_SET, zoom=zoom))
        plan = select_view_plan(scene, view, "map", self._overrides, self._level, self._plan_measurements)
        self._table.put_plan(sun, zoom, self._request_digest, plan.model_dump_json())
        return plan


def _level_sun_values(scene: Scene) -> Any:
    """Return the level's own sun as JSON values for a digest. Requests without a sun use it."""
    sun = scene.loaded.level.sun
    return sun if sun is None or sun == "none" else sun.model_dump(mode="json")


def _plan_measurements(level: LevelKey) -> PlanMeasurements:
    """Return the measurements of a service on this machine: the calibration and the saved probes of the level."""
    if local_renderer() == NO_OPENGL_RENDERER:
        return PlanMeasurements()
    probes = load_probes(probes_folder(*gl.renderer_and_version()) / f"{level.version}.json")
    return PlanMeasurements(calibration(), {level.version: probes.model_dump_json()})


def _renderer_of(table: TaskTable) -> str:
    """Return the OpenGL renderer for which a table's plans are made. A new table gets the renderer of this process.

    Raises ``RenderError`` if this process has another renderer.
    """
    current, stored_renderer = local_renderer(), table.get("renderer")
    if stored_renderer is None:
        table.put(renderer=current.encode())
    elif stored_renderer.decode() != current:
        raise RenderError(
            f"{table.folder}: its tasks are planned for the renderer '{stored_renderer.decode()}', but this machine draws with "
            f"'{current}'. Use a machine with that renderer, or delete the folder to start again."
        )
    return current


def _zooms_and_bounds(scene: Scene, requested: ZoomRange | None) -> tuple[ZoomRange, LonLatBounds]:
    """Return the zooms of a run, and the bounds of the level's data in degrees. Raises ``InputError`` for zooms beyond the data.

    ``requested`` are the zooms of the request; ``None``: from the zoom that shows the whole level to the zoom of its cells.
    """
    data_bounds = scene.bounds_lon_lat
    if data_bounds is None or scene.world.off_earth_reason is not None:
        raise UnsupportedError("LEVEL", scene.loaded.name, f"{scene.world.off_earth_reason}, so there are no tiles")
    cell_m, matrix_set = scene.elevation.cell_size_m(scene.world.metres_per_unit), matrix_set_of(MATRIX_SET)
    served_zooms, ground_zooms = (
        zoom_range(matrix_set, scene.world, data_bounds, detail) for detail in (finest_detail_m(scene), cell_m)
    )
    if served_zooms is None or ground_zooms is None:
        raise UnsupportedError("LEVEL", scene.loaded.name, f"it lies outside of {MATRIX_SET}")
    native_zoom = max(ground_zooms.last - MAX_OVERZOOM, served_zooms.first)
    if requested is not None and not 0 <= requested.first <= requested.last <= served_zooms.last:
        allowed = f"zooms 0 to {served_zooms.last} in ascending order (full resolution at zoom {native_zoom})"
        raise InputError("--zooms", f"{requested.first}-{requested.last}", allowed)
    west, south, east, north = transformer(scene.elevation.crs, LONGITUDE_LATITUDE).transform_bounds(
        *scene.elevation.bounds, densify_pts=21
    )
    bounds = west, south, east + 360.0 if east < west else east, north
    return requested or ZoomRange(served_zooms.first, native_zoom), bounds


def blocks_of_zoom(zoom: int, bounds: LonLatBounds) -> list[tuple[int, int]]:
    """Return the blocks of a zoom that may show data within some bounds in degrees: (column, row), counted in blocks."""
    matrix_set, side = matrix_set_of(MATRIX_SET), 2**zoom
    top, bottom, left, right = tile_limits(matrix_set, zoom, bounds)
    blocks = [
        (x, y)
        for y in range(top // BLOCK_SIDE_TILES, bottom // BLOCK_SIDE_TILES + 1)
        for x in range(left // BLOCK_SIDE_TILES, right // BLOCK_SIDE_TILES + 1)
    ]
    if (left, right) != (0, side - 1):
        return blocks
    grid = tile_grid(matrix_set, zoom)  # all longitudes, or across the antimeridian
    return [(x, y) for x, y in blocks if not is_extent_without_data(grid.crs, block_of_grid(grid, x, y).bounds, bounds)]


def first_tile_of_block(zoom: int, x: int, y: int) -> int:
    """Return the smallest PMTiles tile id of the block in column ``x`` and row ``y`` of a zoom.

    The ids of its tiles are consecutive.
    """
    first = first_tile_id(zoom)
    if 2**zoom < BLOCK_SIDE_TILES:
        return first
    tile_offset = zxy_to_tileid(zoom, x * BLOCK_SIDE_TILES, y * BLOCK_SIDE_TILES) - first
    return first + tile_offset // BLOCK_SIDE_TILES**2 * BLOCK_SIDE_TILES**2


def _full_block_task_s(plan: Plan | None, zoom: int, measured_costs: dict[int, tuple[float, float]]) -> float:
    """Return the expected seconds of a task whose block is full of data: measured at its zoom, or predicted by the plan.

    ``measured_costs`` has seconds and bytes of such a task by zoom.
    """
    if zoom in measured_costs:
        return measured_costs[zoom][0]
    if plan is None or plan.predicted is None:
        return DEFAULT_TASK_S
    return plan.predicted.ms / 1000.0 + SHADING_OVERHEAD_S
