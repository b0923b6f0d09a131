"""Which pages of other origins may read answers."""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import Message, Receive, Scope, Send


class CrossOrigin(CORSMiddleware):
    """Starlette's, but for what shared caches make of it: where all origins may read, an answer is the same for all, also for a
    request that names none; else it says that it depends on the origin, whether or not one was named.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application, or answer what a browser asks beforehand."""
        if scope["type"] == "http" and scope["method"] != "OPTIONS":
            await self.simple_response(scope, receive, send, request_headers=Headers(scope=scope))
        else:
            await super().__call__(scope, receive, send)

    async def send(self, message: Message, send: Send, request_headers: Headers) -> None:
        """Give an answer its headers."""
        if message["type"] == "http.response.start":
            headers, origin = MutableHeaders(scope=message), request_headers.get("Origin")
            if self.allow_all_origins:
                headers.update(self.simple_headers)
            else:
                headers.add_vary_header("Origin")
                if origin is not None and self.is_allowed_origin(origin=origin):
                    headers.update({**self.simple_headers, "Access-Control-Allow-Origin": origin})
        await send(message)
