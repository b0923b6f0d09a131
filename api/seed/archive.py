"""PMTiles archives out of shards: https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md

Where every tile will lie follows from the shards' indexes alone. So header and directories are written first, and the tiles' bytes
are copied once, each checked against its digest on the way.
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

from skugga.api.archive_format import HEADER_BYTES, TILE_TYPES
from skugga.api.errors import BrokenShardError
from skugga.terrain.errors import InputError
from skugga.terrain.whole_files import replaced_whole

DIGEST_BYTES = 16

SHARED_BELOW_BYTES = 2048
"""Equal tiles of fewer bytes are stored once, wherever they are. Such are of one colour, or nearly so: among larger ones equal
tiles are rare, and to look for them costs memory with every tile."""

ROOT_END = 16_384
"""Header and root directory lie within so many bytes: readers fetch them in one request."""

ROOT_ENTRIES = 16_384
"""With more entries a root directory is not tried without leaves: hardly ever would it fit."""

LEAF_ENTRIES = 4096
"""Of a leaf directory at first: some 20 KB, one request of a reader."""

_TILE = np.dtype([("id", "<u8"), ("length", "<u4"), ("digest", "u1", (DIGEST_BYTES,))])
"""A tile in an index as bytes."""


@dataclass(frozen=True, eq=False)
class ShardIndex:
    """The tiles of a shard: ``ids`` (n,) uint64, PMTiles tile ids, ascending; ``lengths`` (n,) uint32, bytes, none of them 0;
    ``digests`` (n, 16) uint8, BLAKE2b of 16 bytes. The shard itself is the tiles' bytes in this order, and nothing else.
    """

    ids: NDArray[np.uint64]
    lengths: NDArray[np.uint32]
    digests: NDArray[np.uint8]

    @classmethod
    def of(cls, tiles: Mapping[int, bytes]) -> tuple[ShardIndex, bytes]:
        """The index of tiles by their ids, and the shard's bytes."""
        ids = sorted(tiles)
        digests = b"".join(_digest(tiles[tile_id]) for tile_id in ids)
        index = cls(
            np.array(ids, np.uint64),
            np.array([len(tiles[tile_id]) for tile_id in ids], np.uint32),
            np.frombuffer(digests, np.uint8).reshape(-1, DIGEST_BYTES),
        )
        return index, b"".join(tiles[tile_id] for tile_id in ids)

    def to_bytes(self) -> bytes:
        """The index in 28 bytes a tile."""
        table = np.empty(len(self.ids), _TILE)
        table["id"], table["length"], table["digest"] = self.ids, self.lengths, self.digests
        return table.tobytes()

    @classmethod
    def from_bytes(cls, blob: bytes) -> ShardIndex:
        """What ``to_bytes`` gave. Raises ``ValueError`` for bytes of another length."""
        table = np.frombuffer(blob, _TILE)
        return cls(*(np.ascontiguousarray(table[name]) for name in ("id", "length", "digest")))


@dataclass(frozen=True)
class ArchiveFacts:
    """What an archive says of itself: the tiles' format, west, south, east and north in degrees (east may pass 180), the zooms in
    which all tiles lie, and the JSON object of its metadata.
    """

    format: Literal["png", "webp", "jpg"]
    bounds: tuple[float, float, float, float]
    first_zoom: int
    last_zoom: int
    metadata: Mapping[str, Any]


