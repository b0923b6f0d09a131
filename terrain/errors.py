"""Domain errors. All layers below ``api`` raise these; ``skugga.api.errors`` alone knows HTTP statuses and exit statuses.

SkuggaError
├── InputError            the caller's input is wrong: names the file or parameter, the value and the allowed values
│   ├── LevelError        a level file
│   ├── SourceError       a raster
│   ├── ArrayError        an array, which is a ``ValueError``, too
│   └── UnsupportedError  a combination that an algorithm, a CRS or a view cannot serve, with the reason
├── NotFoundError         an unknown level, tile matrix set, tile or view
├── BusyError             the render queue is full
└── RenderError           the work itself failed
    ├── GraphicsError     OpenGL does not work or reported an error
    │   └── NoOpenGLError   no OpenGL on this machine; pictures that need no OpenGL still work
    └── RenderTimeoutError  a render exceeded its time limit
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Self, TypeVar

InputErrorT = TypeVar("InputErrorT", bound="InputError")


_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


class SkuggaError(Exception):
    """Base of all errors that Skugga raises on purpose. The message is one line, or one line for each error of a file."""


MAX_LISTED_ERRORS = 100
"""How many errors of one input a message lists."""

CONFLICT_REMEDY = "Use one of them"


class Problem(str):
    """A description of an input error, such as ``unknown key``. ``InputError`` takes it in place of the wrong value."""


MISSING_VALUE = Problem("missing")


class InputError(SkuggaError):
    """The caller's input is wrong.

    The constructor makes the message of a value that is not allowed, or of a ``Problem``. The class methods make the other kinds:
    ``missing``, ``conflict`` and ``over_limit``. Engine errors name parameters (``least_altitude``); front ends name them as
    their users write them (``renamed``).

    Parameters
    ----------
    name
        The file, key or parameter that is wrong.
    value
        The value that was given, or a ``Problem``.
    allowed
        The allowed values as a phrase; after a ``Problem`` the remedy as a sentence without its full stop.

    Attributes
    ----------
    further_errors
        Further errors of the same input (``combined_error``); the message has a line for each.
    conflicting_name
        The other parameter of a ``conflict``.
    """

    further_errors: tuple[InputError, ...] = ()
    conflicting_name: str | None = None

    def __init__(self, name: str, value: object, allowed: str) -> None:
        self.name = name
        self.value = value
        self.allowed = allowed
        problem = f"{value}. {allowed}" if isinstance(value, Problem) else f"{_quoted(value)} is not allowed. Allowed: {allowed}"
        super().__init__(_message_line(name, problem))

    @classmethod
    def missing(cls, name: str, remedy: str) -> Self:
        """Return the error of a required value that is missing."""
        return cls(name, MISSING_VALUE, remedy)

    @classmethod
    def conflict(cls, name: str, other_name: str, remedy: str = CONFLICT_REMEDY) -> Self:
        """Return the error of two parameters that exclude each other."""
        error = cls(name, Problem(f"cannot be combined with {other_name}"), remedy)
        error.conflicting_name = other_name
        return error

    @classmethod
    def over_limit(cls, name: str, amount: str, limit: str, remedy: str) -> Self:
        """Return the error of an amount that exceeds a limit. Both are texts with a unit."""
        return cls(name, Problem(f"{amount}, more than the limit of {limit}"), remedy)

    def renamed(self, name: str) -> Self:
        """Return the same error of a parameter by another name."""
        return type(self)(name, self.value, self.allowed)

    def prefixed(self, prefix: str) -> Self:
        """Return the same error with a prefix, such as two dashes, before the names of its parameters."""
        if self.conflicting_name is not None:
            return self.conflict(prefix + self.name, prefix + self.conflicting_name, self.allowed)
        return self.renamed(prefix + self.name)


class LevelError(InputError):
    """A level file is wrong."""


class SourceError(InputError):
    """A raster cannot be used, or a part of it cannot be read.

    Parameters
    ----------
    name
        The file.
    value
        What is wrong with it, in words.
    allowed
        The remedy as a sentence without its full stop.
    """

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(name, Problem(value), allowed)


class ArrayError(InputError, ValueError):
    """An array in memory cannot be used as a grid of heights."""


class UnsupportedError(InputError):
    """A combination of level, view and algorithm that the engine does not support.

    Parameters
    ----------
    name
        The parameter.
    value
        Its value.
    allowed
        The reason as a clause.
    """

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(name, value, allowed)
        self.args = (_message_line(name, f"{_quoted(value)} is not supported here: {allowed}"),)


def combined_error(errors: Sequence[InputErrorT]) -> InputErrorT:
    """Return the first of some errors, with a message that has a line for each of them.

    ``errors`` has at least one. Of more than ``MAX_LISTED_ERRORS`` errors the message lists that many and counts the rest.
    """
    first, *further_errors = errors[:MAX_LISTED_ERRORS]
    first.further_errors = tuple(further_errors)
    overflow_lines = [f"{len(errors) - MAX_LISTED_ERRORS} more errors"] if len(errors) > MAX_LISTED_ERRORS else []
    first.args = ("\n".join([*map(str, (first, *further_errors)), *overflow_lines]),)
    return first


class NotFoundError(SkuggaError):
    """The level, tile matrix set, tile or view does not exist."""


class BusyError(SkuggaError):
    """The render queue is full. The caller may try again soon."""


class RenderError(SkuggaError):
    """Rendering failed although the input was valid."""


class GraphicsError(RenderError):
    """OpenGL does not work, or an OpenGL call has reported an error."""


class NoOpenGLError(GraphicsError):
    """This machine has no OpenGL. Pictures that need it cannot be drawn; all others can."""


class RenderTimeoutError(RenderError):
    """A render took longer than the settings allow."""


def printable(text: str) -> str:
    """Return a text on one line, without characters that control a terminal.

    Control characters, changes of the writing direction and lone surrogates become escapes.
    """
    return _UNPRINTABLE.sub(lambda match: ascii(match[0])[1:-1], text)


def _message_line(name: str, problem: str) -> str:
    """Return the message ``NAME: problem.`` on one printable line."""
    return printable(f"{name}: {problem}" if problem.endswith((".", "?")) else f"{name}: {problem}.")


def _quoted(value: object) -> str:
    """Return a value as text on one line, in quotes, shortened to 120 characters."""
    text = value if isinstance(value, str) else repr(value)
    text = " ".join(text.split())
    return f"'{text}'" if len(text) <= 120 else f"'{text[:117]}...'"
