"""Weather from a CSV with a header: one record a line, with columns of the user's own.

Columns are ``time`` and ``ghi``, ``dni``, ``dhi`` (or PVGIS's ``G(h)``, ``Gb(n)``, ``Gd(h)``), or those that the user names. Units
follow the names, as in ``GHI [kJ/m2]`` and ``ghi_wh_m2``, or the user's name of the column, as in ``Global:kJ/m2``; without a unit
values are W/m2. Energies are those of one record. The user adds what no file tells: ``stamp``, whether times are the start, the
middle or the end of records, and ``clock`` where times have no UTC offset of their own.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Mapping, Sequence
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skugga.shadows.irradiation.weather_records import Weather, as_timedelta
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.clock import parse_clock

OPTION = "weather_columns"
"""Name of the parameter that describes columns."""

ALIASES = {
    "time": ("time", "timestamp", "datetime"), "ghi": ("ghi", "g(h)"), "dni": ("dni", "gb(n)"), "dhi": ("dhi", "gd(h)"),
}  # fmt: skip
"""Names of the columns, in lower case and without units."""

KEYS = (*ALIASES, "stamp", "clock")

UNITS = {
    "W/m2": 1.0, "kW/m2": 1e3, "Wh/m2": 60.0, "kWh/m2": 60e3, "J/m2": 1 / 60.0, "kJ/m2": 1e3 / 60.0, "MJ/m2": 1e6 / 60.0,
    "J/cm2": 1e4 / 60.0,
}  # fmt: skip
"""Watts per square metre of units of power, and watts per square metre times minutes of units of energy."""

POWER_UNITS = ("W/m2", "kW/m2")

STAMPS = {"start": 0.0, "middle": -0.5, "end": -1.0}
"""Lengths of a record from its stamp to its start."""

MIN_LENGTH_MIN, MAX_LENGTH_MIN = 1.0, 180.0
"""Lengths of records that one sun can stand for."""

LENGTH_TOLERANCE_MIN = 1e-3

_UNIT_BY_LETTERS = {re.sub("[^a-z0-9]", "", unit.lower()): unit for unit in UNITS}

_BRACKETS = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]{2,})[\])]")

_SUFFIX = re.compile(r"(?P<name>.+?)_(?P<unit>(?:w|kw|wh|kwh|j|kj|mj)_?(?:c?m2))", re.IGNORECASE)

_UTC_OFFSET = re.compile(r"\d:\d\d(?::\d\d(?:\.\d+)?)?\s*(?:z|utc|[+-]\d\d(?::?\d\d)?)", re.IGNORECASE)

_MISSING = ("", "nan", "na", "n/a", "null", "none", "-")


class _Column(NamedTuple):
    """The number of a column, its name and its unit."""

    number: int
    name: str
    unit: str


def parse_weather_columns(text: str) -> dict[str, str]:
    """Return the columns, the clock and the stamps that a text such as ``ghi=Global:kJ/m2,clock=+01:00,stamp=end`` names.

    Raises ``InputError`` for unknown or repeated keys. Their values are checked with a file.
    """
    out: dict[str, str] = {}
    for item in filter(None, map(str.strip, text.split(","))):
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not value or key in out:
            raise InputError(OPTION, item, "one NAME=VALUE each, such as ghi=Global:kJ/m2,clock=+01:00,stamp=end")
        out[key] = value
    _check_keys(out)
    return out


def csv_weather(text: str, name: str, columns: Mapping[str, str]) -> Weather:
    """Return the weather of a CSV from its text. Raises ``InputError``."""
    _check_keys(columns)
    header, rows = _table(text, name)
    used = _columns(header, columns, name)
    stamp = columns.get("stamp")
    if stamp is None:
        raise InputError.missing("stamp", f"Say whether times of {name} are the start, the middle or the end of records: stamp=end")
    if stamp not in STAMPS:
        raise InputError(f"{OPTION}: stamp", stamp, ", ".join(STAMPS))
    stamps = _times([row[used["time"].number] for row in rows], columns.get("clock"), name)
    stamps, order = np.sort(stamps), np.argsort(stamps, kind="stable")
    length_min = _length_min(stamps, name)
    parts = {part: _values(rows, used[part], length_min, name)[order] for part in ("ghi", "dni", "dhi") if part in used}
    starts = stamps + as_timedelta(STAMPS[stamp] * length_min)
    return Weather(
        f"{Path(name).name} (CSV)", starts, np.full(len(starts), length_min), parts.get("ghi"), parts.get("dni"), parts.get("dhi")
    )  # fmt: skip


def _check_keys(columns: Mapping[str, str]) -> None:
    """Raise ``InputError`` for an unknown key."""
    for key in columns:
        if key not in KEYS:
            raise InputError(OPTION, key, ", ".join(KEYS))


def _table(text: str, name: str) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a CSV with commas, semicolons or tabs. Lines that start with # are comments."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(name, Problem("is empty"), "Use EPW, TMY3, a TMY of PVGIS, or a CSV")
    separator = max(",;\t", key=lines[0].count)
    header, *rows = csv.reader(io.StringIO("\n".join(lines)), delimiter=separator)
    if len(header) < 2:
        raise InputError(name, Problem("is not a weather file"), "Use EPW, TMY3, a TMY of PVGIS, or a CSV with a header")
    for number, row in enumerate(rows, 2):
        if len(row) < len(header):
            raise InputError(name, Problem(f"row {number} has {len(row)} values, the header {len(header)}"), "Complete the row")
    if separator != ",":
        rows = [[value.replace(",", ".") for value in row] for row in rows]
    return [value.strip() for value in header], rows


def _columns(header: Sequence[str], columns: Mapping[str, str], name: str) -> dict[str, _Column]:
    """Return the columns of a header that are used. Raises ``InputError`` for missing ones and for unknown units."""
    out = {}
    for key, aliases in ALIASES.items():
        if key in columns:
            out[key] = _named_column(header, columns[key], key)
            continue
        for number, title in enumerate(header):
            base, unit = _name_and_unit(title)
            if title.lower() in aliases or base.lower() in aliases:
                out[key] = _Column(number, title, unit if title.lower() not in aliases else "")
                break
    if "time" not in out:
        raise InputError(name, Problem("has no column time"), f"Name it: time=NAME, one of {', '.join(header)[:120]}")
    if "ghi" not in out and not ("dni" in out and "dhi" in out):
        raise InputError(
            name, Problem("has neither a column ghi nor both dni and dhi"), f"Name it: ghi=NAME, one of {', '.join(header)[:120]}"
        )
    return {key: column if key == "time" else column._replace(unit=_unit(column, name)) for key, column in out.items()}


def _named_column(header: Sequence[str], text: str, key: str) -> _Column:
    """Return the column that the user names, with a unit after a colon or as in the header."""
    if text in header:
        return _Column(header.index(text), text, _name_and_unit(text)[1])
    title, colon, unit = text.rpartition(":")
    if colon and title in header:
        return _Column(header.index(title), title, unit.strip())
    raise InputError(f"{OPTION}: {key}", text, f"a column of the file: {', '.join(header)[:120]}")


def _name_and_unit(title: str) -> tuple[str, str]:
    """Return the name and the unit of a column's title; an empty unit if it has none."""
    match = _BRACKETS.fullmatch(title) or _SUFFIX.fullmatch(title)
    return (match["name"].strip(" _"), match["unit"]) if match else (title, "")


