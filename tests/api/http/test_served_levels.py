"""Levels of a service: versions, errors, pins, and the cache of scenes."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil

from skugga.api.catalogue import bundled_levels
from skugga.api.errors import exit_status
from skugga.api.http.server.app import create_app
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.level_summary import remarks
from skugga.api.settings import Settings
from skugga.api.workers.jobs import LevelKey
from skugga.api.workers.worker_state import SceneCache
from skugga.terrain.errors import InputError, LevelError, NotFoundError, SkuggaError, SourceError, UnsupportedError
from tests.api.conftest import running, write_level
from tests.api.http.test_problems import check_problem


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """File of the level ``hills``."""
    return write_level(tmp_path, "hills")


def raise_ground(level: Path, metres: float) -> None:
    """Raise the heights of a level's raster by metres, with a later modification time."""
    raster = level.with_suffix(".tif")
    with rasterio.open(raster, "r+") as dataset:
        dataset.write(dataset.read(1) + np.float32(metres), 1)
    mtime_ns = raster.stat().st_mtime_ns + 10**9
    os.utime(raster, ns=(mtime_ns, mtime_ns))


def test_bundled_levels_can_be_served():
    levels = ServedLevels(bundled_levels())
    assert [level.name for level in levels.current_levels()] == [path.stem for path in bundled_levels()]
    assert all(bool(level.zooms) != level.world.is_flat for level in levels.current_levels())


def test_equal_files_have_equal_versions(path: Path):
    assert ServedLevels([path]).reload_if_changed("hills").version == ServedLevels([path]).reload_if_changed("hills").version


def test_changed_raster_changes_the_version(path: Path):
    levels = ServedLevels([path])
    before = levels.reload_if_changed("hills")
    assert levels.reload_if_changed("hills") is before
    raise_ground(path, 100)
    assert levels.reload_if_changed("hills").version != before.version


def test_changed_raster_in_a_nested_vrt_changes_the_version(path: Path):
    """The level names a VRT of a VRT; only GDAL knows which files that reads."""
    raster, inner, outer = path.with_suffix(".tif"), path.with_name("inner.vrt"), path.with_name("outer.vrt")
    rasterio.shutil.copy(raster, inner, driver="VRT")
    outer.write_text(inner.read_text().replace(raster.name, inner.name), encoding="utf-8")
    level = json.loads(path.read_text())
    path.write_text(json.dumps({**level, "terrain": {"source": outer.name}}), encoding="utf-8")
    levels = ServedLevels([path])
    before = levels.reload_if_changed("hills")
    raise_ground(path, 100)
    assert levels.reload_if_changed("hills").version != before.version


@pytest.mark.parametrize("ending", [".tif.aux.xml", ".tif.ovr", ".tfw", ".tif.msk"])
def test_new_sidecar_file_changes_the_version(path: Path, ending: str):
    levels = ServedLevels([path])
    before = levels.reload_if_changed("hills").version
    sidecar = path.with_name(f"hills{ending}")
    sidecar.write_text("<PAMDataset/>" if ending.endswith("xml") else "", encoding="utf-8")
    assert levels.reload_if_changed("hills").version != before


def test_replaced_raster_of_equal_time_and_size_is_noticed(path: Path):
    levels, raster = ServedLevels([path]), path.with_suffix(".tif")
    before, status = levels.reload_if_changed("hills").version, raster.stat()
    other = raster.with_suffix(".new")
    other.write_bytes(raster.read_bytes())
    os.utime(other, ns=(status.st_mtime_ns, status.st_mtime_ns))
    other.replace(raster)
    assert (raster.stat().st_mtime_ns, raster.stat().st_size) == (status.st_mtime_ns, status.st_size)
    assert levels.reload_if_changed("hills").version != before


def test_changed_level_file_is_read_again(path: Path):
    levels = ServedLevels([path])
    before = levels.reload_if_changed("hills").version
    path.write_text(json.dumps({**json.loads(path.read_text()), "title": "Other hills"}), encoding="utf-8")
    assert levels.reload_if_changed("hills").version != before
    assert levels.reload_if_changed("hills").summary()["title"] == "Other hills"


def test_broken_level_fails_until_it_is_repaired(path: Path):
    levels = ServedLevels([path])
    text = path.read_text()
    path.write_text("version: 7", encoding="utf-8")
    for _ in range(2):
        with pytest.raises(LevelError):
            levels.reload_if_changed("hills")
    assert levels.current_levels() == []
    path.write_text(text, encoding="utf-8")
    assert levels.reload_if_changed("hills").name == "hills"


def test_unknown_level_error_lists_the_known_ones(path: Path):
    with pytest.raises(NotFoundError, match="hills"):
        ServedLevels([path]).reload_if_changed("mountains")


def level_of_wrong_version(folder: Path) -> Path:
    """Return the file of a level whose format version is unknown."""
    path = folder / "wrong.yaml"
    path.write_text("version: 7", encoding="utf-8")
    return path


def level_without_raster(folder: Path) -> Path:
    """Return the file of a level whose raster is missing."""
    path = write_level(folder, "wrong")
    path.with_suffix(".tif").unlink()
    return path


def level_with_remote_raster(folder: Path) -> Path:
    """Return the file of a level whose raster is a URL."""
    return write_level(folder, "wrong", terrain={"source": "/vsicurl/https://example.org/wrong.tif"})


def level_with_truth(folder: Path) -> Path:
    """Return the file of a level that asks for ray-traced shadows."""
    return write_level(folder, "wrong", shadows={"algorithm": {"relief": "truth"}})


