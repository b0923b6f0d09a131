"""Exception handlers that answer every error with a problem document."""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.routing import Match, Mount

from skugga.api.http.problems import logged_error_response, problem_of, problem_response
from skugga.api.http.responses import wants_html
from skugga.api.http.server.not_found import not_found_page
from skugga.terrain.errors import InputError, Problem, SkuggaError, printable
from skugga.terrain.level.level_errors import UNKNOWN_KEY, allowed_phrase


def install_problem_handlers(app: FastAPI) -> None:
    """Install handlers that answer every error of an application with a problem document."""

    async def handle_skugga_error(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, SkuggaError)
        return logged_error_response(request, error)

    async def handle_validation_error(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return logged_error_response(request, _first_error(error))

    async def handle_http_error(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = ", ".join(_methods_at(request))
        details = {
            400: "body: cannot be read. Send JSON in UTF-8, not nested too deeply.",  # before routing only the body is parsed
            404: f"Nothing is served at {printable(request.url.path[:200])}.",
            405: f"{request.method[:20]} is not allowed here. Allowed: {headers.get('Allow')}.",
        }
        detail = details.get(error.status_code, str(error.detail))
        if error.status_code == 404 and wants_html(request):
            return not_found_page(request, detail)
        parameter = "body" if error.status_code in (400, 413) else None
        return problem_response(problem_of(error.status_code, detail, parameter=parameter), headers)

    async def handle_unexpected_error(request: Request, error: Exception) -> JSONResponse:
        return problem_response(problem_of(500))

    app.add_exception_handler(SkuggaError, handle_skugga_error)
    app.add_exception_handler(RequestValidationError, handle_validation_error)
    app.add_exception_handler(HTTPException, handle_http_error)
    app.add_exception_handler(Exception, handle_unexpected_error)


def _methods_at(request: Request) -> list[str]:
    """Return the HTTP methods of all routes that match a request's path. Starlette reports only the first route's methods."""

    def is_allowed(method: str) -> bool:
        scope = {**request.scope, "method": method}
        routes = [route for route in request.app.routes if method == "GET" or not isinstance(route, Mount)]  # mounts: files
        return any(route.matches(scope)[0] is Match.FULL for route in routes)

    return [*(["GET", "HEAD"] if is_allowed("GET") else []), *(method for method in ("POST", "DELETE") if is_allowed(method))]


def _first_error(error: RequestValidationError) -> InputError:
    """Convert the first of FastAPI's validation errors. The result names a parameter, or the path of a value in the body."""
    detail = error.errors()[0]
    location, *path = detail["loc"]
    name = ".".join(str(part) for part in path) or "body" if location == "body" else str(detail["loc"][-1])
    if detail["type"] == "json_invalid":
        return InputError("body", Problem(f"not valid JSON at character {path[0]} ({detail['ctx']['error']})"), "Send JSON")
    if detail["type"] == "missing":
        return InputError.missing(name, "Give a value")
    if location == "body" and isinstance(detail.get("input"), bytes):
        return InputError("body", Problem("not sent as JSON"), "Send JSON with Content-Type: application/json")
    if detail["type"] == UNKNOWN_KEY:
        location = ".".join([*map(str, path), detail["ctx"]["key"]])
        return InputError(location, Problem("unknown key"), f"Allowed keys: {detail['ctx']['known']}")
    if detail["type"] == "extra_forbidden":
        return InputError(name, Problem("unknown key"), "Omit it")
    if detail["type"] == "model_attributes_type":
        return InputError(name, detail.get("input"), "an object")
    return InputError(name, detail.get("input"), allowed_phrase(detail))
