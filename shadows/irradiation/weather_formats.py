"""Readers of the formats of typical years: EPW, TMY3 and PVGIS's TMY, by pvlib.

What a stamp means differs from format to format, and half an hour moves the sun by 7.5 degrees:

- EPW: local standard time. Hours are numbered from 1 to 24 and end at their number. pvlib's index is an hour earlier: their start.
- TMY3: local standard time. Hours end at their stamp, which is pvlib's index, too.
- PVGIS's TMY: UTC. Values are those of one moment, which follows the stamp by the file's "irradiance time offset". They stand for
  the hour around it. Old files do not have the offset. In the EPW of PVGIS it is not clear which clock hours follow. For both,
  moments are those that fit the sun (``time_shift_min``).
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skugga.shadows.irradiation.weather_records import Weather, typical_starts
from skugga.shadows.irradiation.weather_sun import time_shift_min, without_pvlib_warnings
from skugga.terrain.errors import InputError, Problem

if TYPE_CHECKING:
    import pandas

HOUR_MIN = 60.0

EPW_MISSING, TMY3_MISSING = 9999.0, -9000.0
"""Values from which, and down from which, a format has no data."""

MAX_PVGIS_OFFSET_MIN = 60.0
"""Maximum of an irradiance time offset of PVGIS. Larger shifts are no offsets."""

PARTS = ("ghi", "dni", "dhi")

PVGIS_PARTS = ("G(h)", "Gb(n)", "Gd(h)")
"""PVGIS's names of GHI, DNI and DHI."""

UNREADABLE = (ValueError, LookupError, TypeError, AttributeError)
"""Errors of readers for a file that is not of their format."""

Reader = Callable[[str, str], Weather]


def reader_of(text: str) -> tuple[str, Reader] | None:
    """Return the name and the reader of a file's format from its text; ``None`` for other formats."""
    first, second = ([*text.lstrip().splitlines()[:2], "", ""])[:2]
    if first.startswith("LOCATION,"):
        return ("PVGIS's EPW", _pvgis_epw) if "ECMWF/ERA" in first else ("EPW", _epw)
    if second.startswith("Date (MM/DD/YYYY),Time (HH:MM)"):
        return "TMY3", _tmy3
    if first.startswith("Latitude (decimal degrees)"):
        return "PVGIS's CSV", _pvgis_csv
    return ("PVGIS's JSON", _pvgis_json) if first.startswith("{") else None


def typical_weather(text: str, name: str, kind: str, read: Reader) -> Weather:
    """Return the weather of a file from its text by a reader of a format. Raises ``InputError`` for a file that is not complete."""
    try:
        with without_pvlib_warnings():
            return read(text, f"{Path(name).name} ({kind})")
    except UNREADABLE as error:
        reason = " ".join(str(error).split())[:120].rstrip(".") or type(error).__name__
        raise InputError(name, Problem(f"cannot be read as {kind} ({reason})"), "Use a complete file") from None


def _epw(text: str, source: str) -> Weather:
    """Return the weather of an EPW file."""
    from pvlib.iotools import read_epw

    data, place = read_epw(io.StringIO(text.lstrip()))
    parts = _parts(data, PARTS, lambda values: values >= EPW_MISSING)
    return _weather(source, _stamps(data), place["TZ"] * 60.0, 0.0, parts, _place(place, "altitude"))


def _tmy3(text: str, source: str) -> Weather:
    """Return the weather of a TMY3 file."""
    from pvlib.iotools import read_tmy3

    data, place = read_tmy3(io.StringIO(text.lstrip()), map_variables=True)
    parts = _parts(data, PARTS, lambda values: values <= TMY3_MISSING)
    return _weather(source, _stamps(data), place["TZ"] * 60.0, -HOUR_MIN, parts, _place(place, "altitude"))


def _pvgis_csv(text: str, source: str) -> Weather:
    """Return the weather of PVGIS's TMY as CSV."""
    from pvlib.iotools import read_pvgis_tmy

    data, meta = read_pvgis_tmy(io.BytesIO(text.lstrip().encode()), "csv", map_variables=False)
    return _pvgis(data, meta["inputs"], meta["inputs"].get("irradiance time offset"), source)


