"""Tiles as they were sent: kept, and sent again before anything else is looked at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Scope

from skugga.api.http.answers import is_fresh
from skugga.api.http.moments import TIME_HEADER, is_of_now
from skugga.terrain.cache import MIB, Cache, Missing

DrawnBy = tuple[str | None, ...]
"""What the tiles of a level hang on besides their addresses."""

OVERHEAD_BYTES = 1024
"""What a kept tile, or its address, takes besides a body: headers, tags, and the cache's own."""


@dataclass(frozen=True)
class EncodedTile:
    """A tile's bytes, and what its answer says: the entity tag, how long it is fresh, and how it was made."""

    body: bytes
    headers: dict[str, str]
    media_type: str

    def answer(self, request: Request) -> Response:
        """The answer to a request; 304 where the client has it."""
        if is_fresh(request, self.headers["ETag"]):
            unchanged = {name: value for name, value in self.headers.items() if name in ("ETag", "Cache-Control", TIME_HEADER)}
            return Response(status_code=304, headers=unchanged)
        return Response(self.body, headers=self.headers, media_type=self.media_type)


@dataclass(frozen=True)
class _Sent:
    """What was sent for an address: the tag of a tile, of a version of a level, drawn so."""

    tag: str
    level: str
    drawn: DrawnBy


Address = tuple[str, bytes]
"""Path and query."""


class EncodedTiles:
    """Tiles by entity tag, within so many bytes. To be used from one event loop."""

    def __init__(self, limit_bytes: int) -> None:
        self._kept: Cache[EncodedTile] = Cache(
            "skugga.api.http.state.encoded_tiles", "process", limit_bytes, lambda tile: len(tile.body) + OVERHEAD_BYTES
        )
        self._sent: Cache[_Sent] = Cache("skugga.api.http.tile_addresses", "process", 16 * MIB, lambda _: OVERHEAD_BYTES)
        self.hits, self.misses = 0, 0

    @property
    def kept_bytes(self) -> int:
        """Bytes of all that is kept."""
        return self._kept.nbytes

    def get(self, tag: str) -> EncodedTile | None:
        """A tile that is kept; counted, found or not."""
        tile = self._found(tag)
        self.hits, self.misses = self.hits + (tile is not None), self.misses + (tile is None)
        return tile

    def _found(self, tag: str) -> EncodedTile | None:
        tile = self._kept.get(tag)
        return None if isinstance(tile, Missing) else tile

    def put(self, request: Request, tile: EncodedTile, level: str, drawn: DrawnBy) -> None:
        """Keep a tile, and that a request was answered with it; ``drawn`` is what that hangs on.

        An address that means now is not remembered: soon it means another tile.
        """
        tag = tile.headers["ETag"]
        self._kept.put(tag, value=tile)
        if is_of_now(request):
            return
        self._sent.put(_address(request.scope), value=_Sent(tag, level, drawn))

    def sent_before(self, scope: Scope, drawn_by: Callable[[str], DrawnBy]) -> EncodedTile | None:
        """Return the tile that an address was answered with, if what its level hangs on (``drawn_by``) is unchanged."""
        sent = self._sent.get(_address(scope))
        if isinstance(sent, Missing) or sent.drawn != drawn_by(sent.level):
            return None
        tile = self._found(sent.tag)
        self.hits += tile is not None  # where it is not found, it is looked for again
        return tile


def _address(scope: Scope) -> Address:
    return scope["path"], scope["query_string"]
