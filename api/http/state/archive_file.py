"""Read PMTiles archives: https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md

An archive has a root directory, whose entries are tiles or leaf directories with further entries. Directories are decoded into
arrays and validated. The file is read with ``pread`` and not mapped into memory. A file that is truncated while it is served then
causes an error and does not kill the process.
"""

from __future__ import annotations

import hashlib
import json
import os
import weakref
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pmtiles.tile import Compression, HeaderDict, TileType, deserialize_header, tileid_to_zxy, zxy_to_tileid

from skugga.api.archive_format import ARCHIVED_MEDIA_TYPES, FORMAT_BY_TILE_TYPE, PMTILES_HEADER_BYTES
from skugga.api.errors import ArchiveError
from skugga.api.file_stamps import Stamp, file_stamps
from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.errors import Problem

MAX_DIRECTORY_DEPTH = 3
"""Maximum number of nested directories, including the root."""

MAX_DECOMPRESSED_BYTES = 64 * MIB
"""Maximum bytes of a decompressed directory or metadata document. A leaf directory of 4096 entries has some 40 KB."""

MAX_VALIDATED_LEAF_BYTES = 64 * MIB
"""Maximum compressed bytes of leaf directories that are validated when an archive is opened. It takes a second or two.

Leaf directories beyond this limit are validated when they are first used."""

ARCHIVE_REMEDY = "Give a whole PMTiles archive of version 3 with tiles as pictures"


@dataclass(frozen=True, eq=False)
class _Directory:
    """The decoded entries of a directory, as arrays of uint64 and shape (n,).

    Attributes
    ----------
    ids
        First tile id of each entry, ascending.
    run_lengths
        Number of consecutive tile ids that the entry's tile stands for; 0 if the entry is a leaf directory.
    lengths
        Lengths of the tiles or leaf directories in bytes.
    offsets
        Their offsets in bytes, from the begin of the section of tiles or of leaf directories.
    """

    ids: NDArray[np.uint64]
    run_lengths: NDArray[np.uint64]
    lengths: NDArray[np.uint64]
    offsets: NDArray[np.uint64]

    @property
    def nbytes(self) -> int:
        """Total bytes of the arrays."""
        return 4 * self.ids.nbytes


_directory_cache: Cache[_Directory] = Cache("skugga.api.http.archive_directories", "process", 64 * MIB)


