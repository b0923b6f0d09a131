"""What is told of an animation: its state as JSON, with the words of OGC API - Processes, and the bytes of its film."""

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
from skugga.api.animations.film_file import Reading
from skugga.api.errors import NotServedError, UnfinishedError
from skugga.api.http.answers import is_fresh, tag_of
from skugga.api.http.problems import Problem, problem_response, public_problem
from skugga.api.settings import Settings

FILM_MEDIA: dict[str, str] = {"webp": "image/webp", "mp4": "video/mp4"}

RESULTS = "http://www.opengis.net/def/rel/ogc/1.0/results"
"""Relation of a link to what a job has made."""

_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


class Link(BaseModel):
    """Another address, and what is there."""

    href: str
    rel: str
    type: str
    title: str


class AnimationState(BaseModel):
    """How far an animation is. ``progress`` is in per cent; ``seconds_left`` is how long all of it is expected to take yet, those
    before it included; ``problem`` says why it failed. A film is there until ``expires``, if there is room for so long.
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


def state_of(animation: Animation, animations: Animations, address: str) -> AnimationState:
    """The state of an animation whose ``address`` it is."""
    done, frames = animation.frames_done, animation.order.span.frames
    links = [Link(href=address, rel="self", type="application/json", title="How far it is")]
    if animation.status == "successful":
        media_type = FILM_MEDIA[animation.order.format]
        links.append(Link(href=f"{address}/result", rel=RESULTS, type=media_type, title="The film"))
    told = None if animation.error is None else public_problem(animation.error)
    messages: dict[AnimationStatus, str] = {
        "accepted": "It waits for its turn.", "running": f"{done} of {frames} frames are drawn.",
        "successful": "The film is there.", "failed": "" if told is None else told.detail,
        "dismissed": animation.message or "",
    }  # fmt: skip
    return AnimationState(
        job_id=animation.id, status=animation.status, message=messages[animation.status], progress=100 * done // frames,
        frames=frames, frames_done=done,
        seconds_left=None if animation.ended else round(animations.seconds_left(animation), 1),
        created=animation.created, started=animation.started, updated=animation.updated, finished=animation.finished,
        expires=animation.expires, problem=told, links=links,
    )  # fmt: skip


def state_answer(status: int, state: AnimationState, settings: Settings) -> Response:
    """A state as JSON, which no cache keeps; with its address, and when to ask again where there is news to come."""
    headers = {"Cache-Control": "no-store", "Location": state.links[0].href}
    if state.seconds_left is not None:
        headers["Retry-After"] = str(retry_s(state.seconds_left, settings))
    without = {"problem"} if state.problem is None else None
    return JSONResponse(state.model_dump(mode="json", by_alias=True, exclude=without), status, headers)


def retry_s(seconds_left: float, settings: Settings) -> int:
    """When to ask again, in whole seconds: when all is expected to be done, but long before it is given up because nobody asks."""
    return max(math.ceil(min(seconds_left, settings.animation_abandoned_s / 3.0)), 1)


def film_answer(request: Request, animation: Animation, animations: Animations, settings: Settings) -> Response:
    """The film, or the part of it that is asked for by ``Range``; the problem of one that failed.

    Raises ``UnfinishedError`` before it is there, ``NotServedError`` for one that was dismissed.
    """
    if animation.error is not None:
        return problem_response(public_problem(animation.error))
    if animation.status == "dismissed":
        raise NotServedError("animation", f"This animation was dismissed. {animation.message or ''}".strip())
    if animation.film is None:
        message = f"{animation.frames_done} of {animation.order.span.frames} frames of this animation are drawn."
        raise UnfinishedError(message, retry_s(animations.seconds_left(animation), settings))
    nbytes = animation.film.nbytes
    headers = {
        "ETag": tag_of("animation", animation.id), "Accept-Ranges": "bytes",
        "Cache-Control": f"private, max-age={int(settings.animation_age_s)}",
    }  # fmt: skip
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if_range = request.headers.get("if-range", headers["ETag"])
    part = byte_range(request.headers.get("range", ""), nbytes) if if_range == headers["ETag"] else None
    first, end = part or (0, nbytes)
    headers |= {"Content-Length": str(end - first)} | ({"Content-Range": f"bytes {first}-{end - 1}/{nbytes}"} if part else {})
    reading = animation.film.reading(first, end)
    return StreamingResponse(_chunks(reading), 206 if part else 200, headers=headers, media_type=FILM_MEDIA[animation.order.format])


def byte_range(text: str, nbytes: int) -> tuple[int, int] | None:
    """Where the part of so many bytes begins, and before which byte it ends, that a ``Range`` asks for (RFC 9110, section 14).

    ``None`` for what asks for several parts or for none that is there: the whole may be sent then.
    """
    found = _RANGE.fullmatch(text.strip())
    if found is None or not any(found.groups()):
        return None
    first, last = found.groups()
    begin = int(first) if first else max(nbytes - int(last), 0)
    end = min(int(last) + 1, nbytes) if first and last else nbytes
    return (begin, end) if begin < end else None


async def _chunks(reading: Reading) -> AsyncIterator[bytes]:
    try:
        while chunk := await asyncio.to_thread(reading.chunk):
            yield chunk
    finally:
        reading.close()
