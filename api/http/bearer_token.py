"""A token that clients have to show, where the settings have one."""

from __future__ import annotations

import hmac

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from api.http.problems import problem_response

OPEN_PATHS = {"/healthz", "/readyz"}
"""What needs no token: whoever watches the service's health has none."""


class BearerToken:
    """Refuses requests without the header ``Authorization: Bearer TOKEN`` (RFC 6750), but for health and preflight requests."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self.app, self._expected = app, f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application."""
        if scope["type"] == "http" and scope["path"] not in OPEN_PATHS and scope["method"] != "OPTIONS":
            given = Request(scope).headers.get("authorization", "").encode("latin-1", "replace")
            if not hmac.compare_digest(given, self._expected):
                headers = {"WWW-Authenticate": "Bearer"}
                answer = problem_response(401, "unauthorized", "A token is needed: Authorization: Bearer TOKEN.", headers=headers)
                await answer(scope, receive, send)
                return
        await self.app(scope, receive, send)