class ArchiveFile:
    """An open PMTiles archive of raster tiles.

    All threads may use it except the thread of the event loop, since it reads files. The constructor and every read raise
    ``ArchiveError``, which names the file, if the file is incomplete or broken or has tiles of another kind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            (self.stamp,) = file_stamps([path])  # before reading: the next check then sees changes made meanwhile
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise self._error(error.strerror or str(error)) from None
        weakref.finalize(self, os.close, self._descriptor)
        self.header = self._read_header()
        self.metadata = self._read_metadata()
        self.version = self._compute_version()
        self._root_directory = self._checked_root()
        self.first_tile = self._find_first_tile()
        self.format = FORMAT_BY_TILE_TYPE[self.header["tile_type"]]
        self.media_type = ARCHIVED_MEDIA_TYPES[self.format]

    @property
    def zooms(self) -> range:
        """The zooms of the archive's tiles, as its header has them."""
        return range(self.header["min_zoom"], self.header["max_zoom"] + 1)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Bounds of the archive as its header has them: west, south, east and north in degrees."""
        header = self.header
        edges = (header["min_lon_e7"], header["min_lat_e7"], header["max_lon_e7"], header["max_lat_e7"])
        west, south, east, north = (edge / 1e7 for edge in edges)
        return west, south, east, north

    @property
    def skugga_metadata(self) -> dict[str, Any]:
        """The member ``skugga`` of the metadata, which this package writes; empty if another program made the archive."""
        skugga_part = self.metadata.get("skugga")
        return skugga_part if isinstance(skugga_part, dict) else {}

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a tile's bytes; ``None`` if the archive lacks the tile. Raises ``ArchiveError``.

        ``x`` is the column from the west, and ``y`` the row from the north.
        """
        if zoom not in self.zooms or not (0 <= x < 2**zoom and 0 <= y < 2**zoom):
            return None
        tile_id = zxy_to_tileid(zoom, x, y)
        directory = self._root_directory
        for _ in range(MAX_DIRECTORY_DEPTH):
            row = int(np.searchsorted(directory.ids, np.uint64(tile_id), side="right")) - 1
            if row < 0:
                return None
            run, length, offset = (int(column[row]) for column in (directory.run_lengths, directory.lengths, directory.offsets))
            if run:
                is_in_run = tile_id < int(directory.ids[row]) + run
                return self._read(self.header["tile_data_offset"] + offset, length) if is_in_run else None
            directory = self._leaf_directory(offset, length)
        raise self._error(f"directories nested more than {MAX_DIRECTORY_DEPTH} deep")

    def _find_first_tile(self) -> tuple[int, int, int]:
        """Return zoom, column and row of the tile with the lowest tile id."""
        directory = self._root_directory
        for _ in range(MAX_DIRECTORY_DEPTH):
            if directory.run_lengths[0]:
                return tileid_to_zxy(int(directory.ids[0]))
            directory = self._leaf_directory(int(directory.offsets[0]), int(directory.lengths[0]))
        raise self._error(f"directories nested more than {MAX_DIRECTORY_DEPTH} deep")

    def _read_header(self) -> HeaderDict:
        """Read and check the header of the archive. Raises ``ArchiveError``."""
        raw = os.pread(self._descriptor, PMTILES_HEADER_BYTES, 0)
        if raw[:7] != b"PMTiles":
            raise self._error("not a PMTiles archive" if raw[:2] != b"PM" else "a PMTiles archive of an earlier version")
        if raw[7:8] not in (b"", b"\x03"):
            raise self._error(f"a PMTiles archive of version {raw[7]}")
        if len(raw) < PMTILES_HEADER_BYTES:
            raise self._error("truncated: it ends in its header")
        try:
            header = deserialize_header(raw)
        except ValueError as error:
            raise self._error(f"its header is wrong: {error}") from None
        if header["tile_type"] not in FORMAT_BY_TILE_TYPE:
            kind = "vector tiles" if header["tile_type"] in (TileType.MVT, TileType.MLT) else "tiles of an unknown kind"
            raise self._error(f"it has {kind}, which are not served")
        for part in ("internal", "tile"):
            default_compression = Compression.UNKNOWN if part == "tile" else Compression.GZIP
            compression = header["tile_compression"] if part == "tile" else header["internal_compression"]
            if compression not in (Compression.NONE, default_compression):
                raise self._error(
                    f"its {'tiles' if part == 'tile' else 'directories'} are compressed by {compression.name.lower()}"
                )
        size = os.fstat(self._descriptor).st_size
        ends = {
            "root directory": header["root_offset"] + header["root_length"],
            "metadata": header["metadata_offset"] + header["metadata_length"],
            "leaf directories": header["leaf_directory_offset"] + header["leaf_directory_length"],
            "tiles": header["tile_data_offset"] + header["tile_data_length"],
        }
        part, end = max(ends.items(), key=lambda item: item[1])
        if end > size:
            raise self._error(f"truncated: its {part} end at byte {end}, but the file has {size} bytes")
        if not header["min_zoom"] <= header["max_zoom"] <= 31:
            raise self._error(f"its header is wrong: zooms from {header['min_zoom']} to {header['max_zoom']}")
        return header

    def _read_metadata(self) -> dict[str, Any]:
        """Read the metadata of the archive, a JSON object; empty if it has none. Raises ``ArchiveError``."""
        raw = self._decompress(self.header["metadata_offset"], self.header["metadata_length"], "metadata")
        try:
            metadata = json.loads(raw) if raw else {}
        except ValueError:
            raise self._error("its metadata are not JSON") from None
        if not isinstance(metadata, dict):
            raise self._error("its metadata are not a JSON object")
        return metadata

    def _compute_version(self) -> str:
        """Return a digest, 16 hexadecimal digits, that changes with the file's stamp, its header and its metadata."""
        text = repr((self.stamp, sorted(map(str, self.header.items())), sorted(map(str, self.metadata.items()))))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _checked_root(self) -> _Directory:
        """Read the root directory, and validate leaf directories up to ``MAX_VALIDATED_LEAF_BYTES``. Raises ``ArchiveError``."""
        root = self._read_directory(self.header["root_offset"], self.header["root_length"])
        bytes_left = MAX_VALIDATED_LEAF_BYTES
        for length, offset in _leaf_directories(root):
            bytes_left -= length
            if bytes_left < 0:
                break
            self._leaf_directory(offset, length)
        return root

    def _leaf_directory(self, offset: int, length: int) -> _Directory:
        """Return a leaf directory from the cache or from the file.

        ``offset`` is counted from the begin of the section of leaf directories, and ``length`` is its compressed size; both are
        in bytes.
        """
        directory = _directory_cache.get(self, offset)
        if isinstance(directory, Missing):
            if offset + length > self.header["leaf_directory_length"]:
                raise self._error("broken directories: a leaf reaches past the end of the leaf directories")
            directory = self._read_directory(self.header["leaf_directory_offset"] + offset, length)
            _directory_cache.put(self, offset, value=directory)
        return directory

    def _read_directory(self, offset: int, length: int) -> _Directory:
        """Read, decode and validate a directory, whose ``length`` compressed bytes begin at byte ``offset`` of the file.

        Raises ``ArchiveError``.
        """
        numbers = _varints(self._decompress(offset, length, "directories"))
        count = int(numbers[0]) if numbers is not None and len(numbers) else 0
        if numbers is None or count == 0 or len(numbers) != 1 + 4 * count:
            raise self._error("broken directories: one is truncated or empty")
        deltas, run_lengths, lengths, codes = numbers[1:].reshape(4, count)
        ids = np.cumsum(deltas, dtype=np.uint64)
        # A code of 0 means that the entry follows the previous one. Its offset is the last explicit offset plus the lengths since.
        is_explicit = codes > 0
        if not is_explicit[0]:
            raise self._error("broken directories: the first entry has no offset")
        lengths_before = np.concatenate([[0], np.cumsum(lengths[:-1], dtype=np.uint64)]).astype(np.uint64)
        last_explicit = np.maximum.accumulate(np.where(is_explicit, np.arange(count), 0))
        offsets = codes[last_explicit] - np.uint64(1) + lengths_before - lengths_before[last_explicit]
        is_tile = run_lengths > 0
        ends = offsets + lengths
        if not (
            (deltas[1:] > 0).all()
            and (ids[1:] >= ids[:-1] + run_lengths[:-1]).all()
            and lengths.all()
            and (ends >= lengths).all()
            and (ends[is_tile] <= self.header["tile_data_length"]).all()
            and (ends[~is_tile] <= self.header["leaf_directory_length"]).all()
        ):
            raise self._error("broken directories: entries overlap, or reach past the end")
        return _Directory(ids, run_lengths, lengths, offsets)

    def _decompress(self, offset: int, length: int, section_name: str) -> bytes:
        """Return ``length`` bytes at byte ``offset`` of the file, decompressed as the header says.

        ``section_name`` names them in an error. Raises ``ArchiveError``.
        """
        raw = self._read(offset, length)
        if self.header["internal_compression"] is Compression.NONE or not raw:
            return raw
        decompressor = zlib.decompressobj(wbits=31)
        try:
            decompressed = decompressor.decompress(raw, MAX_DECOMPRESSED_BYTES)
        except zlib.error:
            raise self._error(f"broken {section_name}: not gzip") from None
        if not decompressor.eof:
            raise self._error(f"broken {section_name}: gzip that is truncated or larger than {MAX_DECOMPRESSED_BYTES // MIB} MiB")
        return decompressed

    def _read(self, offset: int, length: int) -> bytes:
        """Return ``length`` bytes at byte ``offset`` of the file. Raises ``ArchiveError`` if the file ends before."""
        try:
            raw = os.pread(self._descriptor, length, offset)
        except (OSError, OverflowError) as error:
            raise self._error(f"cannot be read: {error}") from None
        if len(raw) < length:
            raise self._error("truncated since it was opened")
        return raw

    def _error(self, fault: str) -> ArchiveError:
        """Return the error that names this file and its ``fault``."""
        return ArchiveError(str(self.path), Problem(fault), ARCHIVE_REMEDY)


