"""What a render process keeps while it lives: open levels, plans of tiles and drawn blocks."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from skugga.api.workers.block_views import block_of_grid, grid_of_zoom
from skugga.api.workers.jobs import BlockJob, LevelKey, Tiles
from skugga.api.workers.map_plans import plan_in_service
from skugga.api.workers.plan_basis import PlanBasis
from skugga.api.workers.process_life import resident_bytes
from skugga.shadows.picture import Picture
from skugga.shadows.plan import Plan
from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.compiling.ahead import MAPS, MAPS_OF_CASTERS
from skugga.terrain.compiling.hooks import need
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

MAX_SCENES = 16
"""Levels that a process keeps open: an overview (some MB), a file handle, trees and meshes (up to hundreds of MB) each."""

SCENES_BYTES = 2**30
"""Bytes of their overviews, at most."""

TILE_PLANS_BYTES = 16 * MIB
"""Bytes of the plans of tiles that a process keeps: some 30 KiB each."""

BLOCKS_BYTES = 48 * MIB
"""Bytes of the blocks drawn last, some 5 MiB each, of which other layers or formats may be asked for."""

MAX_PROCESS_BYTES = 3 * 2**30
"""Memory of a process beyond which it keeps only the level that it draws; with a software rasteriser it takes about 1.5 GB."""


class SceneCache:
    """The scenes used last, by level file; a level of which a file has changed is opened anew."""

    def __init__(self, limit: int = MAX_SCENES, process_bytes: Callable[[], int] = resident_bytes) -> None:
        self._process_bytes = process_bytes
        self._scenes: Cache[tuple[str, Scene]] = Cache(
            "skugga.api.workers.scenes",
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
        self._plans: Cache[Plan] = Cache("skugga.api.workers.tile_plans", "process", limit_bytes)

    def get(self, key: Hashable, make: Callable[[], Plan]) -> Plan:
        """The plan that was made for a key, or is made now."""
        plan = self._plans.get(key)
        if isinstance(plan, Missing):
            plan = make()
            self._plans.put(key, value=plan)
        return plan


DrawnAndFacts = tuple[Picture, dict[str, Any]]
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
    blocks: Cache[DrawnAndFacts] = field(default_factory=lambda: Cache("skugga.api.workers.blocks", "process", BLOCKS_BYTES))

    @property
    def device(self) -> DeviceProfile | None:
        """The device's calibration."""
        return self.basis.device


def block_view(job: BlockJob) -> MapView:
    """The view of a block: its pixels are the tile matrix's own."""
    return block_of_grid(grid_of_zoom(job.matrix_set, job.zoom), job.block_x, job.block_y)


def tiles_view(scene: Scene, tiles: Tiles) -> MapView:
    """The view of the block that holds the level's middle: what is planned for all tiles of the zoom is planned for this one."""
    grid = grid_of_zoom(tiles.matrix_set, tiles.zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    return block_of_grid(grid, int((west + east) / 2 // BLOCK_PX), int((north + south) / 2 // BLOCK_PX))


def plan_of_tiles(job: BlockJob, scene: Scene, state: WorkerState) -> Plan:
    """The plan that all tiles of a block's zoom have."""
    tiles = Tiles(matrix_set=job.matrix_set, zoom=job.zoom)

    def make() -> Plan:
        overrides = job.request.overrides.for_selector()
        return plan_in_service(scene, tiles_view(scene, tiles), "map", overrides, job.level, state.basis)

    return state.plans.get((job.level, state.basis.version_of(job.level), tiles, job.request.picture), make)
