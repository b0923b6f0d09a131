"""PMTiles archives: served by themselves, and in place of rendering a level's tiles."""

from __future__ import annotations

import gzip
import os
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from pmtiles.reader import MmapSource, all_tiles
from pmtiles.tile import Compression, TileType, tileid_to_zxy
from pmtiles.writer import Writer

from skugga.api.errors import ArchiveError
from skugga.api.http.server.app import create_app
from skugga.api.http.state import archive_file
from skugga.api.http.state.archive_file import ArchiveFile
from skugga.api.http.state.served_archives import with_utc_time
from skugga.api.seed.archive import first_tile_id
from skugga.api.settings import Settings
from skugga.terrain.errors import InputError, LevelError
from skugga.terrain.level.level import load_level
from tests.api.conftest import CORNER, PNG, ZOOM, Client, running, write_level, write_tiles
from tests.api.http.test_problems import check_problem
from tests.api.seed.pmtiles_checker import MAGIC, tile_id_to_zxy
from tests.api.workers import fake_workers

X, Y = CORNER
TILES = "/levels/hills/tiles/WebMercatorQuad"
TIME = "2024-06-21T16:00:00+00:00"

READY_TIMEOUT_S = 600
"""A render worker compiles at its first start."""


def tile_of(number: int) -> bytes:
    """Return the content of a tile, which differs for each number."""
    return MAGIC["png"] + number.to_bytes(8, "big") + bytes(40)


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file's content atomically."""
    part = path.with_suffix(".part")
    part.write_bytes(content)
    os.replace(part, path)


@pytest.fixture
def serve(tmp_path: Path) -> Callable[..., object]:
    """Return ``serve(keys, archives, **settings)``, which starts a service of ``hills`` with keys and a fake render worker."""

    def make(keys: dict | None, archives: list[Path] = [], **settings) -> object:  # noqa: B006
        levels = [] if keys is None else [write_level(tmp_path, "hills", **keys)]
        settings = {"level_check_s": 0.0, "tile_cache_bytes": 0} | settings
        return running(create_app(Settings(workers=1, **settings), levels, fake_workers.scripted, archives=archives))

    return make


def drawn_block_count(client: Client) -> int:
    """Return how many blocks the render workers have drawn."""
    return client.service.pool.counters.jobs_answered


def test_archived_tile_equals_the_rendered_tile(client: Client, serve, tmp_path: Path):
    """One service renders the tiles; another, which renders nothing, sends equal bytes for each canonical query."""
    end = time.monotonic() + READY_TIMEOUT_S
    while client.get("/readyz").status_code != 200:  # this may be the first test of a run
        assert time.monotonic() < end, "no render process is ready"
        time.sleep(0.5)
    queries = {"a": {"layer": "shadow"}, "b": {"layer": "color", "time": TIME}, "c": {"layer": "terrarium"}}
    places = [(ZOOM, X + col, Y + row) for row in (-1, 0) for col in (-1, 0)]
    rendered = {
        name: {(z, x, y): client.get(f"{TILES}/{z}/{x}/{y}.png", params=query).content for z, x, y in places}
        for name, query in queries.items()
    }
    for name, query in queries.items():
        tile_metadata = {
            "layer": query["layer"],
            "query": f"time={TIME.replace(':', '%3A').replace('+', '%2B')}" if "time" in query else "",
        }
        write_tiles(tmp_path / f"{name}.pmtiles", rendered[name], **tile_metadata)
    with serve({"archive": [f"{name}.pmtiles" for name in queries]}) as archive_client:
        for name, query in queries.items():
            for (z, x, y), body in rendered[name].items():
                answer = archive_client.get(f"{TILES}/{z}/{x}/{y}.png", params=query)
                assert (answer.status_code, answer.content) == (200, body) and body.startswith(MAGIC["png"])
                assert answer.headers["content-type"] == "image/png" and "archive" in answer.headers["server-timing"]
        # The same instant in another spelling; heights do not depend on the sun.
        other = archive_client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png", params={"time": "2024-06-21T18:00:00+02:00"})
        assert other.content == rendered["b"][ZOOM, X, Y] and other.headers["x-skugga-time"] == "2024-06-21T18:00:00+02:00"
        height_response = archive_client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png", params={"layer": "terrarium", "time": TIME})
        assert height_response.content == rendered["c"][ZOOM, X, Y]
        assert drawn_block_count(archive_client) == 0


