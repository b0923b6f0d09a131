"""A task drawn: its block's tiles, one after another in a shard."""

from __future__ import annotations

import resource
import sys
import time as clock

from pmtiles.tile import zxy_to_tileid

from skugga.api.layers import LAYERS, MapFormat, nodata_height_m
from skugga.api.seed.archive import ShardIndex
from skugga.api.seed.messages import Drawn, Task
from skugga.api.seed.run_spec import MATRIX_SET, RunSpec
from skugga.api.seed.storage import ShardStore
from skugga.api.workers.block_tiles import BLOCK_TILES, cut_tiles, empty_tile, encoded_part
from skugga.api.workers.drawn_blocks import block_of_grid, drawn_block, grid_of_zoom
from skugga.api.workers.map_jobs import heights_picture
from skugga.terrain.compiling.ahead import MAPS, MAPS_OF_CASTERS
from skugga.terrain.compiling.hooks import need
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.bare_ground import forget_ground_before
from skugga.terrain.geo.grid import TILE_PX
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

RSS_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024
"""Of ``getrusage``."""


class Drawer:
    """Draws tasks of one run, with its level open."""

    def __init__(self, spec: RunSpec, store: ShardStore) -> None:
        self._spec, self._store = spec, store
        loaded = load_level(spec.level)
        need(MAPS_OF_CASTERS if loaded.level.forest or loaded.level.meshes else MAPS)
        self._scene = build_scene(loaded)
        self._under = {number: self._scene.with_sun(sun) for number, sun in enumerate(spec.suns)}

    def draw(self, task: Task) -> Drawn:
        """Draw a task and write its shard. Raises ``SkuggaError`` and ``OSError``."""
        start = clock.perf_counter()
        tiles, encode_s = tiles_of_task(self._under[task.sun], self._spec, task)
        forget_ground_before(1)  # the next task may be of the same block under another sun, but of no block before it
        index, content = ShardIndex.of(tiles)
        if content:
            self._store.write(task.shard, content)
        peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * RSS_UNIT_BYTES
        return Drawn(task.id, index.to_bytes(), len(content), clock.perf_counter() - start, encode_s, peak_bytes)

    def close(self) -> None:
        """Close the level."""
        self._scene.close()


def tiles_of_task(scene: Scene, spec: RunSpec, task: Task) -> tuple[dict[int, bytes], float]:
    """The tiles of a task that show any data, by tile id, and how long writing their files took, seconds."""
    view, encoding = block_of_grid(grid_of_zoom(MATRIX_SET, task.zoom), task.x, task.y), LAYERS[spec.layer].encoding
    tiles: dict[tuple[int, int], bytes] = {}
    if encoding is not None:
        heights = heights_picture(scene, view, encoding)
        start = clock.perf_counter()
        nothing = empty_tile(spec.layer, spec.format, 1, nodata_height_m(scene.height_range_m[0]))
        cut = cut_tiles(heights, spec.layer, spec.format, 1, view)
        tiles = {place: body for place, body in cut.items() if body != nothing}
    else:
        block, _ = drawn_block(scene, view, spec.plan_by_place[task.sun, task.zoom], spec.layer)
        start = clock.perf_counter()
        for row in range(BLOCK_TILES):
            for col in range(BLOCK_TILES):
                part = block.part(row * TILE_PX, col * TILE_PX, TILE_PX)
                if part.there.any():
                    tiles[row, col] = encoded_part(part, spec.layer, spec.format)
    side = 2**task.zoom
    places = {(task.y * BLOCK_TILES + row, task.x * BLOCK_TILES + col): body for (row, col), body in tiles.items()}
    by_id = {zxy_to_tileid(task.zoom, x, y): body for (y, x), body in places.items() if x < side and y < side}
    return dict(sorted(by_id.items())), clock.perf_counter() - start


FORMATS: tuple[MapFormat, ...] = ("png", "webp", "jpg")
"""Formats that archives of tiles have a name for, of those that tiles are served in."""


def check_seeded_format(layer: str, format: str) -> None:
    """Raise ``InputError`` where pyramids of a layer have no such format."""
    if layer not in LAYERS or not any(each in LAYERS[layer].map_formats for each in FORMATS):
        layers = [name for name, each in LAYERS.items() if set(each.map_formats) & set(FORMATS)]
        raise InputError("--layer", layer, ", ".join(layers))
    formats = [each for each in FORMATS if each in LAYERS[layer].map_formats]
    if format not in formats:
        raise InputError("--format", format, f"{', '.join(formats)} for layer {layer}")
