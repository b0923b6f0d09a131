"""``skugga point``: report the sun at points as tables or JSON; write horizon files and sky charts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import typer
from pydantic import ValidationError
from pyproj import CRS
from pyproj.exceptions import CRSError

from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.point_irradiation import IrradiationTexts, report_irradiation, report_irradiation_of_points
from skugga.api.cli.tables import wide_console
from skugga.api.cli.times import read_time
from skugga.api.cli.warnings import print_warnings
from skugga.api.point.horizon_formats import HORIZON_FORMATS, azimuths_of_format, horizon_file
from skugga.api.point.horizons import TABLE_SUFFIXES, check_azimuths, horizons_at_points
from skugga.api.point.polar_picture import sky_picture
from skugga.api.point.report import point_report, point_surroundings, requested_clock, requested_day
from skugga.api.point.track import read_points, read_track, sun_at_points, with_arrival_times
from skugga.api.point.values import PointQuery, PointReport, PointRow, ReportedCaster, TrackPoint
from skugga.shadows.point.horizon import Surroundings, horizon_profile
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.compiling.ahead_of_time import POINTS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.clock import parse_clock, parse_date
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_errors import allowed_phrase
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

PICTURE_SUFFIXES = {".svg": "svg", ".png": "png"}

_LIT_TEXT, _DARK_TEXT, _NIGHT_TEXT = "lit", "in shadow", "night"


@dataclass(frozen=True)
class PointOptions:
    """The options of the command. Texts are not parsed yet.

    Attributes
    ----------
    at
        ``LON,LAT`` in degrees, or ``x,y`` of ``crs``.
    crs
        CRS of ``at``.
    sun
        The sun of ``--time``; ``None`` without that option.
    date, clock
        The day, and the clock that it belongs to.
    height
        Height above the ground, metres.
    year
        Year of the hours of sun by day.
    horizon, output
        Format of the horizon, and its file (``None``: standard output).
    azimuths
        Number of azimuths of the horizons of many points; ``None`` reports their sun.
    irradiation
        Whether to report irradiation instead of the sun.
    picture
        File of the sky chart.
    as_json
        Whether to print JSON.
    """

    at: str | None
    crs: str | None
    sun: SunSpec | None
    date: str | None
    clock: str | None
    height: float
    year: int | None
    horizon: str | None
    azimuths: int | None
    irradiation: bool
    output: Path | None
    picture: Path | None
    as_json: bool


def check_point_options(options: PointOptions, points: Path | None, line: Path | None, start: str | None) -> None:
    """Raise ``InputError`` for options that exclude or need each other, before any work.

    ``points`` and ``line`` are the files of points or of a track, and ``start`` is the time at the start of the track, as text.
    """
    batch_option = "--points" if points is not None else "--line" if line is not None else None
    if batch_option is None:
        if options.at is None:
            raise InputError.missing("--at", "Give LON,LAT, or many points with --points or --line")
    else:
        excluded_options = {
            "--at": options.at, "--line": line if batch_option == "--points" else None, "--horizon": options.horizon,
            "--picture": options.picture, "--year": None if options.irradiation else options.year,
        }  # fmt: skip
        for name, value in excluded_options.items():
            if value is not None:
                raise InputError.conflict(name, batch_option)
    if options.irradiation:
        _check_irradiation_options(options, batch_option)
    if options.azimuths is not None:
        _check_horizons_options(options, batch_option, start)
    if start is not None and line is None:
        raise InputError("--start", Problem("needs a track"), "Add --line FILE")
    if options.horizon is not None and options.horizon not in HORIZON_FORMATS:
        raise InputError("--horizon", options.horizon, f"{', '.join(HORIZON_FORMATS)} (--output names the file)")
    if options.output is not None and options.horizon is None and options.azimuths is None and not options.irradiation:
        raise InputError(
            "--output", Problem("needs a horizon format"), f"Add --horizon FORMAT: {', '.join(HORIZON_FORMATS)}, or --irradiation"
        )
    if options.as_json and options.horizon is not None and options.output is None:
        raise InputError.conflict("--json", "--horizon", "Add --output FILE for the horizon: only one of the two can be printed")


def _check_irradiation_options(options: PointOptions, batch_option: str | None) -> None:
    """Raise ``InputError`` for options that do not go with ``--irradiation``. ``batch_option`` is ``--points`` or ``--line``."""
    excluded_options = {
        "--line": True if batch_option == "--line" else None, "--time": options.sun, "--horizon": options.horizon,
        "--picture": options.picture, "--azimuths": options.azimuths,
    }  # fmt: skip
    for name, value in excluded_options.items():
        if value is not None:
            raise InputError.conflict(name, "--irradiation")


def _check_horizons_options(options: PointOptions, batch_option: str | None, start: str | None) -> None:
    """Raise ``InputError`` for options that do not go with ``--azimuths``. ``batch_option`` is ``--points`` or ``--line``."""
    if batch_option is None:
        raise InputError("--azimuths", Problem("needs many points"), "Add --points FILE, or use --horizon FORMAT for one point")
    assert options.azimuths is not None
    check_azimuths(options.azimuths, "--azimuths")
    excluded_options = {
        "--time": options.sun, "--date": options.date, "--clock": options.clock, "--start": start, "--json": options.as_json or None
    }  # fmt: skip
    for name, value in excluded_options.items():
        if value is not None:
            raise InputError.conflict(
                name, "--azimuths", "Horizons do not depend on the sun" if name != "--json" else "Use one of them"
            )
    if options.output is not None and options.output.suffix.lower() not in TABLE_SUFFIXES:
        raise InputError("--output", str(options.output), f"with --azimuths: {' or '.join(TABLE_SUFFIXES)}")


def report_point(level: LevelSource, options: PointOptions) -> None:
    """Print the report of a point and write its horizon and sky chart. A horizon without a file is printed instead of the report.

    Raises ``SkuggaError`` and ``OSError``.
    """
    if options.picture is not None and options.picture.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputError("--picture", str(options.picture), " or ".join(PICTURE_SUFFIXES))
    check_output_files(level, [("--output", options.output), ("--picture", options.picture)])
    query, crs = _point_query(options, *_read_coordinate_pair(options.at or "")), _read_crs(options.crs)
    declare_product(POINTS)
    loaded = load_level(level)
    scene = build_scene(loaded).with_sun(options.sun)
    print_warnings(scene)
    try:
        surroundings = point_surroundings(scene, query, crs)
        horizon = None if options.horizon is None else _horizon_text(surroundings, options.horizon)
        report = point_report(scene, query, crs) if horizon is None or options.output is not None else None
        if horizon is not None and options.output is not None:
            write_atomically(options.output, horizon)
        if options.picture is not None:
            write_atomically(options.picture, _sky_picture_file(surroundings, query, options.picture))
    finally:
        scene.close()
    if report is None:
        typer.echo(horizon, nl=False)
    elif options.as_json:
        typer.echo(report.model_dump_json(indent=2))
    else:
        has_chosen_sun = options.sun is not None or (options.date is None and loaded.level.sun is not None)
        _print_report(report, has_requested_time=has_chosen_sun)


def report_point_irradiation(level: LevelSource, options: PointOptions, texts: IrradiationTexts, points: Path | None) -> None:
    """Print the irradiation at a point, or at the points of a file, and write it to the file of ``--output``.

    Raises ``SkuggaError`` and ``OSError``.
    """
    irradiation = texts.parsed()
    if points is not None:
        query = _point_query(options, 0.0, 0.0)
        report_irradiation_of_points(level, points, query, irradiation, options.output, options.as_json)
        return
    query = _point_query(options, *_read_coordinate_pair(options.at or ""))
    report_irradiation(level, query, _read_crs(options.crs), irradiation, options.output, options.as_json)


def report_points(level: LevelSource, file: Path, options: PointOptions) -> None:
    """Print the sun at the points of a file. Raises the errors of ``report_point``."""
    _report_track_points(level, file, read_points(file, options.height), options)


def report_line(level: LevelSource, file: Path, options: PointOptions, start: str | None, speed_kmh: float, every_m: float) -> None:
    """Print the sun along a line at the times of arrival. Without ``start`` the time is the level's own everywhere.

    ``speed_kmh`` is the speed along the line in km/h. ``every_m`` is the maximum distance of two reported points in metres.
    Raises the errors of ``report_point``.
    """
    points = read_track(file, every_m, options.height)
    if start is not None:
        points = with_arrival_times(points, read_time("--start", start), speed_kmh)
    _report_track_points(level, file, points, options)


def _report_track_points(level: LevelSource, file: Path, points: list[TrackPoint], options: PointOptions) -> None:
    """Print the sun at the points of a file, as a table or as JSON. The points either all have a time or all have none.

    Points without times also get the day's hours of direct sun. With ``PointOptions.azimuths`` the points' horizons are written
    instead. Raises ``SkuggaError`` and ``OSError``.
    """
    if not points:
        raise InputError(str(file), Problem("no points"), "Give at least one")
    check_output_files(level, [("--output", options.output)], file)
    declare_product(POINTS)
    scene = build_scene(load_level(level)).with_sun(options.sun)
    print_warnings(scene)
    try:
        if options.azimuths is not None:
            _write_horizons(scene, file, points, options.azimuths, options.output)
            return
        has_times = points[0].time is not None
        rows = sun_at_points(scene, points, _point_query(options, 0.0, 0.0), includes_hours=not has_times)
    finally:
        scene.close()
    if options.as_json:
        typer.echo(json.dumps([row.as_json(point) for point, row in zip(points, rows, strict=True)], indent=2))
    else:
        _print_rows(points, rows)


def _write_horizons(scene: Scene, file: Path, points: list[TrackPoint], azimuths: int, output: Path | None) -> None:
    """Write the horizons of the points of ``file`` as a table to ``output``, or print it as a CSV. Raises the errors of both."""
    coordinates = [(point.lon_deg, point.lat_deg) for point in points]
    horizons = horizons_at_points(scene, coordinates, azimuths, [point.height_m for point in points], name=str(file))
    if output is None:
        typer.echo(horizons.csv_text(), nl=False)
    else:
        write_atomically(output, horizons.npz_bytes() if output.suffix.lower() == ".npz" else horizons.csv_text())


def _point_query(options: PointOptions, lon: float, lat: float) -> PointQuery:
    """Return the query of a point at a longitude and latitude in degrees, with the date, clock, year and height of the options.

    In a flat world ``lon`` and ``lat`` are metres east and north. Raises ``InputError``.
    """
    day = None if options.date is None else parse_date("--date", options.date)
    if options.clock is not None:
        parse_clock("--clock", options.clock)
    try:
        return PointQuery(lon=lon, lat=lat, height=options.height, date=day, clock=options.clock, year=options.year)
    except ValidationError as error:
        detail = error.errors()[0]
        raise InputError(f"--{detail['loc'][0]}", detail.get("input"), allowed_phrase(detail)) from None


def _read_coordinate_pair(text: str) -> tuple[float, float]:
    """Return the two numbers of ``--at``, in the order in which they are written. Raises ``InputError``."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--at", text, "two numbers, longitude and latitude in degrees, or x and y in --crs") from None
    return x, y


