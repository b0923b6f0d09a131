"""Middleware that sends cached tiles before requests are routed."""

from __future__ import annotations

from functools import partial

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from skugga.api.http.server.watching import KEPT
from skugga.api.http.state.encoded_tiles import DrawnBy, EncodedTile
from skugga.api.http.state.service import Service

KEPT_TILE = "/levels/{level}/tiles/{tms}/{z}/{x}/{y} (kept)"
"""The route in metrics and logs of tiles that this middleware sends."""


def drawn_by(service: Service, name: str) -> DrawnBy:
    """Return the versions that the tiles of a level depend on besides their addresses.

    It is ``(None,)`` if a check of the level or its archives is due.
    """
    level = service.levels.unchanged(name)
    archives = None if level is None else service.archives.unchanged_of(level)
    if level is None or archives is None:
        return (None,)
    return level.version, service.pool.renderer, service.pool.plan_version(level.key), archives.version


class SentBefore:
    """Middleware that answers requests for cached tiles before routing."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self.app, self.service = app, service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send a cached tile, or run the application."""
        tile = self._sent(scope) if scope["type"] == "http" and scope["method"] == "GET" else None
        if tile is None:
            await self.app(scope, receive, send)
        else:
            scope[KEPT] = KEPT_TILE
            await tile.answer(Request(scope))(scope, receive, send)

    def _sent(self, scope: Scope) -> EncodedTile | None:
        return self.service.tiles.sent_before(scope, partial(drawn_by, self.service))
