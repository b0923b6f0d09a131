"""When a film plays, from what a person asks: ends and steps as texts. The same for the command line, Python and HTTP."""

from __future__ import annotations

from datetime import datetime, timedelta
from math import floor

from skugga.selector.film_request import MOST_FRAMES, FilmSpan
from skugga.terrain.errors import MISSING_VALUE, InputError, Problem
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.durations import ALLOWED_DURATIONS, parse_duration
from skugga.terrain.level.parts import ALLOWED_TIMES, parse_time

USUAL_FPS, LEAST_FPS, MOST_FPS = 25.0, 0.1, 120.0
"""Frames a second of a film that plays."""

LEAST_STEP_S = 0.001

_END_WORDS = f"{ALLOWED_TIMES}; or a reading of the level's clock, as 0s or 10m, under a sun that rests"
_SAME_FRAME = 1e-6
"""Share of a step by which a film may be too short for its last frame: steps of a thirtieth of a second are rounded."""


def film_span(
    start: str | None,
    end: str | None,
    step: str | None,
    fps: float = USUAL_FPS,
    path: CameraPathSpec | None = None,
    first_second: float | None = None,
    most_frames: int = MOST_FRAMES,
) -> FilmSpan:
    """The span from one end to the other: dates, by which the sun moves, or readings of the clock, under a sun that rests. What is
    not said follows from the camera's ``path``: it begins with the first frame, or has dates. Steps of the clock are by default
    those of a film that plays at its own pace, ``fps`` frames a second. ``first_second`` is the clock's first reading, where the
    ends are dates.

    Raises ``InputError``, which names ``from``, ``to``, ``step`` or ``fps``.
    """
    if not LEAST_FPS <= fps <= MOST_FPS:
        raise InputError("fps", fps, f"{LEAST_FPS:g} to {MOST_FPS:g} frames a second")
    if path is not None and path.keys[0].moment is not None and start is None and end is None:
        start, end = path.keys[0].at, path.keys[-1].at
    first = _end("from", "0s" if start is None and path is not None else start)
    path_s = None if path is None else path.keys[-1].elapsed_s
    if end is not None:
        last = _end("to", end)
    elif path_s is not None:
        last = first + timedelta(seconds=path_s)
    else:
        raise InputError("to", MISSING_VALUE, "the last time, beside from")
    if isinstance(first, datetime) and isinstance(last, datetime):
        length_s = (last - first).total_seconds()
    elif isinstance(first, timedelta) and isinstance(last, timedelta):
        length_s = (last - first).total_seconds()
    else:
        raise InputError("to", end, f"like from, {start}: both with a date, or both readings of the clock")
    if length_s < 0.0:
        raise InputError("to", end, f"a time that is not before from, {start}")
    if step is None and isinstance(first, datetime):
        raise InputError("step", MISSING_VALUE, "the time between two frames, as 10m, beside from and to")
    step_s = 1.0 / fps if step is None else _step_s(step)
    frames = floor(length_s / step_s + _SAME_FRAME) + 1
    if frames > most_frames:
        raise InputError("step", Problem(f"{frames} frames, one every {step_s:g} s"), f"at most {most_frames} frames")
    if isinstance(first, datetime):
        return FilmSpan(frames, step_s, first, first_second)
    if first_second is not None and start is not None:
        raise InputError("seconds", first_second, "one way to say what the clock shows: from is there already")
    return FilmSpan(frames, step_s, None, first_second if start is None else first.total_seconds())


def _end(name: str, text: str | None) -> datetime | timedelta:
    """A date with an offset, or a reading of the clock."""
    if text is None:
        raise InputError(name, MISSING_VALUE, "from and to together, or a camera's path")
    try:
        return parse_duration(text)
    except ValueError:
        pass
    try:
        moment = parse_time(text.strip())
    except ValueError:
        raise InputError(name, text, _END_WORDS) from None
    if moment.tzinfo is None:
        raise InputError(name, text, _END_WORDS)
    return moment


def _step_s(text: str) -> float:
    try:
        step_s = parse_duration(text).total_seconds()
    except ValueError:
        step_s = 0.0
    if step_s < LEAST_STEP_S:
        raise InputError("step", text, f"{ALLOWED_DURATIONS}; at least {LEAST_STEP_S:g}s")
    return step_s
