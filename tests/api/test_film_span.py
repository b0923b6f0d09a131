"""Time span of a film: from option texts to frames, and the error of each invalid one."""

from __future__ import annotations

from datetime import datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.api.film_span import film_span
from skugga.selector.film_request import FilmSpan
from skugga.terrain.errors import InputError
from skugga.terrain.level.camera_file import CameraPathSpec

MORNING, EVENING = "2024-10-21T06:00:00-04:00", "2024-10-21T18:00:00-04:00"


def path(*times: str) -> CameraPathSpec:
    """Return a camera path whose keys have the given times and the same camera."""
    return CameraPathSpec.model_validate(
        {"keys": [{"at": time_text, "eye": [0, 0, 5], "target": [9, 9, 0]} for time_text in times]}
    )


def test_a_day_includes_both_ends():
    span = film_span(MORNING, EVENING, "10m")
    assert span == FilmSpan(73, 600.0, datetime.fromisoformat(MORNING))
    assert span.frame_time(72) == datetime.fromisoformat(EVENING) and span.length_s == 43200.0
    assert film_span(MORNING, EVENING, "7m").frames == 103  # the last frame is at 17:54
    assert film_span(MORNING, MORNING, "7m").frames == 1


def test_ends_may_have_different_offsets():
    assert film_span(MORNING, "2024-10-21T10:30:00Z", "10m").frames == 4


def test_the_default_step_of_clock_spans_is_one_frame():
    assert film_span("2s", "4s", None) == FilmSpan(51, 0.04, None, 2.0)
    assert film_span("0s", "1m", "10s", 10.0) == FilmSpan(7, 10.0, None, 0.0)
    assert film_span("0s", "0.1s", "0.05s").frames == 3


def test_a_camera_path_sets_the_ends_of_the_span():
    assert film_span(None, None, None, 10.0, path("0s", "2s")) == FilmSpan(21, 0.1)
    assert film_span(None, None, "0.5s", 10.0, path("1s", "2s"), 7.0) == FilmSpan(5, 0.5, None, 7.0)
    dated = path(MORNING, EVENING)
    assert film_span(None, None, "1h", path=dated) == FilmSpan(13, 3600.0, datetime.fromisoformat(MORNING))
    assert film_span(MORNING, None, "1h", path=path("0s", "6h")) == FilmSpan(7, 3600.0, datetime.fromisoformat(MORNING))
    assert film_span(None, "3s", None, 10.0, path("0s", "2s")) == FilmSpan(31, 0.1)


@given(st.integers(1, 120), st.integers(0, 80))
def test_whole_seconds_have_whole_frames_at_any_rate(fps, seconds):
    """This also holds where a frame is no whole number of microseconds."""
    assert film_span("0s", f"{seconds}s", None, float(fps)).frames == seconds * fps + 1


@given(st.integers(1, 400_000), st.integers(1, 90_000))
def test_the_last_frame_is_the_last_that_fits(length_s, step_s):
    start = datetime.fromisoformat(MORNING)
    end = start + timedelta(seconds=length_s)
    count = length_s // step_s + 1
    if count > 10_000:
        with pytest.raises(InputError, match=f"step: {count} frames"):
            film_span(MORNING, end.isoformat(), f"{step_s}s")
        return
    span = film_span(MORNING, end.isoformat(), f"{step_s}s")
    assert span.frame_time(span.frames - 1) <= end < span.frame_time(span.frames)


INVALID_SPANS = {
    "no offset": (("2024-10-21T06:00:00", EVENING, "10m"), "from", "with an offset"),
    "no time": ((MORNING, "evening", "10m"), "to", "with an offset"),
    "a date alone": ((MORNING, "2024-10-22", "10m"), "to", "with an offset"),
    "after": ((EVENING, MORNING, "10m"), "to", f"a time that is not before from, {EVENING}"),
    "clock after": (("5s", "2s", None), "to", "a time that is not before from, 5s"),
    "date and clock": ((MORNING, "5s", "10m"), "to", "both with a date, or both times on the level's clock"),
    "clock and date": (("5s", EVENING, "10m"), "to", "both with a date, or both times on the level's clock"),
    "no from": ((None, EVENING, "10m"), "from", "from and to together"),
    "nothing": ((None, None, "10m"), "from", "from and to together"),
    "no to": ((MORNING, None, "10m"), "to", "missing. Give the last time together with from"),
    "no step": ((MORNING, EVENING, None), "step", "such as 10m, together with from and to"),
    "zero": ((MORNING, EVENING, "0m"), "step", "at least 0.001s"),
    "negative": ((MORNING, EVENING, "-10m"), "step", "at least 0.001s"),
    "unreadable": ((MORNING, EVENING, "ten"), "step", "a number and a unit, s, m, h or d, such as 15m"),
    "no unit": ((MORNING, EVENING, "10"), "step", "a number and a unit, s, m, h or d, such as 15m"),
    "many": ((MORNING, EVENING, "4s"), "step", "limit of 10000 frames"),
    "many of the clock": (("0s", "900000d", "0.001s"), "step", "limit of 10000 frames"),
    "slow": (("0s", "5s", None, 0.01), "fps", "0.1 to 120"),
    "no number": (("0s", "5s", None, float("nan")), "fps", "0.1 to 120"),
    "two clocks": (("0s", "5s", None, 25.0, None, 3.0), "seconds", "cannot be combined with from. Use one of them"),
}


@pytest.mark.parametrize("name", INVALID_SPANS)
def test_wrong_spans_name_their_parameter(name):
    arguments, parameter, allowed = INVALID_SPANS[name]
    with pytest.raises(InputError) as caught:
        film_span(*arguments)
    assert caught.value.name == parameter and allowed in str(caught.value)


def test_the_limit_of_frames_can_be_lowered():
    with pytest.raises(InputError, match="73 frames, one every 600 s, more than the limit of 50 frames. Use a longer step"):
        film_span(MORNING, EVENING, "10m", max_frames=50)
