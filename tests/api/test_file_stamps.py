"""Versions of levels: they change with the content of the level's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from skugga.api.file_stamps import file_stamps, level_version, watched_files
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from tests.rasters import write_geotiff


def version_of(path: Path) -> str:
    """Return the version of a level, which changes with its files."""
    loaded = load_level(LevelSource(path=path))
    return level_version(loaded, file_stamps(watched_files(loaded)))


def write_flat_ground(path: Path, height_m: float) -> Path:
    """Write a raster of equal heights and return its path."""
    return write_geotiff(path, np.full((8, 9), height_m, np.float32), "EPSG:32633", 500e3, 5200e3, 30.0)


def test_the_version_of_a_raster_depends_on_its_cells(tmp_path: Path):
    raster = write_flat_ground(tmp_path / "dem.tif", 100.0)
    before = version_of(raster)
    assert version_of(raster) == before
    write_flat_ground(raster, 200.0)
    assert version_of(raster) != before


def test_the_version_of_a_level_depends_on_text_and_raster(tmp_path: Path):
    write_flat_ground(tmp_path / "dem.tif", 100.0)
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\nterrain: {source: dem.tif}\n", encoding="utf-8")
    before = version_of(level)
    level.write_text(level.read_text(encoding="utf-8"), encoding="utf-8")
    assert version_of(level) == before, "a rewritten file with the same text has the same version"
    write_flat_ground(tmp_path / "dem.tif", 200.0)
    changed = version_of(level)
    assert changed != before
    level.write_text("version: 1\nterrain: {source: dem.tif, exaggeration: 2}\n", encoding="utf-8")
    assert version_of(level) != changed
