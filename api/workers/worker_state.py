"""The caches of a render process: open levels, plans of tiles and drawn blocks."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from skugga.api.workers.block_views import block_of_grid, grid_of_zoom
from skugga.api.workers.jobs import BlockJob, LevelKey, ZoomTiles
from skugga.api.workers.map_plans import select_view_plan
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.process_life import resident_bytes
from skugga.shadows.picture import Picture
from skugga.shadows.plan import Plan
from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.compiling.ahead_of_time import MAPS, MAPS_OF_CASTERS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

MAX_SCENES = 16
"""Maximum number of levels that a process keeps open.

Each needs an overview of its raster (some MB), a file handle, and trees and meshes (up to hundreds of MB)."""

MAX_SCENES_BYTES = 2**30
"""Upper bound of the bytes of the open levels' overviews together."""

MAX_TILE_PLANS_BYTES = 16 * MIB
"""Upper bound of the bytes of cached plans of tiles. A plan has some 30 KiB."""

BLOCK_CACHE_BYTES = 48 * MIB
"""Upper bound of the bytes of cached blocks. A block has some 5 MiB.

A cached block serves requests for its other layers and formats without rendering."""

MAX_PROCESS_BYTES = 3 * 2**30
"""Resident bytes of a process above which it closes all levels except the current one.

A software rasteriser needs about 1.5 GB."""


class SceneCache:
    """Cache of recently used scenes (open levels) by level file. A level with another version than its open scene is reopened."""

    def __init__(self, max_scenes: int = MAX_SCENES, process_bytes: Callable[[], int] = resident_bytes) -> None:
        self._process_bytes = process_bytes
        self._scenes: Cache[tuple[str, Scene]] = Cache(
            "skugga.api.workers.scenes",
            "process",
            MAX_SCENES_BYTES,
            lambda entry: entry[1].elevation.nbytes,
            lambda entry: entry[1].close(),
            max_scenes,
        )

    def __len__(self) -> int:
        return len(self._scenes)

    def get(self, key: LevelKey) -> Scene:
        """Return the scene of a level in the version of ``key``; open it if necessary. Raises ``LevelError`` or ``SourceError``."""
        path = str(key.path)
        entry = self._scenes.get(path)
        if isinstance(entry, Missing) or entry[0] != key.version:
            self._scenes.drop(path)
            loaded = load_level(key)
            declare_product(MAPS_OF_CASTERS if loaded.level.forest or loaded.level.meshes else MAPS)
            entry = key.version, build_scene(loaded)
            self._scenes.put(path, value=entry)
        if self._process_bytes() > MAX_PROCESS_BYTES:
            self._scenes.trim(1)
        return entry[1]


class TilePlanCache:
    """Cache of plans by level, version of plans, zoom (or map scale) and request. All tiles of a zoom share a plan."""

    def __init__(self, limit_bytes: int = MAX_TILE_PLANS_BYTES) -> None:
        self._plans: Cache[Plan] = Cache("skugga.api.workers.tile_plans", "process", limit_bytes)

    def get(self, key: Hashable, make_plan: Callable[[], Plan]) -> Plan:
        """Return the cached plan of a key; if it is missing, call ``make_plan`` and cache its result."""
        plan = self._plans.get(key)
        if isinstance(plan, Missing):
            plan = make_plan()
            self._plans.put(key, value=plan)
        return plan


DrawnBlock = tuple[Picture, dict[str, Any]]
"""A drawn block, and the fields of ``BlockTiles`` that describe how it was drawn."""


@dataclass(eq=False)
class WorkerState:
    """State of a render process: its renderer, the measurements that its plans use, and its caches.

    The keys of cached plans and blocks include the version of the plans.

    Attributes
    ----------
    renderer : str
        OpenGL's name of the renderer.
    measurements : PlanMeasurements
        The measurements that plans use.
    max_picture_ms : float or None
        Maximum expected time of a picture in milliseconds.
    missing_loop_count : int
        Number of loops (functions that numba compiles) without machine code in the cache on disk, as last counted.
    scenes, plans, blocks
        Caches of open levels, plans of tiles and drawn blocks.
    """

    renderer: str
    measurements: PlanMeasurements = field(default_factory=PlanMeasurements)
    max_picture_ms: float | None = None
    missing_loop_count: int = 0
    scenes: SceneCache = field(default_factory=SceneCache)
    plans: TilePlanCache = field(default_factory=TilePlanCache)
    blocks: Cache[DrawnBlock] = field(default_factory=lambda: Cache("skugga.api.workers.blocks", "process", BLOCK_CACHE_BYTES))

    @property
    def device(self) -> DeviceProfile | None:
        """The device's calibration (measured costs of algorithms); ``None`` without one."""
        return self.measurements.device


def block_view(job: BlockJob) -> MapView:
    """Return the map view of a block, with the pixels of its tile matrix."""
    return block_of_grid(grid_of_zoom(job.matrix_set, job.zoom), job.block_x, job.block_y)


def representative_block(scene: Scene, tiles: ZoomTiles) -> MapView:
    """Return the map view of the block at the level's middle, whose plan all tiles of the zoom share."""
    grid = grid_of_zoom(tiles.matrix_set, tiles.zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    return block_of_grid(grid, int((west + east) / 2 // BLOCK_PX), int((north + south) / 2 // BLOCK_PX))


def plan_of_tiles(job: BlockJob, scene: Scene, state: WorkerState) -> Plan:
    """Return the plan that all tiles of a block's zoom share, from the cache or newly made."""
    tiles = ZoomTiles(matrix_set=job.matrix_set, zoom=job.zoom)

    def make() -> Plan:
        overrides = job.request.overrides.for_selector()
        return select_view_plan(scene, representative_block(scene, tiles), "map", overrides, job.level, state.measurements)

    return state.plans.get((job.level, state.measurements.version_of(job.level), tiles, job.request.picture), make)
