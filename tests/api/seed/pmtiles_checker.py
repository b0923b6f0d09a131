"""Checker of files against version 3 of the PMTiles specification. It shares no code with any reader or writer.

https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md
"""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

MAGIC = {"png": b"\x89PNG\r\n\x1a\n", "jpg": b"\xff\xd8\xff", "webp": b"RIFF"}
TILE_TYPE_BY_FORMAT = {2: "png", 3: "jpg", 4: "webp"}
"""Codes of the supported tile types."""

HEADER = struct.Struct("<7sB 11Q 6B 4i B 2i")
HEADER_FIELDS = (
    "magic", "version", "root_at", "root_bytes", "metadata_at", "metadata_bytes", "leaves_at", "leaves_bytes", "data_at",
    "data_bytes", "addressed", "entries", "contents", "clustered", "internal", "compression", "type", "min_zoom", "max_zoom",
    "west", "south", "east", "north", "center_zoom", "center_lon", "center_lat",
)  # fmt: skip


@dataclass
class Archive:
    """A checked archive.

    Attributes
    ----------
    header
        Fields of the header by name.
    metadata
        Parsed JSON metadata.
    tiles
        Bytes of every tile by zoom, column and row.
    """

    header: dict[str, Any]
    metadata: dict[str, Any]
    tiles: dict[tuple[int, int, int], bytes] = field(default_factory=dict)
    leaves: int = 0


def check_archive(path: Path, any_content: bool = False) -> Archive:
    """Return an archive that conforms to the specification.

    Directories are gzipped or plain, tiles plain. ``any_content`` lets tiles have any bytes. Raises ``AssertionError``
    otherwise.
    """
    data = path.read_bytes()
    assert len(data) >= 127, "shorter than a header"
    assert HEADER.size == 127
    header = dict(zip(HEADER_FIELDS, HEADER.unpack(data[:127]), strict=True))
    assert (header["magic"], header["version"]) == (b"PMTiles", 3)
    assert header["clustered"] in (0, 1)
    assert header["internal"] in (1, 2), "directories are plain or gzipped"
    assert header["compression"] == 1, "tiles are plain"
    assert header["type"] in TILE_TYPE_BY_FORMAT

    parts = sorted((header[f"{part}_at"], header[f"{part}_bytes"], part) for part in ("root", "metadata", "leaves", "data"))
    end = 127
    for section_offset, length, part in parts:
        assert section_offset >= end or not length, f"{part} overlaps what is before it"
        end = max(end, section_offset + length)
        assert end <= len(data), f"{part} reaches past the end"
    assert header["root_at"] + header["root_bytes"] <= 16_384, "the root is not within the first 16 KiB"

    def unpacked(section_offset: int, length: int) -> bytes:
        raw = data[section_offset : section_offset + length]
        return gzip.decompress(raw) if header["internal"] == 2 else raw

    metadata = json.loads(unpacked(header["metadata_at"], header["metadata_bytes"]).decode("utf-8"))
    assert isinstance(metadata, dict)
    archive = Archive(header, metadata)

    content_offsets: set[int] = set()
    addressed = entries = data_end = next_id = 0
    leaves_read: list[tuple[int, int]] = []
    for tile_id, run, length, offset in _entries(header, unpacked, leaves_read):
        assert tile_id >= next_id, f"tile ids do not ascend, or a run overlaps: {tile_id}"
        assert length > 0 and run > 0
        assert offset + length <= header["data_bytes"], f"tile {tile_id} reaches past the tiles' data"
        if header["clustered"]:
            assert offset == data_end or offset in content_offsets, (
                f"clustered, but tile {tile_id} neither follows nor repeats another one"
            )
        content_offsets.add(offset)
        data_end = max(data_end, offset + length)
        next_id = tile_id + run
        addressed, entries = addressed + run, entries + 1
        content = data[header["data_at"] + offset : header["data_at"] + offset + length]
        assert any_content or content.startswith(MAGIC[TILE_TYPE_BY_FORMAT[header["type"]]]), f"tile {tile_id} is of another type"
        for run_id in range(tile_id, next_id):
            archive.tiles[tile_id_to_zxy(run_id)] = content
    archive.leaves = len(leaves_read)
    end = 0
    for section_offset, length in sorted(leaves_read):
        assert section_offset == end, "leaf directories overlap, or leave a gap"
        end = section_offset + length
    assert end == header["leaves_bytes"], "leaf directories that are not reached"

    assert (header["addressed"], header["entries"], header["contents"]) == (addressed, entries, len(content_offsets))
    assert data_end == header["data_bytes"], "bytes that no tile has"
    zooms = {z for z, _, _ in archive.tiles}
    assert (header["min_zoom"], header["max_zoom"]) == (min(zooms), max(zooms))
    assert header["min_zoom"] <= header["center_zoom"] <= header["max_zoom"]
    assert -1_800_000_000 <= header["west"] <= header["center_lon"] <= header["east"] <= 1_800_000_000
    assert -900_000_000 <= header["south"] <= header["center_lat"] <= header["north"] <= 900_000_000
    return archive