def test_requests_outside_the_archive_are_rendered(serve, tmp_path: Path):
    write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): PNG}, layer="shadow")
    with serve({"archive": "a.pmtiles"}) as client:
        assert client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png?layer=shadow").content == PNG
        assert drawn_block_count(client) == 0
        for count, (address, query) in enumerate(
            [
                (f"{ZOOM}/{X}/{Y}.png", {}),
                (f"{ZOOM}/{X}/{Y}.webp", {"layer": "shadow"}),
                (f"{ZOOM}/{X}/{Y}.png", {"layer": "shadow", "time": TIME}),
                (f"{ZOOM}/{X}/{Y}.png", {"layer": "shadow", "map_size": "512"}),
                (f"{ZOOM}/{X}/{Y}@2x.png", {"layer": "shadow"}),
                (f"{ZOOM + 1}/{2 * X}/{2 * Y}.png", {"layer": "shadow", "time": TIME}),
            ],
            start=1,
        ):
            answer = client.get(f"{TILES}/{address}", params=query)
            assert answer.status_code == 200 and answer.content != PNG, address
            assert drawn_block_count(client) == count, address


def test_an_archive_of_one_kind_does_not_answer_for_another(serve, tmp_path: Path):
    write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): PNG}, layer="sky_view", query="kind=openness")
    with serve({"archive": "a.pmtiles"}) as client:
        contents = {
            kind: client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png", params={"layer": "sky_view", "kind": kind}).content
            for kind in ("openness", "solid_angle", "cosine")
        }
    assert contents["openness"] == PNG and PNG not in (contents["solid_angle"], contents["cosine"])


def test_other_matrix_set_is_rendered(serve, tmp_path: Path):
    write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): PNG}, tms="WorldCRS84Quad")
    with serve({"archive": "a.pmtiles"}) as client:
        assert client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png").content != PNG


def test_first_of_two_archives_wins(serve, tmp_path: Path):
    write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): tile_of(1)})
    write_tiles(tmp_path / "b.pmtiles", {(ZOOM, X, Y): tile_of(2)})
    with serve({"archive": ["b.pmtiles", "a.pmtiles"]}) as client:
        assert client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png").content == tile_of(2)


def test_archived_tile_has_cache_headers_and_304(serve, tmp_path: Path):
    write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): tile_of(1), (ZOOM, X, Y - 1): tile_of(2)})
    with serve({"archive": "a.pmtiles"}) as client:
        answer = client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png", headers={"Origin": "https://map.example"})
        assert answer.headers["cache-control"].startswith("public, max-age=3600,")
        assert answer.headers["access-control-allow-origin"] == "*"
        not_modified = client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png", headers={"If-None-Match": answer.headers["etag"]})
        assert (not_modified.status_code, not_modified.content, not_modified.headers["etag"]) == (304, b"", answer.headers["etag"])
        assert client.get(f"{TILES}/{ZOOM}/{X}/{Y - 1}.png").headers["etag"] != answer.headers["etag"]
        head = client.head(f"{TILES}/{ZOOM}/{X}/{Y}.png")
        assert (head.status_code, head.content, head.headers["etag"]) == (200, b"", answer.headers["etag"])


