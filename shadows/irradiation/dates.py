"""The dates whose irradiation is added up, and the periods that it is added up over: all dates, months, days or hours."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, timedelta
from typing import Literal

import numpy as np

from skugga.terrain.geo.daily_windows import DailyWindow, clock_text

Per = Literal["period", "month", "day", "hour"]
"""What one value is the irradiation of: all dates together, or each of their months, days or hours."""

MEAN_DAYS = (17, 16, 16, 15, 15, 11, 17, 16, 15, 15, 14, 10)
"""The mean day of each month: that whose extraterrestrial radiation is nearest to the month's mean (S. A. Klein 1977, "Calculation
of monthly average insolation on tilted surfaces")."""


@dataclass(frozen=True)
class Period:
    """A period whose irradiation is one value.

    Attributes
    ----------
    name
        Its name: "2023-06-01 to 2023-08-31", "2023-06", "2023-06-21" or "2023-06-21 05:00".
    start
        When it begins, datetime64[us] in UTC.
    """

    name: str
    start: np.datetime64


@dataclass(frozen=True)
class Dates:
    """Dates whose irradiation is added up.

    Attributes
    ----------
    windows
        The window of each date, in order.
    weights
        How many days each date stands for.
    per
        What one value is the irradiation of.
    """

    windows: tuple[DailyWindow, ...]
    weights: tuple[float, ...]
    per: Per = "period"

    @property
    def periods(self) -> tuple[Period, ...]:
        """The periods, in order."""
        if self.per == "hour":
            return tuple(period for window in self.windows for period in _hours(window))
        starts: dict[str, np.datetime64] = {}
        for window in self.windows:
            starts.setdefault(self._name(window.date), _utc(window))
        return tuple(Period(name, start) for name, start in starts.items())

    def months(self) -> list[Dates]:
        """Return the dates of each month."""
        out: dict[tuple[int, int], list[int]] = {}
        for number, window in enumerate(self.windows):
            out.setdefault((window.date.year, window.date.month), []).append(number)
        return [
            Dates(tuple(self.windows[n] for n in numbers), tuple(self.weights[n] for n in numbers), self.per)
            for numbers in out.values()
        ]

    def days_represented(self, moments: np.ndarray) -> np.ndarray:
        """Return how many days the dates of some moments (n,), datetime64 in UTC, stand for: (n,)."""
        return np.array(self.weights)[self.date_numbers(moments)]

    def date_numbers(self, moments: np.ndarray) -> np.ndarray:
        """Return the number of the date of each moment (n,), datetime64 in UTC."""
        return np.searchsorted(self.starts, moments, side="right") - 1

    @property
    def starts(self) -> np.ndarray:
        """When each date starts, (dates,) datetime64[us] in UTC."""
        return np.array([_utc(window) for window in self.windows])

    def period_numbers(self, moments: np.ndarray) -> np.ndarray:
        """Return the number of the period of each moment (n,), datetime64 in UTC."""
        return np.searchsorted(np.array([period.start for period in self.periods]), moments, side="right") - 1

    def _name(self, date: datetime.date) -> str:
        """Return the name of the period of a date, if periods are not hours."""
        if self.per == "period":
            first, last = self.windows[0].date.isoformat(), self.windows[-1].date.isoformat()
            return first if first == last else f"{first} to {last}"
        return f"{date:%Y-%m}" if self.per == "month" else date.isoformat()


def all_dates(windows: Sequence[DailyWindow], per: Per = "period") -> Dates:
    """Return dates that each count as one day."""
    return Dates(tuple(windows), (1.0,) * len(windows), per)


def mean_days(first: datetime.date, last: datetime.date) -> dict[datetime.date, float]:
    """Return one date for each month from ``first`` to ``last``, and the number of days of the month that lie between these.

    It is the month's mean day (``MEAN_DAYS``), or the middle of the days where that day does not lie among them.
    """
    out = {}
    begin = first
    while begin <= last:
        next_month = (begin.replace(day=1) + timedelta(days=31)).replace(day=1)
        end = min(next_month - timedelta(days=1), last)
        mean = begin.replace(day=MEAN_DAYS[begin.month - 1])
        days = (end - begin).days + 1
        out[mean if begin <= mean <= end else begin + timedelta(days=(days - 1) // 2)] = float(days)
        begin = next_month
    return out


def _hours(window: DailyWindow) -> list[Period]:
    """Return the hours of a date, counted from the start of its window. Solar days are some seconds longer or shorter than 24 h."""
    hours = round(window.length_min / 60.0)
    start = _utc(window)
    return [
        Period(f"{window.date.isoformat()} {clock_text(window.clock_time_min(60.0 * hour))}", start + np.timedelta64(hour, "h"))
        for hour in range(hours)
    ]


def _utc(window: DailyWindow) -> np.datetime64:
    """Return when a window starts, datetime64[us] in UTC."""
    return np.datetime64(window.start.astimezone(UTC).replace(tzinfo=None), "us")
