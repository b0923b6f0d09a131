"""The central block of each level. Idle render processes open the levels of these blocks.

A block is a square of 4 x 4 tiles that are rendered together.
"""

from __future__ import annotations

from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevel, ServedLevels
from skugga.api.matrices import matrix_set_of
from skugga.api.workers.block_tiles import block_and_position
from skugga.api.workers.jobs import BlockJob


def central_blocks(levels: ServedLevels) -> tuple[BlockJob, ...]:
    """Return the central block of each level with tiles, at its first zoom."""
    blocks = (central_block(level) for level in levels.cached_levels())
    return tuple(block for block in blocks if block is not None)


def central_block(level: ServedLevel, zoom: int | None = None) -> BlockJob | None:
    """Return the central block of a level at a zoom, by default its first zoom; ``None`` for a level without tiles."""
    zooms = level.zooms.get(DEFAULT_MATRIX_SET)
    if zooms is None or level.bounds is None:
        return None
    west, south, east, north = level.bounds
    tile = matrix_set_of(DEFAULT_MATRIX_SET).tile((west + east) / 2.0, (south + north) / 2.0, zooms.first if zoom is None else zoom)
    (x, y), _ = block_and_position(tile.x, tile.y, 1)
    return BlockJob(level=level.key, matrix_set=DEFAULT_MATRIX_SET, zoom=tile.z, block_x=x, block_y=y)
