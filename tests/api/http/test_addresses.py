"""Addresses: where redirects lead, what is at none, how long documents are sent, and levels of one file name."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import pytest
import rasterio

from skugga.api.cli.level_argument import _named_level_source
from skugga.api.http import answers
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


def test_redirects_lead_to_the_public_address(tmp_path: Path):
    settings = Settings(workers=1, public_url="https://maps.example.org/skugga/")
    with running(create_app(settings, [write_level(tmp_path, "hills")], fake_workers.obedient)) as client:
        for path, to in (("/levels/hills/", "/levels/hills"), ("/wms/?REQUEST=GetCapabilities", "/wms?REQUEST=GetCapabilities")):
            answer = client.get(path, follow_redirects=False)
            assert (answer.status_code, answer.headers["Location"]) == (307, f"https://maps.example.org/skugga{to}")


def test_redirects_lead_to_where_they_were_asked_without_one(serve_with):
    client = serve_with(fake_workers.obedient)
    answer = client.get("/levels/hills/", follow_redirects=False)
    assert answer.headers["Location"] == f"{str(client.base_url).rstrip('/')}/levels/hills"


@pytest.mark.parametrize(
    ("accepted", "is_packed"),
    [("gzip", True), ("br, gzip;q=0.5", True), ("gzip;q=0", False), ("gzip; q=0.0", False), ("br", False), ("", False)],
)
def test_long_documents_are_compressed_for_who_takes_that(
    serve_with, monkeypatch: pytest.MonkeyPatch, accepted: str, is_packed: bool
):
    monkeypatch.setattr(answers, "MIN_GZIP_BYTES", 1000)
    client = serve_with(fake_workers.obedient)
    for path in ("/wms?REQUEST=GetCapabilities", "/wmts/1.0.0/WMTSCapabilities.xml"):
        with client.stream("GET", path, headers={"Accept-Encoding": accepted}) as answer:
            raw = b"".join(answer.iter_raw())
        assert "Accept-Encoding" in answer.headers["Vary"]
        assert answer.headers.get("Content-Encoding") == ("gzip" if is_packed else None)
        body = gzip.decompress(raw) if is_packed else raw
        assert body.startswith(b"<?xml") and (not is_packed or len(raw) < 0.3 * len(body))
        again = client.get(path, headers={"Accept-Encoding": accepted, "If-None-Match": answer.headers["ETag"]})
        assert again.status_code == 304


def test_a_browser_at_no_address_is_told_what_is_there(serve_with):
    client = serve_with(fake_workers.obedient)
    page = client.get("/no<b>thing", headers={"Accept": "text/html,*/*"})
    assert page.status_code == 404 and page.headers["Content-Type"].startswith("text/html")
    assert "/levels/hills.html" in page.text and "/docs" in page.text and "<b>" not in page.text
    assert "Content-Security-Policy" in page.headers
    check_problem(client.get("/nothing"), 404, "not_found", None)


def test_two_rasters_of_one_file_name_are_served_by_names_of_their_own(tmp_path: Path):
    first = write_level(tmp_path, "dem").with_suffix(".tif")
    (tmp_path / "other").mkdir()
    second = Path(shutil.copy(first, tmp_path / "other" / "dem.tif"))
    with pytest.raises(InputError, match="NAME=FILE"):
        ServedLevels([first, second])
    levels = ServedLevels([first, _named_level_source(f"other={second}", NO_OPTIONS)])
    assert levels.names() == ["dem", "other"]
    assert levels.get("other").key.name == "other" and levels.get("dem").key.name is None


@pytest.mark.parametrize("text", ["=dem.tif", "a/b=dem.tif", "ü=dem.tif", ".=dem.tif"])
def test_a_name_is_one_that_addresses_have(text: str):
    with pytest.raises(InputError, match="NAME"):
        _named_level_source(text, NO_OPTIONS)


def test_a_file_with_a_sign_of_equality_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_level(tmp_path, "a=b").with_suffix(".tif")
    monkeypatch.chdir(tmp_path)
    assert _named_level_source("a=b.tif", NO_OPTIONS) == LevelSource(path=path.relative_to(tmp_path))


def test_a_point_in_a_hole_does_not_blame_the_bounds(tmp_path: Path):
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
