"""Commands whose modules are imported when they are used: a list of commands, their help and their completion stay light."""

from __future__ import annotations

from functools import cached_property
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

COMMANDS: dict[str, tuple[str, str]] = {
    "serve": (
        "serve:serve",
        "Serve levels as map tiles over HTTP, with a viewer on /; and archives of tiles (.pmtiles) as they are.",
    ),
    "render": (
        "render:render",
        "Render one snapshot of a level's view into a file; or a film, under a sun or along a path that moves.",
    ),
    "shade": ("shade:shade_raster", "Write the shade of a raster of any size, by default on its own grid."),
    "compute": (
        "compute:compute_raster",
        "Compute any product of a level as a raster of any size, by default on its own grid.",
    ),
    "seed": (
        "seed:seed",
        "Draw a level's tiles ahead, into an archive (PMTiles) or a folder. What was drawn is kept: the same command goes on, and "
        "draws what has changed.",
    ),
    "point": ("point:sun_at_point", "The sun at a point: lit or not and by what, a day's sun, the horizon."),
    "sunhours": (
        "sunhours:sun_hours_raster",
        "Write hours of sun, first or last sun of a raster of any size, over dates and daily windows.",
    ),
    "select": ("select:select", "Choose algorithms and settings for a view, and say why; or for all views of a level."),
    "calibrate": ("calibrate:calibrate", "Calibrate this device for the policy `predict`."),
    "compare": ("compare:compare", "Compare algorithms and settings with ray-traced truth: error against time."),
    "init": ("init:init", "Write the level file of a raster, with views, and with comments on what else it may say."),
    "levels": ("levels:levels", "List the bundled levels."),
    "validate": ("validate:validate", "Check a level file and the data it names."),
    "overviews": (
        "overviews:raster_overviews",
        "Make overviews of a big raster beside it, in RASTER.ovr; the raster itself is only read.",
    ),
    "compile": (
        "compile:compile_loops",
        "Compile all loops ahead, for this user and processor, so that no later command waits for it.",
    ),
    "doctor": ("doctor:doctor", "Check OpenGL and packages of this machine, and name what is missing."),
}
"""Command -> its function (module of ``skugga.api.cli.commands``, name) and its help, which is the function's docstring."""


class LazyCommand(TyperCommand):
    """A command by name and help. All else is read off its function, once somebody asks for it."""

    def __init__(self, name: str, function: str, summary: str) -> None:
        super().__init__(name, help=summary, rich_markup_mode=None)
        self._function = function

    @cached_property
    def loaded(self) -> Any:
        """The command with its options."""
        module, _, function = self._function.partition(":")
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        alone.command(self.name)(getattr(import_module(f"skugga.api.cli.commands.{module}"), function))
        return typer.main.get_command(alone)

    def make_context(self, *args: Any, **options: Any) -> Any:
        """Parse arguments: the context's command is the one with its options, which runs, helps and completes from there on."""
        return self.loaded.make_context(*args, **options)


class CommandGroup(TyperGroup):
    """The group of all ``COMMANDS``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for name, (function, summary) in COMMANDS.items():
            self.add_command(LazyCommand(name, function, summary))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command with all of its help, which Typer would cut off at the end of the line."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])
