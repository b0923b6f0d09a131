"""Domain errors. Everything below ``api`` raises these; ``skugga.api.errors`` alone knows status codes and exit codes.

SkuggaError
├── InputError            what the caller gave is wrong: names the file or parameter, the value and what is allowed
│   ├── LevelError        a level file
│   ├── SourceError       a raster
│   ├── ArrayError        an array, which is a ``ValueError``, too
│   └── UnsupportedError  a combination that an algorithm, a CRS or a view cannot serve, with the reason
├── NotFoundError         an unknown level, tile matrix set, tile or view
├── BusyError             the render queue is full
└── RenderError           the work itself failed
    ├── GraphicsError     OpenGL is broken or left an error behind
    │   └── NoOpenGLError   there is none: what needs it cannot be drawn, all else can
    └── RenderTimeoutError  a render took longer than it may
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeVar

InputErrorT = TypeVar("InputErrorT", bound="InputError")


_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


class SkuggaError(Exception):
    """Base of all errors that Skugga raises on purpose; the message is a line for a person, or one for each error of a file."""


MOST_LINES = 100
"""Errors of one input that are told."""


class Fault(str):
    """What is wrong with an input, in words, where that is no value that was given: ``unknown key``."""


MISSING_VALUE = Fault("missing")
"""What is wrong where nothing was given."""


class InputError(SkuggaError):
    """The caller's input is wrong.

    Parameters
    ----------
    name
        The file, key or parameter that is wrong.
    value
        What was given, or a ``Fault``.
    allowed
        What would be right, as a phrase.

    ``others`` are further errors of the same input (``all_at_once``); the message has a line for each.
    """

    others: tuple[InputError, ...] = ()

    def __init__(self, name: str, value: object, allowed: str) -> None:
        self.name = name
        self.value = value
        self.allowed = allowed
        fault = value if isinstance(value, Fault) else f"{_short(value)} is not allowed"
        super().__init__(printable(f"{name}: {fault}; allowed: {allowed}"))


class LevelError(InputError):
    """A level file is wrong."""


class SourceError(InputError):
    """A raster cannot be used, or a part of it cannot be read."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(name, value, allowed)
        self.args = (printable(f"{name}: {_short(value)}; needed: {allowed}"),)


class ArrayError(InputError, ValueError):
    """An array in memory is no grid of heights."""


class UnsupportedError(InputError):
    """A combination of level, view and algorithm that cannot be served."""

    def __init__(self, name: str, value: object, reason: str) -> None:
        super().__init__(name, value, reason)
        self.args = (printable(f"{name}: {_short(value)} cannot be served: {reason}"),)


def all_at_once(errors: Sequence[InputErrorT]) -> InputErrorT:
    """Some errors, at least one, as the first of them, whose message has a line for each."""
    first, *others = errors[:MOST_LINES]
    first.others = tuple(others)
    further = [f"{len(errors) - MOST_LINES} more are wrong"] if len(errors) > MOST_LINES else []
    first.args = ("\n".join([*map(str, (first, *others)), *further]),)
    return first


class NotFoundError(SkuggaError):
    """There is no such level, tile matrix set, tile or view."""


class BusyError(SkuggaError):
    """The render queue is full; the caller may try again soon."""


class RenderError(SkuggaError):
    """The work failed although the input was right."""


class GraphicsError(RenderError):
    """OpenGL is broken, or an error was left behind by a call."""


class NoOpenGLError(GraphicsError):
    """This machine has no OpenGL: what needs it cannot be drawn, all else can."""


class RenderTimeoutError(RenderError):
    """A render took longer than the settings allow and was ended."""


def printable(text: str) -> str:
    """A text with control characters, turns of the writing direction and lone surrogates as escapes: one line, which a terminal
    shows and does not obey, and which can be encoded.
    """
    return _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)


def _short(value: object) -> str:
    text = value if isinstance(value, str) else repr(value)
    text = " ".join(text.split())
    return f"'{text}'" if len(text) <= 120 else f"'{text[:117]}...'"
