"""Weather files for irradiation: EPW, TMY3, PVGIS's TMY, and CSV with columns of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from skugga.shadows.irradiation.weather_csv import OPTION, csv_weather, parse_weather_columns
from skugga.shadows.irradiation.weather_formats import reader_of, typical_weather
from skugga.shadows.irradiation.weather_records import Weather, missing_weather
from skugga.shadows.irradiation.weather_sun import extraterrestrial_w_m2, time_shift_min
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.world import WGS84

__all__ = ["Weather", "check_weather_place", "missing_weather", "parse_weather_columns", "read_weather"]

MIN_POWER_W_M2 = -20.0
"""Minimum power. Pyranometers measure some watts below zero at night, which count as 0."""

MAX_EXTRATERRESTRIAL_SHARE = 1.5
"""Maximum power as a multiple of sunlight outside of the atmosphere. Clouds beside the sun add some of theirs."""

MIN_PEAK_W_M2 = 20.0
"""Peak power below which a warning asks for the unit: values in kWh/m2 and MJ/m2 are that small."""

MAX_DISTANCE_KM, MAX_HEIGHT_DIFFERENCE_M = 50.0, 300.0
"""Distance and difference of height between a file's place and a level up to which no warning is given."""

MAX_LATITUDES_OVER_EQUATOR_DEG = 10.0
"""Degrees of latitude by which a file may be away on the other hemisphere: near the equator there are no seasons to confuse."""

MAX_TIME_SHIFT_MIN = 20.0
"""Shift of a file's times against the sun up to which no warning is given."""

HEADER_BYTES = 4096
"""Bytes of a file that tell whether it is text."""


def read_weather(path: str | Path, columns: Mapping[str, str] | None = None) -> Weather:
    """Return the weather of an EPW, TMY3 or PVGIS TMY file, or of any other CSV with a header.

    Parameters
    ----------
    path
        The file. Its content decides the format.
    columns
        What a CSV does not tell: ``time``, ``ghi``, ``dni``, ``dhi`` (names of columns, with a unit after a colon), ``clock`` and
        ``stamp``, as ``parse_weather_columns`` returns them. Not for other formats.

    Returns
    -------
    Weather
        The records, W/m2. Records without data are left out.

    Raises
    ------
    InputError
        If the file cannot be read, is of no known format, lacks columns, has impossible values, or two records at a time.
    """
    name = str(path)
    text = _text(Path(path), name)
    reader = reader_of(text)
    if reader is None:
        if Path(path).suffix.lower() in (".epw", ".json"):
            raise InputError(name, Problem("is neither EPW nor a TMY of PVGIS"), "Use EPW, TMY3, a TMY of PVGIS, or a CSV")
        return _checked(csv_weather(text, name, columns or {}), name)
    if columns:
        raise InputError(OPTION, Problem(f"cannot be used with {reader[0]}"), "Use it with a CSV that has columns of its own")
    return _checked(typical_weather(text, name, *reader), name)


def check_weather_place(weather: Weather, lon_deg: float, lat_deg: float, height_m: float) -> tuple[str, ...]:
    """Return warnings of weather that does not fit a place.

    Parameters
    ----------
    weather
        The weather of a file.
    lon_deg, lat_deg, height_m
        The middle of a level, degrees, and its height, metres.

    Returns
    -------
    tuple of str
        Sentences about the distance to the file's place, the difference of heights, and times that do not fit the sun.

    Raises
    ------
    InputError
        For weather of the other hemisphere, whose seasons are not those of the place.
    """
    out = []
    if weather.lon_deg is not None and weather.lat_deg is not None:
        if weather.lat_deg * lat_deg < 0.0 and abs(weather.lat_deg - lat_deg) > MAX_LATITUDES_OVER_EQUATOR_DEG:
            where = f"is at {_latitude_text(weather.lat_deg)}, the level at {_latitude_text(lat_deg)}"
            raise InputError(weather.source, Problem(where), "Use weather of the level's own hemisphere")
        distance_km = WGS84.inv(weather.lon_deg, weather.lat_deg, lon_deg, lat_deg)[2] / 1000.0
        if distance_km > MAX_DISTANCE_KM:
            out.append(f"{weather.source}: the weather is that of a place {distance_km:.0f} km away.")
    if weather.height_m is not None and abs(weather.height_m - height_m) > MAX_HEIGHT_DIFFERENCE_M:
        side = "higher" if weather.height_m > height_m else "lower"
        out.append(f"{weather.source}: the weather is that of a place {abs(weather.height_m - height_m):.0f} m {side}.")
    if weather.ghi is not None and weather.dni is not None and weather.dhi is not None:
        shift_min = time_shift_min(weather.middle, weather.ghi, weather.dni, weather.dhi, lon_deg, lat_deg)
        if shift_min is not None and abs(shift_min) > MAX_TIME_SHIFT_MIN:
            side = "later" if shift_min > 0.0 else "earlier"
            out.append(
                f"{weather.source}: its light fits the sun here if its times are {abs(shift_min):.0f} minutes {side}. "
                "Check the clock, the stamps and the place."
            )
    return tuple(out)


