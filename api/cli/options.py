"""Shadow settings as options of a command, and their conversion to overrides of a level's ``shadows``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from skugga.api.cli.completion import complete_words
from skugga.api.shown_parameters import FunctionT, takes_settings
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES
from skugga.terrain.level.level import Shadows, parse_algorithm
from skugga.terrain.level.setting import FrontEnd, Setting, settings_of


def with_shadow_options(command: FrontEnd, after: str = "crs") -> Callable[[FunctionT], FunctionT]:
    """Decorate a command that takes ``**asked``: add an option for each shadow setting after its own option ``after``."""
    return takes_settings(command, _option, after)


def overrides_of(command: FrontEnd, asked: dict[str, Any]) -> dict[str, Any]:
    """Return options as overrides of a level's ``shadows``. Raises ``InputError``."""
    found = dict(asked)
    for each in settings_of(Shadows, command):
        given = found.get(each.name)
        if each.name == "algorithm" and given is not None:
            found[each.name] = parse_algorithm(given, "--algorithm")
        elif isinstance(given, str) and given.isascii() and given.isdigit() and any(isinstance(word, int) for word in each.words):
            found[each.name] = int(given)
    return found


def _option(setting: Setting) -> Any:
    about = setting.about.replace("`", "")
    if setting.allowed:
        about = f"{about.removesuffix('.')} ({setting.allowed})."
    of_type: Any = setting.plain_type
    words = ["auto", *ALGORITHM_NAMES] if setting.name == "algorithm" else setting.words
    return Annotated[of_type | None, typer.Option(help=about, autocompletion=complete_words(words))]