def _unit(column: _Column, name: str) -> str:
    """Return a column's unit as ``UNITS`` spells it. Raises ``InputError``."""
    letters = re.sub("[^a-z0-9]", "", column.unit.lower().replace("\u00b2", "2").replace("\u207b", ""))
    unit = _UNIT_BY_LETTERS.get(letters) if column.unit else "W/m2"
    if unit is None:
        raise InputError(f"{name}: unit of {column.name}", column.unit, ", ".join(UNITS))
    return unit


def _times(texts: Sequence[str], clock: str | None, name: str) -> np.ndarray:
    """Return times (n,) as datetime64[us] in UTC from ISO 8601 texts with UTC offsets, or without them and by a clock."""
    import pandas

    if not texts:
        raise InputError(name, Problem("has no records"), "Use a file with a line for each record")
    offsets = {_UTC_OFFSET.search(text) is not None for text in texts}
    if len(offsets) == 2:
        raise InputError(name, Problem("has times with and without a UTC offset"), "Use one of them")
    has_offset = offsets.pop()
    if has_offset and clock is not None:
        raise InputError(f"{OPTION}: clock", Problem(f"cannot be used with the UTC offsets in the times of {name}"), "Omit it")
    if not has_offset and clock is None:
        raise InputError(name, Problem("has times without a UTC offset"), "Name their clock, such as clock=utc or clock=+01:00")
    try:
        index = pandas.DatetimeIndex(pandas.to_datetime(pandas.Series(texts).str.strip(), format="ISO8601", utc=has_offset))
    except ValueError as error:
        reason = " ".join(str(error).split())[:100].rstrip(".")
        raise InputError(
            f"{name}: time", Problem(f"cannot be read ({reason})"), "Use times such as 2023-06-21T12:00+02:00"
        ) from None
    if index.hasnans:
        raise InputError(f"{name}: time", texts[int(np.flatnonzero(index.isna())[0])], "times such as 2023-06-21T12:00+02:00")
    if clock is not None:
        index = index.tz_localize(None)
        zone = parse_clock(f"{OPTION}: clock", clock)
        if not isinstance(zone, tzinfo):
            raise InputError(f"{OPTION}: clock", clock, "utc, an offset such as +02:00, or a time zone such as Europe/Oslo")
        try:
            index = index.tz_localize(zone, ambiguous="infer")
        except _clock_errors():
            problem = Problem(f"does not have all times of {name}: it skips some when summer time begins, or has them twice")
            raise InputError(f"{OPTION}: clock", problem, "Use the clock of the logger, such as +01:00") from None
    return index.tz_convert(None).to_numpy().astype("datetime64[us]")


