"""``skugga irradiation``: convert its options into a request."""

from __future__ import annotations

import datetime
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import typer

from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.shading import OutputGrid
from skugga.api.cli.times import read_duration
from skugga.api.cli.warnings import print_product_warnings, print_warnings
from skugga.api.products import PRODUCTS
from skugga.api.products.irradiation import PARTS, PERIODS, PLANES, PRODUCT_NAME, IrradiationOptions
from skugga.api.request import ProductRequest
from skugga.terrain.errors import InputError, printable
from skugga.terrain.geo.clock import parse_clock, parse_date
from skugga.terrain.geo.sun_path import SUPPORTED_YEARS
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import build_scene


@dataclass(frozen=True)
class IrradiationArguments:
    """The options of ``skugga irradiation``, by the names of the product's options (``IrradiationOptions``)."""

    year: int | None
    date: str | None
    last: str | None
    days: str
    per: str
    part: str
    plane: str
    tilt: float | None
    azimuth: float | None
    albedo: float
    linke: float | None
    transmissivity: float
    weather: Path | None
    weather_columns: str | None
    clock: str
    step: str | None
    checkpoint: Path | None


def irradiation_request(arguments: IrradiationArguments) -> ProductRequest:
    """Return the request for irradiation over a period. Raises ``InputError``, which names options as the command does."""
    first, last = _dates(arguments.year, arguments.date, arguments.last)
    for name, value, allowed in (
        ("--part", arguments.part, ("all", *PARTS)), ("--plane", arguments.plane, PLANES), ("--per", arguments.per, PERIODS),
        ("--days", arguments.days, ("all", "mean")),
    ):  # fmt: skip
        if value not in allowed:
            raise InputError(name, value, ", ".join(allowed))
    for name, share in (("--albedo", arguments.albedo), ("--transmissivity", arguments.transmissivity)):
        if not 0.0 <= share <= 1.0:
            raise InputError(name, share, "0 to 1")
    minutes = None if arguments.step is None else read_duration("--step", arguments.step) / datetime.timedelta(minutes=1)
    if minutes is not None and not 1.0 <= minutes <= 60.0:
        raise InputError("--step", arguments.step, "1m to 1h")
    parse_clock("--clock", arguments.clock)
    values = {
        "date": first, "to": last, "days": arguments.days, "per": arguments.per,
        "part": "total" if arguments.part == "all" else arguments.part, "by_part": arguments.part == "all",
        "plane": arguments.plane, "tilt": arguments.tilt, "plane_azimuth": arguments.azimuth, "albedo": arguments.albedo,
        "linke": arguments.linke, "transmissivity": arguments.transmissivity, "weather": arguments.weather,
        "weather_columns": arguments.weather_columns, "clock": arguments.clock, "step_min": minutes,
        "checkpoint": arguments.checkpoint,
    }  # fmt: skip
    try:
        options = PRODUCTS[PRODUCT_NAME].options_of(values)
    except InputError as error:
        names = {"plane_azimuth": "azimuth", "step_min": "step"}
        raise error.renamed(f"--{names.get(error.name, error.name).replace('_', '-')}") from None
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


def write_polygons(
    level: LevelSource,
    output: Path,
    polygons: Path,
    request: ProductRequest,
    output_grid: OutputGrid,
    on_step: Callable[[int, int], None],
) -> None:
    """Write the irradiation of polygons, computed on the cells of a level's raster. Raises ``SkuggaError`` and ``OSError``."""
    from skugga.api.polygon_irradiation import DRIVER_BY_SUFFIX, polygon_irradiation, read_polygons, write_polygon_irradiation

    if output.suffix.lower() not in DRIVER_BY_SUFFIX:
        raise InputError("--output", str(output), f"a table of polygons: {', '.join(DRIVER_BY_SUFFIX)}")
    for name, value in (
        ("--bounds", output_grid.bounds), ("--crs", output_grid.crs), ("--resolution", output_grid.resolution),
        ("--like", output_grid.like),
    ):  # fmt: skip
        if value is not None:
            raise InputError.conflict(name, "--polygons")
    check_output_files(level, [("--output", output)], polygons)
    options = request.options
    assert isinstance(options, IrradiationOptions)
    scene = build_scene(load_level(level))
    print_warnings(scene)
    try:
        PRODUCTS[PRODUCT_NAME].check(scene)
        print_product_warnings(options.warnings(scene))
        answer = polygon_irradiation(scene, read_polygons(polygons, scene), options, on_step)
        write_polygon_irradiation(output, answer)
    finally:
        scene.close()
    if sys.stderr.isatty():
        typer.echo(printable(f"skugga: wrote {output}: irradiation of {len(answer.cells)} polygons"), err=True)
