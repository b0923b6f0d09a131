"""CORS headers that work with shared caches."""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import Message, Receive, Scope, Send


class SharedCacheCorsMiddleware(CORSMiddleware):
    """Starlette's CORS middleware with headers that are safe for shared caches.

    With all origins allowed, answers have the same headers for every request, even without ``Origin``. Otherwise every answer has
    ``Vary: Origin``.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application, or answer a preflight request."""
        if scope["type"] == "http" and scope["method"] != "OPTIONS":
            await self.simple_response(scope, receive, send, request_headers=Headers(scope=scope))
        else:
            await super().__call__(scope, receive, send)

    async def send(self, message: Message, send: Send, request_headers: Headers) -> None:
        """Add the CORS headers to an answer and send it."""
        if message["type"] == "http.response.start":
            headers, origin = MutableHeaders(scope=message), request_headers.get("Origin")
            if self.allow_all_origins:
                headers.update(self.simple_headers)
            else:
                headers.add_vary_header("Origin")
                if origin is not None and self.is_allowed_origin(origin=origin):
                    headers.update({**self.simple_headers, "Access-Control-Allow-Origin": origin})
        await send(message)
