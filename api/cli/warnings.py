"""What may not be as it was meant with a level that can be drawn, on standard error."""

from __future__ import annotations

import sys

import typer

from terrain.errors import printable
from terrain.scene import Scene


def say_warnings(scene: Scene, with_objects: bool = True) -> None:
    """Print a line for each warning, on the ground and, ``with_objects``, on what stands on it, whose files are read for it."""
    on_objects = scene.objects.warnings if with_objects else ()
    for text in (*(f"{scene.elevation.name}: {text}" for text in scene.warnings), *on_objects):
        typer.echo(printable(f"skugga: warning: {text}"), err=True)


def say_own_sun(scene: Scene) -> None:
    """On a terminal, which sun is taken where none was asked for: a picture does not show that nobody chose it."""
    if sys.stderr.isatty():
        from api.report.plan_text import format_sun

        said = f"{scene.loaded.name} is drawn with its own light, {format_sun(scene.sun)}; --time says another"
        typer.echo(printable(f"skugga: {said}"), err=True)
