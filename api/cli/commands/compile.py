"""``skugga compile``."""

from __future__ import annotations

import typer


def compile_loops() -> None:
    """Compile all loops ahead, for this user and processor, so that no later command waits for it."""
    from skugga.api.cli.compiling import compile_everything

    typer.echo(compile_everything())