@pytest.mark.parametrize(("setting", "status"), [("transparent", 200), ("204", 204), ("404", 404)])
def test_missing_archived_tile_is_empty(serve, tmp_path: Path, setting: str, status: int):
    path = write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): tile_of(1)})
    with serve({"archive": "a.pmtiles"}, empty_tile=setting) as client:
        answer = client.get(f"{TILES}/{ZOOM}/{X - 1}/{Y}.png")
        assert answer.status_code == status and drawn_block_count(client) == 0
        if status == 404:
            check_problem(answer, 404, "not_found", "x")
            return
        if status == 200:
            assert answer.content == client.get(f"{TILES}/{ZOOM}/{X + 50}/{Y}.png").content
        write_tiles(path, {(ZOOM, X, Y): tile_of(1), (ZOOM, X - 1, Y): tile_of(2)})
        filled = client.get(f"{TILES}/{ZOOM}/{X - 1}/{Y}.png", headers={"If-None-Match": answer.headers["etag"]})
        assert (filled.status_code, filled.content) == (200, tile_of(2))
        path.unlink()  # the rendered tile has another ETag
        assert client.get(f"{TILES}/{ZOOM}/{X - 1}/{Y}.png").headers["etag"] not in (answer.headers["etag"], filled.headers["etag"])


def test_replaced_archive_is_reopened(serve, tmp_path: Path, capfd):
    """Cached rendered tiles do not hide it: the address switches to the archive's tile and back."""
    path = write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): tile_of(1)}, layer="shadow")
    address = f"{TILES}/{ZOOM}/{X}/{Y}.png"
    with serve({"archive": "a.pmtiles"}, tile_cache_bytes=2**20, level_check_s=0.05) as client:

        def wait_for_content(content: bytes) -> httpx.Response:
            for _ in range(200):
                answer = client.get(address)
                assert answer.status_code == 200
                if answer.content == content:
                    return answer
            raise AssertionError("the service did not send the expected tile within 200 requests")

        version = client.service.levels.cached_levels()[0].version
        rendered_tile = client.get(address).content
        assert client.get(address).content == rendered_tile and client.service.tiles.hits > 0
        other = tmp_path / "other.pmtiles"
        replace_file(path, write_tiles(other, {(ZOOM, X, Y): tile_of(2)}).read_bytes())
        second = wait_for_content(tile_of(2))
        replace_file(path, write_tiles(other, {(ZOOM, X, Y): tile_of(3)}).read_bytes())
        third = wait_for_content(tile_of(3))
        assert second.headers["etag"] != third.headers["etag"]
        replace_file(path, b"PMTiles\x02")
        wait_for_content(rendered_tile)
        replace_file(path, other.read_bytes())
        assert wait_for_content(tile_of(3)).headers["etag"] == third.headers["etag"]
        path.unlink()
        wait_for_content(rendered_tile)
        assert client.service.levels.cached_levels()[0].version == version
    log_text = capfd.readouterr().err
    assert log_text.count("a.pmtiles: a PMTiles archive of version 2.") == 1, "the error is logged once"
    assert log_text.count("a.pmtiles: No such file") == 1 and "Its tiles are rendered." in log_text and "was reopened" in log_text


def test_equal_archived_tiles_keep_their_own_headers(serve, tmp_path: Path):
    """The tile cache sends each answer with its own requested time and maximum age."""
    for name, query in (("a", ""), ("b", "time=2024-06-21T16%3A00%3A00%2B00%3A00")):
        write_tiles(tmp_path / f"{name}.pmtiles", {(ZOOM, X, Y): tile_of(1)}, query=query)
    moments = [None, "2024-06-21T18:00:00+02:00", "2024-06-21T16:00:00+00:00"]
    with serve({"archive": ["a.pmtiles", "b.pmtiles"]}, tile_cache_bytes=2**20, level_check_s=60.0) as client:
        while not client.service.pool.is_ready:  # answers depend on the renderer, too
            client.get("/readyz")
        for repeats in range(2):
            before = client.service.tiles.hits
            for moment in moments:
                answer = client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png", params={} if moment is None else {"time": moment})
                assert answer.content == tile_of(1) and answer.headers.get("x-skugga-time") == moment
                assert answer.headers["cache-control"].startswith(f"public, max-age={3600 if moment is None else 86400},")
            assert client.service.tiles.hits - before == repeats * len(moments)
        assert drawn_block_count(client) == 0