def _read_crs(text: str | None) -> CRS | None:
    """Return the CRS of ``--crs``; ``None`` without the option. Raises ``InputError``."""
    if text is None:
        return None
    try:
        return CRS.from_user_input(int(text) if text.isascii() and text.isdigit() else text)
    except CRSError:
        raise InputError("--crs", text, "a CRS that PROJ knows, such as EPSG:32616") from None


def _horizon_text(surroundings: Surroundings, format: str) -> str:
    """Return the horizon of a point as the text of a horizon file; ``format`` is a key of ``HORIZON_FORMATS``."""
    return horizon_file(format, horizon_profile(surroundings, azimuths_of_format(format)), surroundings.place)


def _sky_picture_file(surroundings: Surroundings, query: PointQuery, file: Path) -> bytes:
    """Return the content of a sky chart in the format that the suffix of ``file`` names."""
    scene: Scene = surroundings.scene
    day = requested_day(scene, query, surroundings.place.lon_deg)
    clock = requested_clock(scene, query, surroundings.place.lon_deg, day)
    title = scene.loaded.level.title or scene.loaded.name
    format: Any = PICTURE_SUFFIXES[file.suffix.lower()]
    return sky_picture(surroundings, horizon_profile(surroundings), day, clock, format, title)


def _print_report(report: PointReport, has_requested_time: bool) -> None:
    """Print the report as tables, with the sun at the requested time if ``has_requested_time`` is true."""
    from rich.table import Table

    console = wide_console()
    position_text = "" if report.lon is None else f"{report.lon:.6f}, {report.lat:.6f}; "
    height_text = f", {report.height_m:g} m above it" if report.height_m else ""
    assert report.elevation_m is not None  # a point outside the data raises an error before
    console.print(f"{report.level}: {position_text}ground {report.elevation_m:.1f} m{height_text}")
    if report.now is not None and has_requested_time:
        time_text = "under the level's default sun: " if report.now.time is None else f"{report.now.time.isoformat()}: "
        sun = f"sun at azimuth {report.now.azimuth:.1f}, altitude {report.now.altitude:.1f} degrees"
        console.print(f"{time_text}{_format_state(report.now.lit, report.now.altitude, report.now.by)} ({sun})")
    if report.day is not None:
        table = Table(
            box=None, show_header=False, title=f"{report.day.date.isoformat()} ({report.day.clock})", title_justify="left"
        )
        rows: Sequence[tuple[str, str]] = (
            ("sunrise, level horizon", _format_time(report.day.sunrise)),
            ("first sun", _format_time(report.day.first_sun)),
            ("last sun", _format_time(report.day.last_sun)),
            ("sunset, level horizon", _format_time(report.day.sunset)),
            ("noon", f"{_format_time(report.day.noon)}, {report.day.noon_altitude:.1f} degrees high"),
            ("daylight", f"{report.day.daylight_h:.2f} h"),
            ("direct sun", f"{report.day.direct_h:.2f} h"),
            ("hidden", f"{report.day.masked_h:.2f} h"),
        )
        for row in rows:
            table.add_row(*row)
        console.print(table)
        intervals = Table("sun from", "to", "hidden before by", "hidden after by", box=None)
        for interval in report.day.sunlit:
            intervals.add_row(
                _format_time(interval.begin),
                _format_time(interval.end),
                _format_caster(interval.after),
                _format_caster(interval.before),
            )
        if report.day.sunlit:
            console.print(intervals)
        if report.day.remark:
            console.print(report.day.remark)
    if report.year is not None:
        table = Table("date", "daylight, h", "direct sun, h", box=None)
        for day in report.year:
            table.add_row(day.date.isoformat(), f"{day.daylight_h:.2f}", f"{day.direct_h:.2f}")
        console.print(table)
    if report.remark:
        console.print(report.remark)