def _clock_errors() -> tuple[type[Exception], ...]:
    """Return the errors that pandas raises for times that a clock skips or has twice: before pandas 3 those of pytz."""
    pytz = sys.modules.get("pytz")  # pandas imports it where it uses it
    return (ValueError,) if pytz is None else (ValueError, pytz.InvalidTimeError)


def _length_min(stamps: np.ndarray, name: str) -> float:
    """Return the length of records from their ascending stamps (n,): the most frequent step, minutes.

    Other steps are gaps, and longer. Raises ``InputError``.
    """
    steps = np.diff(stamps) / np.timedelta64(1, "m")
    for number in np.flatnonzero(steps == 0.0)[:1]:
        raise InputError(name, Problem(f"has two records at {stamps[number].astype('datetime64[s]')} UTC"), "Keep one of them")
    if not len(steps):
        raise InputError(name, Problem("has one record, so its length is not known"), "Use a file with more records")
    lengths, counts = np.unique(np.round(steps, 3), return_counts=True)
    length = float(lengths[np.argmax(counts)])
    if not MIN_LENGTH_MIN <= length <= MAX_LENGTH_MIN:
        raise InputError(
            name, Problem(f"has records of {length:g} minutes"), f"Use records of {MIN_LENGTH_MIN:g} to {MAX_LENGTH_MIN:g}"
        )
    for number in np.flatnonzero(steps < length - LENGTH_TOLERANCE_MIN)[:1]:
        where = f"{steps[number]:g} minutes after {stamps[number].astype('datetime64[s]')} UTC"
        raise InputError(name, Problem(f"has records of {length:g} minutes, and one only {where}"), "Use records of one length")
    return length


def _values(rows: Sequence[Sequence[str]], column: _Column, length_min: float, name: str) -> np.ndarray:
    """Return the values of a column (n,) in W/m2; NaN where there is none."""
    texts = [row[column.number].strip() for row in rows]
    out = np.full(len(texts), np.nan)
    for number, text in enumerate(texts):
        if text.lower() in _MISSING:
            continue
        try:
            out[number] = float(text)
        except ValueError:
            raise InputError(f"{name}: {column.name} of row {number + 2}", text, "a number") from None
    return out * UNITS[column.unit] / (1.0 if column.unit in POWER_UNITS else length_min)
