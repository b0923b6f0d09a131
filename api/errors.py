"""Mapping from domain errors to HTTP statuses and exit statuses.

Modules below ``api`` know no status codes. No other module of ``api`` maps an error to one.
"""

from __future__ import annotations

import re
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

EXIT_SUCCESS, EXIT_FAILURE, EXIT_WRONG_INPUT = 0, 1, 2
"""Exit statuses of the command line."""

_PARAMETER_REMEDY = re.compile(r"(\(without a level file: )(\w+)=")
"""The part of ``skugga.terrain.level.level_source.option_remedy`` that spells an option as a parameter."""


class NotServedError(NotFoundError):
    """The service has no such resource; ``name`` is the parameter that names it."""

    def __init__(self, name: str, message: str) -> None:
        self.name = name
        super().__init__(message)


class TooLargeError(InputError):
    """A request's body has more bytes than the settings allow."""


class ArchiveError(InputError):
    """A file is not a tile archive that can be served; ``name`` is its path."""


class WorkerCrashError(RenderError):
    """A render process ended during its work."""


class WorkerStartError(BusyError):
    """A render process ended while it started, or was not ready in time."""


class BrokenShardError(RenderError):
    """The bytes of a shard (the tiles of one seeding task) do not match its index.

    ``shard_number`` counts the shards that are read, from 0.
    """

    def __init__(self, message: str, shard_number: int | None = None) -> None:
        self.shard_number = shard_number
        super().__init__(message)


class NotReadyError(BusyError):
    """No render process has warmed up yet.

    ``preparing`` is the progress: ``task`` in words, the steps ``done`` and in ``total``, and ``elapsed_s``.
    """

    def __init__(self, message: str, preparing: dict[str, Any] | None = None) -> None:
        self.preparing = preparing
        super().__init__(message)


class RetryLaterError(BusyError):
    """The service is busy; ``retry_after_s`` is the delay after which a retry may succeed, seconds."""

    def __init__(self, message: str, retry_after_s: int | None = None) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(message)


class ExhaustedError(BusyError):
    """The machine has no thread, file descriptor or memory left."""


class CircuitOpenError(RetryLaterError):
    """Renders with these settings fail repeatedly. The service does not try them again for a while."""


class RateLimitError(RetryLaterError):
    """A client requests more new sun positions than the settings allow."""


class UnfinishedError(RetryLaterError):
    """The animation is not finished yet."""


class LevelChangedError(BusyError):
    """The level changed while an animation of it was drawn. Request it again."""


class StorageError(SkuggaError):
    """A film cannot be stored because no space is left."""


def with_option_names(message: str) -> str:
    """Return a message whose remedies name options of the command line: ``--units ft`` instead of ``units=ft``."""
    return _PARAMETER_REMEDY.sub(r"\1--\2 ", message)


class TooCostlyError(InputError):
    """The picture is expected to take longer than the limit."""


class UnhealthyError(SkuggaError):
    """A part of the service has ended unexpectedly. The service has to be restarted."""


@dataclass(frozen=True)
class ErrorReport:
    """How an error is reported to users.

    Attributes
    ----------
    status
        HTTP status.
    exit_status
        Exit status of the command line.
    code
        Stable code of HTTP problem documents.
    public_message
        Message for HTTP clients; ``None`` sends the error's own message. Some messages contain paths of the operator's files or
        texts of drivers. They only go to the log, and clients get this message.
    retry_after_s
        Seconds after which the client may retry.
    reaches_http
        Whether HTTP answers can have this error.
    """

    status: int
    exit_status: int
    code: str
    public_message: str | None = None
    retry_after_s: int | None = None
    reaches_http: bool = True