def _pvgis_json(text: str, source: str) -> Weather:
    """Return the weather of PVGIS's TMY as JSON."""
    from pvlib.iotools import read_pvgis_tmy

    if "outputs" not in json.loads(text):
        raise ValueError("no outputs")
    data, meta = read_pvgis_tmy(io.StringIO(text), "json", map_variables=False)
    place = meta["inputs"]["location"]
    return _pvgis(data, place, place.get("irradiance_time_offset"), source)


def _pvgis(data: pandas.DataFrame, place: dict[str, Any], offset_hours: float | None, source: str) -> Weather:
    """Return the weather of a table of PVGIS, whose index is UTC."""
    parts = _parts(data, PVGIS_PARTS, lambda values: values <= TMY3_MISSING)
    position, stamps = _place(place, "elevation"), _stamps(data)
    if offset_hours is not None:
        return _weather(source, stamps, 0.0, float(offset_hours) * 60.0 - HOUR_MIN / 2.0, parts, position)
    shift_min = _fitted_shift_min(stamps, 0.0, parts, position)
    if shift_min is None or abs(shift_min) > MAX_PVGIS_OFFSET_MIN:
        raise InputError(source, Problem("has no irradiance time offset, and its light fits no sun"), "Download it anew from PVGIS")
    return _weather(source, stamps, 0.0, shift_min - HOUR_MIN / 2.0, parts, position)


def _pvgis_epw(text: str, source: str) -> Weather:
    """Return the weather of PVGIS's TMY as EPW."""
    from pvlib.iotools import read_epw

    data, place = read_epw(io.StringIO(text.lstrip()))
    parts = _parts(data, PARTS, lambda values: values >= EPW_MISSING)
    position, stamps, utc_offset_min = _place(place, "altitude"), _stamps(data), place["TZ"] * 60.0
    shift_min = _fitted_shift_min(stamps, utc_offset_min, parts, position)
    if shift_min is None:
        raise InputError(source, Problem("has light that fits no sun, so its times are not known"), "Use PVGIS's CSV or JSON")
    return _weather(source, stamps, utc_offset_min, shift_min - HOUR_MIN / 2.0, parts, position)


def _fitted_shift_min(
    stamps: np.ndarray, utc_offset_min: float, parts: dict[str, np.ndarray], place: dict[str, float]
) -> float | None:
    """Return the minutes from stamps to the moments at which light fits the sun; ``None`` if none fits."""
    moments, is_kept = typical_starts(stamps, utc_offset_min, 0.0)
    ghi, dni, dhi = (np.nan_to_num(parts[part][is_kept]) for part in PARTS)
    return time_shift_min(moments, ghi, dni, dhi, place["lon_deg"], place["lat_deg"])


def _weather(
    source: str, stamps: np.ndarray, utc_offset_min: float, shift_min: float, parts: dict[str, np.ndarray], place: dict[str, float]
) -> Weather:
    """Return weather in hours that start ``shift_min`` after their stamps, which are times by the file's clock."""
    starts, is_kept = typical_starts(stamps, utc_offset_min, shift_min)
    ghi, dni, dhi = (parts[part][is_kept] for part in PARTS)
    length_min = np.full(len(starts), HOUR_MIN)
    return Weather(
        source, starts, length_min, ghi, dni, dhi, True, utc_offset_min, place["lon_deg"], place["lat_deg"], place["height_m"]
    )


def _stamps(data: pandas.DataFrame) -> np.ndarray:
    """Return the index of a table by its own clock, datetime64[us]."""
    return data.index.tz_localize(None).to_numpy().astype("datetime64[us]")


def _parts(
    data: pandas.DataFrame, columns: tuple[str, str, str], is_missing: Callable[[np.ndarray], np.ndarray]
) -> dict[str, np.ndarray]:
    """Return GHI, DNI and DHI from the columns of a table; NaN where they are missing."""
    out = {}
    for part, column in zip(PARTS, columns, strict=True):
        values = data[column].to_numpy(float)
        out[part] = np.where(is_missing(values), np.nan, values)
    return out


def _place(place: dict[str, Any], height_key: str) -> dict[str, float]:
    """Return the position of a file, as fields of ``Weather``."""
    return {
        "lon_deg": float(place["longitude"]), "lat_deg": float(place["latitude"]), "height_m": float(place[height_key]),
    }  # fmt: skip
