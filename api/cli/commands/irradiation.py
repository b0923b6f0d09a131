"""``skugga irradiation``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skugga.api.cli.common_options import BoundsOption, CrsOption, read_bounds
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.progress import ProgressBar
from skugga.api.products.irradiation import PARTS, PERIODS, PLANES

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def irradiation_raster(
    level: LevelSource,
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write; with --polygons .gpkg, .geojson, .csv.")],
    year: Annotated[int | None, typer.Option(metavar="YYYY", help="A whole year.")] = None,
    date: Annotated[str | None, typer.Option(metavar="DATE", help="One date, or the first of many: 2024-03-21.")] = None,
    last: Annotated[str | None, typer.Option("--to", metavar="DATE", help="Last of many dates.")] = None,
    days: Annotated[
        str,
        typer.Option(
            help="Dates that are computed: all, or mean (one day for each month, at once).",
            autocompletion=complete_words(("all", "mean")),
        ),
    ] = "all",
    per: Annotated[
        str,
        typer.Option(help="A band for the whole period, or each month, day or hour.", autocompletion=complete_words(PERIODS)),
    ] = "period",
    part: Annotated[
        str,
        typer.Option(
            help="Part of the light: total, beam, circumsolar, sky, horizon_band or reflected; all: a band for each.",
            autocompletion=complete_words(("all", *PARTS)),
        ),
    ] = "total",
    plane: Annotated[
        str,
        typer.Option(help="Plane that receives light: ground (its own slope) or level.", autocompletion=complete_words(PLANES)),
    ] = "ground",
    tilt: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Tilt of a plane on every cell, instead of --plane: 0 faces up, 90 is a wall."),
    ] = None,
    azimuth: Annotated[float | None, typer.Option(metavar="DEG", help="Azimuth that this plane faces; 180 unless given.")] = None,
    albedo: Annotated[float, typer.Option(help="Albedo of the ground around, 0 to 1.")] = 0.2,
    linke: Annotated[
        float | None, typer.Option(help="Linke's turbidity of the air, instead of the place's monthly climate.")
    ] = None,
    weather: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Weather instead of a clear sky: EPW, TMY3, PVGIS's TMY, or CSV."),
    ] = None,
    weather_columns: Annotated[
        str | None, typer.Option(metavar="COLUMNS", help="Columns of a CSV: time=Date,ghi=Global:kJ/m2,clock=+01:00,stamp=end.")
    ] = None,
    transmissivity: Annotated[float, typer.Option(help="Share of the light that comes through crowns of trees, 0 to 1.")] = 0.0,
    clock: Annotated[
        str,
        typer.Option(help="Clock of dates: solar (true solar time), utc, an offset or a zone (Europe/Oslo)."),
    ] = "solar",
    step: Annotated[
        str | None, typer.Option(metavar="10m", help="Time between two suns; default: 1h for 28 dates and more, else 10m.")
    ] = None,
    polygons: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Roofs, fields or other polygons: write their means and sums instead of a raster."),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Keep finished months here. After a stop the same command continues with them."),
    ] = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    resolution: Annotated[float | None, typer.Option(help="Side of a cell, in units of the output CRS.")] = None,
    like: Annotated[Path | None, typer.Option(metavar="RASTER", help="Use the grid of this raster.")] = None,
) -> None:
    """Write the irradiation of a year or of dates, kWh/m2, as a raster or for polygons.

    Terrain, buildings and trees are in the way.
    """
    from skugga.api.cli.irradiation_options import IrradiationArguments, irradiation_request, write_polygons
    from skugga.api.cli.shading import OutputGrid, write_product

    arguments = IrradiationArguments(
        year,
        date,
        last,
        days,
        per,
        part,
        plane,
        tilt,
        azimuth,
        albedo,
        linke,
        transmissivity,
        weather,
        weather_columns,
        clock,
        step,
        checkpoint,
    )
    request = irradiation_request(arguments)
    output_grid = OutputGrid(read_bounds(bounds), crs, resolution, like)
    with ProgressBar("Adding up sunlight") as advance:
        if polygons is None:
            write_product(level, output, [request], output_grid, {}, advance)
        else:
            write_polygons(level, output, polygons, request, output_grid, advance)
