"""``skugga overviews``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skugga.api.cli.level_argument import PositiveOption, UnitsOption
from skugga.api.cli.progress import ProgressBar
from skugga.terrain.errors import printable


def raster_overviews(
    raster: Annotated[Path, typer.Argument(metavar="RASTER", help="A raster of heights, a virtual one too.", exists=True)],
    nodata: Annotated[float | None, typer.Option(metavar="VALUE", help="Its value of cells without a height.")] = None,
    units: UnitsOption = None,
    positive: PositiveOption = None,
) -> None:
    """Make overviews of a big raster beside it, in RASTER.ovr; the raster itself is only read."""
    from skugga.api.overviews import make_overviews, missing_overviews
    from skugga.terrain.level.level_source import direction_named, units_named

    stated = units_named("--units", units), direction_named("--positive", positive)
    if (why_none := missing_overviews(raster)) is not None:
        typer.echo(printable(why_none))
        return
    with ProgressBar("Averaging") as advance:
        path = make_overviews(raster, nodata, *stated, advance)
    typer.echo(printable(f"Wrote {path}"))