ERROR_REPORTS: dict[type[SkuggaError], ErrorReport] = {
    SkuggaError: ErrorReport(500, EXIT_FAILURE, "error", "The work failed. The service's log has the cause."),
    InputError: ErrorReport(422, EXIT_WRONG_INPUT, "invalid_parameter"),
    LevelError: ErrorReport(500, EXIT_WRONG_INPUT, "level", "The level file is wrong. The service's log has the details."),
    SourceError: ErrorReport(
        500, EXIT_WRONG_INPUT, "source", "The level's raster cannot be read. The service's log has the cause."
    ),
    ArrayError: ErrorReport(422, EXIT_WRONG_INPUT, "array", reaches_http=False),
    ArchiveError: ErrorReport(
        500, EXIT_WRONG_INPUT, "archive", "The tile archive cannot be read. The service's log has the cause."
    ),
    UnsupportedError: ErrorReport(422, EXIT_WRONG_INPUT, "unsupported"),
    TooLargeError: ErrorReport(413, EXIT_WRONG_INPUT, "too_large"),
    TooCostlyError: ErrorReport(422, EXIT_WRONG_INPUT, "too_costly"),
    NotFoundError: ErrorReport(404, EXIT_WRONG_INPUT, "not_found"),
    NotServedError: ErrorReport(404, EXIT_WRONG_INPUT, "not_found"),
    BusyError: ErrorReport(503, EXIT_FAILURE, "busy", retry_after_s=2),
    RetryLaterError: ErrorReport(503, EXIT_FAILURE, "busy", retry_after_s=2),
    ExhaustedError: ErrorReport(
        503,
        EXIT_FAILURE,
        "exhausted",
        "The service's machine has run out of threads, file descriptors or memory. The service's log has the details.",
        retry_after_s=5,
    ),
    CircuitOpenError: ErrorReport(503, EXIT_FAILURE, "set_aside", retry_after_s=30),
    NotReadyError: ErrorReport(503, EXIT_FAILURE, "not_ready", retry_after_s=2),
    RateLimitError: ErrorReport(429, EXIT_WRONG_INPUT, "too_many_suns", retry_after_s=2),
    UnfinishedError: ErrorReport(409, EXIT_WRONG_INPUT, "unfinished", retry_after_s=2),
    LevelChangedError: ErrorReport(503, EXIT_FAILURE, "level_changed", retry_after_s=1),
    StorageError: ErrorReport(507, EXIT_FAILURE, "storage", "No space is left for the film. The service's log has the cause."),
    UnhealthyError: ErrorReport(
        503, EXIT_FAILURE, "unhealthy", "A part of the service has ended. Its log names it.", retry_after_s=30
    ),
    RenderError: ErrorReport(500, EXIT_FAILURE, "render", "The picture could not be drawn. The service's log has the cause."),
    WorkerCrashError: ErrorReport(
        503, EXIT_FAILURE, "worker_crash", "Two render processes ended while they drew this picture. They are being replaced.", 2
    ),
    WorkerStartError: ErrorReport(
        503, EXIT_FAILURE, "worker_start", "A render process ended while it started. It is being restarted.", retry_after_s=5
    ),
    BrokenShardError: ErrorReport(
        500, EXIT_FAILURE, "broken_shard", "Stored tiles are damaged. The log names them.", reaches_http=False
    ),
    GraphicsError: ErrorReport(
        503,
        EXIT_FAILURE,
        "graphics",
        "The service cannot draw: OpenGL does not work. Its log has the cause.",
        retry_after_s=30,
    ),
    NoOpenGLError: ErrorReport(
        503,
        EXIT_FAILURE,
        "no_opengl",
        "This picture needs OpenGL, which the service does not have. Bare ground under the sun does not need it.",
    ),
    RenderTimeoutError: ErrorReport(504, EXIT_FAILURE, "render_timeout"),
}
"""Report by the exact class of an error. A test checks that all classes are listed."""


def error_report_of(error: SkuggaError) -> ErrorReport:
    """Return the report of an error to users."""
    return ERROR_REPORTS[type(error)]


def exit_status(error: SkuggaError) -> int:
    """Return the command line's exit status: 1 if the work failed, 2 if the input is wrong."""
    return error_report_of(error).exit_status
