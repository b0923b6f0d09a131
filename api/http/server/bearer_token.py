"""Authentication with a bearer token, if the settings have one."""

from __future__ import annotations

import hmac

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skugga.api.http.problems import problem_of, problem_response

PUBLIC_PATHS = {"/healthz", "/readyz"}
"""Paths that need no token, since health checks of load balancers and orchestrators send none."""


class BearerTokenMiddleware:
    """Middleware that rejects requests without ``Authorization: Bearer TOKEN`` (RFC 6750), except for health checks.

    It marks answers as ``private`` in ``Cache-Control``: a shared cache would also send public answers to clients without a token.
    """

    def __init__(self, app: ASGIApp, token: str) -> None:
        self.app, self._expected = app, f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application if the request has the token or needs none; otherwise answer 401."""
        if scope["type"] == "http" and scope["path"] not in PUBLIC_PATHS:
            authorization = Request(scope).headers.get("authorization", "").encode("latin-1", "replace")
            if not hmac.compare_digest(authorization, self._expected):
                await problem_response(problem_of(401), {"WWW-Authenticate": "Bearer"})(scope, receive, send)
                return

        async def send_private(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if "Cache-Control" in headers:
                    headers["Cache-Control"] = headers["Cache-Control"].replace("public", "private")
            await send(message)

        await self.app(scope, receive, send_private)
