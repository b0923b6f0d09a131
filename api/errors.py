"""The one table from domain errors to HTTP statuses and exit statuses.

Nothing below ``api`` knows a status, and nothing in ``api`` maps an error anywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from skugga.terrain.errors import (
    ArrayError,
    BusyError,
    GraphicsError,
    InputError,
    LevelError,
    NoOpenGLError,
    NotFoundError,
    RenderError,
    RenderTimeoutError,
    SkuggaError,
    SourceError,
    UnsupportedError,
)

DONE, FAILED, WRONG_INPUT = 0, 1, 2
"""Exit statuses."""


class NotServedError(NotFoundError):
    """The service has no such thing; ``name`` is the parameter that names it."""

    def __init__(self, name: str, message: str) -> None:
        self.name = name
        super().__init__(message)


class TooLargeError(InputError):
    """A request's body has more bytes than the settings allow."""


class ArchiveError(InputError):
    """A file is no archive of tiles that can be served; ``name`` is its path."""


class WorkerCrashError(RenderError):
    """A render process ended in the middle of its work."""


class WorkerStartError(BusyError):
    """A render process ended, or did not get ready in time, while it started."""


class BrokenShardError(RenderError):
    """The bytes of a shard are not those that its index tells of; ``number`` is the shard's among those that are read."""

    def __init__(self, message: str, number: int | None = None) -> None:
        self.number = number
        super().__init__(message)


class NotReadyError(BusyError):
    """No render process has warmed up yet.

    ``preparing`` is what it does: the ``task`` in words, steps ``done``, ``total``, and ``elapsed_s``.
    """

    def __init__(self, message: str, preparing: dict[str, Any] | None = None) -> None:
        self.preparing = preparing
        super().__init__(message)


class LaterError(BusyError):
    """The service is busy; ``retry_after_s`` says when it expects to be less so."""

    def __init__(self, message: str, retry_after_s: int | None = None) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(message)


class ExhaustedError(BusyError):
    """The machine has no thread, file descriptor or memory left."""


class SetAsideError(LaterError):
    """Pictures of this kind keep failing, and are not tried again for a while."""


class TooManySunsError(LaterError):
    """A client asks for more new suns than the settings allow."""


class UnfinishedError(LaterError):
    """The animation is not drawn yet."""


class LevelChangedError(BusyError):
    """The level has changed while an animation of it was drawn: ask for it again."""


class StorageError(SkuggaError):
    """A film cannot be kept: there is no room for it."""


class TooCostlyError(InputError):
    """What is asked for is expected to take longer than a picture may."""


class UnhealthyError(SkuggaError):
    """A part of the service has ended that should not: it is to be started anew."""


@dataclass(frozen=True)
class Outcome:
    """What an error means outside: HTTP status, exit status and a stable code.

    ``public`` is the sentence that HTTP clients read; ``None`` lets them read the error's own message. Errors of the
    work and of the operator's files have messages with paths and drivers' words in them, which are for the log.
    ``retry_after_s`` tells the client when to come back. ``in_http`` says whether HTTP answers can have it at all.
    """

    status: int
    exit_status: int
    code: str
    public: str | None = None
    retry_after_s: int | None = None
    in_http: bool = True


OUTCOMES: dict[type[SkuggaError], Outcome] = {
    SkuggaError: Outcome(500, FAILED, "error", "The work failed; the service's log says why."),
    InputError: Outcome(422, WRONG_INPUT, "invalid_parameter"),
    LevelError: Outcome(500, WRONG_INPUT, "level", "The level's file is wrong; the service's log says what."),
    SourceError: Outcome(500, WRONG_INPUT, "source", "The level's raster cannot be read; the service's log says why."),
    ArrayError: Outcome(422, WRONG_INPUT, "array", in_http=False),
    ArchiveError: Outcome(500, WRONG_INPUT, "archive", "The archive of tiles cannot be read; the service's log says why."),
    UnsupportedError: Outcome(422, WRONG_INPUT, "unsupported"),
    TooLargeError: Outcome(413, WRONG_INPUT, "too_large"),
    TooCostlyError: Outcome(422, WRONG_INPUT, "too_costly"),
    NotFoundError: Outcome(404, WRONG_INPUT, "not_found"),
    NotServedError: Outcome(404, WRONG_INPUT, "not_found"),
    BusyError: Outcome(503, FAILED, "busy", retry_after_s=2),
    LaterError: Outcome(503, FAILED, "busy", retry_after_s=2),
    ExhaustedError: Outcome(
        503, FAILED, "exhausted", "The machine of the service has nothing left to work with; its log says what.", retry_after_s=5
    ),
    SetAsideError: Outcome(503, FAILED, "set_aside", retry_after_s=30),
    NotReadyError: Outcome(503, FAILED, "not_ready", retry_after_s=2),
    TooManySunsError: Outcome(429, WRONG_INPUT, "too_many_suns", retry_after_s=2),
    UnfinishedError: Outcome(409, WRONG_INPUT, "unfinished", retry_after_s=2),
    LevelChangedError: Outcome(503, FAILED, "level_changed", retry_after_s=1),
    StorageError: Outcome(507, FAILED, "storage", "There is no room for the film; the service's log says why."),
    UnhealthyError: Outcome(503, FAILED, "unhealthy", "A part of the service has ended; its log says which.", retry_after_s=30),
    RenderError: Outcome(500, FAILED, "render", "The picture could not be drawn; the service's log says why."),
    WorkerCrashError: Outcome(
        503, FAILED, "worker_crash", "Two render processes ended in the middle of this picture; others take their places.", 2
    ),
    WorkerStartError: Outcome(
        503, FAILED, "worker_start", "A render process ended while it started; it is started again.", retry_after_s=5
    ),
    BrokenShardError: Outcome(500, FAILED, "broken_shard", "Tiles that were stored are broken; the log says which.", in_http=False),
    GraphicsError: Outcome(
        503, FAILED, "graphics", "The service cannot draw: OpenGL does not work; its log says why.", retry_after_s=30
    ),
    NoOpenGLError: Outcome(
        503,
        FAILED,
        "no_opengl",
        "This needs OpenGL, which the service does not have. Bare ground under the sun does not.",
    ),
    RenderTimeoutError: Outcome(504, FAILED, "render_timeout"),
}
"""Every class of error, each by itself: a test holds the table complete."""


def outcome_of(error: SkuggaError) -> Outcome:
    """What an error means outside."""
    return OUTCOMES[type(error)]


def exit_status(error: SkuggaError) -> int:
    """Exit status of the command line: 1 the work failed, 2 the input is wrong."""
    return outcome_of(error).exit_status
