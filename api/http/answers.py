"""Headers of answers: entity tags known before the work, cache rules, timings and caster reach."""

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

OWN_SUN_S = 3600
"""How long a picture under the level's own sun is fresh: the operator may give the level another one."""

GIVEN_SUN_S = 86400
"""How long a picture under a sun of the request's own is fresh. Not `immutable`: the level's data may still change, and
asking again costs no rendering."""

FACTS_S = 60
"""How long what is said of levels is fresh."""

LEAST_PACKED_BYTES, GZIP_LEVEL = 16 * 1024, 4
"""Documents of so many bytes are compressed: capabilities of many levels are half a megabyte, a twentieth of that compressed."""

ABSENT_S = 86400
"""How long caches may send what they have where the service is away."""

EXPOSED_HEADERS = (
    "Content-Range", "ETag", "Location", "Retry-After", "Server-Timing", "X-Request-ID", "X-Skugga-Algorithm",
    "X-Skugga-Caster-Reach", "X-Skugga-Expected-Time", "X-Skugga-Time",
)  # fmt: skip
"""What pages of other origins may read."""


@dataclass(frozen=True)
class ExpectedTime:
    """How long a picture was expected to take when it was asked for.

    Attributes
    ----------
    wait_s : float
        Seconds until its turn.
    work_s : float
        Seconds of work.
    """

    wait_s: float
    work_s: float

    def headers(self) -> dict[str, str]:
        """The same as a header."""
        return {"X-Skugga-Expected-Time": f"wait={self.wait_s:.1f}; work={self.work_s:.1f}"}


def tag_of(*parts: object) -> str:
    """A strong entity tag of everything that an answer depends on; this package's version is one of the parts."""
    return f'"{hashlib.sha256(repr((VERSION, *parts)).encode()).hexdigest()[:32]}"'


def is_fresh(request: Request, tag: str) -> bool:
    """Whether the client says that it has this very answer (RFC 9110, section 13.1.2: weak comparison)."""
    client_tags = request.headers.get("if-none-match", "")
    return client_tags.strip() == "*" or tag in (part.strip().removeprefix("W/") for part in client_tags.split(","))


def cache_headers(tag: str, fresh_s: int) -> dict[str, str]:
    """Headers of an answer that caches may keep for ``fresh_s`` seconds. For as long again they may send it while they ask anew,
    and longer where they cannot (RFC 5861). What is fresh for less than an hour is never sent stale: it hangs on the clock, on what
    levels are now, or on a calibration or probe to come.
    """
    later = f", stale-while-revalidate={fresh_s}, stale-if-error={ABSENT_S}" if fresh_s >= OWN_SUN_S else ""
    return {"ETag": tag, "Cache-Control": f"public, max-age={fresh_s}{later}"}


def wants_page(request: Request) -> bool:
    """Whether whoever asks is a browser: it takes HTML by name, and JSON not so."""
    accepted = request.headers.get("accept", "")
    return "text/html" in accepted and "application/json" not in accepted


def json_answer(request: Request, value: object, **more: str) -> Response:
    """A JSON answer, with ``more`` headers, or 304 where the client has it."""
    return document_answer(request, bytes(JSONResponse(value).body), JSON_MEDIA, **more)


def document_answer(request: Request, body: bytes, media_type: str, **more: str) -> Response:
    """A document that is said of levels, with ``more`` headers, or 304 where the client has it. A long one is compressed for
    clients that take that, with an entity tag of its own.
    """
    packed = len(body) >= LEAST_PACKED_BYTES and _takes_gzip(request)
    vary = ", ".join(filter(None, (more.pop("Vary", ""), "Accept-Encoding"))) if len(body) >= LEAST_PACKED_BYTES else None
    more |= {} if vary is None else {"Vary": vary}
    headers = cache_headers(tag_of(body, "gzip") if packed else tag_of(body), FACTS_S) | more
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if packed:
        body, headers["Content-Encoding"] = gzip.compress(body, GZIP_LEVEL, mtime=0), "gzip"
    return Response(body, headers=headers, media_type=media_type)


def _takes_gzip(request: Request) -> bool:
    """Whether a client takes ``gzip`` by name, and not with a weight of nothing (RFC 9110, section 12.5.3)."""
    for coding in request.headers.get("accept-encoding", "").lower().split(","):
        name, _, weight = coding.partition(";")
        if name.strip() in ("gzip", "x-gzip"):
            return re.fullmatch(r"\s*q\s*=\s*0(\.0*)?\s*", weight) is None
    return False


def base_url(request: Request, public_url: str | None) -> str:
    """Where clients reach the service, without a slash at the end."""
    return (public_url or str(request.base_url)).rstrip("/")


def drawn_headers(drawn: BlockTiles | Snapshot, subject: str, kept: bool, encode_ms: float) -> dict[str, str]:
    """What a picture says of what it is made of (``subject``: a block or a snapshot): the passes that drew it, whether it was
    drawn for this answer or kept from an earlier one, and caster reach.

    The passes' names are made into tokens: runs of other characters become hyphens.
    """
    timings = [f"{re.sub('[^A-Za-z0-9_]+', '-', name).strip('-')};dur={ms:.1f}" for name, ms in drawn.passes]
    timings += [f"encode;dur={encode_ms:.1f}", f"{subject};desc={'kept' if kept else 'drawn'}"]
    reach = {}
    if drawn.reach_used_m is not None and drawn.reach_needed_m is not None:
        reach = reach_headers(drawn.headline, drawn.reach_used_m, drawn.reach_needed_m, drawn.reach_clipped)
    return {"Server-Timing": ", ".join(timings), **reach}


def reach_headers(algorithm: str, used_m: float = 0.0, needed_m: float = 0.0, clipped: bool = False) -> dict[str, str]:
    """The algorithm, and how far towards the sun casters were looked for and would have had to be, in whole metres."""
    reach = f"used={used_m:.0f}; needed={needed_m:.0f}; clipped={'yes' if clipped else 'no'}"
    return {"X-Skugga-Algorithm": algorithm, "X-Skugga-Caster-Reach": reach}
