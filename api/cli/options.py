"""Shadow settings as options of a command, and their conversion to overrides of a level's ``shadows``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from skugga.api.cli.completion import complete_words
from skugga.api.signature_parameters import FunctionT, with_shadow_settings
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES
from skugga.terrain.level.level import Shadows, parse_algorithm
from skugga.terrain.level.setting import FrontEnd, Setting, settings_of


def with_shadow_options(command: FrontEnd, after_parameter: str = "crs") -> Callable[[FunctionT], FunctionT]:
    """Return a decorator that replaces ``**declared_options`` of a command by shadow settings as options.

    They come after the parameter named ``after_parameter``.
    """
    return with_shadow_settings(command, _shadow_option, after_parameter)


def overrides_of(command: FrontEnd, declared_options: dict[str, Any]) -> dict[str, Any]:
    """Convert parsed options into overrides of a level's ``shadows``. Raises ``InputError``."""
    overrides = dict(declared_options)
    for setting in settings_of(Shadows, command):
        value = overrides.get(setting.name)
        if setting.name == "algorithm" and value is not None:
            overrides[setting.name] = parse_algorithm(value, "--algorithm")
        elif (
            isinstance(value, str)
            and value.isascii()
            and value.isdigit()
            and any(isinstance(word, int) for word in setting.literal_values)
        ):
            overrides[setting.name] = int(value)
    return overrides


def _shadow_option(setting: Setting) -> Any:
    """Return the annotation of a shadow setting as a command option, with its help text and completion."""
    help_text = setting.description.replace("`", "")
    if setting.allowed_text:
        help_text = f"{help_text.removesuffix('.')} ({setting.allowed_text})."
    value_type: Any = setting.command_line_type
    words = ["auto", *ALGORITHM_NAMES] if setting.name == "algorithm" else setting.literal_values
    return Annotated[value_type | None, typer.Option(help=help_text, autocompletion=complete_words(words))]
