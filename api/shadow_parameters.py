"""Functions that take settings of shadows: the frameworks that read their parameters see the fields of ``Shadows``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from skugga.terrain.level.level import Shadows
from skugga.terrain.level.setting import FrontEnd, Setting, settings_of

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


def takes_settings(
    front_end: FrontEnd, annotation: Callable[[Setting], Any], after: str | None = None
) -> Callable[[FunctionT], FunctionT]:
    """Decorate a function that takes ``**asked``: it shows the settings that a front end takes in their place, each ``None``
    where it is not given. They come last, or ``after`` a parameter of that name.
    """
    settings = [
        inspect.Parameter(each.name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation(each))
        for each in settings_of(Shadows, front_end)
    ]

    def shown(function: FunctionT) -> FunctionT:
        signature = inspect.signature(function, eval_str=True)
        own = [each for each in signature.parameters.values() if each.kind is not inspect.Parameter.VAR_KEYWORD]
        place = len(own) if after is None else [each.name for each in own].index(after) + 1
        vars(function)["__signature__"] = signature.replace(parameters=[*own[:place], *settings, *own[place:]])
        return function

    return shown
