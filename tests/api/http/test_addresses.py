"""Addresses: redirects, unknown paths, compressed documents, and level names that collide."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import pytest
import rasterio

from skugga.api.cli.level_argument import _named_level_source
from skugga.api.http import responses
from skugga.api.http.server.app import create_app
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.settings import Settings
from skugga.shadows.point.place import place_at
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import build_scene
from tests.api.conftest import running, write_level
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

NO_OPTIONS = dict.fromkeys(("canopy", "buildings", "nodata", "units", "positive"))


def test_redirects_use_the_public_url(tmp_path: Path):
    settings = Settings(workers=1, public_url="https://maps.example.org/skugga/")
    with running(create_app(settings, [write_level(tmp_path, "hills")], fake_workers.scripted)) as client:
        for path, target in (
            ("/levels/hills/", "/levels/hills"),
            ("/wms/?REQUEST=GetCapabilities", "/wms?REQUEST=GetCapabilities"),
        ):
            answer = client.get(path, follow_redirects=False)
            assert (answer.status_code, answer.headers["Location"]) == (307, f"https://maps.example.org/skugga{target}")


def test_redirects_use_the_request_host_by_default(serve_with):
    client = serve_with(fake_workers.scripted)
    answer = client.get("/levels/hills/", follow_redirects=False)
    assert answer.headers["Location"] == f"{str(client.base_url).rstrip('/')}/levels/hills"


@pytest.mark.parametrize(
    ("accept_encoding", "is_gzipped"),
    [("gzip", True), ("br, gzip;q=0.5", True), ("gzip;q=0", False), ("gzip; q=0.0", False), ("br", False), ("", False)],
)
def test_long_documents_are_gzipped_if_accepted(
    serve_with, monkeypatch: pytest.MonkeyPatch, accept_encoding: str, is_gzipped: bool
):
    monkeypatch.setattr(responses, "MIN_GZIP_BYTES", 1000)
    client = serve_with(fake_workers.scripted)
    for path in ("/wms?REQUEST=GetCapabilities", "/wmts/1.0.0/WMTSCapabilities.xml"):
        with client.stream("GET", path, headers={"Accept-Encoding": accept_encoding}) as answer:
            raw = b"".join(answer.iter_raw())
        assert "Accept-Encoding" in answer.headers["Vary"]
        assert answer.headers.get("Content-Encoding") == ("gzip" if is_gzipped else None)
        body = gzip.decompress(raw) if is_gzipped else raw
        assert body.startswith(b"<?xml") and (not is_gzipped or len(raw) < 0.3 * len(body))
        not_modified = client.get(path, headers={"Accept-Encoding": accept_encoding, "If-None-Match": answer.headers["ETag"]})
        assert not_modified.status_code == 304


def test_not_found_page_lists_levels_to_browsers(serve_with):
    client = serve_with(fake_workers.scripted)
    page = client.get("/no<b>thing", headers={"Accept": "text/html,*/*"})
    assert page.status_code == 404 and page.headers["Content-Type"].startswith("text/html")
    assert "/levels/hills.html" in page.text and "/docs" in page.text and "<b>" not in page.text
    assert "Content-Security-Policy" in page.headers
    check_problem(client.get("/nothing"), 404, "not_found", None)


def test_rasters_of_one_file_name_need_explicit_names(tmp_path: Path):
    first = write_level(tmp_path, "dem").with_suffix(".tif")
    (tmp_path / "other").mkdir()
    second = Path(shutil.copy(first, tmp_path / "other" / "dem.tif"))
    with pytest.raises(InputError, match="NAME=FILE"):
        ServedLevels([first, second])
    levels = ServedLevels([first, _named_level_source(f"other={second}", NO_OPTIONS)])
    assert levels.names() == ["dem", "other"]
    assert levels.reload_if_changed("other").key.name == "other" and levels.reload_if_changed("dem").key.name is None


@pytest.mark.parametrize("text", ["=dem.tif", "a/b=dem.tif", "ü=dem.tif", ".=dem.tif"])
def test_level_name_must_be_valid_in_a_url(text: str):
    with pytest.raises(InputError, match="NAME"):
        _named_level_source(text, NO_OPTIONS)


def test_file_name_with_equals_sign_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_level(tmp_path, "a=b").with_suffix(".tif")
    monkeypatch.chdir(tmp_path)
    assert _named_level_source("a=b.tif", NO_OPTIONS) == LevelSource(path=path.relative_to(tmp_path))


def test_point_in_a_nodata_hole_does_not_blame_bounds(tmp_path: Path):
    path = write_level(tmp_path, "hills")
    with rasterio.open(path.with_suffix(".tif"), "r+") as raster:
        raster.nodata = -9999.0
        height_m = raster.read(1)
        rows, cols = height_m.shape
        height_m[rows // 4 : 3 * rows // 4, cols // 4 : 3 * cols // 4] = -9999.0
        raster.write(height_m, 1)
    scene = build_scene(load_level(path))
    west, south, east, north = scene.bounds_lon_lat
    middle = (west + east) / 2, (south + north) / 2
    with pytest.raises(InputError, match="within the level's bounds .* its raster has none there"):
        place_at(scene, middle)
    with pytest.raises(InputError, match="a place on the level's data: longitudes"):
        place_at(scene, (middle[0], north + 1.0))
    with pytest.raises(InputError, match="has none there"):
        place_at(scene, (middle[0] + 360.0, middle[1]))
    scene.close()
