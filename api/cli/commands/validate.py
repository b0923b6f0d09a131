"""``skugga validate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from skugga.api.cli.level_argument import with_level_argument
from skugga.api.errors import with_option_names
from skugga.terrain.errors import printable

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def validate(level: LevelSource) -> None:
    """Check a level file and the data it names."""
    from skugga.api.level_summary import remarks
    from skugga.terrain.level.level import load_level

    loaded, notes = load_level(level), remarks(level)
    typer.echo(printable(f"{level.path}: valid. {loaded.level.title or loaded.name}; views: {', '.join(loaded.level.views)}"))
    for remark in notes:
        typer.echo(printable(f"  note: {with_option_names(remark)}"))