def _entries(header: dict[str, Any], unpacked: Any, leaves: list[tuple[int, int]]) -> Iterator[tuple[int, int, int, int]]:
    """Yield tile id, run, length and offset of every tile entry in order. Append leaf directories to ``leaves``."""

    def walk(raw: bytes, depth: int) -> Iterator[tuple[int, int, int, int]]:
        assert depth < 4, "directories are nested deeper than readers go"
        rows = directory(raw)
        assert rows, "a directory without entries"
        for row, (tile_id, run, length, offset) in enumerate(rows):
            if run:
                yield tile_id, run, length, offset
                continue
            assert offset + length <= header["leaves_bytes"], "a leaf directory reaches past the others"
            leaves.append((offset, length))
            below = list(walk(unpacked(header["leaves_at"] + offset, length), depth + 1))
            assert below[0][0] == tile_id, "a leaf directory does not begin with the id that it is under"
            assert row + 1 == len(rows) or below[-1][0] + below[-1][1] <= rows[row + 1][0], "leaf directories overlap in ids"
            yield from below

    yield from walk(unpacked(header["root_at"], header["root_bytes"]), 0)


def directory(raw: bytes) -> list[tuple[int, int, int, int]]:
    """Return tile id, run, length and offset of every entry of a directory's plain bytes."""
    count, *numbers = _varints(raw)
    assert len(numbers) == 4 * count, "a directory with too few or too many numbers"
    deltas, runs, lengths, codes = (numbers[count * column : count * (column + 1)] for column in range(4))
    rows: list[tuple[int, int, int, int]] = []
    tile_id = 0
    for place, (delta, run, length, code) in enumerate(zip(deltas, runs, lengths, codes, strict=True)):
        assert delta or not place, "an id twice"
        assert code or place, "the first entry follows no other"
        tile_id += delta
        rows.append((tile_id, run, length, code - 1 if code else rows[-1][3] + rows[-1][2]))
    return rows


def _varints(raw: bytes) -> Iterator[int]:
    """Yield the numbers of a sequence of protocol-buffer varints (seven bits a byte, lowest first)."""
    number = shift = 0
    for byte in raw:
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            yield number
            number = shift = 0
    assert not shift, "a number is cut short"


def tile_id_to_zxy(tile_id: int) -> tuple[int, int, int]:
    """Return zoom, column and row of a tile id.

    Ids count zooms one after another, and in each zoom along a Hilbert curve from the top left to the top right. From the
    finest step to the coarsest, each pair of bits gives the quadrant and the orientation of the previous square in it.
    """
    zoom = 0
    while tile_id >= 4**zoom:
        tile_id -= 4**zoom
        zoom += 1
    x = y = 0
    for step in range(zoom):
        side = 1 << step
        quadrant = tile_id >> 2 * step & 3
        if quadrant == 0:
            x, y = y, x
        elif quadrant == 1:
            y += side
        elif quadrant == 2:
            x, y = x + side, y + side
        else:
            x, y = 2 * side - 1 - y, side - 1 - x
    return zoom, x, y
