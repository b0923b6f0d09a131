"""Look-up of levels: bundled levels by name, others by path."""

from __future__ import annotations

from pathlib import Path

from skugga.configs import LEVELS_FOLDER
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.rasters import LEVEL_SUFFIXES, is_level_raster

RASTER_SUFFIXES = ".tif", ".tiff", ".vrt", ".img", ".asc", ".hgt"
"""Usual suffixes of height rasters. A message about a folder suggests files with them."""

ARCHIVE_SUFFIX = ".pmtiles"
"""Suffix of tile archives, which are served unchanged."""


MAX_PATH_CHARACTERS = 4096
"""Linux's ``PATH_MAX``."""


def bundled_levels() -> list[Path]:
    """Return the paths of the bundled level files, sorted by name.

    A level is a scene with its views, as a level file (YAML) or a raster of heights alone defines it.
    """
    return sorted(LEVELS_FOLDER.glob("*.yaml"))


def find_level(name: str) -> Path:
    """Return the file of a level, given a bundled level's name or the path of a level file or a raster. Raises ``InputError``."""
    if len(name) > MAX_PATH_CHARACTERS:
        raise InputError("LEVEL", name, "a level file, a raster, or the name of a bundled level")
    bundled = LEVELS_FOLDER / f"{name}.yaml"
    if Path(name).name == name and bundled.is_file():
        return bundled
    path = Path(name)
    if path.is_file() or ((path.is_dir() or name.startswith("/vsi")) and is_level_raster(path)):
        return path
    if path.is_dir():
        suggestions = sorted(entry.name for entry in path.iterdir() if entry.suffix.lower() in (*LEVEL_SUFFIXES, *RASTER_SUFFIXES))
        raise InputError(
            "LEVEL",
            Problem(f"{name} is a folder"),
            f"Use a level file or a raster{', such as ' if suggestions else ''}{', '.join(suggestions[:3])}",
        )
    if path.suffix or path.name != name:
        raise InputError(
            "LEVEL", Problem(f"no file {name}"), "Use an existing level file or raster, or the name of a bundled level"
        )
    names = ", ".join(level.stem for level in bundled_levels())
    raise InputError("LEVEL", name, f"a level file, a raster, or one of the bundled levels: {names}")
