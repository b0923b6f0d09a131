"""Errors as ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

import inspect
import logging
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict

from skugga.api.errors import OUTCOMES, Outcome, outcome_of
from skugga.terrain.errors import SkuggaError

MEDIA_TYPE = "application/problem+json"

log = logging.getLogger("skugga")


class Problem(BaseModel):
    """A problem document. ``code`` is stable; ``parameter`` is there where one parameter is to blame, and ``preparing`` before a
    service is ready: the ``task`` in words, steps ``done``, and ``total`` (0 while unknown).
    """

    model_config = ConfigDict(frozen=True)

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    code: str
    parameter: str | None = None
    preparing: dict[str, Any] | None = None


OF_HTTP: dict[int, tuple[str, str]] = {
    400: ("bad_request", "The request, or its body, cannot be read: it is not HTTP/1.1, or not JSON in UTF-8."),
    401: ("unauthorized", "A token is needed: Authorization: Bearer TOKEN."),
    404: ("not_found", "There is nothing at this address."),
    405: ("method_not_allowed", "There is no such method here."),
    413: ("too_large", "The body has too many bytes."),
    431: ("head_too_large", "The request's line and headers have too many bytes."),
    500: ("internal", "Something went wrong inside the service; its log says what."),
}
"""Codes and texts of problems that no domain error stands for, by their statuses."""


@dataclass(frozen=True)
class ProblemKind:
    """A kind of problem, as it is documented: its status, its stable code, what it says, and when to come back, if that is told."""

    status: int
    code: str
    about: str
    retry_after_s: int | None = None

    @property
    def example(self) -> dict[str, Any]:
        """A problem document of this kind."""
        return problem_of(self.status, self.about, self.code).model_dump(exclude_none=True)


def problem_kinds() -> list[ProblemKind]:
    """All kinds of problems: of the table of ``skugga.api.errors``, as far as HTTP answers can have them, and of HTTP itself.
    Errors that clients cannot tell apart are one.
    """
    kinds: dict[tuple[int, str], ProblemKind] = {}
    for error, outcome in OUTCOMES.items():
        if not outcome.in_http:
            continue
        about = outcome.public or " ".join(inspect.cleandoc(error.__doc__ or "").split("\n\n")[0].split())
        kinds.setdefault((outcome.status, outcome.code), ProblemKind(outcome.status, outcome.code, about, outcome.retry_after_s))
    for status, (code, about) in OF_HTTP.items():
        kinds.setdefault((status, code), ProblemKind(status, code, about))
    return sorted(kinds.values(), key=lambda kind: kind.status)


def problem_of(status: int, detail: str | None = None, code: str | None = None, parameter: str | None = None) -> Problem:
    """A problem document; what is not given is of HTTP itself."""
    own_code, own_detail = OF_HTTP.get(status, (HTTPStatus(status).name.lower(), HTTPStatus(status).phrase))
    return Problem(
        title=HTTPStatus(status).phrase, status=status, detail=detail or own_detail, code=code or own_code, parameter=parameter
    )


def problem_response(problem: Problem, headers: dict[str, str] | None = None) -> JSONResponse:
    """An answer that no cache keeps."""
    return JSONResponse(
        problem.model_dump(exclude_none=True), problem.status, {"Cache-Control": "no-store", **(headers or {})}, MEDIA_TYPE
    )


def public_error(request: Request, error: SkuggaError) -> tuple[Outcome, str]:
    """What a domain error means by the table of ``skugga.api.errors``, and what clients read of it; what they may not goes to the
    log.
    """
    outcome = outcome_of(error)
    if outcome.public is not None:
        log.error("%s %s: %s: %s", request.method, request.url.path, outcome.code, error)
    return outcome, outcome.public or str(error)


def public_problem(error: SkuggaError) -> Problem:
    """What clients read of a domain error."""
    outcome = outcome_of(error)
    # An error that is not the client's blames none of his parameters: its name would be the operator's file.
    parameter = getattr(error, "name", None) if outcome.public is None else None
    problem = problem_of(outcome.status, outcome.public or str(error), outcome.code, parameter)
    return problem.model_copy(update={"preparing": getattr(error, "preparing", None)})


def domain_problem(request: Request, error: SkuggaError) -> JSONResponse:
    """A domain error as a problem document."""
    outcome, _ = public_error(request, error)
    retry_after_s = getattr(error, "retry_after_s", None) or outcome.retry_after_s
    headers = None if retry_after_s is None else {"Retry-After": str(retry_after_s)}
    return problem_response(public_problem(error), headers)
