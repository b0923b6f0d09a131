"""``skugga point``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skugga.api.cli.common_options import JsonOption, TimeOption
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.point.horizon_formats import HORIZON_FORMATS

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def sun_at_point(
    level: LevelSource,
    at: Annotated[str | None, typer.Option(metavar="LON,LAT", help="The point in degrees, or x,y in --crs.")] = None,
    crs: Annotated[str | None, typer.Option(metavar="EPSG", help="CRS of --at.")] = None,
    time: TimeOption = None,
    date: Annotated[str | None, typer.Option(help="Day, such as 2024-10-21; default: the day of --time, else today.")] = None,
    clock: Annotated[
        str | None, typer.Option(help="Clock: solar, utc, +02:00 or Europe/Oslo; default: the offset of --time.")
    ] = None,
    height: Annotated[float, typer.Option(help="Height above the ground, metres.")] = 0.0,
    year: Annotated[int | None, typer.Option(help="Report the hours of sun of each day of this year.")] = None,
    horizon: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT",
            help=f"Print the horizon instead of the report, or write it to --output: {', '.join(HORIZON_FORMATS)}.",
            autocompletion=complete_words(HORIZON_FORMATS),
        ),
    ] = None,
    azimuths: Annotated[
        int | None,
        typer.Option(metavar="N", help="Write the horizons of --points in N directions, as a CSV, or as .npz with --output."),
    ] = None,
    irradiation: Annotated[
        bool, typer.Option("--irradiation", help="Report the energy of light on a plane by month: of --year, or --date and --to.")
    ] = False,
    to: Annotated[str | None, typer.Option(metavar="DATE", help="Last of several dates, for --irradiation.")] = None,
    plane: Annotated[
        str | None,
        typer.Option(help="Plane of --irradiation: level (default) or ground.", autocompletion=complete_words(("level", "ground"))),
    ] = None,
    tilt: Annotated[float | None, typer.Option(help="Tilt of the plane, degrees: 90 is a wall, 180 faces down.")] = None,
    azimuth: Annotated[float | None, typer.Option(help="Azimuth that a tilted plane faces; default: 180, south.")] = None,
    albedo: Annotated[float | None, typer.Option(help="Albedo of the ground around, for --irradiation; default: 0.2.")] = None,
    linke: Annotated[
        float | None, typer.Option(help="Linke's turbidity of the air, instead of the place's monthly climate.")
    ] = None,
    step: Annotated[
        str | None, typer.Option(help="Time between two suns of --irradiation; default: 1h for 28 dates and more, else 10m.")
    ] = None,
    weather: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Weather for --irradiation instead of a clear sky: EPW, TMY3, PVGIS's TMY, or CSV."),
    ] = None,
    weather_columns: Annotated[
        str | None, typer.Option(metavar="COLUMNS", help="Columns of a CSV: time=Date,ghi=Global:kJ/m2,clock=+01:00,stamp=end.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="File for --horizon, --azimuths, or --irradiation (.json, .csv; of one point also .svg, .png).",
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a chart of the horizon and the sun's paths: .svg or .png.")
    ] = None,
    points: Annotated[Path | None, typer.Option(metavar="FILE", help="Many points: .csv (lon, lat), .gpkg, .geojson ...")] = None,
    line: Annotated[Path | None, typer.Option(metavar="FILE", help="A track: a vector file with a line.")] = None,
    start: Annotated[str | None, typer.Option(help="Time at the start of the track, ISO 8601 with an offset.")] = None,
    speed: Annotated[float, typer.Option(help="Speed along the track, km/h.")] = 4.5,
    every: Annotated[float, typer.Option(help="Maximum distance between points on the track, metres.", min=0.1)] = 100.0,
    as_json: JsonOption = False,
) -> None:
    """Report the sun at a point: lit or in shadow and of what, the day's sun, the horizon, the irradiation."""
    from skugga.api.cli.point import (
        PointOptions,
        check_point_options,
        report_line,
        report_point,
        report_point_irradiation,
        report_points,
    )
    from skugga.api.cli.point_irradiation import IrradiationTexts
    from skugga.api.cli.times import sun_from_options

    sun = sun_from_options(time, None, None)
    texts = IrradiationTexts(to, plane, tilt, azimuth, albedo, linke, step, weather, weather_columns)
    if not irradiation:
        texts.check_absent()
    options = PointOptions(at, crs, sun, date, clock, height, year, horizon, azimuths, irradiation, output, picture, as_json)
    check_point_options(options, points, line, start)
    if irradiation:
        report_point_irradiation(level, options, texts, points)
    elif points is not None:
        report_points(level, points, options)
    elif line is not None:
        report_line(level, line, options, start, speed, every)
    else:
        report_point(level, options)
