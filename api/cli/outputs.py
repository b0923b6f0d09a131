"""Checks of output files before a command starts its work."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from skugga.terrain.errors import InputError, Problem, SkuggaError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource


def check_output_files(level: LevelSource, option_files: Iterable[tuple[str, Path | None]], *input_paths: Path | None) -> None:
    """Raise ``InputError`` if an output file is also an input.

    Inputs are the level file, all files that it refers to, and ``input_paths``. Files are compared by identity, not by spelling.
    ``option_files`` are pairs of an option and its file. Raises ``FileNotFoundError`` if the folder of an output does not exist.
    """
    for option, target in option_files:
        if target is None:
            continue
        if not target.parent.is_dir():
            raise FileNotFoundError(2, "folder not found", str(target))
        if not target.exists():
            continue
        for source in _input_files(level, input_paths):
            if source.exists() and target.samefile(source):
                raise InputError(option, Problem(f"{target} is the same file as the input {source}"), "Write to another file")


def _input_files(level: LevelSource, input_paths: tuple[Path | None, ...]) -> Iterator[Path]:
    """Yield the files that a command reads: the level's files, all files that they refer to, and ``input_paths``."""
    yield from (path for path in (level.path, level.canopy, level.buildings, *input_paths) if path is not None)
    try:
        sources = load_level(level).linked_sources
    except SkuggaError:  # reported when the level is loaded for its work
        return
    for source in map(Path, sources):
        yield source
        if source.suffix.lower() == ".shp":  # its attributes, index and CRS are in files of the same name
            yield from source.parent.glob(f"{source.stem}.*")
