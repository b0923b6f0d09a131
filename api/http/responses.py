"""Build documents as responses, and response headers: entity tags, cache rules, timings and the caster reach.

An entity tag depends on the inputs of an answer, so it is known before anything is rendered. The caster reach is the distance
towards the sun in which shadow casters are searched.
"""

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

JSON_MEDIA_TYPE = "application/json"

DEFAULT_SUN_MAX_AGE_S = 3600
"""Freshness lifetime (``max-age``) in seconds of a picture under the level's own sun.

It is short since the operator may change that sun."""

REQUESTED_SUN_MAX_AGE_S = 86400
"""Freshness lifetime in seconds of a picture whose request names the sun.

The answer is not marked ``immutable``: the level's data may still change, and revalidation costs no rendering."""

METADATA_MAX_AGE_S = 60
"""Freshness lifetime in seconds of documents about levels, such as JSON, pages and capabilities."""

MIN_GZIP_BYTES, GZIP_LEVEL = 16 * 1024, 4
"""Size in bytes from which documents are compressed, and gzip's compression level (1 to 9).

Capabilities of many levels have half a megabyte; gzip reduces them to a twentieth."""

STALE_IF_ERROR_S = 86400
"""Seconds of ``stale-if-error``: how long caches may send a stale answer while the service is down."""

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
        """Return the response header ``X-Skugga-Expected-Time`` with both times in seconds."""
        return {"X-Skugga-Expected-Time": f"wait={self.wait_s:.1f}; work={self.work_s:.1f}"}


def entity_tag(*parts: object) -> str:
    """Return a strong entity tag: a digest of ``parts`` and of this package's version.

    ``parts`` are all inputs that the answer depends on.
    """
    return f'"{hashlib.sha256(repr((VERSION, *parts)).encode()).hexdigest()[:32]}"'


def has_current_copy(request: Request, tag: str) -> bool:
    """Return whether the client's copy is current: ``If-None-Match`` has ``tag`` (RFC 9110, section 13.1.2: weak comparison)."""
    client_tags = request.headers.get("if-none-match", "")
    return client_tags.strip() == "*" or tag in (part.strip().removeprefix("W/") for part in client_tags.split(","))


def cache_headers(tag: str, max_age_s: int) -> dict[str, str]:
    """Return the headers ``ETag`` and ``Cache-Control`` of an answer that stays fresh for ``max_age_s`` seconds.

    Caches may send a stale answer for another ``max_age_s`` seconds while they revalidate it, and for ``STALE_IF_ERROR_S`` seconds
    while the service fails (RFC 5861). Answers that are fresh for less than an hour are never sent stale. Such answers depend on
    the clock, on the present levels, or on measurements of the device or the level that are still to come.
    """
    stale_directives = (
        f", stale-while-revalidate={max_age_s}, stale-if-error={STALE_IF_ERROR_S}" if max_age_s >= DEFAULT_SUN_MAX_AGE_S else ""
    )
    return {"ETag": tag, "Cache-Control": f"public, max-age={max_age_s}{stale_directives}"}


def wants_html(request: Request) -> bool:
    """Return whether the client is a browser: its ``Accept`` header names HTML and does not name JSON."""
    accepted = request.headers.get("accept", "")
    return "text/html" in accepted and "application/json" not in accepted


def json_response(request: Request, value: object, **extra_headers: str) -> Response:
    """Return a value as JSON with ``extra_headers``, or 304 if the client's copy is current."""
    return document_response(request, bytes(JSONResponse(value).body), JSON_MEDIA_TYPE, **extra_headers)


def document_response(request: Request, body: bytes, media_type: str, **extra_headers: str) -> Response:
    """Return a document with ``extra_headers``, or 304 if the client's copy is current.

    A long document is compressed for clients that accept gzip. The compressed form has a different entity tag.
    """
    is_compressed = len(body) >= MIN_GZIP_BYTES and _accepts_gzip(request)
    vary = ", ".join(filter(None, (extra_headers.pop("Vary", ""), "Accept-Encoding"))) if len(body) >= MIN_GZIP_BYTES else None
    extra_headers |= {} if vary is None else {"Vary": vary}
    headers = cache_headers(entity_tag(body, "gzip") if is_compressed else entity_tag(body), METADATA_MAX_AGE_S) | extra_headers
    if has_current_copy(request, headers["ETag"]):
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


def render_headers(picture: BlockTiles | Snapshot, picture_kind: str, is_cached: bool, encode_ms: float) -> dict[str, str]:
    """Return headers about the rendering of a picture: ``Server-Timing``, its algorithms and its caster reach.

    ``Server-Timing`` has the milliseconds of each render pass and of encoding (``encode_ms``). An entry named ``picture_kind`` says
    whether the picture came from the cache (``kept``) or was rendered (``drawn``). Hyphens replace the characters of pass names
    that the header does not allow. The headers of ``reach_headers`` follow if the picture has one caster reach.
    """
    timings = [f"{re.sub('[^A-Za-z0-9_]+', '-', name).strip('-')};dur={ms:.1f}" for name, ms in picture.passes]
    timings += [f"encode;dur={encode_ms:.1f}", f"{picture_kind};desc={'kept' if is_cached else 'drawn'}"]
    reach = {}
    if picture.reach_used_m is not None and picture.reach_needed_m is not None:
        reach = reach_headers(picture.headline, picture.reach_used_m, picture.reach_needed_m, picture.reach_clipped)
    return {"Server-Timing": ", ".join(timings), **reach}


def reach_headers(algorithm: str, used_m: float = 0.0, needed_m: float = 0.0, is_clipped: bool = False) -> dict[str, str]:
    """Return headers with the shadow algorithm and the caster reach in whole metres.

    The reach is the distance towards the sun in which shadow casters were searched (``used``) and had to be searched (``needed``).
    ``is_clipped`` says whether the level's data ends before the needed distance.
    """
    reach = f"used={used_m:.0f}; needed={needed_m:.0f}; clipped={'yes' if is_clipped else 'no'}"
    return {"X-Skugga-Algorithm": algorithm, "X-Skugga-Caster-Reach": reach}