def _print_rows(points: list[TrackPoint], rows: list[PointRow]) -> None:
    """Print a table with one row for each point."""
    from rich.table import Table

    table = Table("longitude", "latitude", "time", "ground, m", "sun", "direct sun, h", box=None)
    for point, row in zip(points, rows, strict=True):
        sun = row.remark or ("" if row.now is None else _format_state(row.now.lit, row.now.altitude, row.now.by))
        table.add_row(
            f"{point.lon_deg:.6f}", f"{point.lat_deg:.6f}", "" if point.time is None else point.time.isoformat(),
            "" if row.elevation_m is None else f"{row.elevation_m:.1f}", sun, "" if row.direct_h is None else f"{row.direct_h:.2f}",
        )  # fmt: skip
    wide_console().print(table)


def _format_state(is_lit: bool, altitude_deg: float, occluder: ReportedCaster | None) -> str:
    """Return whether a point is lit, in shadow and of what caster, or at night.

    ``altitude_deg`` is the sun's altitude; at most 0 means night. ``occluder`` is the caster that hides the sun, if any.
    """
    if altitude_deg <= 0.0:
        return _NIGHT_TEXT
    return _LIT_TEXT if is_lit else f"{_DARK_TEXT}, {_format_caster(occluder)}"


def _format_caster(caster: ReportedCaster | None) -> str:
    """Return a caster's kind, distance, position and height as text; ``-`` without a caster."""
    if caster is None:
        return "-"
    distance_text = f"{caster.distance_m / 1000.0:.1f} km" if caster.distance_m >= 1000.0 else f"{caster.distance_m:.0f} m"
    position_text = "" if caster.lon is None else f" at {caster.lon:.5f}, {caster.lat:.5f}"
    kind = "surface" if caster.kind == "relief" else caster.kind  # heights may be those of houses and trees
    return f"{kind} {distance_text} away{position_text}, {caster.height_m:.0f} m high"


def _format_time(moment: datetime | None) -> str:
    """Return the time of day as text; ``-`` for ``None``."""
    return "-" if moment is None else f"{moment:%H:%M:%S}"
