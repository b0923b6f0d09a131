"""What rasters of hours of sun may hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from skugga.shadows.sun_hours.sun_hours import SunHours

QUANTITIES: dict[str, Callable[[SunHours], np.ndarray]] = {
    "hours": lambda found: found.hours,
    "first": lambda found: found.first,
    "last": lambda found: found.last,
    "longest": lambda found: found.longest,
    "days": lambda found: found.days,
}
"""What a raster may hold, by name: float32, NaN where there is no surface (and of ``first`` and ``last`` no sun)."""

QUANTITY_NOTES: dict[str, tuple[str, str]] = {
    "hours": ("hours of direct sun, mean of the dates", "h"),
    "first": ("first sun of any date, minutes from midnight by the clock", "min"),
    "last": ("last sun of any date, minutes from midnight by the clock", "min"),
    "longest": ("longest unbroken sun of any date", "h"),
    "days": ("days with enough direct sun", "d"),
}
"""Quantity -> what its cells are, and their unit, as files say them."""
