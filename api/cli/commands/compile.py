"""``skugga compile``."""

from __future__ import annotations

import typer


def compile_loops() -> None:
    """Compile all loops in advance, for this user and processor, so that later commands start faster."""
    from skugga.api.cli.compiling import compile_everything

    typer.echo(compile_everything())