def has_changed(archive: ArchiveFile | None, path: Path) -> bool:
    """Return whether the file at ``path`` has changed since it was opened as ``archive``; true if ``archive`` is ``None``.

    Reads the file's status (size, times and inode), not its content.
    """
    stamp: Stamp = file_stamps([path])[0]
    return archive is None or archive.stamp != stamp


def _leaf_directories(directory: _Directory) -> Iterator[tuple[int, int]]:
    """Return pairs of length and offset, in bytes, of the leaf directories that a directory lists."""
    rows = np.flatnonzero(directory.run_lengths == 0)
    return zip(directory.lengths[rows].tolist(), directory.offsets[rows].tolist(), strict=True)


def _varints(raw: bytes) -> NDArray[np.uint64] | None:
    """Decode a sequence of varints to uint64 (n,).

    A byte of a varint has 7 bits of the number, the lowest bits first. Its highest bit is set except in the number's last byte.

    Returns ``None`` for bytes that are empty or end within a number, and for numbers of more than ten bytes.
    """
    data = np.frombuffer(raw, np.uint8)
    ends = np.flatnonzero(data < 128)
    if not len(data) or data[-1] >= 128:
        return None
    begins = np.concatenate([[0], ends[:-1] + 1])
    byte_index = np.arange(len(data)) - np.repeat(begins, ends - begins + 1)
    if byte_index.max() >= 10:
        return None
    return np.add.reduceat((data & 127).astype(np.uint64) << (7 * byte_index).astype(np.uint64), begins)