def test_archive_cut_after_opening_is_logged_and_rendered(serve, tmp_path: Path, monkeypatch, capfd):
    path = write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): tile_of(1)})
    with serve({"archive": "a.pmtiles"}, level_check_s=60.0) as client:
        assert client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png").content == tile_of(1)
        os.truncate(path, path.stat().st_size - 5)
        assert client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png").content not in (tile_of(1), b"")
        assert drawn_block_count(client) == 1
    assert "a.pmtiles: truncated since it was opened" in capfd.readouterr().err


def test_archive_does_not_change_the_level_digest(tmp_path: Path):
    plain_level = load_level(write_level(tmp_path, "hills"))
    named = load_level(write_level(tmp_path, "hills", archive="sub/a.pmtiles"))
    assert plain_level.digest == named.digest != load_level(write_level(tmp_path, "hills", seconds=1)).digest
    assert plain_level.archives == () and named.archives == (tmp_path / "sub" / "a.pmtiles",)
    assert named.sources == plain_level.sources
    for invalid_archive in ("https://example.org/a.pmtiles", "", ["a.pmtiles", "/vsicurl/b"], 7):
        with pytest.raises(LevelError, match="archive"):
            load_level(write_level(tmp_path, "hills", archive=invalid_archive))


def test_archive_must_lie_in_the_data_roots(tmp_path: Path, serve):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "levels").mkdir()
    archive = write_tiles(elsewhere / "a.pmtiles", {(ZOOM, X, Y): PNG})
    level = write_level(tmp_path / "levels", "hills", archive=str(archive))
    with pytest.raises(LevelError, match="lies outside the folders of levels"):
        create_app(Settings(), [level])
    create_app(Settings(data_roots=(elsewhere,)), [level])


# Archives without levels.


def test_archives_alone_need_no_render_worker(serve, tmp_path: Path):
    tiles = {(z, x, y): tile_of(100 * z + 10 * x + y) for z in (2, 3) for x in range(3) for y in range(3)}
    path = write_tiles(tmp_path / "sun & shade.pmtiles", tiles, layer="terrarium")
    with serve(None, [path]) as client:
        assert client.get("/readyz").status_code == 200 and client.service.pool.ready_pids == set()
        assert client.get("/levels").json() == []
        (facts,) = client.get("/archives").json()
        assert facts == {
            "name": "sun & shade", "title": "Hills", "attribution": "nobody", "bounds": [8.3, 47.4, 8.6, 47.6], "minzoom": 2,
            "maxzoom": 3, "format": "png", "layer": "terrarium",
        }  # fmt: skip
        response = client.get("/archives/sun & shade/tilejson.json")
        tilejson = response.json()
        assert response.headers["etag"] and tilejson["encoding"] == "terrarium" and tilejson["skugga"]["level"] == "hills"
        assert (tilejson["minzoom"], tilejson["maxzoom"], tilejson["bounds"]) == (2, 3, facts["bounds"])
        assert tilejson["center"] == pytest.approx([8.45, 47.5, 2])
        for (z, x, y), body in tiles.items():
            address = tilejson["tiles"][0].format(z=z, x=x, y=y)
            answer = client.get(address, headers={"Origin": "https://map.example"})
            assert (answer.status_code, answer.content) == (200, body)
            assert answer.headers["access-control-allow-origin"] == "*" and "max-age" in answer.headers["cache-control"]
            not_modified = client.get(address, headers={"If-None-Match": answer.headers["etag"]})
            assert (not_modified.status_code, not_modified.content) == (304, b"")
        assert client.get(address.replace("/3/2/2", "/3/7/7")).status_code == 204
        example = client.get("/openapi.json").json()["paths"]["/plan"]["post"]["requestBody"]["content"]["application/json"][
            "example"
        ]
        check_problem(client.post("/plan", json=example), 404, "not_found", "level")


