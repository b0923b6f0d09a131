"""What may be wrong with a level that can be drawn, on standard error."""

from __future__ import annotations

import typer

from terrain.errors import printable
from terrain.scene import Scene


def say_warnings(scene: Scene) -> None:
    """One line for each warning."""
    for text in scene.warnings:
        typer.echo(printable(f"skugga: warning: {scene.elevation.name}: {text}"), err=True)
