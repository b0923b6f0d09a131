"""Decorators that replace the ``**`` parameter of a function by declared ones, in the signature that frameworks read."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from skugga.terrain.level.level import Shadows
from skugga.terrain.level.setting import FrontEnd, Setting, settings_of

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


def with_parameters(parameters: Sequence[tuple[str, Any]], after_parameter: str | None = None) -> Callable[[FunctionT], FunctionT]:
    """Return a decorator that replaces the ``**`` parameter in a function's signature by declared ones (names and annotations).

    Their default is ``None``. They come last, or after the parameter named ``after_parameter``.
    """
    added = [
        inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=annotation)
        for name, annotation in parameters
    ]

    def decorate(function: FunctionT) -> FunctionT:
        signature = inspect.signature(function, eval_str=True)
        declared = [parameter for parameter in signature.parameters.values() if parameter.kind is not inspect.Parameter.VAR_KEYWORD]
        index = len(declared) if after_parameter is None else [parameter.name for parameter in declared].index(after_parameter) + 1
        vars(function)["__signature__"] = signature.replace(parameters=[*declared[:index], *added, *declared[index:]])
        return function

    return decorate


def with_shadow_settings(
    front_end: FrontEnd, annotation_of: Callable[[Setting], Any], after_parameter: str | None = None
) -> Callable[[FunctionT], FunctionT]:
    """Return a decorator that replaces the ``**`` parameter in a function's signature by a front end's shadow settings.

    ``annotation_of`` returns the annotation of the parameter for a setting. ``after_parameter`` is as in ``with_parameters``.
    """
    return with_parameters([(setting.name, annotation_of(setting)) for setting in settings_of(Shadows, front_end)], after_parameter)
