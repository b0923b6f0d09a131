"""``skugga init``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skugga.api.cli.level_argument import with_level_argument
from skugga.terrain.errors import printable

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def init(
    level: LevelSource,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Level file to write; default: NAME.yaml.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")] = False,
) -> None:
    """Write the level file of a raster, with views, and with comments on further keys."""
    from skugga.api.cli.first_level import write_first_level

    path = write_first_level(level, output, force)
    typer.echo(printable(f"Wrote {path}. To view it: skugga serve {path}"))
