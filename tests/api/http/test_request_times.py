"""Request times are rounded to a grain, ``current`` means now and expires soon, and new suns of a client are rate limited."""

import re
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.api.errors import RateLimitError
from skugga.api.http.request_times import rounded_time
from skugga.api.http.state.rate_limiter import RateLimiter, client_key
from tests.api.conftest import CORNER, ZOOM
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers
from tests.api.workers.test_pool import Gate

TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"
DAY = "2024-06-21T"


@pytest.mark.parametrize(
    ("time_text", "grain_s", "expected"),
    [("12:00:29", 60, "12:00:00"), ("12:00:30", 60, "12:01:00"), ("12:07:29", 900, "12:00:00"), ("12:00:29", 0, "12:00:29")],
)
def test_rounded_time_rounds_to_the_grain(time_text: str, grain_s: int, expected: str):
    for offset in (UTC, timezone(timedelta(hours=-4))):
        moment = datetime.fromisoformat(DAY + time_text).replace(tzinfo=offset)
        rounded = rounded_time(moment, grain_s)
        assert rounded == datetime.fromisoformat(DAY + expected).replace(tzinfo=offset)
        assert rounded.utcoffset() == moment.utcoffset()


@given(st.datetimes(timezones=st.just(UTC)), st.integers(1, 86400))
def test_rounded_time_moves_half_a_grain_and_only_once(moment: datetime, grain_s: int):
    rounded = rounded_time(moment, grain_s)
    assert rounded == moment or abs((rounded - moment).total_seconds()) <= grain_s / 2
    if rounded.year not in (1, 9999):
        assert rounded_time(rounded, grain_s) == rounded


def test_times_within_a_grain_share_one_tile(serve_with):
    client = serve_with(fake_workers.scripted)
    first, second = (client.get(TILE, params={"time": f"{DAY}12:00:{s}+02:00"}) for s in ("05", "20"))
    assert first.status_code == 200
    assert first.headers["etag"] == second.headers["etag"]
    assert client.service.pool.counters.jobs_answered == 1
    for answer in (first, second, client.get(TILE, params={"time": f"{DAY}12:00:05+02:00"})):
        assert answer.headers["x-skugga-time"] == f"{DAY}12:00:00+02:00"
        assert "x-skugga-time" in answer.headers["access-control-expose-headers"].lower() if "origin" in answer.headers else True
    unchanged = client.get(TILE, params={"time": f"{DAY}12:00:10+02:00"}, headers={"If-None-Match": first.headers["etag"]})
    assert (unchanged.status_code, unchanged.headers["x-skugga-time"]) == (304, f"{DAY}12:00:00+02:00")
    other = client.get(TILE, params={"time": f"{DAY}12:01:00+02:00"})
    assert other.headers["etag"] != first.headers["etag"]
    assert "x-skugga-time" not in client.get(TILE).headers


def test_time_grain_is_a_setting(serve_with):
    client = serve_with(fake_workers.scripted, time_grain_s=0)
    assert client.get(TILE, params={"time": f"{DAY}12:00:05+02:00"}).headers["x-skugga-time"] == f"{DAY}12:00:05+02:00"


def test_current_time_is_now_and_expires_soon(serve_with):
    client = serve_with(fake_workers.scripted)
    before = datetime.now(UTC)
    for _ in range(2):
        answer = client.get(TILE, params={"time": "current"})
        assert answer.status_code == 200, answer.text
        time = datetime.fromisoformat(answer.headers["x-skugga-time"])
        assert before - timedelta(seconds=60) <= time <= datetime.now(UTC)
        (max_age_s,) = re.findall(r"max-age=(\d+)", answer.headers["cache-control"])
        assert 1 <= int(max_age_s) <= 60 and "immutable" not in answer.headers["cache-control"]
    explicit = client.get(TILE, params={"time": answer.headers["x-skugga-time"]})
    assert explicit.headers["etag"] == answer.headers["etag"]
    assert "max-age=86400" in explicit.headers["cache-control"], "a tile of an explicit time stays fresh for a day"
    check_problem(client.get(TILE, params={"time": "current", "azimuth": 1, "altitude": 2}), 422, "invalid_parameter", "time")


