"""Write PMTiles archives made of shards: https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md

A shard holds the tiles of one task, one after the other. The shards' indexes determine the position of every tile. So the header
and the directories are written first. Then each tile is checked against its digest and copied once.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray
from pmtiles.tile import Compression, Entry, serialize_directory, serialize_header, tileid_to_zxy

from skugga.api.archive_format import PMTILES_HEADER_BYTES, TILE_TYPE_BY_FORMAT
from skugga.api.errors import BrokenShardError
from skugga.terrain.atomic_files import atomic_path
from skugga.terrain.errors import InputError, Problem

DIGEST_BYTES = 16
"""Size of a tile's digest in bytes."""

DEDUPLICATION_LIMIT_BYTES = 2048
"""Equal tiles of fewer bytes are stored once. Such tiles have one colour, or nearly so.

Equal larger tiles are rare, and finding them would cost memory for every tile.
"""

MAX_ROOT_END_BYTES = 16_384
"""Upper bound in bytes of the end of the root directory (specification): readers fetch header and root in one request."""

MAX_ROOT_ENTRIES = 16_384
"""Maximum number of entries for which a root directory without leaves is tried. With more it hardly ever fits."""

INITIAL_LEAF_ENTRIES = 4096
"""Number of entries of a leaf directory that is tried first: some 20 KB, one request of a reader."""

TILE_RECORD_DTYPE = np.dtype([("id", "<u8"), ("length", "<u4"), ("digest", "u1", (DIGEST_BYTES,))])
"""Binary record of a tile in an index."""


@dataclass(frozen=True, eq=False)
class ShardIndex:
    """The tiles of a shard. The shard is the concatenation of their bytes in this order.

    Attributes
    ----------
    ids : (n,) uint64
        PMTiles tile ids, ascending.
    lengths : (n,) uint32
        Bytes of the tiles, all positive.
    digests : (n, 16) uint8
        BLAKE2b digests of 16 bytes.
    """

    ids: NDArray[np.uint64]
    lengths: NDArray[np.uint32]
    digests: NDArray[np.uint8]

    @classmethod
    def from_tiles(cls, tiles: Mapping[int, bytes]) -> tuple[ShardIndex, bytes]:
        """Return the index of tiles, given by tile id, and the shard's bytes."""
        ids = sorted(tiles)
        digests = b"".join(_digest(tiles[tile_id]) for tile_id in ids)
        index = cls(
            np.array(ids, np.uint64),
            np.array([len(tiles[tile_id]) for tile_id in ids], np.uint32),
            np.frombuffer(digests, np.uint8).reshape(-1, DIGEST_BYTES),
        )
        return index, b"".join(tiles[tile_id] for tile_id in ids)

    def to_bytes(self) -> bytes:
        """Return the index as bytes, 28 per tile."""
        table = np.empty(len(self.ids), TILE_RECORD_DTYPE)
        table["id"], table["length"], table["digest"] = self.ids, self.lengths, self.digests
        return table.tobytes()

    @classmethod
    def from_bytes(cls, blob: bytes) -> ShardIndex:
        """Return the index that ``to_bytes`` wrote. Raises ``ValueError`` for bytes of a wrong length."""
        table = np.frombuffer(blob, TILE_RECORD_DTYPE)
        return cls(*(np.ascontiguousarray(table[name]) for name in ("id", "length", "digest")))


@dataclass(frozen=True)
class ArchiveMetadata:
    """The metadata of an archive.

    Attributes
    ----------
    format : str
        Format of the tiles.
    bounds : tuple of float
        West, south, east and north in degrees; east may exceed 180.
    first_zoom, last_zoom : int
        Range of zooms of the tiles.
    metadata : Mapping
        JSON object of the metadata.
    """

    format: Literal["png", "webp", "jpg"]
    bounds: tuple[float, float, float, float]
    first_zoom: int
    last_zoom: int
    metadata: Mapping[str, Any]


@dataclass(frozen=True)
class ArchiveSize:
    """The size of an archive.

    Attributes
    ----------
    file_bytes : int
        Bytes of the file.
    tile_count : int
        Number of tile ids that the archive answers.
    entry_count : int
        Number of directory entries.
    content_count : int
        Number of tile contents that are stored; equal tiles may share one.
    """

    file_bytes: int
    tile_count: int
    entry_count: int
    content_count: int


@dataclass(frozen=True, eq=False)
class _Layout:
    """The positions of all tiles in an archive, and its directory entries.

    Attributes
    ----------
    is_stored : (tiles,) bool
        Whether a tile's bytes are stored; if not, the tile shares the bytes of an equal one.
    ids, offsets, lengths, run_lengths : (entries,)
        Of each entry: first tile id, offset of its bytes from those of the first tile, number of bytes, and run length.
    data_bytes : int
        Bytes of all stored tiles.
    """

    is_stored: NDArray[np.bool_]
    ids: NDArray[np.uint64]
    offsets: NDArray[np.uint64]
    lengths: NDArray[np.uint32]
    run_lengths: NDArray[np.uint64]
    data_bytes: int