@dataclass(frozen=True)
class ArchiveSize:
    """How large an archive is: bytes of the file, tiles that it answers, entries of its directories, and contents stored."""

    file_bytes: int
    tiles: int
    entries: int
    contents: int


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where everything will lie. ``stored`` (n,) bool says of every tile whether its bytes are copied; of entries there are
    ``ids``, ``offsets`` (uint64, bytes from the first tile's), ``lengths`` and ``runs``.
    """

    stored: NDArray[np.bool_]
    ids: NDArray[np.uint64]
    offsets: NDArray[np.uint64]
    lengths: NDArray[np.uint32]
    runs: NDArray[np.uint64]
    data_bytes: int


def write_archive(path: Path, indexes: Sequence[ShardIndex], read: Callable[[int], bytes], facts: ArchiveFacts) -> ArchiveSize:
    """Write the tiles of shards as a PMTiles archive: whole, or not at all. The same tiles and facts give the same bytes.

    The indexes' tile ids ascend from one shard to the next. ``read(i)`` is asked for shard i's bytes once, in order. Equal
    neighbours are one run, equal small tiles one content.

    Raises ``BrokenShardError`` for bytes that are not the index's, ``InputError`` where there is no tile, ``ValueError`` for ids in
    another order or outside of the zooms, ``OSError``, and what ``read`` raises.
    """
    layout = _layout(indexes, facts)
    head = _head(layout, facts)
    with replaced_whole(path) as part, part.open("wb") as file:
        file.write(head)
        first = 0
        for number, index in enumerate(indexes):
            _copy(file, number, index, read(number), layout.stored[first : first + len(index.ids)])
            first += len(index.ids)
    return ArchiveSize(len(head) + layout.data_bytes, len(layout.stored), len(layout.ids), int(np.count_nonzero(layout.stored)))


def _layout(indexes: Sequence[ShardIndex], facts: ArchiveFacts) -> _Layout:
    ids = np.concatenate([np.empty(0, np.uint64), *(index.ids for index in indexes)])
    lengths = np.concatenate([np.empty(0, np.uint32), *(index.lengths for index in indexes)])
    digests = np.concatenate([np.empty((0, DIGEST_BYTES), np.uint8), *(index.digests for index in indexes)])
    if not len(ids):
        raise InputError("tiles", "none", "at least one that shows data")
    if not (ids[1:] > ids[:-1]).all():
        raise ValueError("tile ids of shards do not ascend")
    if not (first_tile_id(facts.first_zoom) <= ids[0] and ids[-1] < first_tile_id(facts.last_zoom + 1)):
        raise ValueError(f"tiles outside of the zooms {facts.first_zoom} to {facts.last_zoom}")
    if not lengths.all():
        raise ValueError("a tile without bytes")

    keys = np.ascontiguousarray(digests).view(f"V{DIGEST_BYTES}")[:, 0]
    goes_on = (ids[1:] == ids[:-1] + 1) & (keys[1:] == keys[:-1]) & (lengths[1:] == lengths[:-1])
    begins = np.flatnonzero(np.concatenate([[True], ~goes_on]))  # first tile of every entry
    runs = np.diff(np.append(begins, len(ids))).astype(np.uint64)
    # The entry whose bytes each one refers to: the first of those that equal it.
    source = np.arange(len(begins))
    small = np.flatnonzero(lengths[begins] < SHARED_BELOW_BYTES)
    _, first, which = np.unique(keys[begins[small]], return_index=True, return_inverse=True)
    source[small] = small[first[which]]
    copied = source == np.arange(len(begins))
    entry_lengths = lengths[begins]
    ends = np.cumsum(np.where(copied, entry_lengths, 0), dtype=np.uint64)
    stored = np.zeros(len(ids), np.bool_)
    stored[begins[copied]] = True
    return _Layout(stored, ids[begins], (ends - entry_lengths)[source], entry_lengths, runs, int(ends[-1]))


def _head(layout: _Layout, facts: ArchiveFacts) -> bytes:
    """All that lies before the tiles' bytes."""
    root, leaves = _directories(layout)
    metadata = gzip.compress(json.dumps(dict(facts.metadata), sort_keys=True, allow_nan=False).encode(), mtime=0)
    west, south, east, north = facts.bounds
    # A reader knows no degrees past 180: what reaches round the earth there is all round it.
    west, east = (-180.0, 180.0) if east > 180.0 or west < -180.0 else (west, east)
    edges = [round(degrees * 1e7) for degrees in (west, max(south, -90.0), east, min(north, 90.0))]
    metadata_at, leaves_at = HEADER_BYTES + len(root), HEADER_BYTES + len(root) + len(metadata)
    first_zoom = tileid_to_zxy(int(layout.ids[0]))[0]
    header = serialize_header(
        {
            "version": 3,
            "root_offset": HEADER_BYTES,
            "root_length": len(root),
            "metadata_offset": metadata_at,
            "metadata_length": len(metadata),
            "leaf_directory_offset": leaves_at,
            "leaf_directory_length": len(leaves),
            "tile_data_offset": leaves_at + len(leaves),
            "tile_data_length": layout.data_bytes,
            "addressed_tiles_count": len(layout.stored),
            "tile_entries_count": len(layout.ids),
            "tile_contents_count": int(np.count_nonzero(layout.stored)),
            "clustered": True,
            "internal_compression": Compression.GZIP,
            "tile_compression": Compression.NONE,
            "tile_type": TILE_TYPES[facts.format],
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
    """Root directory and leaf directories; the leaves are made larger until a root of them lies where readers look for it."""
    count, most = len(layout.ids), ROOT_END - HEADER_BYTES
    if count <= ROOT_ENTRIES:
        root = serialize_directory(_entries(layout, 0, count))
        if len(root) <= most:
            return root, b""
    leaf_entries = LEAF_ENTRIES
    while True:
        of_leaves, leaves = [], bytearray()
        for first in range(0, count, leaf_entries):
            leaf = serialize_directory(_entries(layout, first, min(first + leaf_entries, count)))
            of_leaves.append(Entry(int(layout.ids[first]), len(leaves), len(leaf), 0))
            leaves += leaf
        root = serialize_directory(of_leaves)
        if len(root) <= most:
            return root, bytes(leaves)
        leaf_entries *= 2


def _entries(layout: _Layout, first: int, end: int) -> list[Entry]:
    part = slice(first, end)
    columns = (column[part].tolist() for column in (layout.ids, layout.offsets, layout.lengths, layout.runs))
    return [Entry(*row) for row in zip(*columns, strict=True)]


def _copy(file: BinaryIO, number: int, index: ShardIndex, shard: bytes, stored: NDArray[np.bool_]) -> None:
    """Check a shard's tiles and write those that are stored. Raises ``BrokenShardError``."""
    ends = np.cumsum(index.lengths, dtype=np.int64).tolist()
    expected = ends[-1] if ends else 0
    if len(shard) != expected:
        raise BrokenShardError(f"shard {number} has {len(shard)} bytes; its index says {expected}", number)
    view, digests = memoryview(shard), index.digests.tobytes()
    edges = [0, *ends]
    for row, (begin, end) in enumerate(pairwise(edges)):
        if _digest(view[begin:end]) != digests[row * DIGEST_BYTES : (row + 1) * DIGEST_BYTES]:
            z, x, y = tileid_to_zxy(int(index.ids[row]))
            raise BrokenShardError(f"shard {number}: the bytes of tile {z}/{x}/{y} are not those that were written", number)
    if stored.all():
        file.write(shard)
        return
    for row in np.flatnonzero(stored).tolist():
        file.write(view[edges[row] : edges[row + 1]])


def _digest(tile: bytes | memoryview) -> bytes:
    return blake2b(tile, digest_size=DIGEST_BYTES).digest()


def first_tile_id(zoom: int) -> int:
    """The first tile id of a zoom: the number of tiles of all zooms before it."""
    return (4**zoom - 1) // 3
