"""A deliberate defect of the engine, and the ways to apply one to a running process.

A defect names what it changes by text: a module and an attribute, and a piece of source. Each must exist, or the defect raises
``DefectError``. So a mutant fails after a renaming, rather than break nothing.
"""

from __future__ import annotations

import inspect
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

CaseName = tuple[str, str, str]
"""Module under ``tests.hard_cases``, test, algorithm."""


class DefectError(Exception):
    """The engine lacks what a defect would change."""


@dataclass(frozen=True)
class Mutant:
    """A defect: its description, how it is applied, and the cases that must detect it."""

    description: str
    apply_defect: Callable[[], None]
    detecting_cases: tuple[CaseName, ...]

    @property
    def module(self) -> str:
        """The test module in whose process the mutant runs."""
        return self.detecting_cases[0][0]


def cases(module: str, test: str, *algorithms: str) -> tuple[CaseName, ...]:
    """Return the names of a case by some algorithms."""
    return tuple((module, test, algorithm) for algorithm in algorithms)


def edited(target: str, *changes: tuple[str, str]) -> Callable[[], None]:
    """Return a defect that replaces pieces of a function's source, each of which the source must have exactly once.

    ``target`` is ``module:function`` or ``module:Class.method``, without the ``skugga.`` in front.
    """

    def apply() -> None:
        owner, name, original = _find(target)
        source = textwrap.dedent(inspect.getsource(getattr(original, "py_func", original)))
        for old, new in changes:
            source = _replaced(source, old, new, target)
        module = sys.modules[original.__module__]
        namespace: dict[str, Any] = {}
        exec(compile("from __future__ import annotations\n" + source, target, "exec"), vars(module), namespace)
        _replace(owner, name, original, namespace[name])

    return apply


def wrapped(target: str, wrap: Callable[[Any], Any]) -> Callable[[], None]:
    """Return a defect that replaces an attribute of the engine by ``wrap(attribute)``."""

    def apply() -> None:
        owner, name, original = _find(target)
        _replace(owner, name, original, wrap(original))

    return apply


def constant(target: str, value: Any) -> Callable[[], None]:
    """Return a defect that gives another value to a constant of the engine, in all modules that have imported it."""
    return wrapped(target, lambda _: value)


def edited_shader(part: str, *changes: tuple[str, str]) -> Callable[[], None]:
    """Return a defect that replaces pieces of a shader part's source, each of which the part must have exactly once."""

    def apply() -> None:
        from skugga.terrain.gbuffer import id_buffer

        original = id_buffer.shader_source
        text = original(part)
        for old, new in changes:
            _replaced(text, old, new, part)

        def shader_source(*parts: str) -> str:
            source = original(*parts)
            for old, new in changes if part in parts else ():
                source = source.replace(old, new)
            return source

        _replace(id_buffer, "shader_source", original, shader_source)

    return apply


def set_existing(owner: Any, name: str, value: Any) -> None:
    """Set an attribute of a module or a class of the engine. Raises ``DefectError`` if there is none of this name."""
    if name not in vars(owner):
        raise DefectError(f"the engine has no {owner.__name__}.{name}")
    setattr(owner, name, value)


def _find(target: str) -> tuple[Any, str, Any]:
    """Return the owner of a target, its name there, and itself. Raises ``DefectError`` if there is none."""
    module, _, path = target.partition(":")
    *classes, name = path.split(".")
    try:
        owner: Any = import_module(f"skugga.{module}")
        for class_name in classes:
            owner = getattr(owner, class_name)
        return owner, name, vars(owner)[name]
    except (ImportError, AttributeError, KeyError):
        raise DefectError(f"the engine has no {target}") from None


def _replaced(source: str, old: str, new: str, target: str) -> str:
    """Return a source with ``old`` replaced by ``new``.

    Raises ``DefectError``, which names ``target``, unless ``old`` occurs exactly once.
    """
    if source.count(old) != 1:
        raise DefectError(f"{target} has {source.count(old)} times: {old}")
    return source.replace(old, new)


def _replace(owner: Any, name: str, original: Any, value: Any) -> None:
    """Set an attribute, and the names under which modules have imported it."""
    setattr(owner, name, value)
    if not isinstance(owner, ModuleType):
        return
    for module in [module for key, module in sys.modules.items() if key.startswith(("skugga.", "tests."))]:
        if vars(module).get(name) is original:
            setattr(module, name, value)
