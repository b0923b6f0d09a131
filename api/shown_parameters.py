"""Functions whose parameters are declared elsewhere: the frameworks that read their signatures see those."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from skugga.terrain.level.level import Shadows
from skugga.terrain.level.setting import FrontEnd, Setting, settings_of

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


def takes_parameters(parameters: Sequence[tuple[str, Any]], after: str | None = None) -> Callable[[FunctionT], FunctionT]:
    """Decorate a function that takes ``**asked``: it shows parameters (names and annotations) in their place.

    Each is ``None`` where it is not given. They come last, or ``after`` a parameter of that name.
    """
    shown = [
        inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
        for name, annotation in parameters
    ]

    def decorated(function: FunctionT) -> FunctionT:
        signature = inspect.signature(function, eval_str=True)
        own = [each for each in signature.parameters.values() if each.kind is not inspect.Parameter.VAR_KEYWORD]
        place = len(own) if after is None else [each.name for each in own].index(after) + 1
        vars(function)["__signature__"] = signature.replace(parameters=[*own[:place], *shown, *own[place:]])
        return function

    return decorated


def takes_settings(
    front_end: FrontEnd, annotation: Callable[[Setting], Any], after: str | None = None
) -> Callable[[FunctionT], FunctionT]:
    """Decorate a function that takes ``**asked``: it shows the settings of shadows that a front end takes in their place."""
    return takes_parameters([(each.name, annotation(each)) for each in settings_of(Shadows, front_end)], after)
