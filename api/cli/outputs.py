"""Files that a command shall write: looked at before any work is done for them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from skugga.terrain.errors import InputError, SkuggaError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource


def check_targets(level: LevelSource, targets: Iterable[tuple[str, Path | None]], *inputs: Path | None) -> None:
    """Refuse to write over what is read: the level's file, any file that it names or leads to, and a command's other ``inputs``,
    however they are spelt. ``targets`` are names of options with their files.

    Raises ``InputError``, and ``FileNotFoundError`` where there is no folder for a file.
    """
    for option, target in targets:
        if target is None:
            continue
        if not target.parent.is_dir():
            raise FileNotFoundError(2, "folder not found", str(target))
        if not target.exists():
            continue
        for source in _read_by(level, inputs):
            if source.exists() and target.samefile(source):
                raise InputError(option, str(target), f"another file: {source} is one that the level is made of")


def _read_by(level: LevelSource, inputs: tuple[Path | None, ...]) -> Iterator[Path]:
    yield from (each for each in (level.path, level.canopy, level.buildings, *inputs) if each is not None)
    try:
        sources = load_level(level).linked_sources
    except SkuggaError:  # said when the level is loaded for its work
        return
    for source in map(Path, sources):
        yield source
        if source.suffix.lower() == ".shp":  # its attributes, index and CRS lie in files beside it
            yield from source.parent.glob(f"{source.stem}.*")
