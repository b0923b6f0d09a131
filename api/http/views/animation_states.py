"""Build the responses about an animation: its state as JSON, and its film (a WebP or MP4 file).

The state has the names of OGC API - Processes.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import AsyncIterator
from datetime import datetime
from typing import Literal

from fastapi import Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel, Field

from skugga.api.animations.animation import Animation, AnimationStatus
from skugga.api.animations.animations import Animations
from skugga.api.animations.film_file import FilmReader
from skugga.api.errors import NotServedError, UnfinishedError
from skugga.api.http.problems import Problem, error_response, public_problem
from skugga.api.http.responses import entity_tag, has_current_copy
from skugga.api.settings import Settings

FILM_MEDIA_TYPES: dict[str, str] = {"webp": "image/webp", "mp4": "video/mp4"}

RESULTS_RELATION = "http://www.opengis.net/def/rel/ogc/1.0/results"
"""Link relation from a job to its results (OGC API - Processes)."""

_BYTE_RANGE_PATTERN = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


class Link(BaseModel):
    """A link to another address."""

    href: str
    rel: str
    type: str
    title: str


class AnimationState(BaseModel):
    """The state of an animation.

    ``progress`` is in per cent. ``seconds_left`` is the expected time until the film is finished, including animations before it in
    the queue. ``problem`` is the reason of a failure. The film is kept until ``expires`` at most, and less if space runs out.
    """

    job_id: str = Field(serialization_alias="jobID")
    type: Literal["process"] = "process"
    process_id: Literal["animation"] = Field(default="animation", serialization_alias="processID")
    status: AnimationStatus
    message: str
    progress: int = Field(ge=0, le=100)
    frames: int
    frames_done: int
    seconds_left: float | None
    created: datetime
    started: datetime | None
    updated: datetime | None
    finished: datetime | None
    expires: datetime | None
    problem: Problem | None = None
    links: list[Link]


def animation_state_of(animation: Animation, animations: Animations, address: str) -> AnimationState:
    """Return the state of an animation. ``address`` is the URL of the animation, for links."""
    done, frames = animation.frames_done, animation.spec.span.frames
    links = [Link(href=address, rel="self", type="application/json", title="The state")]
    if animation.status == "successful":
        media_type = FILM_MEDIA_TYPES[animation.spec.format]
        links.append(Link(href=f"{address}/result", rel=RESULTS_RELATION, type=media_type, title="The film"))
    problem = None if animation.error is None else public_problem(animation.error)
    messages: dict[AnimationStatus, str] = {
        "accepted": "The animation is in the queue.", "running": f"{done} of {frames} frames are drawn.",
        "successful": "The film is ready.", "failed": "" if problem is None else problem.detail,
        "dismissed": animation.message or "",
    }  # fmt: skip
    return AnimationState(
        job_id=animation.id, status=animation.status, message=messages[animation.status], progress=100 * done // frames,
        frames=frames, frames_done=done,
        seconds_left=None if animation.has_ended else round(animations.seconds_left(animation), 1),
        created=animation.created, started=animation.started, updated=animation.updated, finished=animation.finished,
        expires=animation.expires, problem=problem, links=links,
    )  # fmt: skip


def state_response(status: int, state: AnimationState, settings: Settings) -> Response:
    """Return a state as JSON with an HTTP ``status``. Caches must not store it.

    ``Location`` is the animation's URL. ``Retry-After`` is present until the animation has ended.
    """
    headers = {"Cache-Control": "no-store", "Location": state.links[0].href}
    if state.seconds_left is not None:
        headers["Retry-After"] = str(poll_after_s(state.seconds_left, settings))
    excluded = {"problem"} if state.problem is None else None
    return JSONResponse(state.model_dump(mode="json", by_alias=True, exclude=excluded), status, headers)


def poll_after_s(seconds_left: float, settings: Settings) -> int:
    """Return the whole seconds after which a client should poll again: the expected time left, at least 1.

    It is at most a third of ``animation_abandoned_s``, the time after which an animation that no client polls is dismissed.
    """
    return max(math.ceil(min(seconds_left, settings.animation_abandoned_s / 3.0)), 1)


def film_response(request: Request, animation: Animation, animations: Animations, settings: Settings) -> Response:
    """Return the film, the bytes of it that ``Range`` asks for, or 304; for a failed animation return its problem.

    Raises ``UnfinishedError`` for an unfinished animation and ``NotServedError`` for a dismissed one.
    """
    if animation.error is not None:
        return error_response(animation.error)
    if animation.status == "dismissed":
        raise NotServedError("animation", f"This animation was dismissed. {animation.message or ''}".strip())
    if animation.film is None:
        message = f"{animation.frames_done} of {animation.spec.span.frames} frames of this animation are drawn."
        raise UnfinishedError(message, poll_after_s(animations.seconds_left(animation), settings))
    nbytes = animation.film.nbytes
    headers = {
        "ETag": entity_tag("animation", animation.id), "Accept-Ranges": "bytes",
        "Cache-Control": f"private, max-age={int(settings.animation_age_s)}",
    }  # fmt: skip
    if has_current_copy(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if_range = request.headers.get("if-range", headers["ETag"])
    part = parse_byte_range(request.headers.get("range", ""), nbytes) if if_range == headers["ETag"] else None
    first, end = part or (0, nbytes)
    headers |= {"Content-Length": str(end - first)} | ({"Content-Range": f"bytes {first}-{end - 1}/{nbytes}"} if part else {})
    reader = animation.film.open_reader(first, end)
    return StreamingResponse(
        _read_chunks(reader), 206 if part else 200, headers=headers, media_type=FILM_MEDIA_TYPES[animation.spec.format]
    )


def parse_byte_range(text: str, nbytes: int) -> tuple[int, int] | None:
    """Return the begin and the end of the bytes that a header ``Range`` asks for (RFC 9110, section 14).

    The end is the index after the last byte. ``nbytes`` is the size of the file. The result is ``None`` for an invalid text,
    several ranges, or a range outside the file. The service then sends the whole file, as the RFC allows.
    """
    match = _BYTE_RANGE_PATTERN.fullmatch(text.strip())
    if match is None or not any(match.groups()):
        return None
    first, last = match.groups()
    begin = int(first) if first else max(nbytes - int(last), 0)
    end = min(int(last) + 1, nbytes) if first and last else nbytes
    return (begin, end) if begin < end else None


async def _read_chunks(reader: FilmReader) -> AsyncIterator[bytes]:
    """Yield the bytes of a film in chunks that are read in a thread, and close the reader."""
    try:
        while chunk := await asyncio.to_thread(reader.read_chunk):
            yield chunk
    finally:
        reader.close()
