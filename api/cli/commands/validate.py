"""``skugga validate``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from api.cli.level_argument import takes_level
from terrain.errors import printable

if TYPE_CHECKING:
    from terrain.level.level_source import LevelSource


@takes_level
def validate(level: LevelSource) -> None:
    """Check a level file and the data it names."""
    from api.level_summary import remarks
    from terrain.level.level import load_level

    loaded, notes = load_level(level), remarks(level)
    typer.echo(printable(f"{level.path}: right. {loaded.level.title or loaded.name}; views: {', '.join(loaded.level.views)}"))
    for remark in notes:
        typer.echo(printable(f"  note: {remark}"))
