"""Read tiles from PMTiles archives, and add response headers to them."""

from __future__ import annotations

import hashlib
import logging

from starlette.concurrency import run_in_threadpool

from skugga.api.errors import ArchiveError
from skugga.api.http.responses import cache_headers, entity_tag
from skugga.api.http.state.archive_file import ArchiveFile
from skugga.api.http.state.encoded_tiles import EncodedTile

log = logging.getLogger("skugga")


async def read_tile(archive: ArchiveFile, zoom: int, x: int, y: int) -> bytes | None:
    """Read the bytes of an archive's tile in a thread; ``None`` if the archive lacks it. Logs and raises ``ArchiveError``.

    ``x`` is the column from the west, and ``y`` the row from the north.
    """
    try:
        return await run_in_threadpool(archive.tile, zoom, x, y)
    except ArchiveError as error:
        log.error("archive %s", error)
        raise


def archived_tile(body: bytes, archive: ArchiveFile, max_age_s: int, *request_parts: object, **extra_headers: str) -> EncodedTile:
    """Return a tile of an archive with its response headers and ``extra_headers``.

    ``body`` has the tile's bytes, and ``max_age_s`` is the freshness lifetime in seconds. The entity tag depends only on the
    tile's bytes and on ``request_parts``. So the tag stays the same if the archive is replaced by another one with the same
    tile. All services with the tile have the same tag.
    """
    tag = entity_tag("archived", hashlib.blake2b(body, digest_size=16).hexdigest(), *request_parts)
    return EncodedTile(
        body, {**cache_headers(tag, max_age_s), "Server-Timing": "archive;desc=read", **extra_headers}, archive.media_type
    )
