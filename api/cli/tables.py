"""Tables for terminals, files and pipes."""

from __future__ import annotations

import sys
from typing import Any

FILE_WIDTH_CHARACTERS = 200
"""Width of tables in files and pipes, characters."""


def wide_console() -> Any:
    """Return a console as wide as the terminal, or wide enough for a table if the output is a file or a pipe."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else FILE_WIDTH_CHARACTERS)


def table_with_names(first_column: str, *other_columns: str, **style: Any) -> Any:
    """Return an empty table whose first column is never truncated, because users type its names."""
    from rich.table import Table

    table = Table(**style)
    table.add_column(first_column, no_wrap=True, overflow="ignore")
    for column in other_columns:
        table.add_column(column, overflow="fold")
    return table
