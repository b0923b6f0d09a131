"""Errors as ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

import inspect
import logging
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException
from starlette.routing import Match, Mount

from api.errors import OUTCOMES, Outcome, outcome_of
from api.http.answers import wants_page
from terrain.errors import MISSING_VALUE, Fault, InputError, SkuggaError, printable
from terrain.level.level_errors import UNKNOWN_KEY

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
    """All kinds of problems: of the table of ``api.errors``, as far as HTTP answers can have them, and of HTTP itself. Errors that
    clients cannot tell apart are one.
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
    """What a domain error means by the table of ``api.errors``, and what clients read of it; what they may not goes to the log."""
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


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error of an application as a problem document."""

    async def domain(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, SkuggaError)
        return domain_problem(request, error)

    async def validation(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return domain_problem(request, _first_wrong(error))

    async def http(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = ", ".join(_methods_at(request))
        said = {
            400: "body: it cannot be read; allowed: JSON in UTF-8, nested not too deeply",  # nothing else is read before a route
            404: f"There is nothing at {printable(request.url.path[:200])}.",
            405: f"There is no {request.method[:20]} here; allowed: {headers.get('Allow')}.",
        }
        detail = said.get(error.status_code, str(error.detail))
        if error.status_code == 404 and wants_page(request):
            from api.http.not_found import not_found_page  # it knows the service, which knows problems

            return not_found_page(request, detail)
        parameter = "body" if error.status_code in (400, 413) else None
        return problem_response(problem_of(error.status_code, detail, parameter=parameter), headers)

    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        return problem_response(problem_of(500))

    app.add_exception_handler(SkuggaError, domain)
    app.add_exception_handler(RequestValidationError, validation)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(Exception, unexpected)


def _methods_at(request: Request) -> list[str]:
    """The methods that an address has, by all routes that lead there: the framework tells of the first alone."""

    def has(method: str) -> bool:
        scope = {**request.scope, "method": method}
        routes = [route for route in request.app.routes if method == "GET" or not isinstance(route, Mount)]  # of files
        return any(route.matches(scope)[0] is Match.FULL for route in routes)

    return [*(["GET", "HEAD"] if has("GET") else []), *(method for method in ("POST", "DELETE") if has(method))]


def _first_wrong(error: RequestValidationError) -> InputError:
    """The first thing that is wrong: a parameter by its name, a part of the body by its path."""
    detail = error.errors()[0]
    where, *path = detail["loc"]
    name = ".".join(str(part) for part in path) or "body" if where == "body" else str(detail["loc"][-1])
    if detail["type"] == "json_invalid":
        return InputError("body", Fault(f"not valid JSON at character {path[0]} ({detail['ctx']['error']})"), "JSON")
    if detail["type"] == "missing":
        return InputError(name, MISSING_VALUE, "a value: it is required")
    if where == "body" and isinstance(detail.get("input"), bytes):
        return InputError("body", Fault("not sent as JSON"), "JSON, with Content-Type: application/json")
    if detail["type"] == UNKNOWN_KEY:
        where = ".".join([*map(str, path), detail["ctx"]["key"]])
        return InputError(where, Fault("unknown key"), detail["ctx"]["known"])
    if detail["type"] == "model_attributes_type":
        return InputError(name, detail.get("input"), "an object")
    allowed = detail["msg"].removeprefix("Input should be ")
    return InputError(name, detail.get("input"), allowed[:1].lower() + allowed[1:])
