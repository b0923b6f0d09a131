"""Records of weather, and those of them that serve windows of time.

Typical years join months of different years. Their records are kept in the year ``TYPICAL_YEAR`` by the file's clock. They serve
the same dates and hours of every year; 29 February takes the records of the 28th.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC

import numpy as np

from skugga.shadows.irradiation.suns import time_up
from skugga.terrain.errors import InputError
from skugga.terrain.geo.daily_windows import DailyWindow

TYPICAL_YEAR = 2001
"""Year of the records of typical years: without a 29 February."""

END_OF_FEBRUARY = np.timedelta64(59, "D")
"""Time from the start of a year to 1 March, without a 29 February."""

DAY = np.timedelta64(1, "D")

GAP_PIECE_MIN = 60.0
"""Maximum minutes of the pieces in which light is looked for between records."""

MIN_MISSING_MIN = 1.0
"""Minutes of daylight without records up to which no warning is given."""


@dataclass(frozen=True, eq=False)
class Weather:
    """The light of n records of a weather file. Albedo, which some files have, is not read.

    GHI, or DNI and DHI, are given. A part that is ``None`` is computed with the sun of each record.

    Attributes
    ----------
    source
        The file and its format.
    start
        (n,), datetime64[us] in UTC: the starts of the records' intervals, ascending.
    length_min
        (n,): the lengths of the intervals, minutes.
    ghi, dni, dhi
        (n,): mean power in the interval on a level plane, from the sun on a plane that faces it, and from the sky on a level plane,
        W/m2; ``None``: not in the file.
    is_typical
        Whether the records are those of a typical year. They then lie in ``TYPICAL_YEAR`` by the file's clock.
    utc_offset_min
        The file's clock: minutes ahead of UTC.
    lon_deg, lat_deg, height_m
        The place; ``None`` where the file does not tell it.
    warnings
        Sentences for the user.
    """

    source: str
    start: np.ndarray
    length_min: np.ndarray
    ghi: np.ndarray | None
    dni: np.ndarray | None
    dhi: np.ndarray | None
    is_typical: bool = False
    utc_offset_min: float = 0.0
    lon_deg: float | None = None
    lat_deg: float | None = None
    height_m: float | None = None
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self.start)

    @property
    def middle(self) -> np.ndarray:
        """The middles of the intervals, (n,) datetime64[us] in UTC."""
        return self.start + as_timedelta(self.length_min / 2.0)

    @property
    def parts(self) -> dict[str, np.ndarray]:
        """The parts of the light that the file has, by name."""
        parts = {"ghi": self.ghi, "dni": self.dni, "dhi": self.dhi}
        return {name: values for name, values in parts.items() if values is not None}


@dataclass(frozen=True, eq=False)
class RecordIntervals:
    """The intervals of n records within windows, cut at the windows' ends and in the order of the windows.

    Attributes
    ----------
    record
        (n,): the numbers of the records.
    window
        (n,): the numbers of the windows.
    start
        (n,), datetime64[us] in UTC.
    length_min
        (n,), minutes.
    record_start
        (n,), datetime64[us] in UTC: the starts of the whole records in the year of the window.
    """

    record: np.ndarray
    window: np.ndarray
    start: np.ndarray
    length_min: np.ndarray
    record_start: np.ndarray


def records_in_windows(weather: Weather, windows: Sequence[DailyWindow], lon_deg: float, lat_deg: float) -> RecordIntervals:
    """Return the intervals of the records that serve windows at a place.

    Raises ``InputError`` for a date with daylight that has no record at all.
    """
    starts, number = _records_of_years(weather, windows)
    ends = starts + as_timedelta(weather.length_min[number])
    window_starts, window_ends = _bounds(windows)
    first = np.searchsorted(ends, window_starts, side="right")
    counts = np.maximum(np.searchsorted(starts, window_ends, side="left") - first, 0)
    window = np.repeat(np.arange(len(windows)), counts)
    index = np.repeat(first, counts) + np.arange(len(window)) - np.repeat(np.cumsum(counts) - counts, counts)
    cut_starts = np.maximum(starts[index], window_starts[window])
    length_min = (np.minimum(ends[index], window_ends[window]) - cut_starts) / np.timedelta64(1, "m")
    for empty in np.flatnonzero(counts == 0).tolist():
        if _daylight(window_starts[empty : empty + 1], window_ends[empty : empty + 1], lon_deg, lat_deg)[1] > 0.0:
            raise InputError("weather", windows[empty].date.isoformat(), f"dates of {_dates_text(weather)}")
    return RecordIntervals(number[index], window, cut_starts, length_min, starts[index])


def missing_weather(weather: Weather, windows: Sequence[DailyWindow], lon_deg: float, lat_deg: float) -> tuple[str, ...]:
    """Return a warning of daylight in windows at a place for which weather has no records, or nothing.

    Such time counts as without light. Raises ``InputError`` for a date with daylight that has no record at all.
    """
    records = records_in_windows(weather, windows, lon_deg, lat_deg)
    window_starts, window_ends = _bounds(windows)
    ends = records.start + as_timedelta(records.length_min)
    windows_of = np.concatenate([np.arange(len(windows)), records.window])
    gap_starts = np.concatenate([window_starts, ends])
    gap_starts = gap_starts[np.lexsort((gap_starts, windows_of))]
    windows_of = np.concatenate([records.window, np.arange(len(windows))])
    gap_ends = np.concatenate([records.start, window_ends])
    gap_ends = gap_ends[np.lexsort((gap_ends, windows_of))]
    is_gap = gap_ends > gap_starts
    first, minutes = _daylight(gap_starts[is_gap], gap_ends[is_gap], lon_deg, lat_deg)
    if minutes <= MIN_MISSING_MIN or first is None:
        return ()
    moment = str(first.astype("datetime64[m]")).replace("T", " ")
    return (
        f"{weather.source}: {minutes / 60.0:.3g} hours of daylight have no record, the first from {moment} UTC on. "
        "They count as without light.",
    )


def typical_starts(stamps: np.ndarray, utc_offset_min: float, shift_min: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the starts in UTC of a typical year's records, datetime64[us], and which of n stamps have one: not 29 February.

    ``stamps`` (n,) are datetime64 of any year by the file's clock. ``shift_min`` leads from a stamp to its record's start.
    """
    months = stamps.astype("datetime64[M]")
    since_month = stamps.astype("datetime64[us]") - months.astype("datetime64[us]")
    month_numbers = months.astype(int) % 12
    is_kept = ~((month_numbers == 1) & (since_month >= np.timedelta64(28, "D")))
    typical_months = (np.datetime64(f"{TYPICAL_YEAR}-01", "M") + month_numbers).astype("datetime64[us]")
    return (typical_months + since_month + as_timedelta(shift_min - utc_offset_min))[is_kept], is_kept


