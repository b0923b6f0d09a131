"""Middleware that sends cached tiles before requests are routed."""

from __future__ import annotations

from functools import partial

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from skugga.api.http.server.request_middleware import CACHED_ROUTE_KEY
from skugga.api.http.state.encoded_tiles import EncodedTile, TileVersions
from skugga.api.http.state.service import Service

CACHED_TILE_ROUTE = "/levels/{level}/tiles/{tms}/{z}/{x}/{y} (kept)"
"""The route in metrics and logs of tiles that this middleware sends."""


def tile_versions(service: Service, level_name: str) -> TileVersions:
    """Return the versions that the tiles of a level depend on: of the level, the renderer, its plans and its archives.

    The result is ``(None,)`` if the files of the level or its archives must be checked first. No cached tile has this version.
    """
    level = service.levels.fresh_level(level_name)
    archives = None if level is None else service.archives.fresh_archives_of(level)
    if level is None or archives is None:
        return (None,)
    return level.version, service.pool.renderer, service.pool.plan_version(level.key), archives.version


class TileCacheMiddleware:
    """Middleware that answers requests for cached tiles before routing."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self.app, self.service = app, service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the cached tile of the request's address if there is one, else run the application."""
        tile = self._cached_tile(scope) if scope["type"] == "http" and scope["method"] == "GET" else None
        if tile is None:
            await self.app(scope, receive, send)
        else:
            scope[CACHED_ROUTE_KEY] = CACHED_TILE_ROUTE
            await tile.response(Request(scope))(scope, receive, send)

    def _cached_tile(self, scope: Scope) -> EncodedTile | None:
        """Return the cached tile of a request's address, or ``None`` if there is none or it may be outdated."""
        return self.service.tiles.cached_tile(scope, partial(tile_versions, self.service))