def _text(path: Path, name: str) -> str:
    """Return the text of a file. Raises ``InputError`` for a file that cannot be read or is not text."""
    try:
        with path.open("rb") as file:
            data = file.read(HEADER_BYTES)
            if b"\0" in data:
                raise InputError(name, Problem("is not a text file"), "Use EPW, TMY3, a TMY of PVGIS, or a CSV")
            data += file.read()
    except OSError as error:
        raise InputError(name, Problem(f"cannot be read ({error.strerror})"), "Name a weather file") from None
    if not data.strip():
        raise InputError(name, Problem("is empty"), "Use EPW, TMY3, a TMY of PVGIS, or a CSV")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:  # names of cities in EPW
        return data.decode("latin-1")


def _checked(weather: Weather, name: str) -> Weather:
    """Return weather in the order of time and without records that have no data. Raises ``InputError`` for impossible values."""
    order = np.argsort(weather.start, kind="stable")
    starts = weather.start[order]
    for number in np.flatnonzero(np.diff(starts) == np.timedelta64(0, "us"))[:1]:
        problem = f"has two records at {_moment_text(starts[number], weather)}"
        raise InputError(name, Problem(problem), "Use a typical year, or one record a time")
    parts = {part: values[order] for part, values in weather.parts.items()}
    is_kept = np.all([np.isfinite(values) for values in parts.values()], axis=0)
    if not is_kept.any():
        raise InputError(name, Problem("has no record with data"), "Use a file with GHI, or with DNI and DHI")
    starts, length_min = starts[is_kept], weather.length_min[order][is_kept]
    limits = MAX_EXTRATERRESTRIAL_SHARE * extraterrestrial_w_m2(starts)
    kept = {}
    for part, values in parts.items():
        values = values[is_kept]
        for number in np.flatnonzero((values < MIN_POWER_W_M2) | (values > limits))[:1]:
            problem = f"{part.upper()} is {values[number]:.6g} W/m2 at {_moment_text(starts[number], weather)}"
            raise InputError(name, Problem(problem), f"Allowed: 0 to {limits[number]:.0f}. Check the unit")
        kept[part] = np.maximum(values, 0.0) + 0.0
    return replace(weather, start=starts, length_min=length_min, **kept, warnings=_warnings(weather.source, kept))


def _warnings(source: str, parts: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Return sentences for the user about parts that are missing, and about powers that are too small."""
    out = []
    if "dni" not in parts and "dhi" not in parts:
        out.append(f"{source}: has GHI alone. Direct and diffuse light follow from it by the model of Erbs and Driesse.")
    elif len(parts) == 2:
        missing = next(part for part in ("ghi", "dni", "dhi") if part not in parts).upper()
        out.append(f"{source}: has no {missing}. It follows from the other two.")
    peak = max(float(values.max()) for values in parts.values())
    if peak < MIN_PEAK_W_M2:
        out.append(f"{source}: its light reaches {peak:.3g} W/m2. Check the unit.")
    return tuple(out)


def _moment_text(start: np.datetime64, weather: Weather) -> str:
    """Return the start of a record for a message: in UTC, or month, day and hour by the file's clock in a typical year."""
    if not weather.is_typical:
        return f"{str(start.astype('datetime64[m]')).replace('T', ' ')} UTC"
    local = start + np.timedelta64(round(weather.utc_offset_min * 60.0), "s")
    return str(local.astype("datetime64[m]"))[5:].replace("T", " ")


def _latitude_text(lat_deg: float) -> str:
    """Return a latitude such as 47.1 N."""
    return f"{abs(lat_deg):.1f} {'N' if lat_deg >= 0.0 else 'S'}"
