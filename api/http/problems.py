"""Errors as ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException

from api.errors import Outcome, outcome_of
from terrain.errors import Fault, InputError, SkuggaError

MEDIA_TYPE = "application/problem+json"

log = logging.getLogger("skugga")


class Problem(BaseModel):
    """A problem document. ``code`` is stable; ``parameter`` is there where one parameter is to blame."""

    model_config = ConfigDict(frozen=True)

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    code: str
    parameter: str | None = None


def problem_docs(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What OpenAPI says of the statuses of a route's errors."""
    schema = Problem.model_json_schema()
    return {status: {"description": HTTPStatus(status).phrase, "content": {MEDIA_TYPE: {"schema": schema}}} for status in statuses}


def problem_response(
    status: int, code: str, detail: str, parameter: str | None = None, headers: dict[str, str] | None = None
) -> JSONResponse:
    """An answer that no cache keeps."""
    problem = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail, code=code, parameter=parameter)
    return JSONResponse(problem.model_dump(exclude_none=True), status, {"Cache-Control": "no-store", **(headers or {})}, MEDIA_TYPE)


def public_error(request: Request, error: SkuggaError) -> tuple[Outcome, str]:
    """What a domain error means by the table of ``api.errors``, and what clients read of it; what they may not goes to the log."""
    outcome = outcome_of(error)
    if outcome.public is not None:
        log.error("%s %s: %s: %s", request.method, request.url.path, outcome.code, error)
    return outcome, outcome.public or str(error)


def domain_problem(request: Request, error: SkuggaError) -> JSONResponse:
    """A domain error as a problem document."""
    outcome, text = public_error(request, error)
    retry_after_s = getattr(error, "retry_after_s", None) or outcome.retry_after_s
    headers = None if retry_after_s is None else {"Retry-After": str(retry_after_s)}
    # An error that is not the client's blames none of his parameters: its name would be the operator's file.
    parameter = getattr(error, "name", None) if outcome.public is None else None
    return problem_response(outcome.status, outcome.code, text, parameter, headers)


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error of an application as a problem document."""

    async def domain(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, SkuggaError)
        return domain_problem(request, error)

    async def validation(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return domain_problem(request, _first_wrong(error))

    async def http(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        code = HTTPStatus(error.status_code).name.lower()
        detail = {404: f"There is nothing at {request.url.path[:200]}."}.get(error.status_code, str(error.detail))
        return problem_response(error.status_code, code, detail, headers=dict(error.headers or {}))

    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        return problem_response(500, "internal", "Something went wrong inside the service; its log says what.")

    app.add_exception_handler(SkuggaError, domain)
    app.add_exception_handler(RequestValidationError, validation)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(Exception, unexpected)


def _first_wrong(error: RequestValidationError) -> InputError:
    """The first thing that is wrong: a parameter by its name, a part of the body by its path."""
    detail = error.errors()[0]
    where, *path = detail["loc"]
    allowed = detail["msg"].removeprefix("Input should be ")
    allowed = allowed[:1].lower() + allowed[1:]
    if where != "body":
        return InputError(str(detail["loc"][-1]), detail.get("input"), allowed)
    if detail["type"] == "json_invalid":
        return InputError("body", Fault(f"not valid JSON at character {path[0]} ({detail['ctx']['error']})"), "JSON")
    if detail["type"] == "missing":
        return InputError(".".join(str(part) for part in path) or "body", Fault("missing"), "a value: the field is required")
    return InputError(".".join(str(part) for part in path) or "body", detail.get("input"), allowed)
