"""The levels there are: the bundled ones by name, and others by path."""

from __future__ import annotations

from pathlib import Path

from skugga.configs import LEVELS_FOLDER
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.rasters import LEVEL_SUFFIXES, is_level_raster

RASTER_SUFFIXES = ".tif", ".tiff", ".vrt", ".img", ".asc", ".hgt"
"""Usual ones of rasters of heights, by which those in a folder are named."""

ARCHIVE_SUFFIX = ".pmtiles"
"""Of archives of tiles, which are served as they are."""


MAX_PATH_CHARACTERS = 4096
"""Linux opens no longer paths."""


def bundled_levels() -> list[Path]:
    """Paths of the bundled level files, by name."""
    return sorted(LEVELS_FOLDER.glob("*.yaml"))


def find_level(name: str) -> Path:
    """The file of a bundled level's name or of a path. Raises ``InputError``."""
    if len(name) > MAX_PATH_CHARACTERS:
        raise InputError("LEVEL", name, "a level file or a raster, or a bundled level's name")
    bundled = LEVELS_FOLDER / f"{name}.yaml"
    if Path(name).name == name and bundled.is_file():
        return bundled
    path = Path(name)
    if path.is_file() or ((path.is_dir() or name.startswith("/vsi")) and is_level_raster(path)):
        return path
    if path.is_dir():
        inside = sorted(each.name for each in path.iterdir() if each.suffix.lower() in (*LEVEL_SUFFIXES, *RASTER_SUFFIXES))
        raise InputError(
            "LEVEL", Problem(f"{name} is a folder"), f"a level file or a raster{', as ' if inside else ''}{', '.join(inside[:3])}"
        )
    if path.suffix or path.name != name:
        raise InputError(
            "LEVEL", Problem(f"there is no file {name}"), "a level file or a raster that is there, or a bundled level's name"
        )
    names = ", ".join(level.stem for level in bundled_levels())
    raise InputError("LEVEL", name, f"a level file, a raster, or one of the bundled levels: {names}")
