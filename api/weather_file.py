"""Weather files, which are read once and again when they change."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from skugga.api.file_stamps import Stamp, file_stamps
from skugga.terrain.cache import MIB, cached

if TYPE_CHECKING:
    from skugga.shadows.irradiation.weather import Weather


def weather_of_file(path: Path, columns: str | None) -> Weather:
    """Return the weather of a file. ``columns`` are those of a CSV, as the option ``weather_columns`` spells them.

    Raises ``InputError``.
    """
    return _weather(path, file_stamps([path])[0], columns)


@cached("process", 16 * MIB)
def _weather(path: Path, stamp: Stamp, columns: str | None) -> Weather:
    """Return the weather of a file, whose ``stamp`` tells its versions apart."""
    from skugga.shadows.irradiation.weather import parse_weather_columns, read_weather

    return read_weather(path, {} if columns is None else parse_weather_columns(columns))
