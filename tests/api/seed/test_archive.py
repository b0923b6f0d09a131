"""PMTiles archives: other readers find the written tiles byte by byte, and broken input is detected."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pmtiles.reader import MmapSource, Reader, all_tiles

from skugga.api.errors import BrokenShardError
from skugga.api.seed.archive import (
    DEDUPLICATION_LIMIT_BYTES,
    ArchiveMetadata,
    ArchiveSize,
    ShardIndex,
    first_tile_id,
    write_archive,
)
from skugga.terrain.errors import InputError
from tests.api.seed import pmtiles_checker
from tests.api.seed.pmtiles_checker import MAGIC, check_archive, tile_id_to_zxy

Shards = Sequence[Mapping[int, bytes]]


def archive_metadata(first_zoom: int, last_zoom: int, **changed: Any) -> ArchiveMetadata:
    """Return metadata of an archive. ``changed`` replaces fields."""
    facts = {"format": "png", "bounds": (7.0, 46.0, 8.0, 47.0), "metadata": {"name": "hills", "skugga": {"layer": "shadow"}}}
    return ArchiveMetadata(first_zoom=first_zoom, last_zoom=last_zoom, **(facts | changed))


def tile_of(number: int, size: int = 40) -> bytes:
    """Return a content of so many bytes that is unique to a number and begins like a PNG."""
    return MAGIC["png"] + number.to_bytes(8, "big") + bytes(size - 16)


def write_shards(path: Path, shards: Shards, facts: ArchiveMetadata) -> ArchiveSize:
    """Write an archive of shards (tiles by their ID), and return its size."""
    indexed_shards = [ShardIndex.from_tiles(shard) for shard in shards]
    return write_archive(path, [index for index, _ in indexed_shards], lambda number: indexed_shards[number][1], facts)


def pyramid(first_zoom: int, last_zoom: int, per_shard: int = 16) -> list[dict[int, bytes]]:
    """Return all tiles of some zooms, each with a different content, in shards."""
    ids = range(first_tile_id(first_zoom), first_tile_id(last_zoom + 1))
    return [{tile_id: tile_of(tile_id) for tile_id in ids[begin : begin + per_shard]} for begin in range(0, len(ids), per_shard)]


def read_back(path: Path) -> dict[tuple[int, int, int], bytes]:
    """Return all tiles as the reader of the pmtiles package finds them."""
    with path.open("rb") as file:
        return dict(all_tiles(MmapSource(file)))


def test_another_reader_finds_every_tile(tmp_path):
    path, shards = tmp_path / "hills.pmtiles", pyramid(0, 5)
    size = write_shards(path, shards, archive_metadata(0, 5))
    expected = {tile_id_to_zxy(tile_id): tile for shard in shards for tile_id, tile in shard.items()}
    assert len(expected) == size.tile_count == 1365
    with path.open("rb") as file:
        reader = Reader(MmapSource(file))
        assert {place: reader.get(*place) for place in expected} == expected
        assert reader.get(6, 0, 0) is None
        assert reader.metadata() == {"name": "hills", "skugga": {"layer": "shadow"}}
    archive = check_archive(path)
    assert archive.tiles == expected
    assert archive.metadata == {"name": "hills", "skugga": {"layer": "shadow"}}
    assert archive.leaves == 0
    assert path.stat().st_size == size.file_bytes


def test_the_same_tiles_give_the_same_bytes(tmp_path, monkeypatch):
    shards = pyramid(2, 5)
    write_shards(tmp_path / "a.pmtiles", shards, archive_metadata(2, 5))
    monkeypatch.setattr("time.time", lambda: 1e9)
    # Another time, other sizes of shards, and another order of the metadata's keys.
    other = archive_metadata(2, 5, metadata={"skugga": {"layer": "shadow"}, "name": "hills"})
    write_shards(tmp_path / "b.pmtiles", pyramid(2, 5, per_shard=64), other)
    assert (tmp_path / "a.pmtiles").read_bytes() == (tmp_path / "b.pmtiles").read_bytes()


def test_counts_of_runs_and_shared_contents(tmp_path):
    first = first_tile_id(3)
    sea, snow = tile_of(1), tile_of(2)
    large = tile_of(3, DEDUPLICATION_LIMIT_BYTES)  # too large to be deduplicated; in a run it is stored once
    shards = [
        {first: sea, first + 1: sea, first + 2: snow, first + 3: sea},  # a run of two, one, and the first again
        {first + 4: sea, first + 5: large, first + 6: large},  # the run continues across shards
        {first + 8: sea, first + 9: large, first + 10: tile_of(4)},  # after a gap: no run
    ]
    size = write_shards(tmp_path / "a.pmtiles", shards, archive_metadata(3, 3))
    archive = check_archive(tmp_path / "a.pmtiles")
    # Entries: sea (2), snow, sea (2, shared), large (2), sea (shared), large, 4. Contents: sea, snow, large twice, 4.
    assert (size.tile_count, size.entry_count, size.content_count) == (10, 7, 5)
    assert [archive.header[name] for name in ("addressed", "entries", "contents")] == [10, 7, 5]
    assert archive.header["data_bytes"] == 3 * 40 + 2 * DEDUPLICATION_LIMIT_BYTES
    assert archive.header["clustered"] == 1
    assert read_back(tmp_path / "a.pmtiles") == {tile_id_to_zxy(i): tile for shard in shards for i, tile in shard.items()}


def test_equal_tiles_across_a_gap_of_ids_are_no_run(tmp_path):
    last_of_2, first_of_3 = first_tile_id(3) - 1, first_tile_id(3)
    size = write_shards(tmp_path / "a.pmtiles", [{last_of_2: tile_of(1), first_of_3 + 1: tile_of(1)}], archive_metadata(2, 3))
    assert (size.entry_count, size.content_count) == (2, 1)
    assert set(check_archive(tmp_path / "a.pmtiles").tiles) == {tile_id_to_zxy(last_of_2), tile_id_to_zxy(first_of_3 + 1)}


def test_many_entries_have_leaf_directories(tmp_path):
    path, shards = tmp_path / "many.pmtiles", pyramid(0, 7)
    write_shards(path, shards, archive_metadata(0, 7))
    archive = check_archive(path)
    assert archive.header["entries"] == 21_845
    assert archive.leaves == 6  # of 4096 entries
    assert archive.tiles == {tile_id_to_zxy(i): tile for shard in shards for i, tile in shard.items()} == read_back(path)


def test_leaf_directories_grow_until_their_root_fits(tmp_path, monkeypatch):
    monkeypatch.setattr("skugga.api.seed.archive.INITIAL_LEAF_ENTRIES", 1)
    rng = np.random.default_rng(7)
    tiles = {i: tile_of(i, int(rng.integers(16, 60))) for i in sorted(rng.choice(4**12, 20_000, replace=False).tolist())}
    write_shards(tmp_path / "a.pmtiles", [tiles], archive_metadata(0, 12))
    archive = check_archive(tmp_path / "a.pmtiles")
    assert 1000 < archive.leaves < 20_000
    assert archive.tiles == {tile_id_to_zxy(i): tile for i, tile in tiles.items()}


@pytest.mark.parametrize(
    ("bounds", "edges"),
    [
        ((7.25, -46.5, 8.0, 47.0), (72_500_000, -465_000_000, 80_000_000, 470_000_000)),
        ((170.0, -20.0, 190.0, -10.0), (-1_800_000_000, -200_000_000, 1_800_000_000, -100_000_000)),
        ((-180.0, -90.5, 180.0, 90.5), (-1_800_000_000, -900_000_000, 1_800_000_000, 900_000_000)),
    ],
)
def test_bounds_are_those_of_a_map(tmp_path, bounds, edges):
    write_shards(tmp_path / "a.pmtiles", pyramid(1, 2), archive_metadata(1, 2, bounds=bounds))
    header = check_archive(tmp_path / "a.pmtiles").header
    assert tuple(header[name] for name in ("west", "south", "east", "north")) == edges
    assert (header["min_zoom"], header["max_zoom"], header["center_zoom"]) == (1, 2, 1)


@pytest.mark.parametrize("format", ["png", "jpg", "webp"])
def test_tiles_are_of_the_type_that_the_header_says(tmp_path, format):
    write_shards(tmp_path / "a.pmtiles", [{0: MAGIC[format] + b"1"}], archive_metadata(0, 0, format=format))
    check_archive(tmp_path / "a.pmtiles")


def test_an_index_survives_a_round_trip():
    index, shard = ShardIndex.from_tiles({9: b"nine", 5: b"five!"})
    assert shard == b"five!nine"
    blob = index.to_bytes()
    assert len(blob) == 2 * 28
    restored = ShardIndex.from_bytes(blob)
    for name in ("ids", "lengths", "digests"):
        np.testing.assert_array_equal(getattr(restored, name), getattr(index, name))
        assert getattr(restored, name).dtype == getattr(index, name).dtype
    assert restored.ids.tolist() == [5, 9] and restored.lengths.tolist() == [5, 4]
    with pytest.raises(ValueError):
        ShardIndex.from_bytes(blob[:-1])


def test_shards_are_read_once_each_in_order(tmp_path):
    indexed_shards = [ShardIndex.from_tiles(shard) for shard in [*pyramid(2, 3), {}]]  # the last one has no tile
    read_order = []
    write_archive(
        tmp_path / "a",
        [index for index, _ in indexed_shards],
        lambda i: read_order.append(i) or indexed_shards[i][1],
        archive_metadata(2, 3),
    )
    assert read_order == list(range(len(indexed_shards)))


@pytest.mark.parametrize(
    "break_shard",
    [
        lambda shard: shard[:-1],
        lambda shard: shard + b"x",
        lambda shard: b"",
        lambda shard: shard[:50] + bytes([shard[50] ^ 1]) + shard[51:],
    ],
)
def test_a_broken_shard_is_named_and_keeps_the_old_archive(tmp_path, break_shard):
    path = tmp_path / "a.pmtiles"
    write_shards(path, pyramid(2, 2), archive_metadata(2, 2))
    before = path.read_bytes()
    indexed_shards = [ShardIndex.from_tiles(shard) for shard in pyramid(2, 4)]
    with pytest.raises(BrokenShardError, match="shard 7") as caught:
        write_archive(
            path,
            [index for index, _ in indexed_shards],
            lambda i: break_shard(indexed_shards[i][1]) if i == 7 else indexed_shards[i][1],
            archive_metadata(2, 4),
        )
    assert caught.value.shard_number == 7
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.pmtiles"]


def test_a_deduplicated_tile_is_checked_too(tmp_path):
    index, shard = ShardIndex.from_tiles({5: tile_of(1), 6: tile_of(1)})
    with pytest.raises(BrokenShardError, match="tile 2/1/0 "):
        write_archive(tmp_path / "a", [index], lambda _: shard[:-1] + b"x", archive_metadata(1, 2))


def test_an_archive_without_tiles_is_not_written(tmp_path):
    for shards in ([], [{}]):
        with pytest.raises(InputError, match="tiles"):
            write_shards(tmp_path / "a.pmtiles", shards, archive_metadata(2, 3))
    with pytest.raises(ValueError, match="ascend"):
        write_shards(tmp_path / "a.pmtiles", [{30: b"a"}, {30: b"b"}], archive_metadata(2, 3))
    with pytest.raises(ValueError, match="zooms"):
        write_shards(tmp_path / "a.pmtiles", pyramid(2, 4), archive_metadata(2, 3))
    with pytest.raises(ValueError, match="without bytes"):
        write_shards(tmp_path / "a.pmtiles", [{30: b""}], archive_metadata(2, 3))
    assert not list(tmp_path.iterdir())


def _patched(path: Path, offset: int, struct_format: str, value: int) -> None:
    """Write a value, packed by ``struct_format``, at a byte offset of a file."""
    content = bytearray(path.read_bytes())
    struct.pack_into(struct_format, content, offset, value)
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(
    ("offset", "struct_format", "value"),
    [
        (0, "<B", 0), (7, "<B", 2), (8, "<Q", 16_300), (24, "<Q", 130), (48, "<Q", 3), (56, "<Q", 9), (64, "<Q", 10**6),
        (72, "<Q", 20), (80, "<Q", 1), (88, "<Q", 1), (99, "<B", 3), (100, "<B", 1), (101, "<B", 9), (102, "<i", 1_900_000_000),
        (118, "<B", 7), (123, "<i", 890_000_000),
    ],
)  # fmt: skip
def test_the_checker_detects_a_wrong_header(tmp_path, offset, struct_format, value):
    path = tmp_path / "a.pmtiles"
    write_shards(path, pyramid(2, 3), archive_metadata(2, 3))
    check_archive(path)
    _patched(path, offset, struct_format, value)
    with pytest.raises((AssertionError, OSError, json.JSONDecodeError)):
        check_archive(path)


def test_the_checker_detects_wrong_directories(tmp_path, monkeypatch):
    path = tmp_path / "a.pmtiles"
    write_shards(path, pyramid(2, 2), archive_metadata(2, 2))
    rows = [(first_tile_id(2) + row, 1, 40, 40 * row) for row in range(16)]
    for wrong_entries in (
        [rows[1], rows[0], *rows[2:]],  # ids
        [(*rows[0][:1], 2, *rows[0][2:]), *rows[1:]],  # a run over the next one
        [(*rows[0][:3], rows[5][3]), *rows[1:]],  # an offset ahead
        [(*rows[0][:2], 10**6, rows[0][3]), *rows[1:]],  # a length
        rows[:-1],
    ):
        monkeypatch.setattr(pmtiles_checker, "directory", lambda raw, wrong_entries=wrong_entries: wrong_entries)
        with pytest.raises(AssertionError):
            check_archive(path)