def as_timedelta(minutes: np.ndarray | float) -> np.ndarray:
    """Return minutes as timedelta64[us]."""
    return np.rint(np.asarray(minutes) * 60e6).astype("timedelta64[us]")


def _bounds(windows: Sequence[DailyWindow]) -> tuple[np.ndarray, np.ndarray]:
    """Return the starts and the ends of windows, datetime64[us] in UTC."""
    starts = np.array([window.start.astimezone(UTC).replace(tzinfo=None) for window in windows], "datetime64[us]")
    return starts, starts + as_timedelta(np.array([window.length_min for window in windows]))


def _records_of_years(weather: Weather, windows: Sequence[DailyWindow]) -> tuple[np.ndarray, np.ndarray]:
    """Return the starts in UTC of the records in the years of windows, ascending, and their numbers."""
    numbers = np.arange(len(weather))
    if not weather.is_typical:
        return weather.start, numbers
    offset = as_timedelta(weather.utc_offset_min)
    since_new_year = weather.start + offset - np.datetime64(f"{TYPICAL_YEAR}-01-01", "us")
    is_28_february = (since_new_year >= END_OF_FEBRUARY - DAY) & (since_new_year < END_OF_FEBRUARY)
    after_february = np.where(since_new_year >= END_OF_FEBRUARY, DAY, np.timedelta64(0, "D"))
    starts, ends = _bounds(windows)
    first, last = ((moment + offset).astype("datetime64[Y]") for moment in (starts.min() - DAY, ends.max() + DAY))
    all_starts, all_numbers = [], []
    for year in np.arange(first, last + 1):
        new_year = year.astype("datetime64[us]") - offset
        has_leap_day = (year + 1).astype("datetime64[D]") - year.astype("datetime64[D]") > np.timedelta64(365, "D")
        if has_leap_day:
            all_starts += [new_year + since_new_year + after_february, (new_year + since_new_year + DAY)[is_28_february]]
            all_numbers += [numbers, numbers[is_28_february]]
        else:
            all_starts.append(new_year + since_new_year)
            all_numbers.append(numbers)
    out = np.concatenate(all_starts)
    order = np.argsort(out, kind="stable")
    return out[order], np.concatenate(all_numbers)[order]


def _daylight(starts: np.ndarray, ends: np.ndarray, lon_deg: float, lat_deg: float) -> tuple[np.datetime64 | None, float]:
    """Return the first moment of daylight in intervals, to the hour, and the minutes of daylight in all of them."""
    lengths = (ends - starts) / np.timedelta64(1, "m")
    counts = np.ceil(lengths / GAP_PIECE_MIN).astype(int)
    interval = np.repeat(np.arange(len(starts)), counts)
    number = np.arange(len(interval)) - np.repeat(np.cumsum(counts) - counts, counts)
    piece_min = (lengths / np.maximum(counts, 1))[interval]
    piece_starts = starts[interval] + as_timedelta(number * piece_min)
    up_minutes, _ = time_up(piece_starts, piece_min, lon_deg, lat_deg)
    lit = np.flatnonzero(up_minutes > 0.0)
    return (piece_starts[lit[0]] if len(lit) else None), float(up_minutes.sum())


def _dates_text(weather: Weather) -> str:
    """Return the source of weather with its first and last date."""
    begin = len("2001-") if weather.is_typical else 0
    first, last = (str(moment.astype("datetime64[D]"))[begin:] for moment in (weather.start[0], weather.middle[-1]))
    return f"{weather.source}, {first} to {last}"
