"""``skugga irradiation``: convert its options into a request."""

from __future__ import annotations

import datetime

from skugga.api.cli.times import read_duration
from skugga.api.products import PRODUCTS
from skugga.api.products.irradiation import PARTS, PLANES, PRODUCT_NAME
from skugga.api.request import ProductRequest
from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import parse_clock, parse_date
from skugga.terrain.geo.sun_path import SUPPORTED_YEARS


def irradiation_request(
    period: tuple[int | None, str | None, str | None],
    quantity: tuple[str, str],
    air_and_ground: tuple[float, float | None],
    clock: str,
    step: str,
) -> ProductRequest:
    """Return the request for irradiation over a period.

    ``period`` is the year, or the first and the last date. ``quantity`` is the part of the light and the plane, ``air_and_ground``
    the albedo and Linke's turbidity. Raises ``InputError``.
    """
    part, plane = quantity
    albedo, linke = air_and_ground
    first, last = _dates(*period)
    if part not in PARTS:
        raise InputError("--part", part, ", ".join(PARTS))
    if plane not in PLANES:
        raise InputError("--plane", plane, ", ".join(PLANES))
    if not 0.0 <= albedo <= 1.0:
        raise InputError("--albedo", albedo, "0 to 1")
    if linke is not None and not 1.0 <= linke <= 20.0:
        raise InputError("--linke", linke, "1 to 20")
    minutes = read_duration("--step", step) / datetime.timedelta(minutes=1)
    if not 1.0 <= minutes <= 60.0:
        raise InputError("--step", step, "1m to 1h")
    parse_clock("--clock", clock)
    values = {"date": first, "to": last, "part": part, "plane": plane, "albedo": albedo, "linke": linke, "clock": clock}
    options = PRODUCTS[PRODUCT_NAME].options_of({**values, "step_min": minutes})
    return ProductRequest(product=PRODUCT_NAME, options=options)


def _dates(year: int | None, date: str | None, last: str | None) -> tuple[datetime.date, datetime.date | None]:
    """Return the first and the last date of ``--year``, or of ``--date`` and ``--to``. Raises ``InputError``."""
    if year is None:
        if date is None:
            raise InputError.missing("--year", "Give a year, or --date")
        first, to = parse_date("--date", date), None if last is None else parse_date("--to", last)
        if to is not None and to < first:
            raise InputError("--to", last, f"{first.isoformat()} or later")
        return first, to
    for name, value in (("--date", date), ("--to", last)):
        if value is not None:
            raise InputError.conflict(name, "--year")
    low, high = SUPPORTED_YEARS[0] + 1, SUPPORTED_YEARS[1] - 1
    if not low <= year <= high:
        raise InputError("--year", year, f"years {low} to {high}")
    return datetime.date(year, 1, 1), datetime.date(year, 12, 31)
