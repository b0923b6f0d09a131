"""Levels that are made of a raster and options."""

from __future__ import annotations

from pathlib import Path

from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from tests.api.conftest import write_level


def test_link_of_another_name_opens_its_raster(tmp_path: Path):
    """The level lies in the folder of the raster, where no file has the link's name."""
    (tmp_path / "data").mkdir()
    raster = write_level(tmp_path / "data", "hills").with_suffix(".tif")
    link = tmp_path / "dsm.tif"
    link.symlink_to(raster)
    loaded = load_level(LevelSource(path=link))
    assert loaded.name == loaded.level.title == "dsm", "the name is the one that the user gave"
    assert loaded.sources == (str(raster),)


def test_link_to_a_name_of_a_bundled_data_set_opens_its_raster(tmp_path: Path):
    raster = write_level(tmp_path, "hills").with_suffix(".tif").rename(tmp_path / "jacksboro")
    link = tmp_path / "link.tif"
    link.symlink_to(raster)
    assert load_level(LevelSource(path=link)).sources == (str(raster),)
