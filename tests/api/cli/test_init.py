"""``skugga init``: the level file equals the raster's own level, and its commented-out parts are valid."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING, write_geotiff

COMMENTED_OUT = re.compile(r"^#(?! \S)(?=.)")
"""A commented-out line of the level: in comments, a single space and a word follow the "#"; here they do not."""


def write_hills(folder: Path, crs: str = "EPSG:32633", name: str = "dem.tif") -> Path:
    """Write a raster of hills with nodes of 30 units of ``crs`` as ``name``, and return its path."""
    row, col = np.mgrid[:120, :150].astype(np.float32)
    return write_geotiff(folder / name, 600 + 250 * np.sin(col / 11) * np.cos(row / 9), crs, 500e3, 5200e3, 30.0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that is the working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("crs", ["EPSG:32633", ENGINEERING])
def test_init_writes_the_raster_s_own_level(run, folder, crs):
    raster = write_hills(folder, crs)
    assert run("init", "dem.tif") == (0, "Wrote dem.yaml. To view it: skugga serve dem.yaml\n", "")
    written_level, raster_level = load_level(folder / "dem.yaml"), build_scene(load_level(raster)).loaded
    assert written_level.source == raster_level.source == str(raster)
    excluded_keys = {"views"}
    assert written_level.level.model_dump(exclude=excluded_keys) == raster_level.level.model_dump(exclude=excluded_keys)
    assert list(written_level.level.views) == ["map", "view"]
    status, out, err = run("validate", "dem.yaml")
    assert (status, err) == (0, "") and "valid. dem; views: map, view" in out


def test_the_view_shows_both_lit_and_shaded_ground(gl, run, folder):
    write_hills(folder)
    assert run("init", "dem.tif", "-o", "a.yaml")[0] == 0
    assert run("render", "a.yaml", "--view", "view", "--layer", "mask", "--size", "160x128", "-o", "mask.png") == (0, "", "")
    mask = np.asarray(Image.open("mask.png"))
    assert (mask == 128).mean() < 0.01 and 0.05 < (mask == 0).mean() < 0.7


def test_every_commented_out_part_is_valid(run, folder):
    write_hills(folder)
    assert run("init", "dem.tif")[0] == 0
    lines = (folder / "dem.yaml").read_text(encoding="utf-8").splitlines()
    blocks, block = [], []
    for number, line in enumerate([*lines, ""]):
        if COMMENTED_OUT.match(line):
            block.append(number)
        elif block:
            blocks.append(block)
            block = []
    assert len(blocks) == 11
    for uncommented in (*blocks, [number for block in blocks for number in block]):
        text = "\n".join(COMMENTED_OUT.sub("", line) if number in uncommented else line for number, line in enumerate(lines))
        (folder / "more.yaml").write_text(text, encoding="utf-8")
        load_level(folder / "more.yaml")
    level = load_level(folder / "more.yaml").level
    assert level.forest and level.meshes and level.lights and level.water and level.weather.cloud_cover and level.terrain.imagery
    assert level.terrain.nodata == 0 and level.attribution


def test_options_of_the_raster_are_written(run, folder):
    write_hills(folder)
    (folder / "trees").mkdir()
    write_geotiff(folder / "trees" / "canopy.tif", np.zeros((9, 9), np.float32), "EPSG:32633", 500e3, 5200e3, 30.0)
    (folder / "houses.geojson").write_text("{}")
    options = ("--canopy", "trees/canopy.tif", "--buildings", "houses.geojson", "--nodata", "-1")
    assert run("init", "dem.tif", *options)[0] == 0
    level = load_level(folder / "dem.yaml").level
    assert (
        level.forest[0].source == "trees/canopy.tif" and level.meshes[0].source == "houses.geojson" and level.terrain.nodata == -1
    )


def test_titles_and_paths_are_quoted_for_yaml(run, folder):
    (folder / "there").mkdir()
    write_hills(folder, name='yes: "8" #1.tif')
    assert run("init", 'yes: "8" #1.tif', "-o", "there/it.yaml")[0] == 0
    loaded = load_level(folder / "there" / "it.yaml")
    assert loaded.level.title == 'yes: "8" #1' and loaded.source == str(folder / 'yes: "8" #1.tif')


def test_an_existing_file_is_kept_without_force(run, folder):
    write_hills(folder)
    (folder / "dem.yaml").write_text("mine")
    status, out, err = run("init", "dem.tif")
    assert (status, out) == (2, "") and err.count("\n") == 1 and "dem.yaml" in err and "--force" in err
    assert (folder / "dem.yaml").read_text() == "mine"
    assert run("init", "dem.tif", "--force")[0] == 0 and load_level(folder / "dem.yaml")


@pytest.mark.parametrize(
    ("arguments", "expected_status", "expected_texts"),
    [
        (("jacksboro",), 2, ("LEVEL", "jacksboro.yaml", "already")),
        (("nowhere.tif",), 2, ("nowhere.tif",)),
        (("dem.tif", "-o", "level.txt"), 2, ("--output", "level.txt", ".yaml")),
        (("dem.tif", "-o", "nowhere/level.yaml"), 1, ("nowhere/level.yaml",)),
    ],
)
def test_wrong_input_of_init_is_one_line(run, folder, arguments, expected_status, expected_texts):
    write_hills(folder)
    status, out, err = run("init", *arguments)
    assert (status, out) == (expected_status, "") and err.count("\n") == 1
    for text in expected_texts:
        assert text in err
    assert [path.name for path in folder.iterdir()] == ["dem.tif"]
