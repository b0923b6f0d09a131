"""Settings as requests take them: read off the fields of a model, so that a setting is declared there and nowhere else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import or_
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

FrontEnd = Literal["render", "select", "pictures", "plans"]
"""What takes settings: two commands, and what is asked for over HTTP."""

AUTO = "auto"
"""What leaves a setting to the selector. A request does so by not naming it."""

_FORMS: dict[str, Any] = {"Literal": Literal, "Annotated": Annotated}
"""Forms of types that are filled while the program runs."""


@dataclass(frozen=True)
class Requests:
    """Said of a field (in its ``Annotated``) that requests do not take as they take the others.

    ``take`` are the front ends that take it. ``spelt`` is its type in requests, where a level file may say it in ways that
    a request cannot. With ``auto`` a request may ask for ``auto``.
    """

    take: tuple[FrontEnd, ...] = get_args(FrontEnd)
    spelt: Any = None
    auto: bool = False


@dataclass(frozen=True)
class Setting:
    """A setting as a request takes it: its name, what it is, in a sentence, and the type of its values with their limits."""

    name: str
    about: str
    type: Any
    examples: tuple[Any, ...] = ()

    @property
    def example(self) -> Any:
        """A value: the one that the field has for an example, else the first of those that can be listed."""
        return (*self.examples, *self.words)[0]

    @property
    def words(self) -> tuple[str | int, ...]:
        """The values that can be listed."""
        return tuple(word for part in _parts(self.type) if get_origin(part) is Literal for word in get_args(part))

    @property
    def plain_type(self) -> type:
        """``int``, ``float`` or ``str``: what a command line reads, which has no better ones."""
        found = {type(word) for word in self.words}
        found |= {_bare(part) for part in _parts(self.type) if get_origin(part) is not Literal}
        return found.pop() if len(found) == 1 else str

    @property
    def allowed(self) -> str:
        """The values in words, as ``16, 24 or 32`` or ``64 to 8192``; empty where any will do."""
        *most, last = (*map(str, self.words), *filter(None, map(_span, _parts(self.type)))) or ("",)
        return f"{', '.join(most)} or {last}" if most else last


def settings_of(model: type[BaseModel], front_end: FrontEnd) -> list[Setting]:
    """The settings that a front end takes, in the order of their fields."""
    found = []
    for name, field in model.model_fields.items():
        requests = next((each for each in field.metadata if isinstance(each, Requests)), Requests())
        if front_end in requests.take:
            found.append(Setting(name, field.description or "", _asked(field, requests), tuple(field.examples or ())))
    return found


def _asked(field: FieldInfo, requests: Requests) -> Any:
    """A field's type less ``auto`` and ``None``, with its limits."""
    if requests.spelt is not None:
        return requests.spelt
    asked = field.annotation if requests.auto else reduce(or_, _named(field.annotation))
    limits = [each for each in field.metadata if not isinstance(each, Requests)]
    return _FORMS["Annotated"][(asked, *limits)] if limits else asked


def _named(annotation: Any) -> Iterator[Any]:
    """The parts of a type, less ``auto`` and ``None``."""
    for part in _parts(annotation):
        if get_origin(part) is Literal:
            words = tuple(word for word in get_args(part) if word != AUTO)
            if words:
                yield _FORMS["Literal"][words]
        elif part is not NoneType:
            yield part


def _parts(annotation: Any) -> Iterator[Any]:
    """The parts of a union, or a type by itself."""
    if get_origin(annotation) in (Union, UnionType):
        for part in get_args(annotation):
            yield from _parts(part)
    else:
        yield annotation


def _bare(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _span(annotation: Any) -> str:
    """The limits of a number in words."""
    limits: dict[str, Any] = {}
    for each in _limits(get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()):
        limits |= {name: getattr(each, name) for name in ("ge", "le", "gt") if hasattr(each, name)}
    if "ge" in limits and "le" in limits:
        return f"{limits['ge']:g} to {limits['le']:g}"
    return f"more than {limits['gt']:g}" if "gt" in limits else ""


def _limits(metadata: tuple[Any, ...]) -> Iterator[Any]:
    for each in metadata:
        if isinstance(each, FieldInfo):
            yield from each.metadata
        else:
            yield each