@pytest.mark.parametrize(
    ("address", "parameter"),
    [
        ("nowhere/2/0/0.png", "archive"), ("nowhere/tilejson.json", "archive"), ("a/1/0/0.png", "z"), ("a/4/0/0.png", "z"),
        ("a/2/4/0.png", "x"), ("a/2/0/4.png", "x"), ("a/2/0/0.webp", "format"), ("a/2/0/0.gif", "format"),
    ],
)  # fmt: skip
def test_unknown_archived_tile_is_a_problem_document(serve, tmp_path: Path, address: str, parameter: str):
    with serve(None, [write_tiles(tmp_path / "a.pmtiles", {(2, 0, 0): PNG})]) as client:
        check_problem(client.get(f"/archives/{address}"), 404, "not_found", parameter)
        check_problem(client.get("/archives/a/2/0/0.png?layer=color"), 422, "invalid_parameter", "layer")
        assert client.get("/archives/a/2/0/0.png").status_code == 200


def test_missing_tile_is_404_if_configured(serve, tmp_path: Path):
    with serve(None, [write_tiles(tmp_path / "a.pmtiles", {(2, 0, 0): PNG})], empty_tile="404") as client:
        check_problem(client.get("/archives/a/2/1/1.png"), 404, "not_found", "x")


def test_service_serves_levels_and_archives(serve, tmp_path: Path):
    path = write_tiles(tmp_path / "a.pmtiles", {(ZOOM, X, Y): PNG})
    with serve({}, [path]) as client:
        assert [level["name"] for level in client.get("/levels").json()] == ["hills"]
        assert client.get(f"/archives/a/{ZOOM}/{X}/{Y}.png").content == PNG != client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png").content


def test_archive_replaced_or_broken_while_served_is_noticed(serve, tmp_path: Path, capfd):
    path = write_tiles(tmp_path / "a.pmtiles", {(2, 0, 0): tile_of(1)})
    with serve(None, [path]) as client:
        first = client.get("/archives/a/2/0/0.png")
        replace_file(path, write_tiles(tmp_path / "b.pmtiles", {(2, 0, 0): tile_of(2)}).read_bytes())
        second = client.get("/archives/a/2/0/0.png", headers={"If-None-Match": first.headers["etag"]})
        assert (first.content, second.content) == (tile_of(1), tile_of(2))
        replace_file(path, path.read_bytes()[:-3])
        for _ in range(3):
            answer = client.get("/archives/a/2/0/0.png")
            assert answer.status_code == 500 and answer.json()["code"] == "archive" and "/" not in answer.json()["detail"]
        assert client.get("/archives").json() == []
        replace_file(path, (tmp_path / "b.pmtiles").read_bytes())
        assert client.get("/archives/a/2/0/0.png").content == tile_of(2)
    assert "a.pmtiles: truncated: its tiles end at byte" in capfd.readouterr().err


def test_archives_of_one_name_are_refused(tmp_path: Path):
    (tmp_path / "b").mkdir()
    paths = [write_tiles(folder / "a.pmtiles", {(2, 0, 0): PNG}) for folder in (tmp_path, tmp_path / "b")]
    with pytest.raises(InputError, match="another archive are both named"):
        create_app(Settings(), [], archives=paths)


# Reading archive files.


