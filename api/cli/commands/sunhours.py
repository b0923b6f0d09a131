"""``skugga sunhours``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skugga.api.cli.common_options import BoundsOption, CrsOption, read_bounds
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.progress import ProgressBar
from skugga.api.products.sun_hours import QUANTITIES

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def sun_hours_raster(
    level: LevelSource,
    output: Annotated[Path, typer.Option("-o", "--output", help="Cloud-optimised GeoTIFF to write.")],
    date: Annotated[str, typer.Option(metavar="DATE", help="The date, or the first of many: 2024-03-21.")],
    last: Annotated[str | None, typer.Option("--to", metavar="DATE", help="Last of many dates.")] = None,
    every: Annotated[str, typer.Option(metavar="1d", help="Interval between two dates.")] = "1d",
    window: Annotated[str, typer.Option(metavar="HH:MM-HH:MM", help="Daily window that counts.")] = "00:00-24:00",
    clock: Annotated[
        str,
        typer.Option(help="Clock of dates and windows: solar (true solar time), utc, an offset or a zone (Europe/Oslo)."),
    ] = "solar",
    step: Annotated[
        str,
        typer.Option(
            metavar="5m",
            help="Time between two suns (crossings in between are found), or auto: the longest step that keeps hours accurate.",
        ),
    ] = "auto",
    quantity: Annotated[
        str,
        typer.Option(
            help="Quantity: hours (mean of the dates), first, last, longest or days.", autocompletion=complete_words(QUANTITIES)
        ),
    ] = "hours",
    threshold: Annotated[str, typer.Option(metavar="2h", help="For days: sun that a day needs to count.")] = "2h",
    least_altitude: Annotated[float, typer.Option(help="Minimum altitude of a sun that counts, degrees.")] = 0.0,
    height: Annotated[float, typer.Option(help="Height of the receiver above the ground, metres.")] = 0.0,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    resolution: Annotated[float | None, typer.Option(help="Side of a cell, in units of the output CRS.")] = None,
    like: Annotated[Path | None, typer.Option(metavar="RASTER", help="Use the grid of this raster.")] = None,
    contours: Annotated[Path | None, typer.Option(metavar="FILE.gpkg", help="Write contours to this file too.")] = None,
    levels: Annotated[str, typer.Option(metavar="V,V,...", help="Values of the contours.")] = "1,2,3,4,6,8,10,12",
) -> None:
    """Write hours of sun, first or last sun as a raster of any size, over dates and daily windows."""
    from skugga.api.cli.shading import OutputGrid, write_product
    from skugga.api.cli.sun_hours_options import contour_values, sun_hours_request

    rules = step, threshold, least_altitude, height
    request = sun_hours_request(quantity, (date, last, every), window, clock, rules)
    lines = None if contours is None else (contours, contour_values((contours, levels)))
    output_grid = OutputGrid(read_bounds(bounds), crs, resolution, like)
    with ProgressBar("Following the sun") as advance:
        write_product(level, output, [request], output_grid, {}, advance, lines)
