"""Options for several times, and output names for each of them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.durations import ALLOWED_DURATIONS, parse_duration
from skugga.terrain.level.level import parse_sun
from skugga.terrain.level.parts import SunSpec

MAX_TIMES = 10_000
"""Maximum number of times of one command."""

TIME_PLACEHOLDER = "{time}"
"""Placeholder of the time in a file name."""


def sun_from_options(time: str | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    """Return the sun of ``--time``, or of ``--azimuth`` and ``--altitude``; ``None`` without these. Raises ``InputError``."""
    try:
        return parse_sun(time, azimuth, altitude)
    except InputError as error:
        raise error.prefixed("--") from None


def suns_from_options(
    sun: SunSpec | None, times: str | None, start: str | None, end: str | None, step: str | None
) -> Sequence[SunSpec | None]:
    """Return the suns of ``--times``, or of ``--from``, ``--to`` (inclusive) and ``--step``.

    Without these, return ``sun`` alone (``None`` means the level's default sun). Raises ``InputError``.
    """
    steps = {"--from": start, "--to": end, "--step": step}
    used_steps = [name for name, value in steps.items() if value is not None]
    used_options = [
        *(["--time or --azimuth"] if sun is not None else []),
        *(["--times"] if times is not None else []),
        *used_steps[:1],
    ]
    if len(used_options) > 1:
        raise InputError.conflict(used_options[1], used_options[0])
    if times is not None:
        return [SunSpec(time=read_time("--times", text)) for text in times.split(",")]
    if not used_steps:
        return [sun]
    if start is None or end is None or step is None:
        missing = next(name for name, value in steps.items() if value is None)
        raise InputError.missing(missing, "Give --from, --to and --step together")
    first, last = (read_time(name, text) for name, text in (("--from", start), ("--to", end)))
    every = read_duration("--step", step)
    count = (last - first) // every + 1
    if not 1 <= count <= MAX_TIMES:
        raise InputError(
            "--to",
            end,
            f"a time that gives 1 to {MAX_TIMES} times, one every {step} from --from on; this one gives {max(count, 0)}",
        )
    return [SunSpec(time=first + n * every) for n in range(count)]


def time_for_file_name(sun: SunSpec | None, sun_number: int) -> str:
    """Return the time of a sun for a file name, in UTC such as 20240321T090000Z.

    A sun without a time has ``sun_number`` instead.
    """
    if sun is None or sun.time is None:
        return str(sun_number)
    return sun.time.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")


def paths_by_time(output: Path, suns: Sequence[SunSpec | None]) -> list[Path]:
    """Return the output path of each sun: ``{time}`` in the name is replaced. Raises ``InputError``."""
    if len(suns) > 1 and TIME_PLACEHOLDER not in output.name:
        raise InputError("--output", str(output), f"a name with {TIME_PLACEHOLDER}, for {len(suns)} times")
    paths = [
        output.with_name(output.name.replace(TIME_PLACEHOLDER, time_for_file_name(sun, n))) for n, sun in enumerate(suns, start=1)
    ]
    if len(set(paths)) < len(paths):
        raise InputError("--times", Problem("a time occurs twice"), "Give different times")
    return paths


def read_time(name: str, text: str) -> datetime:
    """Return a time from text with an offset. Raises ``InputError``, which names the option ``name``."""
    try:
        sun = parse_sun(text, None, None)
    except InputError as error:
        raise error.renamed(name) from None
    assert sun is not None and sun.time is not None
    return sun.time


def read_duration(name: str, text: str, min_s: float = 1.0) -> timedelta:
    """Return a duration from text such as 15m. Raises ``InputError``, which names the option ``name``.

    ``min_s`` is the shortest allowed duration in seconds.
    """
    try:
        length = parse_duration(text)
    except ValueError:
        length = timedelta(0)
    if length < timedelta(seconds=min_s):
        raise InputError(name, text, f"{ALLOWED_DURATIONS}; at least {min_s:g}s")
    return length
