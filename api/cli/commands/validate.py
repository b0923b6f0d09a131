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
    from api.level_summary import remarks, summary

    row, notes = summary(level), remarks(level)
    typer.echo(printable(f"{level.path}: right. {row['title'] or row['name']}; views: {', '.join(row['views'])}"))
    for remark in notes:
        typer.echo(printable(f"  note: {remark}"))
