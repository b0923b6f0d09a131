"""Build response headers: entity tags known before the work, cache rules, timings and caster reach."""

from __future__ import annotations

import gzip
import hashlib
import re
from dataclasses import dataclass
from importlib.metadata import version

from fastapi import Request, Response
from fastapi.responses import JSONResponse

from skugga.api.workers.jobs import BlockTiles, Snapshot

VERSION = version("skugga")

JSON_MEDIA = "application/json"

DEFAULT_SUN_FRESH_S = 3600
"""Freshness lifetime of a picture under the level's own sun. It is short since the operator may change that sun."""

REQUESTED_SUN_FRESH_S = 86400
"""Freshness lifetime of a picture whose request names the sun.

It is not `immutable`: the level's data may still change, and revalidation costs no rendering."""

METADATA_FRESH_S = 60
"""Freshness lifetime of metadata of levels."""

MIN_GZIP_BYTES, GZIP_LEVEL = 16 * 1024, 4
"""Smallest document that is compressed, and the level of gzip.

Capabilities of many levels have half a megabyte; gzip reduces them to a twentieth."""

STALE_IF_ERROR_S = 86400
"""Duration of ``stale-if-error``: caches may send a stale answer for so long while the service is down."""

EXPOSED_HEADERS = (
    "Content-Range", "ETag", "Location", "Retry-After", "Server-Timing", "X-Request-ID", "X-Skugga-Algorithm",
    "X-Skugga-Caster-Reach", "X-Skugga-Expected-Time", "X-Skugga-Time",
)  # fmt: skip
"""Response headers that scripts of other origins may read (CORS)."""


@dataclass(frozen=True)
class ExpectedTime:
    """Expected time of a picture at the moment of its request.

    Attributes
    ----------
    wait_s : float
        Expected seconds in the queue.
    work_s : float
        Expected seconds of rendering.
    """

    wait_s: float
    work_s: float

    def headers(self) -> dict[str, str]:
        """Return the times as a header."""
        return {"X-Skugga-Expected-Time": f"wait={self.wait_s:.1f}; work={self.work_s:.1f}"}


def entity_tag(*parts: object) -> str:
    """Return a strong entity tag of all parts that an answer depends on, and of this package's version."""
    return f'"{hashlib.sha256(repr((VERSION, *parts)).encode()).hexdigest()[:32]}"'


def is_fresh(request: Request, tag: str) -> bool:
    """Return whether ``If-None-Match`` has the entity tag (RFC 9110, section 13.1.2: weak comparison)."""
    client_tags = request.headers.get("if-none-match", "")
    return client_tags.strip() == "*" or tag in (part.strip().removeprefix("W/") for part in client_tags.split(","))


def cache_headers(tag: str, fresh_s: int) -> dict[str, str]:
    """Return the headers ``ETag`` and ``Cache-Control`` of an answer that stays fresh for ``fresh_s`` seconds.

    Caches may send a stale answer for the same time while they revalidate, and for ``STALE_IF_ERROR_S`` seconds on errors (RFC
    5861). Answers that are fresh for less than an hour are never sent stale. They depend on the clock, on the present levels, or on
    a pending calibration or probe.
    """
    stale_directives = (
        f", stale-while-revalidate={fresh_s}, stale-if-error={STALE_IF_ERROR_S}" if fresh_s >= DEFAULT_SUN_FRESH_S else ""
    )
    return {"ETag": tag, "Cache-Control": f"public, max-age={fresh_s}{stale_directives}"}


def wants_html(request: Request) -> bool:
    """Return whether the client is a browser: its ``Accept`` header names HTML and does not name JSON."""
    accepted = request.headers.get("accept", "")
    return "text/html" in accepted and "application/json" not in accepted


def json_answer(request: Request, value: object, **extra_headers: str) -> Response:
    """Return a JSON answer with ``extra_headers`` headers, or 304 if the client's copy is current."""
    return document_answer(request, bytes(JSONResponse(value).body), JSON_MEDIA, **extra_headers)


def document_answer(request: Request, body: bytes, media_type: str, **extra_headers: str) -> Response:
    """Return a document with ``extra_headers`` headers, or 304 if the client's copy is current.

    A long document is compressed for clients that accept gzip. The compressed form has a different entity tag.
    """
    is_compressed = len(body) >= MIN_GZIP_BYTES and _accepts_gzip(request)
    vary = ", ".join(filter(None, (extra_headers.pop("Vary", ""), "Accept-Encoding"))) if len(body) >= MIN_GZIP_BYTES else None
    extra_headers |= {} if vary is None else {"Vary": vary}
    headers = cache_headers(entity_tag(body, "gzip") if is_compressed else entity_tag(body), METADATA_FRESH_S) | extra_headers
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if is_compressed:
        body, headers["Content-Encoding"] = gzip.compress(body, GZIP_LEVEL, mtime=0), "gzip"
    return Response(body, headers=headers, media_type=media_type)


def _accepts_gzip(request: Request) -> bool:
    """Return whether ``Accept-Encoding`` names gzip with a weight above 0 (RFC 9110, section 12.5.3)."""
    for coding in request.headers.get("accept-encoding", "").lower().split(","):
        name, _, weight = coding.partition(";")
        if name.strip() in ("gzip", "x-gzip"):
            return re.fullmatch(r"\s*q\s*=\s*0(\.0*)?\s*", weight) is None
    return False


def base_url(request: Request, public_url: str | None) -> str:
    """Return the service's public URL without a trailing slash."""
    return (public_url or str(request.base_url)).rstrip("/")


def render_headers(picture: BlockTiles | Snapshot, subject: str, is_cached: bool, encode_ms: float) -> dict[str, str]:
    """Return headers with the render passes of a picture, whether it came from the cache, and its caster reach.

    ``subject`` is the kind of picture: a block or a snapshot. Pass names become tokens: hyphens replace runs of other
    characters.
    """
    timings = [f"{re.sub('[^A-Za-z0-9_]+', '-', name).strip('-')};dur={ms:.1f}" for name, ms in picture.passes]
    timings += [f"encode;dur={encode_ms:.1f}", f"{subject};desc={'kept' if is_cached else 'drawn'}"]
    reach = {}
    if picture.reach_used_m is not None and picture.reach_needed_m is not None:
        reach = reach_headers(picture.headline, picture.reach_used_m, picture.reach_needed_m, picture.reach_clipped)
    return {"Server-Timing": ", ".join(timings), **reach}


def reach_headers(algorithm: str, used_m: float = 0.0, needed_m: float = 0.0, clipped: bool = False) -> dict[str, str]:
    """Return headers with the algorithm and the caster reach in whole metres.

    The reach is the distance towards the sun in which shadow casters were searched (``used``) and had to be searched (``needed``).
    """
    reach = f"used={used_m:.0f}; needed={needed_m:.0f}; clipped={'yes' if clipped else 'no'}"
    return {"X-Skugga-Algorithm": algorithm, "X-Skugga-Caster-Reach": reach}
