"""``skugga sunhours``: convert its options into a request."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from skugga.api.cli.times import read_duration
from skugga.api.products.sun_hours import PRODUCT_NAME, QUANTITIES, SunHoursOptions
from skugga.api.request import ProductRequest
from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import parse_clock, parse_date
from skugga.terrain.geo.daily_windows import parse_window


def sun_hours_request(
    quantity: str, dates: tuple[str, str | None, str], window: str, clock: str, rules: tuple[str, str, float, float]
) -> ProductRequest:
    """Return the request for a quantity over dates and a daily window.

    ``dates`` are the first date, the last date and their interval. ``rules`` are the step, the threshold, the minimum altitude
    (degrees) and the height above the ground (metres). Raises ``InputError``.
    """
    step, threshold, least_altitude, height = rules
    if quantity not in QUANTITIES:
        raise InputError("--quantity", quantity, ", ".join(QUANTITIES))
    minutes = None if step == "auto" else read_duration("--step", step) / timedelta(minutes=1)
    if minutes is not None and not 0.5 <= minutes <= 60.0:
        raise InputError("--step", step, "30s to 1h, or auto")
    if not -1.0 <= least_altitude < 90.0:
        raise InputError("--least-altitude", least_altitude, "-1 to 90 degrees above the horizon")
    if not 0.0 <= height <= 1000.0:
        raise InputError("--height", height, "0 to 1000 metres above the ground")
    hours = read_duration("--threshold", threshold) / timedelta(hours=1)
    if not hours <= 24.0:
        raise InputError("--threshold", threshold, "at most 24h")
    parse_clock("--clock", clock), parse_window(window)
    first = parse_date("--date", dates[0])
    last = None if dates[1] is None else parse_date("--to", dates[1])
    every = read_duration("--every", dates[2])
    if every % timedelta(days=1):
        raise InputError("--every", dates[2], "whole days, such as 7d")
    options = SunHoursOptions(
        date=first, to=last, every_days=every.days, quantity=quantity, window=window, clock=clock, height=height,
        least_altitude=least_altitude, step_min=minutes, threshold_h=hours,
    )  # fmt: skip
    return ProductRequest(product=PRODUCT_NAME, options=options)


def contour_values(contours: tuple[Path, str]) -> list[float]:
    """Return the values of the contours, sorted: hours, or minutes after midnight. Raises ``InputError``."""
    path, text = contours
    if path.suffix.lower() != ".gpkg":
        raise InputError("--contours", str(path), "a GeoPackage: .gpkg")
    try:
        values = sorted({float(part) for part in text.split(",")})
    except ValueError:
        values = []
    if not values or not all(abs(value) < 1e6 for value in values):
        raise InputError("--levels", text, "numbers such as 1,2,3, in hours, or in minutes after midnight for first and last")
    return values
