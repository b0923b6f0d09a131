"""Convert errors to problem documents, ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

import inspect
import logging
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict

from skugga.api.errors import ERROR_REPORTS, ErrorReport, error_report_of
from skugga.terrain.errors import SkuggaError

PROBLEM_MEDIA_TYPE = "application/problem+json"

log = logging.getLogger("skugga")


class Problem(BaseModel):
    """A problem document.

    ``code`` is a stable identifier. ``parameter`` names the wrong parameter, if a parameter is wrong. ``preparing`` is present
    until the service is ready: the ``task`` in words, steps ``done``, and ``total`` (0 while unknown).
    """

    model_config = ConfigDict(frozen=True)

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    code: str
    parameter: str | None = None
    preparing: dict[str, Any] | None = None


HTTP_PROBLEMS: dict[int, tuple[str, str]] = {
    400: ("bad_request", "The request, or its body, cannot be read: it is not HTTP/1.1, or not JSON in UTF-8."),
    401: ("unauthorized", "A token is needed: Authorization: Bearer TOKEN."),
    404: ("not_found", "There is nothing at this address."),
    405: ("method_not_allowed", "The address does not support this method."),
    413: ("too_large", "The body has too many bytes."),
    431: ("head_too_large", "The request's line and headers have too many bytes."),
    500: ("internal", "An unexpected error occurred. The service's log has the details."),
}
"""Codes and texts of problems that are no ``SkuggaError``, by HTTP status."""


@dataclass(frozen=True)
class ProblemKind:
    """A kind of problem, for the documentation.

    Attributes
    ----------
    status : int
        HTTP status.
    code : str
        Stable identifier.
    description : str
        Description, which is also the example's ``detail``.
    retry_after_s : int or None
        Seconds of ``Retry-After``; ``None`` without that header.
    """

    status: int
    code: str
    description: str
    retry_after_s: int | None = None

    @property
    def example(self) -> dict[str, Any]:
        """An example of a problem document of this kind."""
        return problem_of(self.status, self.description, self.code).model_dump(exclude_none=True)


def problem_kinds() -> list[ProblemKind]:
    """Return all kinds of problems in HTTP answers, in order of status.

    They come from the table of ``skugga.api.errors`` and from ``HTTP_PROBLEMS``. Errors with equal status and code are one kind.
    """
    kinds: dict[tuple[int, str], ProblemKind] = {}
    for error, report in ERROR_REPORTS.items():
        if not report.reaches_http:
            continue
        description = report.public_message or " ".join(inspect.cleandoc(error.__doc__ or "").split("\n\n")[0].split())
        kinds.setdefault((report.status, report.code), ProblemKind(report.status, report.code, description, report.retry_after_s))
    for status, (code, description) in HTTP_PROBLEMS.items():
        kinds.setdefault((status, code), ProblemKind(status, code, description))
    return sorted(kinds.values(), key=lambda kind: kind.status)


def problem_of(status: int, detail: str | None = None, code: str | None = None, parameter: str | None = None) -> Problem:
    """Return a problem document. ``detail`` and ``code`` default to those of the status in ``HTTP_PROBLEMS``."""
    own_code, own_detail = HTTP_PROBLEMS.get(status, (HTTPStatus(status).name.lower(), HTTPStatus(status).phrase))
    return Problem(
        title=HTTPStatus(status).phrase, status=status, detail=detail or own_detail, code=code or own_code, parameter=parameter
    )


def problem_response(problem: Problem, headers: dict[str, str] | None = None) -> JSONResponse:
    """Return a problem document as a response that caches must not store."""
    return JSONResponse(
        problem.model_dump(exclude_none=True), problem.status, {"Cache-Control": "no-store", **(headers or {})}, PROBLEM_MEDIA_TYPE
    )


def public_error(request: Request, error: SkuggaError) -> tuple[ErrorReport, str]:
    """Return the entry of a ``SkuggaError`` in the table of ``skugga.api.errors``, and the message for clients.

    If clients must not see the error's own message, it is written to the log.
    """
    report = error_report_of(error)
    if report.public_message is not None:
        log.error("%s %s: %s: %s", request.method, request.url.path, report.code, error)
    return report, report.public_message or str(error)


def public_problem(error: SkuggaError) -> Problem:
    """Return the problem document that clients get for a ``SkuggaError``."""
    report = error_report_of(error)
    # Errors that the client did not cause name no parameter, since their ``name`` may be a path of the operator's files.
    parameter = getattr(error, "name", None) if report.public_message is None else None
    problem = problem_of(report.status, report.public_message or str(error), report.code, parameter)
    return problem.model_copy(update={"preparing": getattr(error, "preparing", None)})


def logged_error_response(request: Request, error: SkuggaError) -> JSONResponse:
    """Return the response for a ``SkuggaError``, and log the error if clients must not see its own message."""
    public_error(request, error)
    return error_response(error)


def error_response(error: SkuggaError) -> JSONResponse:
    """Return the response for a ``SkuggaError``: a problem document, with ``Retry-After`` if that time is known."""
    retry_after_s = getattr(error, "retry_after_s", None) or error_report_of(error).retry_after_s
    headers = None if retry_after_s is None else {"Retry-After": str(retry_after_s)}
    return problem_response(public_problem(error), headers)
