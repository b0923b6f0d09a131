"""What a level is loaded from: a level file by itself; or a raster of heights, with what options say stands on it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from skugga.terrain.errors import InputError, printable
from skugga.terrain.level.parts import METRES_PER_UNIT, Positive, Units

KEYS_OF_OPTIONS = {
    "canopy": "forest: [{source: FILE}]",
    "buildings": "meshes: [{source: FILE}]",
    "nodata": "terrain: {nodata: VALUE}",
    "units": "terrain: {units: UNIT}",
    "positive": "terrain: {positive: down}",
}
"""What may be said of a raster beside its path, and how a level file says the same."""


def remedy(option: str, value: str) -> str:
    """What to write, where a raster does not say something or says it wrongly, as a phrase."""
    return f"write terrain: {{{option}: {value}}} (of a raster without a level file: --{option} {value})"


def units_named(parameter: str, name: str | None) -> Units | None:
    """A unit of heights by its name. Raises ``InputError``, which names the parameter."""
    found = next((unit for unit in METRES_PER_UNIT if unit == name), None)
    if name is not None and found is None:
        raise InputError(parameter, name, ", ".join(METRES_PER_UNIT))
    return found


def direction_named(parameter: str, name: str | None) -> Positive | None:
    """The direction that a raster's numbers grow in, by its name. Raises ``InputError``, which names the parameter."""
    if name in (None, "up", "down"):
        return name  # type: ignore[return-value]
    raise InputError(parameter, name, "up, of heights, or down, of depths")


class LevelSource(BaseModel):
    """A level file's path, or that of a raster that is a level by itself: its ground, and all else by default.

    With a raster go, if wanted, ``canopy`` (a raster of canopy heights, or trees as points), ``buildings`` (footprints with
    heights), ``nodata``, the cells' value that means that no height is known there, ``units`` of heights, and ``positive``, where
    they grow to. Of a level file they are ``None``.

    ``name`` is the level's; ``None``: its file's, without the suffix. ``roots`` are folders in one of which, or below, all has to
    lie that the level is read from; ``None``: anywhere.
    """

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    path: Path
    canopy: Path | None = None
    buildings: Path | None = None
    nodata: float | None = None
    units: Units | None = None
    positive: Positive | None = None
    name: str | None = None
    roots: tuple[Path, ...] | None = None

    @classmethod
    def of(cls, source: Path | str | LevelSource) -> LevelSource:
        """A path as the source of a level."""
        return source if isinstance(source, LevelSource) else cls(path=Path(source))

    @property
    def options(self) -> tuple[str, ...]:
        """The names of the options that were given."""
        return tuple(name for name in KEYS_OF_OPTIONS if getattr(self, name) is not None)

    @property
    def level_keys(self) -> dict[str, Any]:
        """The level file's keys that say the same of the raster as this does."""
        names = "nodata", "units", "positive"
        stated = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return {
            "version": 1,
            "title": printable(self.path.stem),
            "terrain": {"source": self.path.name, **stated},
            **({} if self.canopy is None else {"forest": [{"source": str(self.canopy.resolve())}]}),
            **({} if self.buildings is None else {"meshes": [{"source": str(self.buildings.resolve())}]}),
        }

    @property
    def digest(self) -> str:
        """Changes with the options; what is in the files is told by their own dates."""
        return hashlib.sha256(repr(self.level_keys).encode()).hexdigest()[:16]
