"""Derive the settings that requests accept from the fields of a pydantic model, so that each setting is declared only once."""

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
"""Value with which a level file leaves a setting to the selector. Requests omit the setting instead, unless
``RequestOptions.allows_auto``.
"""

_TYPE_CONSTRUCTORS: dict[str, Any] = {"Literal": Literal, "Annotated": Annotated}
"""Type constructors that are subscripted with values known only at run time. Type checkers reject that if it is written directly.
"""


@dataclass(frozen=True)
class RequestOptions:
    """Metadata in the ``Annotated`` type of a field that not all requests accept, or not in the same form as a level file.

    Attributes
    ----------
    front_ends
        Front ends that accept the field.
    request_type
        Type of the field in requests, if a level file allows more forms than a request; ``None``: the same type.
    allows_auto
        Whether a request may set ``auto``.
    """

    front_ends: tuple[FrontEnd, ...] = get_args(FrontEnd)
    request_type: Any = None
    allows_auto: bool = False


@dataclass(frozen=True)
class Setting:
    """A setting of a request.

    Attributes
    ----------
    name
        Name of the field.
    description
        Description in a sentence.
    type
        Type of the values, with their limits.
    examples
        Example values.
    """

    name: str
    description: str
    type: Any
    examples: tuple[Any, ...] = ()

    @property
    def example(self) -> Any:
        """An example value: the first example of the field, else the first of ``literal_values``."""
        return (*self.examples, *self.literal_values)[0]

    @property
    def literal_values(self) -> tuple[str | int, ...]:
        """The literal values of the type."""
        return tuple(word for part in _union_parts(self.type) if get_origin(part) is Literal for word in get_args(part))

    @property
    def command_line_type(self) -> type:
        """``int``, ``float`` or ``str``: the type for a command line, which has no unions."""
        types = {type(word) for word in self.literal_values}
        types |= {_without_annotation(part) for part in _union_parts(self.type) if get_origin(part) is not Literal}
        return types.pop() if len(types) == 1 else str

    @property
    def allowed_text(self) -> str:
        """The allowed values in words, such as ``16, 24 or 32`` or ``64 to 8192``; empty if all values are allowed."""
        *earlier_texts, last = (*map(str, self.literal_values), *filter(None, map(_limits_text, _union_parts(self.type)))) or ("",)
        return f"{', '.join(earlier_texts)} or {last}" if earlier_texts else last


def settings_of(model: type[BaseModel], front_end: FrontEnd) -> list[Setting]:
    """Return the settings that a front end accepts, in the order of their fields."""
    settings = []
    for name, field in model.model_fields.items():
        options = next((item for item in field.metadata if isinstance(item, RequestOptions)), RequestOptions())
        if front_end in options.front_ends:
            settings.append(Setting(name, field.description or "", _request_type(field, options), tuple(field.examples or ())))
    return settings


def _request_type(field: FieldInfo, options: RequestOptions) -> Any:
    """Return the type of a field's values in requests, with their limits.

    It is the field's type without ``None``, and without ``auto`` unless ``options`` allow it.
    """
    if options.request_type is not None:
        return options.request_type
    request_type = field.annotation if options.allows_auto else reduce(or_, _without_auto(field.annotation))
    limits = [item for item in field.metadata if not isinstance(item, RequestOptions)]
    return _TYPE_CONSTRUCTORS["Annotated"][(request_type, *limits)] if limits else request_type


def _without_auto(annotation: Any) -> Iterator[Any]:
    """Yield the parts of a type without ``auto`` and ``None``."""
    for part in _union_parts(annotation):
        if get_origin(part) is Literal:
            words = tuple(word for word in get_args(part) if word != AUTO)
            if words:
                yield _TYPE_CONSTRUCTORS["Literal"][words]
        elif part is not NoneType:
            yield part


def _union_parts(annotation: Any) -> Iterator[Any]:
    """Yield the parts of a union, or the type itself."""
    if get_origin(annotation) in (Union, UnionType):
        for part in get_args(annotation):
            yield from _union_parts(part)
    else:
        yield annotation


def _without_annotation(annotation: Any) -> Any:
    """Return the type in an ``Annotated`` type, and any other type unchanged."""
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _limits_text(annotation: Any) -> str:
    """Return the limits of a numeric type in words, such as ``64 to 8192``; empty if it has none."""
    limits: dict[str, Any] = {}
    for limit in _limit_values(get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()):
        limits |= {name: getattr(limit, name) for name in ("ge", "le", "gt") if hasattr(limit, name)}
    if "ge" in limits and "le" in limits:
        return f"{limits['ge']:g} to {limits['le']:g}"
    return f"more than {limits['gt']:g}" if "gt" in limits else ""


def limits_text(field: FieldInfo) -> str:
    """Return the limits of a numeric field in words, such as ``64 to 8192``; empty if it has none."""
    return next(filter(None, map(_limits_text, _union_parts(_request_type(field, RequestOptions())))), "")


def _limit_values(metadata: tuple[Any, ...]) -> Iterator[Any]:
    """Yield the metadata of an ``Annotated`` type, those of a ``Field`` one by one."""
    for item in metadata:
        if isinstance(item, FieldInfo):
            yield from item.metadata
        else:
            yield item
