"""Settings of requests, derived from the fields of a pydantic model, so that each setting is declared once."""

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
"""Front ends that accept settings: two commands and two kinds of HTTP requests."""

AUTO = "auto"
"""Value that leaves a setting to the selector. Requests omit the setting instead."""

_FORMS: dict[str, Any] = {"Literal": Literal, "Annotated": Annotated}
"""Type constructors that are subscripted at run time, which type checkers reject in direct use."""


@dataclass(frozen=True)
class RequestOptions:
    """Metadata of a field, in its ``Annotated``, if requests accept it differently from other fields.

    Attributes
    ----------
    take
        Front ends that accept the field.
    spelt
        Type of the field in requests, if a level file allows more forms than a request; ``None``: the same type.
    auto
        Whether a request may set ``auto``.
    """

    take: tuple[FrontEnd, ...] = get_args(FrontEnd)
    spelt: Any = None
    auto: bool = False


@dataclass(frozen=True)
class Setting:
    """A setting of a request.

    Attributes
    ----------
    name
        Name of the field.
    about
        Description in a sentence.
    type
        Type of the values, with their limits.
    examples
        Example values.
    """

    name: str
    about: str
    type: Any
    examples: tuple[Any, ...] = ()

    @property
    def example(self) -> Any:
        """An example value: the first example of the field, else the first of ``words``."""
        return (*self.examples, *self.words)[0]

    @property
    def words(self) -> tuple[str | int, ...]:
        """The literal values of the type."""
        return tuple(word for part in _union_parts(self.type) if get_origin(part) is Literal for word in get_args(part))

    @property
    def plain_type(self) -> type:
        """``int``, ``float`` or ``str``: the type for a command line, which has no unions."""
        found = {type(word) for word in self.words}
        found |= {_unannotated(part) for part in _union_parts(self.type) if get_origin(part) is not Literal}
        return found.pop() if len(found) == 1 else str

    @property
    def allowed(self) -> str:
        """The allowed values in words, such as ``16, 24 or 32`` or ``64 to 8192``; empty if all are."""
        *most, last = (*map(str, self.words), *filter(None, map(_limits_text, _union_parts(self.type)))) or ("",)
        return f"{', '.join(most)} or {last}" if most else last


def settings_of(model: type[BaseModel], front_end: FrontEnd) -> list[Setting]:
    """Return the settings that a front end accepts, in the order of their fields."""
    found = []
    for name, field in model.model_fields.items():
        requests = next((each for each in field.metadata if isinstance(each, RequestOptions)), RequestOptions())
        if front_end in requests.take:
            found.append(Setting(name, field.description or "", _request_type(field, requests), tuple(field.examples or ())))
    return found


def _request_type(field: FieldInfo, requests: RequestOptions) -> Any:
    """Return a field's type without ``auto`` and ``None``, with its limits."""
    if requests.spelt is not None:
        return requests.spelt
    request_type = field.annotation if requests.auto else reduce(or_, _without_auto(field.annotation))
    limits = [each for each in field.metadata if not isinstance(each, RequestOptions)]
    return _FORMS["Annotated"][(request_type, *limits)] if limits else request_type


def _without_auto(annotation: Any) -> Iterator[Any]:
    """Yield the parts of a type without ``auto`` and ``None``."""
    for part in _union_parts(annotation):
        if get_origin(part) is Literal:
            words = tuple(word for word in get_args(part) if word != AUTO)
            if words:
                yield _FORMS["Literal"][words]
        elif part is not NoneType:
            yield part


def _union_parts(annotation: Any) -> Iterator[Any]:
    """Yield the parts of a union, or the type itself."""
    if get_origin(annotation) in (Union, UnionType):
        for part in get_args(annotation):
            yield from _union_parts(part)
    else:
        yield annotation


def _unannotated(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _limits_text(annotation: Any) -> str:
    """Return the limits of a number in words; empty if it has none."""
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