def level_with_tight_fit(folder: Path) -> Path:
    """Return the file of a level whose shadow maps depend on the view's extent."""
    return write_level(folder, "wrong", shadows={"fit": "tight"})


@pytest.mark.parametrize(
    ("write_wrong_level", "error_class", "expected_text"),
    [
        (level_of_wrong_version, LevelError, "version"),
        (level_without_raster, SourceError, "wrong.tif"),
        (level_with_remote_raster, LevelError, "SKUGGA_REMOTE_SOURCES"),
        (level_with_truth, LevelError, "shadow_map"),
        (level_with_tight_fit, LevelError, "stable"),
    ],
)
def test_unservable_level_is_an_error_that_names_it(tmp_path: Path, write_wrong_level, error_class, expected_text: str):
    with pytest.raises(error_class) as caught:
        ServedLevels([write_wrong_level(tmp_path)])
    assert "wrong" in str(caught.value) and expected_text in str(caught.value)
    assert exit_status(caught.value) == 2


@pytest.mark.parametrize(
    ("pin", "expected_texts"),
    [
        ({"algorithm": {"relief": "truth"}}, (".algorithm: ", "truth", "Allowed: auto, shadow_map")),
        ({"map_size": 512, "fit": "tight"}, (".fit: 'tight'", "auto or stable in a served level")),
        ({"view": "mapp", "map_size": 512}, (".view: 'mapp'", "one of the level's views: map")),
        ({"algorithm": {"lamp": {"relief": "hybrid"}}}, (".algorithm: ", "lamp", "a light (sun)")),
        ({"sun_altitude_deg": [9, 12], "map_size": 512}, (": 'view map, sun 9 to 12 degrees high'", "shadows.pins.0")),
    ],
)
def test_unservable_pin_is_one_error_that_names_it(tmp_path: Path, pin: dict, expected_texts: tuple[str, ...]):
    level = write_level(tmp_path, "hills")
    levels, text = ServedLevels([level]), json.loads(level.read_text())
    first = {"view": "map", "sun_altitude_deg": [5, 20], "map_size": 512}
    write_level(tmp_path, "hills", shadows={"pins": [first, {"view": "map", **pin}]})
    for read_level in (lambda: ServedLevels([level]), lambda: levels.reload_if_changed("hills")):  # on load, and on a later check
        with pytest.raises(LevelError) as caught:
            read_level()
        message = str(caught.value)
        assert (
            f"{level}: shadows.pins.1{expected_texts[0]}" in message
            and all(word in message for word in expected_texts)
            and "\n" not in message
        )
        assert exit_status(caught.value) == 2
    level.write_text(json.dumps({**text, "shadows": {"pins": [first]}}))
    assert levels.reload_if_changed("hills").loaded.level.shadows.pins[0].map_size == 512


def test_pin_unsupported_in_its_view_is_reported(tmp_path: Path):
    pins = [{"view": "map", "sun_altitude_deg": [5, 20], "map_size": 512}, {"view": "map", "algorithm": "perspective_shadow_map"}]
    level = write_level(tmp_path, "hills", shadows={"pins": pins})
    with pytest.raises(UnsupportedError) as caught:
        remarks(level)
    assert caught.value.name == f"{level}: shadows.pins.1.algorithm" and "in view map" in str(caught.value)
    with running(create_app(Settings(workers=1), [level])) as client:
        check_problem(
            client.get("/levels/hills/plan?view=map&altitude=40&azimuth=200"), 422, "unsupported", "shadows.pins.1.algorithm"
        )
        assert client.get("/levels/hills/plan?view=map&altitude=12&azimuth=200").status_code == 200


def test_remote_sources_can_be_allowed(tmp_path: Path):
    with pytest.raises(SkuggaError) as caught:
        ServedLevels([write_level(tmp_path, "far", terrain={"source": "/vsimem/nothing/far.tif"})], remote_sources=True)
    assert isinstance(caught.value, SourceError)  # GDAL has looked for it


def test_two_levels_of_one_name_are_refused(path: Path, tmp_path: Path):
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="hills"):
        ServedLevels([path, write_level(tmp_path / "other", "hills")])


def test_scene_cache_keeps_a_scene_of_a_version(path: Path):
    scenes = SceneCache()
    first = scenes.get(LevelKey(path=path, version="1"))
    assert scenes.get(LevelKey(path=path, version="1")) is first
    raise_ground(path, 100)
    second = scenes.get(LevelKey(path=path, version="2"))
    assert second.height_range_m[1] == pytest.approx(first.height_range_m[1] + 100, abs=0.1)


def test_scene_cache_is_bounded(tmp_path: Path):
    scenes = SceneCache(max_scenes=2, process_bytes=lambda: 0)  # the tests' own process may hold more than a render process
    keys = [LevelKey(path=write_level(tmp_path, name), version="1") for name in ("a", "b", "c")]
    first, second, _ = (scenes.get(key) for key in keys)
    assert len(scenes) == 2
    assert scenes.get(keys[1]) is second
    assert scenes.get(keys[0]) is not first
    assert len(scenes) == 2


def test_scene_cache_retries_after_an_error(path: Path):
    scenes, text = SceneCache(), path.read_text()
    path.write_text("version: 7", encoding="utf-8")
    with pytest.raises(LevelError):
        scenes.get(LevelKey(path=path, version="1"))
    path.write_text(text, encoding="utf-8")
    assert scenes.get(LevelKey(path=path, version="1")).loaded.name == "hills"
