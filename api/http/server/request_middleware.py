"""Middleware around every request: request id, access log, metrics, and the headers that all answers have."""

from __future__ import annotations

import json
import logging
import re
import secrets
import time
from contextvars import ContextVar
from typing import Any

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skugga.api.http.problems import logged_error_response, problem_of, problem_response
from skugga.api.http.request_times import TIME_HEADER
from skugga.api.http.state.metrics import ServiceMetrics
from skugga.api.resource_exhaustion import exhausted_error

REQUEST_ID_HEADER = "X-Request-ID"
REQUEST_ID_PATTERN = re.compile(r"[A-Za-z0-9._-]{1,64}")
"""Accepted request ids of clients: without characters that are special in logs, headers or HTML."""

CACHED_ROUTE_KEY = "skugga.kept"
"""Key of the ASGI scope with the path template of a request that was answered from the cache.

Starlette has not set a route then, since the answer is sent before routing."""


def content_security_policy(tile_sources: str = "'self'") -> str:
    """Return the Content-Security-Policy (level 3) of a page.

    The page may load resources of this service only, except images and data, which may come from ``tile_sources``. Workers from
    blobs are allowed, since the map library creates workers from its own code.
    """
    return (
        f"default-src 'self'; img-src {tile_sources} data: blob:; connect-src {tile_sources}; style-src 'self' 'unsafe-inline'; "
        "worker-src 'self' blob:; child-src blob:; object-src 'none'; base-uri 'self'; frame-ancestors 'self'"
    )


CLIENT_CLOSED_REQUEST = 499
"""Status in logs and metrics of a request whose client has disconnected (as in nginx). No client receives it."""

KNOWN_METHODS = {"GET", "HEAD", "POST", "DELETE", "OPTIONS"}

request_id: ContextVar[str] = ContextVar("request_id", default="")

log = logging.getLogger("skugga")
access_logger = logging.getLogger("skugga.access")


class RequestMiddleware:
    """The outermost middleware: gives requests ids, counts and times them, and answers unexpected errors."""

    def __init__(self, app: ASGIApp, metrics: ServiceMetrics, access_log: bool) -> None:
        self.app, self.metrics, self.access_log = app, metrics, access_log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application, and add the common headers to its answer. Answer 500, or 503 without resources, if it raises."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        began_s, status, sent_bytes = time.perf_counter(), 0, 0
        id_ = _request_id_of(scope)
        token = request_id.set(id_)
        scope.setdefault("state", {})

        async def send_with_headers(message: Message) -> None:
            nonlocal status, sent_bytes
            if message["type"] == "http.response.start":
                status = message["status"]
                _add_common_headers(MutableHeaders(scope=message), scope, id_, (time.perf_counter() - began_s) * 1000.0)
            sent_bytes += len(message.get("body", b""))
            await send(message)

        self.metrics.in_progress.inc()
        try:
            await self.app(scope, receive, send_with_headers)
        except Exception as error:
            exhausted = exhausted_error(error)
            if exhausted is None:
                log.exception("%s %s failed unexpectedly", scope["method"], _loggable(scope["path"]))
            if not status:
                answer = (
                    problem_response(problem_of(500)) if exhausted is None else logged_error_response(Request(scope), exhausted)
                )
                await answer(scope, receive, send_with_headers)
        finally:
            duration_s = time.perf_counter() - began_s
            self.metrics.in_progress.dec()
            self._count_request(scope, status or CLIENT_CLOSED_REQUEST, duration_s)
            if self.access_log:
                self._log_access(scope, status or CLIENT_CLOSED_REQUEST, duration_s, sent_bytes)
            request_id.reset(token)

    def _count_request(self, scope: Scope, status: int, duration_s: float) -> None:
        """Count a request by route, method and status, and record its duration in seconds."""
        route, method = _route_template(scope), scope["method"] if scope["method"] in KNOWN_METHODS else "other"
        self.metrics.requests.labels(route, method, str(status)).inc()
        self.metrics.request_seconds.labels(route).observe(duration_s)

    def _log_access(self, scope: Scope, status: int, duration_s: float, sent_bytes: int) -> None:
        """Write a request to the access log. ``duration_s`` is in seconds; ``sent_bytes`` is the size of the body that was sent."""
        client = scope.get("client") or ("",)
        access_logger.info(
            "request",
            extra={
                "fields": {
                    "client": client[0], "method": scope["method"][:20], "path": _loggable(scope["path"]),
                    "query": _loggable(scope["query_string"].decode("latin-1")), "route": _route_template(scope), "status": status,
                    "ms": round(duration_s * 1000.0, 1), "bytes": sent_bytes,
                }
            },
        )  # fmt: skip


