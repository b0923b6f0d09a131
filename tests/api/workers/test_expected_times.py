"""Expected times of jobs."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from skugga.api.workers.expected_times import INITIAL_ESTIMATE_S, REFERENCE_PIXELS, ExpectedTimes
from skugga.api.workers.jobs import Job, LevelKey, MapJob
from tests.products import sun_hours_of

LEVEL = LevelKey(path=Path("hills.yaml"), version="1")


def map_job(side: int, **fields: object) -> MapJob:
    """Return the job of a map with ``side`` x ``side`` pixels."""
    return MapJob(level=LEVEL, bounds=(0.0, 0.0, 1.0, 1.0), crs="EPSG:4326", size=(side, side), format="png", **fields)


def test_every_kind_of_job_has_an_initial_estimate():
    assert set(INITIAL_ESTIMATE_S) == set(get_args(Job))


def test_map_times_scale_with_pixels_and_differ_by_product():
    times = ExpectedTimes()
    assert (
        times.expected_s(map_job(2000))
        == 4 * times.expected_s(map_job(1000))
        == 4 * INITIAL_ESTIMATE_S[MapJob] * 1e6 / REFERENCE_PIXELS
    )
    times.add_duration(map_job(1000), 0.2)
    assert abs(times.expected_s(map_job(2000)) - 0.8) < 1e-9
    sun_hours_job = map_job(1000, request=sun_hours_of(date="2024-03-21"))
    assert times.expected_s(sun_hours_job) == INITIAL_ESTIMATE_S[MapJob] * 1e6 / REFERENCE_PIXELS
