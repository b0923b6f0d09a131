"""Digests of the ground by chunk. They tell which tiles a change of a raster can affect.

A chunk is a square of cells of the raster.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from skugga.terrain.ground.elevation import Elevation

MIN_CHUNK_CELLS = 64
"""Side of a chunk in cells. It doubles for large rasters until ``MAX_CHUNKS`` suffice."""

MAX_CHUNKS = 16_384
"""Upper bound of the number of chunks of a raster."""

MAX_READ_CELLS = 2**23
"""Number of cells read at once."""

CHUNK_DIGEST_BYTES = 16
"""Size of a chunk's digest in bytes."""


@dataclass(frozen=True, eq=False)
class GroundChunks:
    """Square chunks of a raster, counted from its first cell.

    Attributes
    ----------
    side : int
        Cells per side of a chunk.
    digests : (rows, cols, 16) uint8
        Digest of each chunk's cells, and of the cells over them in the file's overviews.
    low_m, high_m : (rows, cols) float32
        Lowest and highest height of each chunk's surface, metres; NaN without data.
    has_nodata : bool
        Whether any cell of the raster has no data.
    """

    side: int
    digests: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray
    has_nodata: bool

    @cached_property
    def digest(self) -> bytes:
        """Digest of the whole ground: of the side and the digests of all chunks. Modification times of files do not affect it."""
        return hashlib.blake2b(np.int64(self.side).tobytes() + self.digests.tobytes(), digest_size=CHUNK_DIGEST_BYTES).digest()

    def to_bytes(self) -> bytes:
        """Return the chunks as bytes for the task table."""
        out = io.BytesIO()
        np.savez_compressed(
            out, side=self.side, digests=self.digests, low_m=self.low_m, high_m=self.high_m, holes=self.has_nodata
        )  # fmt: skip
        return out.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> GroundChunks:
        """Return the chunks that ``to_bytes`` wrote."""
        with np.load(io.BytesIO(content)) as arrays:
            return cls(int(arrays["side"]), arrays["digests"], arrays["low_m"], arrays["high_m"], bool(arrays["holes"]))


def ground_chunks(elevation: Elevation) -> GroundChunks:
    """Compute the chunks of a raster, which is read once. Raises ``SourceError`` for an unreadable part."""
    side = MIN_CHUNK_CELLS
    while -(-elevation.rows // side) * -(-elevation.cols // side) > MAX_CHUNKS:
        side *= 2
    shape = -(-elevation.rows // side), -(-elevation.cols // side)
    factors = [factor for factor in elevation.overview_factors if factor <= side]
    digests = np.zeros((*shape, CHUNK_DIGEST_BYTES), np.uint8)
    low_m, high_m = (np.full(shape, np.nan, np.float32) for _ in range(2))
    has_nodata, chunks_per_read = False, max(MAX_READ_CELLS // side // side, 1)
    for i in range(shape[0]):
        for first in range(0, shape[1], chunks_per_read):
            rows = slice(i * side, min((i + 1) * side, elevation.rows))
            cols = slice(first * side, min((first + chunks_per_read) * side, elevation.cols))
            stored, stored_valid = elevation.stored_values(rows, cols)
            overviews = [_overview_cells(elevation, rows, cols, factor) for factor in factors]
            for j in range(first, min(first + chunks_per_read, shape[1])):
                chunk_cols = slice((j - first) * side, (j - first + 1) * side)
                cells, valid = stored[:, chunk_cols], stored_valid[:, chunk_cols]
                digest = hashlib.blake2b(digest_size=CHUNK_DIGEST_BYTES)
                for part in (
                    cells,
                    valid,
                    *(overview[:, (j - first) * (side // f) :][:, : side // f] for f, overview in overviews),
                ):
                    digest.update(np.ascontiguousarray(part).tobytes())
                digests[i, j] = np.frombuffer(digest.digest(), np.uint8)
                has_nodata |= not valid.all()
                if valid.any():
                    low_m[i, j], high_m[i, j] = elevation.surface_range_m(cells[valid])
    return GroundChunks(side, digests, low_m, high_m, has_nodata)


def _overview_cells(elevation: Elevation, rows: slice, cols: slice, factor: int) -> tuple[int, np.ndarray]:
    """Return ``factor``, and the cells of the overview with that factor of decimation, in a window of the raster.

    ``rows`` and ``cols`` are the window's slices of the raster's rows and columns.
    """
    shape = max((rows.stop - rows.start) // factor, 1), max((cols.stop - cols.start) // factor, 1)
    return factor, elevation.stored_values(rows, cols, shape)[0]
