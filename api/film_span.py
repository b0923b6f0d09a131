"""Parsing of a film's time span from texts. The command line, Python and HTTP share it."""

from __future__ import annotations

from datetime import datetime, timedelta
from math import floor

from skugga.selector.film_request import MAX_FRAMES, FilmSpan
from skugga.terrain.errors import InputError
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.durations import ALLOWED_DURATIONS, parse_duration
from skugga.terrain.level.parts import ALLOWED_TIMES, parse_time

DEFAULT_FPS, MIN_FPS, MAX_FPS = 25.0, 0.1, 120.0
"""Default, lowest and highest frame rate, frames per second."""

MIN_STEP_S = 0.001
"""Shortest time between two frames, seconds."""

_ALLOWED_SPAN_ENDS = f"{ALLOWED_TIMES}; or a time on the level's clock, such as 0s or 10m, under a fixed sun"
_SPAN_TOLERANCE_STEPS = 1e-6
"""Tolerance of the span's length, as a fraction of a step, since steps such as 1/30 s are rounded."""


def film_span(
    start: str | None,
    end: str | None,
    step: str | None,
    fps: float = DEFAULT_FPS,
    path: CameraPathSpec | None = None,
    first_clock_s: float | None = None,
    max_frames: int = MAX_FRAMES,
) -> FilmSpan:
    """Return the time span of a film.

    If both ends are dates, the sun moves. If both are readings of the level's clock, the sun is fixed. Missing ends follow from the
    camera path: its dates, or its duration from the first frame on.

    Parameters
    ----------
    start, end
        Times with an offset from UTC, or clock readings such as ``10m``.
    step
        Time between two frames. With clock readings the default is ``1 / fps`` seconds: the film plays in real time.
    fps
        Frames per second.
    path
        Path of the camera.
    first_clock_s
        Clock reading of the first frame, seconds, if the ends are dates.
    max_frames
        Upper bound of the number of frames.

    Raises
    ------
    InputError
        The error names ``from``, ``to``, ``step``, ``fps`` or ``seconds``.
    """
    if not MIN_FPS <= fps <= MAX_FPS:
        raise InputError("fps", fps, f"{MIN_FPS:g} to {MAX_FPS:g} frames a second")
    if path is not None and path.keys[0].moment is not None and start is None and end is None:
        start, end = path.keys[0].at, path.keys[-1].at
    first = _parse_span_end("from", "0s" if start is None and path is not None else start)
    path_duration_s = None if path is None else path.keys[-1].elapsed_s
    if end is not None:
        last = _parse_span_end("to", end)
    elif path_duration_s is not None:
        last = first + timedelta(seconds=path_duration_s)
    else:
        raise InputError.missing("to", "Give the last time together with from")
    if isinstance(first, datetime) and isinstance(last, datetime):
        length_s = (last - first).total_seconds()
    elif isinstance(first, timedelta) and isinstance(last, timedelta):
        length_s = (last - first).total_seconds()
    else:
        raise InputError("to", end, f"the same kind as from, {start}: both with a date, or both times on the level's clock")
    if length_s < 0.0:
        raise InputError("to", end, f"a time that is not before from, {start}")
    if step is None and isinstance(first, datetime):
        raise InputError.missing("step", "Give the time between two frames, such as 10m, together with from and to")
    step_s = 1.0 / fps if step is None else _parse_step_s(step)
    frames = floor(length_s / step_s + _SPAN_TOLERANCE_STEPS) + 1
    if frames > max_frames:
        raise InputError.over_limit(
            "step", f"{frames} frames, one every {step_s:g} s", f"{max_frames} frames", "Use a longer step or a shorter span"
        )
    if isinstance(first, datetime):
        return FilmSpan(frames, step_s, first, first_clock_s)
    if first_clock_s is not None and start is not None:
        raise InputError.conflict("seconds", "from")
    return FilmSpan(frames, step_s, None, first_clock_s if start is None else first.total_seconds())


def _parse_span_end(name: str, text: str | None) -> datetime | timedelta:
    """Return a time with an offset, or a clock reading as a duration. Raises ``InputError``, which names the parameter ``name``."""
    if text is None:
        raise InputError.missing(name, "Give from and to together, or a camera path")
    try:
        return parse_duration(text)
    except ValueError:
        pass
    try:
        moment = parse_time(text.strip())
    except ValueError:
        raise InputError(name, text, _ALLOWED_SPAN_ENDS) from None
    if moment.tzinfo is None:
        raise InputError(name, text, _ALLOWED_SPAN_ENDS)
    return moment


def _parse_step_s(text: str) -> float:
    """Return the time between two frames in seconds. Raises ``InputError`` for other texts and for less than ``MIN_STEP_S``."""
    try:
        step_s = parse_duration(text).total_seconds()
    except ValueError:
        step_s = 0.0
    if step_s < MIN_STEP_S:
        raise InputError("step", text, f"{ALLOWED_DURATIONS}; at least {MIN_STEP_S:g}s")
    return step_s
