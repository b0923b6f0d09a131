"""The argument LEVEL, and the options that describe a raster used as a level."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skugga.api.catalogue import find_level
from skugga.api.cli.completion import complete_level, complete_words
from skugga.terrain.errors import InputError, Problem

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource

_LEVEL_ARGUMENT = Annotated[
    str,
    typer.Argument(
        metavar="LEVEL", help="Name of a bundled level, a level file, or a raster of heights.", autocompletion=complete_level
    ),
]
_LEVELS_ARGUMENT = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[LEVEL]...",
        help="Level files, rasters, names of bundled levels, or archives of tiles (.pmtiles); NAME=FILE sets a level's name. "
        "Default without --levels: all bundled levels.",
        autocompletion=complete_level,
    ),
]

UnitsOption = Annotated[
    str | None,
    typer.Option(
        metavar="UNIT",
        help="Unit of a raster's heights: m, ft, us-ft, dm, cm, mm, km, yd or fathom.",
        autocompletion=complete_words(["m", "ft", "us-ft", "dm", "cm", "mm", "km", "yd", "fathom"]),
    ),
]
PositiveOption = Annotated[
    str | None,
    typer.Option(
        metavar="WAY",
        help="Direction of a raster's heights: up, or down (depths).",
        autocompletion=complete_words(["up", "down"]),
    ),
]

LEVEL_NAME_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
"""Level names on the command line: no character that is special in a URL."""

_RASTER_OPTIONS: dict[str, Any] = {
    "canopy": Annotated[
        Path | None, typer.Option(metavar="FILE", help="Trees on a raster: a raster of canopy heights, or points.")
    ],
    "buildings": Annotated[Path | None, typer.Option(metavar="FILE", help="Buildings on a raster: footprints with heights.")],
    "nodata": Annotated[float | None, typer.Option(metavar="VALUE", help="Value of the raster's cells without a height.")],
    "units": UnitsOption,
    "positive": PositiveOption,
}


def with_level_argument(function: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command whose first parameter is ``level: LevelSource`` or ``levels: list[LevelSource]``.

    The decorated command gets the argument LEVEL, which is resolved before the call. It also gets the options that describe a
    raster, after all other options.
    """
    # The annotation of the first parameter is replaced, so its type need not be imported.
    signature = inspect.signature(function, eval_str=True, locals={"LevelSource": Any})
    first, *other_parameters = signature.parameters.values()
    level_parameter = (
        first.replace(annotation=_LEVEL_ARGUMENT)
        if first.name == "level"
        else first.replace(annotation=_LEVELS_ARGUMENT, default=None)
    )
    options = [
        inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
        for name, annotation in _RASTER_OPTIONS.items()
    ]

    def command(**arguments: Any) -> None:
        raster_options = {name: arguments.pop(name) for name in _RASTER_OPTIONS}
        level_arguments = arguments.pop(first.name)
        sources = (
            _level_source(level_arguments, raster_options)
            if first.name == "level"
            else _level_sources(level_arguments, raster_options)
        )
        function(**{first.name: sources}, **arguments)

    command.__name__, command.__doc__ = function.__name__, function.__doc__
    vars(command)["__signature__"] = signature.replace(parameters=[level_parameter, *other_parameters, *options])
    return command


def _level_sources(names: list[str] | None, raster_options: dict[str, Any]) -> list[LevelSource]:
    """Return the levels of ``serve`` from their names or files. Raises ``InputError``.

    ``raster_options`` has the values of the options that describe a raster, by name; ``None`` for an unused option. A used
    one needs exactly one level.
    """
    for name, value in raster_options.items():
        if value is not None and len(names or ()) != 1:
            raise InputError(
                f"--{name}", Problem("needs exactly one LEVEL"), "Give one LEVEL, the raster that the option describes"
            )
    return [_named_level_source(name, raster_options) for name in names or ()]


def _named_level_source(text: str, raster_options: dict[str, Any]) -> LevelSource:
    """Return a level from a path or from ``NAME=FILE``. The path of an existing file is never split at '='."""
    name, equals, file = text.partition("=")
    if not equals or Path(text).exists():
        return _level_source(text, raster_options)
    if not re.fullmatch(LEVEL_NAME_PATTERN, name):
        raise InputError(
            "LEVEL", text, "NAME=FILE with a NAME of letters, digits, '.', '_' and '-' that begins with a letter or a digit"
        )
    return _level_source(file, raster_options).model_copy(update={"name": name})


def _level_source(name: str, raster_options: dict[str, Any]) -> LevelSource:
    """Return a level from its name or path, with the options that describe a raster. Raises ``InputError``.

    ``raster_options`` has their values by name, as the user wrote them.
    """
    from skugga.terrain.level.level_source import LevelSource, parse_positive, parse_units

    parsed = {
        "units": parse_units("--units", raster_options["units"]),
        "positive": parse_positive("--positive", raster_options["positive"]),
    }
    return LevelSource(path=find_level(name), **{**raster_options, **parsed})
