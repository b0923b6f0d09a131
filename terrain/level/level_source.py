"""Source of a level: a level file, or a raster of heights with options such as canopy and buildings."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from skugga.terrain.errors import InputError, printable
from skugga.terrain.level.parts import METRES_PER_UNIT, Positive, Units

LEVEL_KEYS_BY_OPTION = {
    "canopy": "forest: [{source: FILE}]",
    "buildings": "meshes: [{source: FILE}]",
    "nodata": "terrain: {nodata: VALUE}",
    "units": "terrain: {units: UNIT}",
    "positive": "terrain: {positive: down}",
}
"""Options of a raster, each with the text that has the same meaning in a level file."""


def option_remedy(option: str, value: str) -> str:
    """Return a phrase for messages that says how to set an option, in a level file or as a parameter.

    The command line spells the parameter as its option (``skugga.api.errors.with_option_names``).
    """
    return f"write terrain: {{{option}: {value}}} (without a level file: {option}={value})"


def parse_units(parameter: str, name: str | None) -> Units | None:
    """Return a unit of heights by its name; ``None`` for ``None``. Raises ``InputError``, which names ``parameter``."""
    units = next((unit for unit in METRES_PER_UNIT if unit == name), None)
    if name is not None and units is None:
        raise InputError(parameter, name, ", ".join(METRES_PER_UNIT))
    return units


def parse_positive(parameter: str, name: str | None) -> Positive | None:
    """Return the direction in which a raster's values increase: ``up``, ``down``, or ``None`` for ``None``.

    Raises ``InputError``, which names ``parameter``.
    """
    if name in (None, "up", "down"):
        return name  # type: ignore[return-value]
    raise InputError(parameter, name, "up (heights) or down (depths)")


class LevelSource(BaseModel):
    """Path of a level file, or of a raster that becomes a level with default settings.

    The options apply to rasters only and are ``None`` for a level file.

    Attributes
    ----------
    path
        The level file or the raster.
    canopy
        Raster of canopy heights, or a vector file of trees as points.
    buildings
        Vector file of footprints with heights.
    nodata
        Cell value that means no height, in addition to the value that the raster declares.
    units
        Unit of the raster's heights.
    positive
        Whether the raster's values increase upwards (heights) or downwards (depths).
    name
        Name of the level; ``None``: the name of its file without the suffix.
    roots
        Folders that must contain all files of the level; ``None``: no restriction.
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
        """Return a path as the source of a level; a ``LevelSource`` is returned as it is."""
        return source if isinstance(source, LevelSource) else cls(path=Path(source))

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the options that are set."""
        return tuple(name for name in LEVEL_KEYS_BY_OPTION if getattr(self, name) is not None)

    @property
    def level_keys(self) -> dict[str, Any]:
        """The keys and values of an equivalent level file."""
        names = "nodata", "units", "positive"
        raster_keys = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return {
            "version": 1,
            "title": printable(self.path.stem),
            "terrain": {"source": self._source, **raster_keys},
            **({} if self.canopy is None else {"forest": [{"source": str(self.canopy.resolve())}]}),
            **({} if self.buildings is None else {"meshes": [{"source": str(self.buildings.resolve())}]}),
        }

    @property
    def _source(self) -> str:
        """Name of the raster in the folder where links of the path lead. A name without a suffix could be a bundled data set's."""
        name = self.path.resolve().name
        return name if "." in name else f"./{name}"

    @property
    def digest(self) -> str:
        """Hash of the options. It does not depend on the contents of the files, whose changes show in their modification times."""
        return hashlib.sha256(repr(self.level_keys).encode()).hexdigest()[:16]
