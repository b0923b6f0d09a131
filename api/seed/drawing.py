"""Draw a task: the tiles of one block of a zoom, concatenated in a shard."""

from __future__ import annotations

import resource
import sys
import time as clock
from collections.abc import Mapping

from pmtiles.tile import zxy_to_tileid

from skugga.api.compute import compute, draw_picture
from skugga.api.products import SEED_PRODUCTS, product_named
from skugga.api.products.product import PICTURE_FORMATS
from skugga.api.seed.archive import ShardIndex
from skugga.api.seed.messages import Task, TaskResult
from skugga.api.seed.run_spec import MATRIX_SET, RunSpec
from skugga.api.seed.storage import ShardStore
from skugga.api.workers.block_tiles import BLOCK_SIDE_TILES, TilePosition, empty_tile, tiles_of_array, tiles_of_picture
from skugga.api.workers.block_views import block_of_grid, grid_of_zoom
from skugga.terrain.compiling.ahead_of_time import MAPS, MAPS_OF_CASTERS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.bare_ground import trim_bare_ground_cache
from skugga.terrain.gbuffer.map_block import trim_map_block_cache
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

RSS_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024
"""Unit of ``ru_maxrss`` in ``getrusage``."""


class TaskDrawer:
    """Draw tasks of one run, with its level open."""

    def __init__(self, spec: RunSpec, store: ShardStore) -> None:
        self._spec, self._store = spec, store
        loaded = load_level(spec.level)
        declare_product(MAPS_OF_CASTERS if loaded.level.forest or loaded.level.meshes else MAPS)
        self._scene = build_scene(loaded)
        self._scenes_by_sun = {number: spec.request(number).applied_to(self._scene) for number in range(len(spec.suns))}

    def draw(self, task: Task) -> TaskResult:
        """Draw a task and write its shard. Raises ``SkuggaError`` and ``OSError``."""
        start = clock.perf_counter()
        tiles, encode_s = tiles_of_task(self._scenes_by_sun[task.sun], self._spec, task)
        trim_bare_ground_cache(1)  # the next task may reuse this block under another sun, but no earlier block
        trim_map_block_cache(1)
        index, content = ShardIndex.from_tiles(tiles)
        if content:
            self._store.write(task.shard, content)
        peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * RSS_UNIT_BYTES
        return TaskResult(task.id, index.to_bytes(), len(content), clock.perf_counter() - start, encode_s, peak_bytes)

    def close(self) -> None:
        """Close the level."""
        self._scene.close()


def tiles_of_task(scene: Scene, spec: RunSpec, task: Task) -> tuple[dict[int, bytes], float]:
    """Return the tiles of a task that show data, by tile id, and the seconds that their encoding took."""
    view, request = block_of_grid(grid_of_zoom(MATRIX_SET, task.zoom), task.x, task.y), spec.request(task.sun)
    product, plan = request.product_record, spec.plan_by_sun_and_zoom.get((task.sun, task.zoom))
    files: Mapping[TilePosition, bytes | None]
    if plan is not None and not product.margin_px:
        picture = draw_picture(scene, view, product, plan)
        start = clock.perf_counter()
        files = tiles_of_picture(picture, request, scene, view, spec.format)
    else:
        array = compute(scene, view, request, plan).array
        start = clock.perf_counter()
        files = tiles_of_array(array, request, scene.world, view, spec.format)
        empty_body = empty_tile(request, spec.format, 1, scene.height_range_m[0])
        files = {place: None if body == empty_body else body for place, body in files.items()}
    side = 2**task.zoom
    places = {
        (task.y * BLOCK_SIDE_TILES + row, task.x * BLOCK_SIDE_TILES + col): body
        for (row, col), body in files.items()
        if body is not None
    }
    by_id = {zxy_to_tileid(task.zoom, x, y): body for (y, x), body in places.items() if x < side and y < side}
    return dict(sorted(by_id.items())), clock.perf_counter() - start


def check_tile_format(layer: str, format: str) -> None:
    """Raise ``InputError`` if tiles of a product cannot be drawn in advance in a format."""
    product = product_named(layer, SEED_PRODUCTS, "--layer")
    formats = [picture_format for picture_format in PICTURE_FORMATS if picture_format in product.map_formats]
    if format not in formats:
        raise InputError("--format", format, f"{', '.join(formats)} for layer {layer}")
