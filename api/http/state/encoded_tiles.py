"""Cache of encoded tiles, found by entity tag or by the request's address.

A middleware answers requests from this cache before they are routed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Scope

from skugga.api.http.request_times import TIME_HEADER, requests_current_time
from skugga.api.http.responses import has_current_copy
from skugga.terrain.cache import MIB, Cache, Missing

TileVersions = tuple[str | None, ...]
"""Versions of everything that the tiles of a level depend on, except their addresses.

These are the versions of the level, the renderer, the plans and the level's archives."""

ENTRY_OVERHEAD_BYTES = 1024
"""Estimated bytes of a cache entry without its body: headers, tags and the cache's own overhead."""


@dataclass(frozen=True)
class EncodedTile:
    """An encoded tile with its response headers.

    Attributes
    ----------
    body : bytes
        The encoded tile.
    headers : dict of str to str
        Response headers: entity tag, freshness lifetime and timings.
    media_type : str
        Media type of the body.
    """

    body: bytes
    headers: dict[str, str]
    media_type: str

    def response(self, request: Request) -> Response:
        """Return the response to a request; 304 if the client's copy is current."""
        if has_current_copy(request, self.headers["ETag"]):
            not_modified_headers = {
                name: value for name, value in self.headers.items() if name in ("ETag", "Cache-Control", TIME_HEADER)
            }
            return Response(status_code=304, headers=not_modified_headers)
        return Response(self.body, headers=self.headers, media_type=self.media_type)


@dataclass(frozen=True)
class _AddressEntry:
    """The cached tile of an address.

    Attributes
    ----------
    tag : str
        Entity tag of the tile.
    level : str
        Name of its level.
    versions : tuple of str or None
        Versions that the tile depends on.
    """

    tag: str
    level: str
    versions: TileVersions


RequestAddress = tuple[str, bytes]
"""Path and query string of a request."""


class EncodedTiles:
    """A cache of encoded tiles by entity tag, with a limit in bytes, and an index of these tiles by address.

    Use it from one event loop: it is not thread-safe.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._by_tag: Cache[EncodedTile] = Cache(
            "skugga.api.http.state.encoded_tiles", "process", limit_bytes, lambda tile: len(tile.body) + ENTRY_OVERHEAD_BYTES
        )
        self._by_address: Cache[_AddressEntry] = Cache(
            "skugga.api.http.tile_addresses", "process", 16 * MIB, lambda _: ENTRY_OVERHEAD_BYTES
        )
        self.hits, self.misses = 0, 0

    @property
    def cached_bytes(self) -> int:
        """Bytes of the cached tiles."""
        return self._by_tag.nbytes

    def get(self, tag: str) -> EncodedTile | None:
        """Return the cached tile with an entity tag, or ``None``. Count the hit or miss."""
        tile = self._lookup(tag)
        self.hits, self.misses = self.hits + (tile is not None), self.misses + (tile is None)
        return tile

    def _lookup(self, tag: str) -> EncodedTile | None:
        """Return the cached tile with an entity tag, or ``None``. Does not count a hit or miss."""
        tile = self._by_tag.get(tag)
        return None if isinstance(tile, Missing) else tile

    def put(self, request: Request, tile: EncodedTile, level: str, versions: TileVersions) -> None:
        """Cache a tile by its entity tag, and add the request's address to the index.

        ``level`` is the level's name, and ``versions`` are the versions that the tile depends on. The address of a request for
        the time ``current`` is not added, since it soon means another tile.
        """
        tag = tile.headers["ETag"]
        self._by_tag.put(tag, value=tile)
        if requests_current_time(request):
            return
        self._by_address.put(_address(request.scope), value=_AddressEntry(tag, level, versions))

    def cached_tile(self, scope: Scope, tile_versions: Callable[[str], TileVersions]) -> EncodedTile | None:
        """Return the cached tile of a request's address; ``None`` without one, and if the level has changed since.

        ``tile_versions`` returns the present versions for a level's name.
        """
        entry = self._by_address.get(_address(scope))
        if isinstance(entry, Missing) or entry.versions != tile_versions(entry.level):
            return None
        tile = self._lookup(entry.tag)
        self.hits += tile is not None  # a miss is counted later, by ``get``
        return tile


def _address(scope: Scope) -> RequestAddress:
    """Return the path and the query string of a request."""
    return scope["path"], scope["query_string"]