class LogFormatter(logging.Formatter):
    """Log formatter with the request id in each line, as text or as JSON."""

    def __init__(self, as_json: bool = False) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s")
        self._as_json = as_json

    def format(self, record: logging.LogRecord) -> str:
        """Return a line of text followed by its traceback, or one line of JSON that includes it."""
        fields: dict[str, Any] = getattr(record, "fields", {})
        id_ = request_id.get()
        if not self._as_json:
            field_texts = [f"{name}={json.dumps(value) if isinstance(value, str) else value}" for name, value in fields.items()]
            line = super().format(record)
            first_line, newline, traceback = line.partition("\n")
            return " ".join([first_line, *field_texts, *([f"[{id_}]"] if id_ else [])]) + newline + traceback
        value = {"time": self.formatTime(record), "level": record.levelname, "message": record.getMessage()}
        if id_:
            value["request_id"] = id_
        if record.exc_info:
            value["traceback"] = self.formatException(record.exc_info)
        return json.dumps({**value, **fields})


def _request_id_of(scope: Scope) -> str:
    """Return the request id that the client has sent, or a new random one if it has sent none or an invalid one."""
    sent_id = dict(scope["headers"]).get(REQUEST_ID_HEADER.lower().encode(), b"").decode("latin-1")
    return sent_id if REQUEST_ID_PATTERN.fullmatch(sent_id) else secrets.token_hex(8)


def _add_common_headers(headers: MutableHeaders, scope: Scope, id_header: str, duration_ms: float) -> None:
    """Add the headers that all answers have. ``duration_ms`` is the time since the request arrived."""
    headers[REQUEST_ID_HEADER] = id_header
    headers["X-Content-Type-Options"] = "nosniff"
    timings = headers.get("Server-Timing")
    headers["Server-Timing"] = f"{timings}, total;dur={duration_ms:.1f}" if timings else f"total;dur={duration_ms:.1f}"
    sun_time = scope["state"].get("request_time")
    if sun_time is not None and TIME_HEADER not in headers:
        headers[TIME_HEADER] = sun_time.time.isoformat()
    location, public_url = headers.get("Location"), scope["app"].state.service.settings.public_url if "app" in scope else None
    if location is not None and public_url is not None:
        internal_url = str(Request(scope).base_url)
        if location.startswith(internal_url):  # a redirect of Starlette
            headers["Location"] = f"{public_url.rstrip('/')}/{location.removeprefix(internal_url)}"
    expected = scope["state"].get("expected_time")
    if expected is not None:
        headers.update(expected.headers())
    if headers.get("Content-Type", "").startswith("text/html"):
        headers.setdefault("Content-Security-Policy", content_security_policy())
        headers["Referrer-Policy"] = "same-origin"


def _route_template(scope: Scope) -> str:
    """Return the path template of a request's route, without parts that a client can choose; ``other`` without a route."""
    route = scope.get(CACHED_ROUTE_KEY) or getattr(scope.get("route"), "path", None)
    return str(route) if route else "other"


def _loggable(text: str) -> str:
    """Return a client's text for a log: at most 500 printable ASCII characters, with ``?`` for all others."""
    return re.sub(r"[^\x20-\x7e]", "?", text[:500])
