"""Warnings and notes on standard error about levels and outputs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from skugga.api.errors import with_option_names
from skugga.terrain.errors import printable
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from skugga.api.raster_view import RasterView


def print_warnings(scene: Scene, includes_objects: bool = True) -> None:
    """Print each warning about the ground as a line.

    If ``includes_objects`` is true, also read the files of objects and print their warnings.
    """
    on_objects = scene.objects.warnings if includes_objects else ()
    for text in (*(f"{scene.elevation.name}: {text}" for text in scene.warnings), *on_objects):
        typer.echo(printable(f"skugga: warning: {with_option_names(text)}"), err=True)


def print_product_warnings(texts: Sequence[str]) -> None:
    """Print warnings about a product's options, each as a line."""
    for text in texts:
        typer.echo(printable(f"skugga: warning: {text}"), err=True)


def print_extent_warning(scene: Scene, raster: RasterView) -> None:
    """Print a warning if a raster extends beyond the level; its cells are empty there."""
    from skugga.api.raster_view import extent_warning

    if (text := extent_warning(scene, raster)) is not None:
        typer.echo(printable(f"skugga: warning: {text}"), err=True)


def print_default_sun(scene: Scene) -> None:
    """Print which default sun is used, because a picture does not show whether its sun was requested.

    The note is printed on a terminal, and everywhere if the level sets no sun.
    """
    if scene.sun_is_default or sys.stderr.isatty():
        from skugga.api.report.plan_text import format_sun

        message = f"{scene.loaded.name} is drawn with its default light, {format_sun(scene.sun)}. Use --time for another sun"
        typer.echo(printable(f"skugga: {message}"), err=True)


def print_written_files(paths: Sequence[Path], content: str, raster: RasterView) -> None:
    """Print one line on the written files, on a terminal only. ``content`` says in words what they contain."""
    if sys.stderr.isatty():
        names = str(paths[0]) if len(paths) == 1 else f"{len(paths)} files, {paths[0]} to {paths[-1].name}"
        rows, cols = raster.shape
        message = f"wrote {names}: {content}, {cols} x {rows} cells, {raster.crs.name}"
        typer.echo(printable(f"skugga: {message}"), err=True)
