"""Tiles as they lie in archives."""

from __future__ import annotations

import hashlib
import logging

from starlette.concurrency import run_in_threadpool

from skugga.api.errors import ArchiveError
from skugga.api.http.answers import cache_headers, tag_of
from skugga.api.http.state.archive_file import ArchiveFile
from skugga.api.http.state.encoded_tiles import EncodedTile

log = logging.getLogger("skugga")


async def read_tile(archive: ArchiveFile, zoom: int, x: int, y: int) -> bytes | None:
    """A tile of an archive, read in a thread; ``None`` where it has none. Raises ``ArchiveError``, of which the log tells."""
    try:
        return await run_in_threadpool(archive.tile, zoom, x, y)
    except ArchiveError as error:
        log.error("archive %s", error)
        raise


def archived_tile(body: bytes, archive: ArchiveFile, fresh_s: int, *asked: object, **more: str) -> EncodedTile:
    """A tile that was read, with ``more`` headers. The tag is of its bytes and of what was ``asked``: it stays the same in all
    services that have the tile, and where an archive is replaced that has it again.
    """
    tag = tag_of("archived", hashlib.blake2b(body, digest_size=16).hexdigest(), *asked)
    return EncodedTile(body, {**cache_headers(tag, fresh_s), "Server-Timing": "archive;desc=read", **more}, archive.media_type)
