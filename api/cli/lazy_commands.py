"""Commands whose modules are imported on use, so that the command list, help and completion start fast."""

from __future__ import annotations

from functools import cached_property
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

COMMANDS: dict[str, tuple[str, str]] = {
    "serve": (
        "serve:serve",
        "Serve levels as map tiles over HTTP, with a viewer on /. Archives of tiles (.pmtiles) are served unchanged.",
    ),
    "render": (
        "render:render",
        "Render a view of a level to an image file, or to a film with a moving sun or camera.",
    ),
    "shade": (
        "shade:shade_raster",
        "Write a shadow mask as a raster of any size, by default on the level's grid.",
    ),
    "compute": (
        "compute:compute_raster",
        "Compute any product of a level as a raster of any size, by default on the level's grid.",
    ),
    "seed": (
        "seed:seed",
        "Render a level's tiles in advance, into an archive (PMTiles) or a folder. The same command resumes an interrupted run, "
        "and redraws what has changed.",
    ),
    "point": (
        "point:sun_at_point",
        "Report the sun at a point: lit or in shadow and of what, the day's sun, the horizon, the irradiation.",
    ),
    "sunhours": (
        "sunhours:sun_hours_raster",
        "Write hours of sun, first or last sun as a raster of any size, over dates and daily windows.",
    ),
    "irradiation": (
        "irradiation:irradiation_raster",
        "Write the irradiation of a year or of dates, kWh/m2, as a raster or for polygons. Terrain, buildings and trees are in "
        "the way.",
    ),
    "select": ("select:select", "Choose algorithms and settings for one view or all views of a level, and give the reasons."),
    "calibrate": ("calibrate:calibrate", "Calibrate this device for the policy `predict`."),
    "compare": ("compare:compare", "Compare algorithms and settings with ray-traced truth: error against time."),
    "init": ("init:init", "Write the level file of a raster, with views, and with comments on further keys."),
    "levels": ("levels:levels", "List the bundled levels."),
    "validate": ("validate:validate", "Check a level file and the data it names."),
    "overviews": (
        "overviews:raster_overviews",
        "Write overviews of a big raster to RASTER.ovr. The raster itself does not change.",
    ),
    "compile": (
        "compile:compile_loops",
        "Compile all loops in advance, for this user and processor, so that later commands start faster.",
    ),
    "doctor": ("doctor:doctor", "Check OpenGL and packages on this machine, and name what is missing."),
}
"""Command -> function (module of ``skugga.api.cli.commands``:name) and help, which equals the function's docstring."""


class LazyCommand(TyperCommand):
    """A command with a name and a help text. It imports its function when its options are needed first."""

    def __init__(self, name: str, function_path: str, summary: str) -> None:
        super().__init__(name, help=summary, rich_markup_mode=None)
        self._function_path = function_path

    @cached_property
    def loaded_command(self) -> Any:
        """The imported command with its options."""
        module, _, function = self._function_path.partition(":")
        single_command_app = typer.Typer(add_completion=False, rich_markup_mode=None)
        single_command_app.command(self.name)(getattr(import_module(f"skugga.api.cli.commands.{module}"), function))
        return typer.main.get_command(single_command_app)

    def make_context(self, *args: Any, **options: Any) -> Any:
        """Parse arguments into a context whose command is the imported one. That command then runs, prints help and completes."""
        return self.loaded_command.make_context(*args, **options)


class CommandGroup(TyperGroup):
    """The group of all ``COMMANDS``."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for name, (function, summary) in COMMANDS.items():
            self.add_command(LazyCommand(name, function, summary))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command with its full help; Typer would truncate it to one line."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])
