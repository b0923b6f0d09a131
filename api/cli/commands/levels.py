"""``skugga levels``."""

from __future__ import annotations

import json

import typer

from skugga.api.cli.common_options import JsonOption
from skugga.api.cli.tables import table_with_names, wide_console


def levels(as_json: JsonOption = False) -> None:
    """List the bundled levels."""
    from skugga.api.catalogue import bundled_levels
    from skugga.api.level_summary import summary

    rows = [summary(path) for path in bundled_levels()]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    table = table_with_names("name", "title", "bounds (west, south, east, north)", "views", box=None)
    for row in rows:
        bounds = "flat world" if row["bounds"] is None else ", ".join(f"{v:.3f}" for v in row["bounds"])
        table.add_row(row["name"], row["title"], bounds, ", ".join(row["views"]))
    wide_console().print(table)