def test_current_time_is_resolved_for_each_request(serve_with, monkeypatch: pytest.MonkeyPatch):
    from skugga.api.http import request_times

    class Clock(datetime):
        moment = datetime(2024, 6, 21, 12, 0, 30, tzinfo=UTC)

        @classmethod
        def now(cls, tz=None):
            return cls.moment

    client = serve_with(fake_workers.scripted)
    monkeypatch.setattr(request_times, "datetime", Clock)
    first_response = client.get(TILE, params={"time": "current"})
    monkeypatch.setattr(Clock, "moment", datetime(2024, 6, 21, 12, 2, 1, tzinfo=UTC))
    second_response = client.get(TILE, params={"time": "current"})
    assert first_response.headers["etag"] != second_response.headers["etag"]
    assert (first_response.headers["x-skugga-time"], second_response.headers["x-skugga-time"]) == (
        f"{DAY}12:00:00+00:00",
        f"{DAY}12:02:00+00:00",
    )


def test_rate_limiter_bounds_new_suns_only():
    now_s = [0.0]
    suns = RateLimiter(3, lambda: now_s[0])
    for sun in ("a", "b", "c", "a", "b"):
        suns.acquire("10.0.0.1", sun)
    with pytest.raises(RateLimitError) as caught:
        suns.acquire("10.0.0.1", "d")
    assert caught.value.retry_after_s == 21
    suns.acquire("10.0.0.1", "a")
    suns.acquire("10.0.0.2", "d")
    now_s[0] = 20.5
    suns.acquire("10.0.0.1", "d")
    with pytest.raises(RateLimitError):
        suns.acquire("10.0.0.1", "e")


def test_rate_limiter_of_zero_is_off():
    suns = RateLimiter(0)
    for sun in range(10_000):
        suns.acquire("10.0.0.1", sun)


@pytest.mark.parametrize(
    ("address", "other_address", "is_same_client"),
    [
        ("2001:db8:1:2::1", "2001:db8:1:2:ffff::9", True),
        ("2001:db8:1:2::1", "2001:db8:1:3::1", False),
        ("::ffff:10.0.0.1", "10.0.0.1", True),
        ("10.0.0.1", "10.0.0.2", False),
        ("a socket", "a socket", True),
    ],
)
def test_client_key_groups_a_customers_addresses(address: str, other_address: str, is_same_client: bool):
    assert (client_key(address) == client_key(other_address)) == is_same_client


def test_too_many_suns_are_429(serve_with):
    client = serve_with(fake_workers.scripted, new_suns_per_minute=2)
    for azimuth in (10, 20):
        assert client.get(TILE, params={"azimuth": azimuth, "altitude": 30}).status_code == 200
    answer = client.get(TILE, params={"azimuth": 30, "altitude": 30})
    check_problem(answer, 429, "too_many_suns", None)
    assert int(answer.headers["retry-after"]) >= 1
    assert client.get(TILE, params={"azimuth": 10, "altitude": 30}).status_code == 200, "the tile is cached"
    assert client.get(TILE).status_code == 200, "the level's own sun is not new"


def test_expected_times_are_headers_of_drawn_pictures_and_refusals(serve_with):
    """The times before any measurement are the initial estimates: 0.5 s for a tile, and by its size for a snapshot."""
    gate = Gate()
    client = serve_with(gate.target, queue_work_s=0.1)
    gate.open()
    assert client.get(TILE).headers["x-skugga-expected-time"] == "wait=0.0; work=0.5"
    assert "x-skugga-expected-time" not in client.get(TILE).headers, "a cached tile needs no drawing"
    snapshots = [f"/levels/hills/snapshot.png?size=1280x1024&azimuth={azimuth}&altitude=30" for azimuth in (10, 20, 30)]
    with ThreadPoolExecutor() as threads:
        answers = [threads.submit(client.get, snapshots[0])]
        while client.service.pool.running_count < 1:
            time.sleep(0.01)
        answers.append(threads.submit(client.get, snapshots[1]))
        while client.service.pool.queued_count < 1:
            time.sleep(0.01)
        refused = client.get(snapshots[2])
        gate.open(2)
    check_problem(refused, 503, "busy", None)
    match = re.fullmatch(r"wait=(\d\.\d); work=2\.5", refused.headers["x-skugga-expected-time"])
    assert match is not None and 2.5 < float(match[1]) <= 5.0, "one snapshot is being drawn, one waits"
    assert all("x-skugga-expected-time" in answer.result().headers for answer in answers)