def write_many_tiles(path: Path, last_zoom: int = 7) -> dict[tuple[int, int, int], bytes]:
    """Write an archive of all zooms with gaps and runs, and return its tiles."""
    numbers = [number for number in range(first_tile_id(last_zoom + 1)) if number % 7 and number % 1000 > 5]
    tiles = {tile_id_to_zxy(number): tile_of(number // 3) for number in numbers}
    write_tiles(path, tiles)
    return tiles


def test_leaf_directories_lead_to_every_tile(tmp_path: Path):
    tiles = write_many_tiles(tmp_path / "a.pmtiles", 8)
    archive = ArchiveFile(tmp_path / "a.pmtiles")
    assert archive.header["leaf_directory_length"] > 0
    for number in range(0, first_tile_id(9), 3):
        place = tile_id_to_zxy(number)
        assert archive.tile(*place) == tiles.get(place)
    assert archive.tile(9, 0, 0) is None and archive.tile(2, 4, 0) is None
    assert archive.first_tile in tiles


def test_archive_of_another_writer_is_read(tmp_path: Path):
    """The ``pmtiles`` package writes it, with plain directories and without our metadata."""
    path = tmp_path / "a.pmtiles"
    with path.open("wb") as file:
        writer = Writer(file)
        for number in range(5000):
            writer.write_tile(number, tile_of(number % 97 if number % 3 else 5))
        writer.finalize({"tile_type": TileType.WEBP, "tile_compression": Compression.UNKNOWN}, {})
    archive = ArchiveFile(path)
    assert (archive.format, archive.skugga_metadata, archive.metadata) == ("webp", {}, {})
    with path.open("rb") as file:
        assert all(archive.tile(*place) == body for place, body in all_tiles(MmapSource(file)))
    assert archive.tile(*tileid_to_zxy(5001)) is None


def test_uncompressed_directories_are_read(tmp_path: Path):
    tiles = {(2, x, x): tile_of(x) for x in range(4)}
    content = write_tiles(tmp_path / "a.pmtiles", tiles).read_bytes()
    offset, length = struct.unpack_from("<QQ", content, 8)
    metadata_offset, metadata_length = struct.unpack_from("<QQ", content, 24)
    (data,) = struct.unpack_from("<Q", content, 56)
    root, metadata = (
        gzip.decompress(content[offset : offset + length]),
        gzip.decompress(content[metadata_offset:][:metadata_length]),
    )
    header = bytearray(content[:127])
    struct.pack_into("<QQQQQQQ", header, 8, 127, len(root), 127 + len(root), len(metadata), 0, 0, 127 + len(root) + len(metadata))
    header[97] = 1
    (tmp_path / "plain.pmtiles").write_bytes(bytes(header) + root + metadata + content[data:])
    archive = ArchiveFile(tmp_path / "plain.pmtiles")
    assert {place: archive.tile(*place) for place in tiles} == tiles


def test_broken_leaf_directory_raises_archive_error(tmp_path: Path, monkeypatch):
    path = tmp_path / "a.pmtiles"
    tiles = write_many_tiles(path, 8)
    content = path.read_bytes()
    offset, length = struct.unpack_from("<QQ", content, 40)
    path.write_bytes(content[: offset + length - 2000] + bytes(2000) + content[offset + length :])
    with pytest.raises(ArchiveError, match="broken directories"):
        ArchiveFile(path)
    monkeypatch.setattr(archive_file, "MAX_VALIDATED_LEAF_BYTES", 0)
    archive = ArchiveFile(path)
    assert archive.tile(*tile_id_to_zxy(7 * 7 - 1)) == tiles[tile_id_to_zxy(48)]
    with pytest.raises(ArchiveError, match=r"a\.pmtiles: broken directories"):
        archive.tile(*max(tiles))


def test_archive_files_are_closed(tmp_path: Path):
    write_tiles(tmp_path / "a.pmtiles", {(2, 0, 0): PNG})
    before = len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else 0
    for _ in range(20):
        ArchiveFile(tmp_path / "a.pmtiles")
    assert len(os.listdir("/proc/self/fd")) - before <= 1


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("", ""), ("map_size=512", "map_size=512"), ("time=noon", "time=noon"),
        ("time=2024-06-21T18%3A00%3A00%2B02%3A00&a=1", "time=2024-06-21T16%3A00%3A00%2B00%3A00&a=1"),
        ("time=2024-06-21T16%3A00%3A00Z", "time=2024-06-21T16%3A00%3A00%2B00%3A00"),
    ],
)  # fmt: skip
def test_with_utc_time_normalizes_instants(query: str, expected: str):
    assert with_utc_time(query) == expected
