"""``skugga compute``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from skugga.api.cli.common_options import AltitudeOption, AzimuthOption, BoundsOption, CrsOption, TimeOption, read_bounds
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.options import overrides_of, with_shadow_options
from skugga.api.cli.product_parameters import split_product_options, with_product_options
from skugga.api.cli.progress import ProgressBar
from skugga.api.cli.times import sun_from_options
from skugga.api.products import RASTER_PRODUCTS, product_named
from skugga.terrain.level.level_source import LevelSource


@with_level_argument
@with_product_options(RASTER_PRODUCTS, after_parameter="product")
@with_shadow_options("render")
def compute_raster(
    level: LevelSource,
    output: Annotated[Path, typer.Option("-o", "--output", help="Cloud-optimised GeoTIFF to write.")],
    product: Annotated[
        str, typer.Option(help=f"Product to compute: {', '.join(RASTER_PRODUCTS)}.", autocompletion=complete_words(RASTER_PRODUCTS))
    ] = "mask",
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    resolution: Annotated[float | None, typer.Option(help="Side of a cell, in units of the output CRS.")] = None,
    like: Annotated[Path | None, typer.Option(metavar="RASTER", help="Use the grid of this raster.")] = None,
    **declared_options: Any,
) -> None:
    """Compute any product of a level as a raster of any size, by default on the level's grid."""
    from skugga.api.cli.shading import OutputGrid, write_product
    from skugga.api.request import ProductRequest

    options, shadows = split_product_options(product_named(product, RASTER_PRODUCTS, "--product"), declared_options)
    request = ProductRequest(product=product, options=options, sun=sun_from_options(time, azimuth, altitude))
    output_grid = OutputGrid(read_bounds(bounds), crs, resolution, like)
    with ProgressBar("Computing") as advance:
        write_product(level, output, [request], output_grid, overrides_of("render", shadows), advance)