def write_archive(
    path: Path, indexes: Sequence[ShardIndex], read_shard: Callable[[int], bytes], archive_metadata: ArchiveMetadata
) -> ArchiveSize:
    """Write the tiles of shards as a PMTiles archive, atomically. Equal tiles and metadata give equal bytes.

    The tile ids of the indexes ascend from shard to shard. ``read_shard(i)`` returns shard i's bytes. It is called once
    per shard, in order. Equal neighbouring tiles form one run, and equal small tiles share one content.

    Raises ``BrokenShardError`` for bytes that do not match the index, ``InputError`` without any tile, ``ValueError`` for
    unordered ids or ids outside of the zooms, ``OSError``, and the errors of ``read_shard``.
    """
    layout = _layout(indexes, archive_metadata)
    head = _encode_head(layout, archive_metadata)
    with atomic_path(path) as part, part.open("wb") as file:
        file.write(head)
        first = 0
        for number, index in enumerate(indexes):
            _copy_shard(file, number, index, read_shard(number), layout.is_stored[first : first + len(index.ids)])
            first += len(index.ids)
    return ArchiveSize(
        len(head) + layout.data_bytes, len(layout.is_stored), len(layout.ids), int(np.count_nonzero(layout.is_stored))
    )


def _layout(indexes: Sequence[ShardIndex], archive_metadata: ArchiveMetadata) -> _Layout:
    """Return the positions of all tiles of an archive, and its directory entries. Equal neighbouring tiles form one run.

    Raises ``InputError`` without any tile, and ``ValueError`` for unordered ids, ids outside of the zooms, or a tile without bytes.
    """
    ids = np.concatenate([np.empty(0, np.uint64), *(index.ids for index in indexes)])
    lengths = np.concatenate([np.empty(0, np.uint32), *(index.lengths for index in indexes)])
    digests = np.concatenate([np.empty((0, DIGEST_BYTES), np.uint8), *(index.digests for index in indexes)])
    if not len(ids):
        raise InputError("tiles", Problem("no tile shows data"), "Choose zooms at which the level has data")
    if not (ids[1:] > ids[:-1]).all():
        raise ValueError("tile ids of shards do not ascend")
    if not (first_tile_id(archive_metadata.first_zoom) <= ids[0] and ids[-1] < first_tile_id(archive_metadata.last_zoom + 1)):
        raise ValueError(f"tiles outside of the zooms {archive_metadata.first_zoom} to {archive_metadata.last_zoom}")
    if not lengths.all():
        raise ValueError("a tile without bytes")

    keys = np.ascontiguousarray(digests).view(f"V{DIGEST_BYTES}")[:, 0]
    continues_run = (ids[1:] == ids[:-1] + 1) & (keys[1:] == keys[:-1]) & (lengths[1:] == lengths[:-1])
    entry_starts = np.flatnonzero(np.concatenate([[True], ~continues_run]))  # first tile of every entry
    run_lengths = np.diff(np.append(entry_starts, len(ids))).astype(np.uint64)
    # The entry whose bytes each entry refers to: the first equal one.
    source = np.arange(len(entry_starts))
    small = np.flatnonzero(lengths[entry_starts] < DEDUPLICATION_LIMIT_BYTES)
    _, first, inverse = np.unique(keys[entry_starts[small]], return_index=True, return_inverse=True)
    source[small] = small[first[inverse]]
    copied = source == np.arange(len(entry_starts))
    entry_lengths = lengths[entry_starts]
    ends = np.cumsum(np.where(copied, entry_lengths, 0), dtype=np.uint64)
    is_stored = np.zeros(len(ids), np.bool_)
    is_stored[entry_starts[copied]] = True
    return _Layout(is_stored, ids[entry_starts], (ends - entry_lengths)[source], entry_lengths, run_lengths, int(ends[-1]))


