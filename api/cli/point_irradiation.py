"""``skugga point --irradiation``: print the irradiation at points by month; write it as JSON, a CSV or a chart."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from pydantic import ValidationError

from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.tables import wide_console
from skugga.api.cli.times import read_duration
from skugga.api.cli.warnings import print_product_warnings, print_warnings
from skugga.api.point.irradiation import (
    csv_text,
    irradiation_at_points,
    named_sums,
    point_irradiation,
    points_csv_text,
    weather_warnings,
)
from skugga.api.point.irradiation_chart import irradiation_chart
from skugga.api.point.irradiation_values import PointIrradiationOptions, PointIrradiationReport, check_plane, requested_dates
from skugga.api.point.track import read_points
from skugga.api.point.values import PointQuery
from skugga.shadows.irradiation.at_point import Cause
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.compiling.ahead_of_time import POINTS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.clock import parse_date
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_errors import allowed_phrase
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import Scene, build_scene

OUTPUT_SUFFIXES = (".json", ".csv", ".svg", ".png")
"""Suffixes of files of irradiation."""

POINTS_OUTPUT_SUFFIXES = (".csv", ".json")
"""Suffixes of files of the irradiation at many points."""

_HEADINGS = {
    "total": "total", "beam": "beam", "circumsolar": "circumsolar", "sky": "sky", "horizon_band": "horizon band",
    "reflected": "reflected", "open_sky": "open sky",
}  # fmt: skip
_CAUSE_HEADINGS: dict[Cause, str] = {"relief": "lost to surface", "solids": "to buildings", "forest": "to trees"}


@dataclass(frozen=True)
class IrradiationTexts:
    """The options of the command for irradiation, as they are written; ``None`` for those that are not there."""

    to: str | None
    plane: str | None
    tilt: float | None
    azimuth: float | None
    albedo: float | None
    linke: float | None
    step: str | None
    weather: Path | None
    weather_columns: str | None

    def check_absent(self) -> None:
        """Raise ``InputError`` if one of the options is there."""
        for name, value in vars(self).items():
            if value is not None:
                raise InputError(f"--{name.replace('_', '-')}", Problem("needs irradiation"), "Add --irradiation")

    def parsed(self) -> PointIrradiationOptions:
        """Return the options as values. Raises ``InputError``."""
        values: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None and name != "step"}
        if self.to is not None:
            values["to"] = parse_date("--to", self.to)
        if self.step is not None:
            minutes = read_duration("--step", self.step) / datetime.timedelta(minutes=1)
            if not 1.0 <= minutes <= 60.0:
                raise InputError("--step", self.step, "1m to 1h")
            values["step_min"] = minutes
        try:
            options = PointIrradiationOptions(**values)
        except ValidationError as error:
            detail = error.errors()[0]
            raise InputError(f"--{detail['loc'][0]}", detail.get("input"), allowed_phrase(detail)) from None
        try:
            check_plane(options)
        except InputError as error:
            raise error.prefixed("--") from None
        return options


def report_irradiation(
    level: LevelSource, query: PointQuery, crs: Any, irradiation: PointIrradiationOptions, output: Path | None, as_json: bool
) -> None:
    """Print the irradiation at a point by month, and write it to ``output`` in the format that the file's suffix names.

    ``crs`` is the CRS of the query's coordinates; ``None``: degrees. Raises ``SkuggaError`` and ``OSError``.
    """
    _check_irradiation(level, query, irradiation, output, OUTPUT_SUFFIXES)
    with _scene_with_warnings(level, query, irradiation) as scene:
        report = point_irradiation(scene, query, irradiation, crs)
    if output is not None:
        write_atomically(output, _file_content(report, output, scene.loaded.level.title or scene.loaded.name))
    if as_json:
        typer.echo(report.model_dump_json(indent=2))
    else:
        print_report(report)


def report_irradiation_of_points(
    level: LevelSource, file: Path, query: PointQuery, irradiation: PointIrradiationOptions, output: Path | None, as_json: bool
) -> None:
    """Print the irradiation at the points of a file, and write it to ``output`` by month, as a CSV or as JSON.

    ``query`` has the dates, and the height of points without their own. Raises ``SkuggaError`` and ``OSError``.
    """
    _check_irradiation(level, query, irradiation, output, POINTS_OUTPUT_SUFFIXES, file)
    points = read_points(file, query.height)
    if not points:
        raise InputError(str(file), Problem("no points"), "Give at least one")
    with _scene_with_warnings(level, query, irradiation) as scene:
        reports = irradiation_at_points(scene, points, query, irradiation)
    content = json.dumps([report.model_dump(mode="json") for report in reports], indent=2)
    if output is not None:
        write_atomically(output, points_csv_text(reports) if output.suffix.lower() == ".csv" else content + "\n")
    if as_json:
        typer.echo(content)
    else:
        _print_points(reports)


def _check_irradiation(
    level: LevelSource,
    query: PointQuery,
    irradiation: PointIrradiationOptions,
    output: Path | None,
    suffixes: Sequence[str],
    file: Path | None = None,
) -> None:
    """Raise ``InputError`` for an output without one of ``suffixes``, or over an input, and for wrong dates, before any work.

    ``file`` is that of the points.
    """
    if output is not None and output.suffix.lower() not in suffixes:
        raise InputError("--output", str(output), f"with --irradiation: {', '.join(suffixes)}")
    check_output_files(level, [("--output", output)], *([] if file is None else [file]))
    try:
        _, last = requested_dates(query, irradiation)
        if irradiation.to is not None and query.date is not None and last < query.date:
            raise InputError("to", last.isoformat(), f"{query.date.isoformat()} or later")
    except InputError as error:
        raise error.prefixed("--") from None


@contextmanager
def _scene_with_warnings(level: LevelSource, query: PointQuery, irradiation: PointIrradiationOptions) -> Iterator[Scene]:
    """Open the scene of a level, and print its warnings and those of the weather."""
    declare_product(POINTS)
    scene = build_scene(load_level(level))
    print_warnings(scene)
    try:
        print_product_warnings(weather_warnings(scene, query, irradiation))
        yield scene
    finally:
        scene.close()


def _file_content(report: PointIrradiationReport, output: Path, title: str) -> str | bytes:
    """Return the content of a file in the format that its suffix names. ``title`` is that of a chart."""
    suffix = output.suffix.lower()
    if suffix == ".json":
        return report.model_dump_json(indent=2) + "\n"
    if suffix == ".csv":
        return csv_text(report)
    return irradiation_chart(report, "svg" if suffix == ".svg" else "png", title)


def print_report(report: PointIrradiationReport) -> None:
    """Print the place, the plane, and a table with a row for each month. Causes that take nothing have no columns."""
    from rich.table import Table

    console = wide_console()
    height_text = f", {report.height_m:g} m above it" if report.height_m else ""
    console.print(f"{report.level}: {report.lon:.6f}, {report.lat:.6f}; ground {report.elevation_m:.1f} m{height_text}")
    plane_text = "level plane" if not report.tilt else f"plane tilted {report.tilt:.1f}, facing {report.azimuth:.1f} degrees"
    console.print(
        f"{plane_text}; sky view {report.sky_view:.3f}, behind the surface alone {report.sky_view_of_relief:.3f}; "
        f"{report.weather}, {report.first} to {report.last}; {report.unit}"
    )
    rows = named_sums(report)
    columns = {heading: [getattr(sums, part) for _, sums in rows] for part, heading in _HEADINGS.items()}
    for cause, heading in _CAUSE_HEADINGS.items():
        losses = [sums.lost(cause) for _, sums in rows]
        if any(losses):
            columns[heading] = losses
    table = Table("month", box=None)
    for heading in columns:
        table.add_column(heading, justify="right")
    for n, (name, _) in enumerate(rows):
        table.add_row(name, *(f"{values[n]:z.1f}" for values in columns.values()))
    console.print(table)
    if report.remark:
        console.print(report.remark)


def _print_points(reports: Sequence[PointIrradiationReport]) -> None:
    """Print a table with a row for each point: light of all dates together, and what takes light."""
    from rich.table import Table

    console, first = wide_console(), reports[0]
    console.print(f"{first.level}: {first.weather}, {first.first} to {first.last}; {first.unit}")
    table = Table("longitude", "latitude", "ground, m", "total", "open sky", *_CAUSE_HEADINGS.values(), box=None)
    for report in reports:
        sums = report.all_months
        ground = "" if report.elevation_m is None else f"{report.elevation_m:.1f}"
        values = [] if sums is None else [sums.total, sums.open_sky, *(sums.lost(cause) for cause in _CAUSE_HEADINGS)]
        texts = [f"{value:z.1f}" for value in values] or [""] * (2 + len(_CAUSE_HEADINGS))
        table.add_row(f"{report.lon:.6f}", f"{report.lat:.6f}", ground, *texts)
    console.print(table)
    for report in reports:
        if report.remark:
            console.print(f"{report.lon:.6f}, {report.lat:.6f}: {report.remark}")
