"""``skugga overviews``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skugga.api.cli.level_argument import PositiveOption, UnitsOption
from skugga.api.cli.progress import ProgressBar
from skugga.terrain.errors import printable


def raster_overviews(
    raster: Annotated[Path, typer.Argument(metavar="RASTER", help="A raster of heights; it may be virtual (VRT).", exists=True)],
    nodata: Annotated[float | None, typer.Option(metavar="VALUE", help="Value of the raster's cells without a height.")] = None,
    units: UnitsOption = None,
    positive: PositiveOption = None,
) -> None:
    """Write overviews of a big raster to RASTER.ovr. The raster itself does not change."""
    from skugga.api.overviews import make_overviews, reason_against_overviews
    from skugga.terrain.level.level_source import parse_positive, parse_units

    vertical_options = parse_units("--units", units), parse_positive("--positive", positive)
    if (why_none := reason_against_overviews(raster)) is not None:
        typer.echo(printable(why_none))
        return
    with ProgressBar("Averaging") as advance:
        path = make_overviews(raster, nodata, *vertical_options, advance)
    typer.echo(printable(f"Wrote {path}"))
