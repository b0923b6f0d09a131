"""``skugga shade``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skugga.api.cli.common_options import (
    AltitudeOption,
    AzimuthOption,
    BoundsOption,
    CrsOption,
    SkyOption,
    SlopeExaggerationOption,
    StyleOption,
    TimeOption,
    check_has_style,
    read_bounds,
    read_style,
)
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.options import overrides_of, with_shadow_options
from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.progress import ProgressBar
from skugga.api.cli.times import sun_from_options, suns_from_options
from skugga.api.products import PRODUCTS, RASTER_PRODUCTS, product_named
from skugga.terrain.level.level_source import LevelSource

if TYPE_CHECKING:
    from skugga.api.raster_file import RasterCells

SHADED_PRODUCTS = tuple(name for name in RASTER_PRODUCTS if PRODUCTS[name].when == "sun")
"""Products of the sun at a moment."""


@with_level_argument
@with_shadow_options("render")
def shade_raster(
    level: LevelSource,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="GeoTIFF (COG) to write. {time} in its name is replaced by each of several times."),
    ],
    layer: Annotated[
        str, typer.Option(help=f"Layer to write: {', '.join(SHADED_PRODUCTS)}.", autocompletion=complete_words(SHADED_PRODUCTS))
    ] = "mask",
    time: TimeOption = None,
    times: Annotated[str | None, typer.Option(metavar="T,T,...", help="Several times, in one run.")] = None,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help="First of many times.")] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="TIME", help="Last of many times.")] = None,
    step: Annotated[str | None, typer.Option(metavar="15m", help="Interval between two times, such as 15m, 1h or 1d.")] = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    style: StyleOption = None,
    slope_exaggeration: SlopeExaggerationOption = None,
    sky: SkyOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    resolution: Annotated[float | None, typer.Option(help="Side of a cell, in units of the output CRS.")] = None,
    like: Annotated[Path | None, typer.Option(metavar="RASTER", help="Use the grid of this raster.")] = None,
    stac: Annotated[
        Path | None,
        typer.Option(metavar="ITEM.json", help="Use the sun or the time of a STAC item, and its finest grid if it has one."),
    ] = None,
    **declared_options: Any,
) -> None:
    """Write a shadow mask as a raster of any size, by default on the level's grid."""
    from skugga.api.cli.shading import OutputGrid, sun_and_grid_of_stac_item, write_product
    from skugga.api.request import ProductRequest

    product = product_named(layer, SHADED_PRODUCTS, "--layer")
    look = read_style(style, slope_exaggeration, sky)
    check_has_style(product, style, slope_exaggeration, sky)
    overrides = overrides_of("render", declared_options)
    cells: Path | RasterCells | None = like
    suns = suns_from_options(sun_from_options(time, azimuth, altitude), times, start, end, step)
    if stac is not None:
        check_output_files(level, [("--output", output)], stac)
        suns, cells = sun_and_grid_of_stac_item(
            stac, suns, like, uses_item_grid=bounds is None and crs is None and resolution is None
        )
    with ProgressBar("Shading") as advance:
        requests = [ProductRequest(product=layer, sun=sun, **look) for sun in suns]
        write_product(level, output, requests, OutputGrid(read_bounds(bounds), crs, resolution, cells), overrides, advance)