def _encode_head(layout: _Layout, archive_metadata: ArchiveMetadata) -> bytes:
    """Return the header, the directories and the metadata, which precede the tiles' bytes."""
    root, leaves = _directories(layout)
    metadata = gzip.compress(json.dumps(dict(archive_metadata.metadata), sort_keys=True, allow_nan=False).encode(), mtime=0)
    west, south, east, north = archive_metadata.bounds
    # Readers accept no degrees beyond 180, so bounds across the antimeridian become all longitudes.
    west, east = (-180.0, 180.0) if east > 180.0 or west < -180.0 else (west, east)
    edges = [round(degrees * 1e7) for degrees in (west, max(south, -90.0), east, min(north, 90.0))]
    metadata_at, leaves_at = PMTILES_HEADER_BYTES + len(root), PMTILES_HEADER_BYTES + len(root) + len(metadata)
    first_zoom = tileid_to_zxy(int(layout.ids[0]))[0]
    header = serialize_header(
        {
            "version": 3,
            "root_offset": PMTILES_HEADER_BYTES,
            "root_length": len(root),
            "metadata_offset": metadata_at,
            "metadata_length": len(metadata),
            "leaf_directory_offset": leaves_at,
            "leaf_directory_length": len(leaves),
            "tile_data_offset": leaves_at + len(leaves),
            "tile_data_length": layout.data_bytes,
            "addressed_tiles_count": len(layout.is_stored),
            "tile_entries_count": len(layout.ids),
            "tile_contents_count": int(np.count_nonzero(layout.is_stored)),
            "clustered": True,
            "internal_compression": Compression.GZIP,
            "tile_compression": Compression.NONE,
            "tile_type": TILE_TYPE_BY_FORMAT[archive_metadata.format],
            "min_zoom": first_zoom,
            "max_zoom": tileid_to_zxy(int(layout.ids[-1]))[0],
            "min_lon_e7": edges[0],
            "min_lat_e7": edges[1],
            "max_lon_e7": edges[2],
            "max_lat_e7": edges[3],
            "center_zoom": first_zoom,
            "center_lon_e7": (edges[0] + edges[2]) // 2,
            "center_lat_e7": (edges[1] + edges[3]) // 2,
        }
    )
    return header + root + metadata + leaves


def _directories(layout: _Layout) -> tuple[bytes, bytes]:
    """Return the root directory and the leaf directories. Leaves hold more and more entries until the root fits its size limit."""
    count, max_root_bytes = len(layout.ids), MAX_ROOT_END_BYTES - PMTILES_HEADER_BYTES
    if count <= MAX_ROOT_ENTRIES:
        root = serialize_directory(_entries(layout, 0, count))
        if len(root) <= max_root_bytes:
            return root, b""
    leaf_entries = INITIAL_LEAF_ENTRIES
    while True:
        root_entries, leaves = [], bytearray()
        for first in range(0, count, leaf_entries):
            leaf = serialize_directory(_entries(layout, first, min(first + leaf_entries, count)))
            root_entries.append(Entry(int(layout.ids[first]), len(leaves), len(leaf), 0))
            leaves += leaf
        root = serialize_directory(root_entries)
        if len(root) <= max_root_bytes:
            return root, bytes(leaves)
        leaf_entries *= 2


def _entries(layout: _Layout, first_entry: int, end_entry: int) -> list[Entry]:
    """Return the directory entries with the indexes ``first_entry`` to before ``end_entry`` of a layout."""
    indexes = slice(first_entry, end_entry)
    columns = (column[indexes].tolist() for column in (layout.ids, layout.offsets, layout.lengths, layout.run_lengths))
    return [Entry(*row) for row in zip(*columns, strict=True)]


def _copy_shard(file: BinaryIO, shard_number: int, index: ShardIndex, shard: bytes, is_stored: NDArray[np.bool_]) -> None:
    """Check a shard's tiles against their digests, and write the tiles for which ``is_stored`` is true.

    Raises ``BrokenShardError``.
    """
    ends = np.cumsum(index.lengths, dtype=np.int64).tolist()
    expected = ends[-1] if ends else 0
    if len(shard) != expected:
        raise BrokenShardError(f"shard {shard_number} has {len(shard)} bytes, but its index lists {expected}", shard_number)
    view, digests = memoryview(shard), index.digests.tobytes()
    edges = [0, *ends]
    for row, (begin, end) in enumerate(pairwise(edges)):
        if _digest(view[begin:end]) != digests[row * DIGEST_BYTES : (row + 1) * DIGEST_BYTES]:
            z, x, y = tileid_to_zxy(int(index.ids[row]))
            raise BrokenShardError(f"shard {shard_number}: tile {z}/{x}/{y} does not match its digest", shard_number)
    if is_stored.all():
        file.write(shard)
        return
    for row in np.flatnonzero(is_stored).tolist():
        file.write(view[edges[row] : edges[row + 1]])


def _digest(tile: bytes | memoryview) -> bytes:
    """Return the BLAKE2b digest of a tile, ``DIGEST_BYTES`` bytes."""
    return blake2b(tile, digest_size=DIGEST_BYTES).digest()


def first_tile_id(zoom: int) -> int:
    """Return the first tile id of a zoom, which is the number of tiles of all lower zooms."""
    return (4**zoom - 1) // 3
