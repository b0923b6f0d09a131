"""Animations over HTTP: requests, job states, results, dismissal, and problem documents for wrong requests."""

from __future__ import annotations

import functools
import io
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from httpx import Response
from PIL import Image

from skugga.api.cli import main as cli
from skugga.api.http.server.app import create_app
from skugga.api.http.views.animation_states import RESULTS_RELATION, parse_byte_range
from skugga.api.settings import Settings
from tests.api.conftest import CORNER, ENGINEERING, ZOOM, Client, running, write_level
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

TIMEOUT_S = 30.0
ADDRESS = "/levels/hills/animations"
REQUEST_BODY: dict[str, Any] = {
    "from": "2024-06-21T16:00:00+02:00",
    "to": "2024-06-21T18:00:00+02:00",
    "step": "1h",
    "size": [64, 48],
}
"""A request for three frames."""

EYE, TARGET = [8.43, 47.5, 300.0], [8.45, 47.51, 0.0]
UNDERGROUND_KEYS = [{"at": at, "eye": [lon, 47.5, 2.0], "target": TARGET} for at, lon in (("0s", 8.42), ("2h", 8.45))]
"""A camera path from one valley to the next, through the ridge."""

CAMERA_KEYS = [{"at": "0s", "eye": EYE, "target": TARGET}, {"at": "2s", "eye": [8.431, 47.501, 400.0], "target": TARGET}]


def wait_for_end(client: Client, answer: Response) -> dict[str, Any]:
    """Poll an animation until it ends, and return its last state."""
    assert answer.status_code == 202, answer.text
    while True:
        state = client.get(answer.headers["location"]).json()
        if state["status"] not in ("accepted", "running"):
            return state


def pictures_of(film: bytes) -> list[np.ndarray]:
    """Return all frames of an animated WebP, each uint8 (rows, cols, 3)."""
    image = Image.open(io.BytesIO(film))
    frames = []
    for number in range(image.n_frames):
        image.seek(number)
        frames.append(np.asarray(image.convert("RGB")))
    return frames


class GatedService:
    """A service whose one render worker blocks before each frame until the test opens the gate."""

    def __init__(self, serve_with: Callable[..., Client], *commands: tuple[int, str], **settings: Any) -> None:
        spawn = get_context("spawn")
        self._job_started, self._may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
        target = functools.partial(
            fake_workers.filming, job_started=self._job_started, may_finish=self._may_finish, commands=commands
        )
        self.client = serve_with(target, **settings)

    def job_started(self) -> None:
        """Wait until the render process has started another job."""
        assert self._job_started.acquire(timeout=TIMEOUT_S)

    def open(self, times: int = 1) -> None:
        """Let a number of jobs finish."""
        for _ in range(times):
            self._may_finish.release()


@pytest.fixture
def gated_service(serve_with) -> Callable[..., GatedService]:
    """A function that starts a ``GatedService``."""
    return functools.partial(GatedService, serve_with)


@pytest.fixture
def filming_client(serve_with) -> Client:
    """Return a service whose render worker draws frames without delay."""
    return serve_with(fake_workers.filming)


@pytest.fixture(scope="module")
def refusing_client(hills_level: Path) -> Iterator[Client]:
    """Return a service that is shared by tests whose requests start no animation."""
    with running(create_app(Settings(workers=1), [hills_level], fake_workers.filming)) as client:
        yield client


def test_animation_runs_from_request_to_result(gated_service):
    service = gated_service()
    client = service.client
    answer = client.post(ADDRESS, json=REQUEST_BODY)
    assert answer.status_code == 202 and answer.headers["cache-control"] == "no-store"
    address, job = answer.headers["location"], answer.json()
    assert address == f"{str(client.base_url).rstrip('/')}/animations/{job['jobID']}"
    assert (job["status"], job["progress"], job["frames"], job["frames_done"]) == ("accepted", 0, 3, 0)
    assert job["seconds_left"] == 4.5, "3 frames, each expected to take 1.5 s"
    assert 1 <= int(answer.headers["retry-after"]) <= 5
    service.job_started()
    refusal = client.get(f"{address}/result")
    check_problem(refusal, 409, "unfinished", None)
    assert int(refusal.headers["retry-after"]) >= 1
    service.open()
    service.job_started()
    while (running := client.get(address)).json()["frames_done"] < 1:
        pass
    state = running.json()
    assert (state["status"], state["message"], state["progress"]) == ("running", "1 of 3 frames are drawn.", 33)
    assert running.headers["cache-control"] == "no-store" and "retry-after" in running.headers
    service.open(2)
    state = wait_for_end(client, answer)
    assert (state["status"], state["progress"], state["seconds_left"]) == ("successful", 100, None)
    (link,) = [item for item in state["links"] if item["rel"] == RESULTS_RELATION]
    assert link["href"] == f"{address}/result" and link["type"] == "image/webp"
    film = client.get(link["href"])
    assert film.status_code == 200 and film.headers["content-type"] == "image/webp"
    assert int(film.headers["content-length"]) == len(film.content)
    assert [int(item[0, 0, 0]) for item in pictures_of(film.content)] == [1, 2, 3]
    assert "retry-after" not in client.get(address).headers


def test_result_supports_etags_and_byte_ranges(filming_client: Client):
    state = wait_for_end(filming_client, filming_client.post(ADDRESS, json=REQUEST_BODY))
    address = f"/animations/{state['jobID']}/result"
    full_response = filming_client.get(address)
    tag, size = full_response.headers["etag"], len(full_response.content)
    assert (
        full_response.headers["cache-control"].startswith("private, max-age=") and full_response.headers["accept-ranges"] == "bytes"
    )
    unchanged = filming_client.get(address, headers={"If-None-Match": tag})
    assert (unchanged.status_code, unchanged.content, unchanged.headers["etag"]) == (304, b"", tag)
    for range_header, first, end in (
        ("bytes=0-3", 0, 4),
        ("bytes=10-", 10, size),
        ("bytes=-5", size - 5, size),
        (f"bytes=4-{size}", 4, size),
    ):
        part = filming_client.get(address, headers={"Range": range_header})
        assert part.status_code == 206 and part.content == full_response.content[first:end], range_header
        assert part.headers["content-range"] == f"bytes {first}-{end - 1}/{size}"
        assert int(part.headers["content-length"]) == end - first
    for ignored_range in ("bytes=5-2", f"bytes={size}-", "bytes=0-1,3-4", "lines=1-2", "bytes=-", "bytes=-0"):
        assert filming_client.get(address, headers={"Range": ignored_range}).content == full_response.content, ignored_range
    old = filming_client.get(address, headers={"Range": "bytes=0-3", "If-Range": '"another"'})
    assert (old.status_code, old.content) == (200, full_response.content)
    head = filming_client.head(address)
    assert (head.content, head.headers["content-length"]) == (b"", str(size))


def test_byte_range_parses_single_ranges_only():
    assert parse_byte_range("bytes=0-0", 10) == (0, 1)
    assert parse_byte_range("bytes=-20", 10) == (0, 10), "a suffix longer than the file is the whole file"
    assert parse_byte_range("", 10) is parse_byte_range("bytes=1-x", 10) is parse_byte_range("bytes=0-0", 0) is None


def test_equal_requests_share_one_animation(gated_service):
    service = gated_service()
    client = service.client
    first = client.post(ADDRESS, json=REQUEST_BODY)
    second_response = client.post(
        ADDRESS, content=json.dumps(dict(reversed(REQUEST_BODY.items()))), headers={"Content-Type": "application/json"}
    )
    assert first.headers["location"] == second_response.headers["location"]
    service.open(6)
    assert client.post(ADDRESS, json=REQUEST_BODY | {"fps": 2}).headers["location"] != first.headers["location"]
    wait_for_end(client, first)
    finished_response = client.post(ADDRESS, json=REQUEST_BODY)
    assert (finished_response.status_code, finished_response.headers["location"]) == (200, first.headers["location"])
    assert finished_response.json()["status"] == "successful"


def test_dismissed_animation_has_a_state_but_no_result(gated_service):
    service = gated_service()
    client = service.client
    address = client.post(ADDRESS, json=REQUEST_BODY).headers["location"]
    service.job_started()
    dismissed = client.delete(address)
    assert (dismissed.status_code, dismissed.json()["status"]) == (200, "dismissed")
    assert dismissed.headers["cache-control"] == "no-store"
    assert client.get(address).json()["status"] == "dismissed"
    check_problem(client.get(f"{address}/result"), 404, "not_found", "animation")
    service.open(4)  # the frame in progress, and the frames of the second animation
    new_response = client.post(ADDRESS, json=REQUEST_BODY)
    assert new_response.headers["location"] != address
    state = wait_for_end(client, new_response)
    assert state["status"] == "successful"
    assert client.delete(new_response.headers["location"]).json()["status"] == "dismissed"
    check_problem(client.get(f"{new_response.headers['location']}/result"), 404, "not_found", "animation")


def test_unknown_animation_or_level_is_404(filming_client: Client):
    for method, path in (("GET", ""), ("GET", "/result"), ("DELETE", "")):
        check_problem(filming_client.request(method, f"/animations/{'0' * 32}{path}"), 404, "not_found", "animation")
    check_problem(filming_client.post("/levels/nowhere/animations", json=REQUEST_BODY), 404, "not_found", "level")
    assert filming_client.get(ADDRESS).headers["allow"] == "POST"
    assert filming_client.put("/animations/x").headers["allow"] == "GET, HEAD, DELETE"


def test_retry_after_is_well_below_the_abandon_timeout(gated_service):
    client = gated_service(animation_abandoned_s=60.0).client
    answer = client.post(ADDRESS, json=REQUEST_BODY | {"step": "1m"})
    assert (answer.json()["seconds_left"], answer.headers["retry-after"]) == (181.5, "20")


def test_animation_without_polls_is_dismissed(gated_service):
    service = gated_service(animation_abandoned_s=0.3)
    client, animations = service.client, service.client.service.animations
    address = client.post(ADDRESS, json=REQUEST_BODY).headers["location"]
    service.job_started()
    while animations.counts["running"]:
        client.get("/healthz")
    service.open()
    state = client.get(address).json()
    assert state["status"] == "dismissed" and "No client requested its state" in state["message"]
    assert state["frames_done"] == 0
    while client.service.pool.running_count:
        client.get("/healthz")
    assert client.service.pool.queued_count == 0, "no further frame of the dismissed animation is drawn"


def test_results_expire_after_their_maximum_age(serve_with):
    client = serve_with(fake_workers.filming, animation_age_s=0.3)
    answer = client.post(ADDRESS, json=REQUEST_BODY)
    while (state := client.get(answer.headers["location"])).status_code == 200:
        pass
    check_problem(state, 404, "not_found", "animation")
    assert client.service.animations.cached_bytes == 0


def test_full_queue_is_503_with_retry_after(gated_service):
    service = gated_service(animations_waiting=1, workers=2)  # while a frame blocks one, the other plans the next requests
    client = service.client
    for fps in (1, 2):
        assert client.post(ADDRESS, json=REQUEST_BODY | {"fps": fps}).status_code == 202
        if fps == 1:
            service.job_started()
    refusal = client.post(ADDRESS, json=REQUEST_BODY | {"fps": 3})
    check_problem(refusal, 503, "busy", None)
    assert int(refusal.headers["retry-after"]) >= 1
    assert client.post(ADDRESS, json=REQUEST_BODY | {"fps": 2}).status_code == 202, "this animation waits already"


def test_tile_request_precedes_the_next_frame(gated_service):
    """The worker draws a tile that is requested during a frame before the next frame."""
    service = gated_service()
    client = service.client
    address = client.post(ADDRESS, json=REQUEST_BODY).headers["location"]
    service.job_started()
    x, y = CORNER
    with ThreadPoolExecutor(1) as thread:
        tile = thread.submit(client.get, f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{x}/{y}.png")
        while client.service.pool.queued_count < 1:
            client.get("/healthz")
        service.open()
        service.job_started()
        while client.get(address).json()["frames_done"] < 1:  # the service counts a frame after its worker has begun the next job
            pass
        service.open()
        assert tile.result().status_code == 200, "the tile is drawn before the next frame"
        assert client.get(address).json()["frames_done"] == 1
    service.open(2)


def test_frame_of_a_killed_worker_is_drawn_again(gated_service):
    service = gated_service()
    client = service.client
    answer = client.post(ADDRESS, json=REQUEST_BODY)
    service.open()
    service.job_started()
    service.job_started()
    os.kill(*client.service.pool.ready_pids, signal.SIGKILL)
    service.job_started()
    service.open(2)
    state = wait_for_end(client, answer)
    assert state["status"] == "successful"
    film = client.get(f"/animations/{state['jobID']}/result").content
    assert [int(picture[0, 0, 0]) for picture in pictures_of(film)] == [1, 2, 3], "each frame was planned once"


@pytest.mark.parametrize(
    ("command", "status", "code"), [("crash", 503, "worker_crash"), ("fail", 500, "render"), ("refuse", 422, "invalid_parameter")]
)
def test_failed_animation_reports_its_problem(serve_with, command: str, status: int, code: str):
    client = serve_with(functools.partial(fake_workers.filming, commands=((1, command),)))
    answer = client.post(ADDRESS, json=REQUEST_BODY)
    state = wait_for_end(client, answer)
    assert state["status"] == "failed"
    assert (state["problem"]["status"], state["problem"]["code"]) == (status, code)
    assert state["message"] == state["problem"]["detail"] and "went wrong" not in state["message"]
    assert len(state["links"]) == 1
    result = client.get(f"/animations/{state['jobID']}/result")
    check_problem(result, status, code, "view" if status == 422 else None)
    assert ("retry-after" in result.headers) == (status == 503)
    assert client.post(ADDRESS, json=REQUEST_BODY).headers["location"] != answer.headers["location"], (
        "a new request draws the film again"
    )


def test_frame_timeout_fails_the_animation(serve_with):
    may_finish = get_context("spawn").Semaphore(0)
    client = serve_with(functools.partial(fake_workers.filming, may_finish=may_finish), render_timeout_s=0.5)
    state = wait_for_end(client, client.post(ADDRESS, json=REQUEST_BODY))
    assert (state["status"], state["problem"]["code"]) == ("failed", "render_timeout")
    may_finish.release()


def test_level_change_fails_the_animation(folder: Path):
    level = write_level(folder, "changing")
    spawn = get_context("spawn")
    job_started, may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
    target = functools.partial(fake_workers.filming, job_started=job_started, may_finish=may_finish)
    with running(create_app(Settings(workers=1, level_check_s=0), [level], target)) as client:
        answer = client.post("/levels/changing/animations", json=REQUEST_BODY)
        assert job_started.acquire(timeout=TIMEOUT_S)
        write_level(folder, "changing", title="Another one")
        may_finish.release()
        state = wait_for_end(client, answer)
        assert (state["status"], state["problem"]["code"]) == ("failed", "level_changed")
        other = client.post("/levels/changing/animations", json=REQUEST_BODY)
        assert other.headers["location"] != answer.headers["location"]
        for _ in range(3):
            may_finish.release()
        assert wait_for_end(client, other)["status"] == "successful"


def test_shutdown_dismisses_all_animations(hills_level: Path):
    """Shutdown dismisses one running and one waiting animation, and drops the cached result of a finished one."""
    spawn = get_context("spawn")
    job_started, may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
    target = functools.partial(fake_workers.filming, job_started=job_started, may_finish=may_finish)
    with running(create_app(Settings(workers=1), [hills_level], target)) as client:
        for _ in range(3):
            may_finish.release()
        assert wait_for_end(client, client.post(ADDRESS, json=REQUEST_BODY))["status"] == "successful"
        for _ in range(3):
            assert job_started.acquire(timeout=TIMEOUT_S)
        with ThreadPoolExecutor(2) as threads:
            posts = [threads.submit(client.post, ADDRESS, json=REQUEST_BODY | {"fps": fps}) for fps in (1, 2)]
            for _ in range(2):  # one animation may get its first frame before the other one starts
                may_finish.release()
            addresses = [item.result().headers["location"] for item in posts]
        animations = client.service.animations
        active_animations = list(animations._active.values())
    assert {item.id for item in active_animations} == {address.rpartition("/")[2] for address in addresses}
    assert [item.status for item in active_animations] == ["dismissed", "dismissed"]
    assert animations.cached_bytes == 0 and not animations.counts["successful"]


@pytest.mark.parametrize(
    ("body_changes", "parameter", "expected_text"),
    [
        ({"from": None}, "from", "from and to together"),
        ({"from": "yesterday"}, "from", "ISO 8601"),
        ({"from": "2024-06-21T16:00:00"}, "from", "offset"),
        ({"to": "2024-06-21T15:00:00+02:00"}, "to", "not before from"),
        ({"to": "10m"}, "to", "both"),
        ({"to": "2924-06-21T15:00:00+02:00", "step": "300000d"}, "to", "years"),
        ({"step": None}, "step", "missing"),
        ({"step": "often"}, "step", "a number and a unit, s, m, h or d"),
        ({"step": "0s"}, "step", "at least"),
        ({"step": "1s"}, "step", "limit of 720 frames"),
        ({"step": 5}, "step", "a text"),
        ({"fps": 0}, "fps", "0.1 to 120"),
        ({"fps": "fast"}, "fps", "a valid number"),
        ({"format": "mp4", "lossless": True}, "lossless", "Use the format webp"),
        ({"lossless": "yes"}, "lossless", "boolean"),
        ({"format": "gif"}, "format", "'webp' or 'mp4'"),
        ({"view": "nowhere"}, "view", "map"),
        ({"view": "map", "path": {"keys": CAMERA_KEYS}}, "view", "cannot be combined with path"),
        ({"path": {"keys": CAMERA_KEYS[:1]}}, "path.keys", "at least 2"),
        ({"path": {"keys": [*CAMERA_KEYS, CAMERA_KEYS[0]]}}, "path.keys.2.at", "later"),
        ({"path": {"keys": [CAMERA_KEYS[0] | {"eye": [8.43, 47.5, 1e6]}, CAMERA_KEYS[1]]}}, "path.keys.0.eye", "at most 100000"),
        ({"path": {"keys": [CAMERA_KEYS[0] | {"height": 1}, CAMERA_KEYS[1]]}}, "path.keys.0.height", "at, eye, target, fov"),
        ({"size": [64]}, "size.1", "missing"),
        ({"size": [0, 48]}, "size.0", "greater than or equal to 1"),
        ({"size": "64x48"}, "size", "a list"),
        ({"size": [2000, 2000]}, "size", "SKUGGA_MAX_ANIMATION_FRAME_PIXELS"),
        ({"size": [1200, 1000], "step": "1m"}, "size", "SKUGGA_MAX_ANIMATION_PIXELS"),
        ({"time": "2024-06-21T16:00:00+02:00"}, "time", "cannot be combined with dates"),
        ({"azimuth": 100, "altitude": 20}, "azimuth", "cannot be combined with dates"),
        ({"azimuth": 100}, "altitude", "missing"),
        ({"style": "ugly"}, "style", "swiss"),
        ({"slope_exaggeration": 0}, "slope_exaggeration", "0.1"),
        ({"algorithm": "truth"}, "algorithm", "shadow_map"),
        ({"algorithm": "relief="}, "algorithm", "shadow_map"),
        ({"map_size": 10}, "map_size", "64"),
        ({"seconds": 1e10}, "seconds", "1000000000"),
        ({"file": "dem.tif"}, "file", "from, to, step"),
    ],
)
def test_invalid_request_is_refused_before_drawing(
    refusing_client: Client, body_changes: dict[str, Any], parameter: str, expected_text: str
):
    answer = refusing_client.post(
        ADDRESS, json={key: value for key, value in (REQUEST_BODY | body_changes).items() if value is not None}
    )
    problem = check_problem(answer, 422, "invalid_parameter", parameter)
    assert expected_text in problem["detail"]
    assert not any(refusing_client.service.animations.counts.values())


def test_missing_or_broken_body_is_refused(refusing_client: Client):
    check_problem(
        refusing_client.post(ADDRESS, content="{", headers={"Content-Type": "application/json"}), 422, "invalid_parameter", "body"
    )
    check_problem(refusing_client.post(ADDRESS), 422, "invalid_parameter", "body")
    check_problem(refusing_client.post(f"{ADDRESS}?step=1h", json=REQUEST_BODY), 422, "invalid_parameter", "step")


def test_mp4_without_an_encoder_is_refused(refusing_client: Client, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("skugga.api.http.views.animation_request.find_spec", lambda name: None)
    problem = check_problem(
        refusing_client.post(ADDRESS, json=REQUEST_BODY | {"format": "mp4"}), 422, "invalid_parameter", "format"
    )
    assert "no encoder of mp4" in problem["detail"]


def test_mp4_result_has_all_frames(filming_client: Client):
    av = pytest.importorskip("av")
    state = wait_for_end(filming_client, filming_client.post(ADDRESS, json=REQUEST_BODY | {"format": "mp4", "fps": 5}))
    film = filming_client.get(f"/animations/{state['jobID']}/result")
    assert film.headers["content-type"] == "video/mp4"
    with av.open(io.BytesIO(film.content)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 3


def test_zero_max_frames_refuses_every_animation(serve_with):
    client = serve_with(fake_workers.filming, max_animation_frames=0)
    check_problem(client.post(ADDRESS, json=REQUEST_BODY), 422, "invalid_parameter", "step")


def test_api_token_protects_animations(serve_with):
    client = serve_with(fake_workers.filming, api_token="a secret token")
    check_problem(client.post(ADDRESS, json=REQUEST_BODY), 401, "unauthorized", None)
    client.headers["Authorization"] = "Bearer a secret token"
    state = wait_for_end(client, client.post(ADDRESS, json=REQUEST_BODY))
    del client.headers["Authorization"]
    for path in ("", "/result"):
        check_problem(client.get(f"/animations/{state['jobID']}{path}"), 401, "unauthorized", None)
    check_problem(client.delete(f"/animations/{state['jobID']}"), 401, "unauthorized", None)


def test_cors_exposes_location_and_allows_delete(filming_client: Client):
    page = {"Origin": "https://map.example"}
    answer = filming_client.post(ADDRESS, json=REQUEST_BODY, headers=page)
    exposed_headers = answer.headers["access-control-expose-headers"]
    assert {"Location", "Retry-After", "Content-Range"} <= {header.strip() for header in exposed_headers.split(",")}
    preflight = filming_client.options(answer.headers["location"], headers=page | {"Access-Control-Request-Method": "DELETE"})
    assert preflight.status_code == 200 and "DELETE" in preflight.headers["access-control-allow-methods"]


def test_metrics_count_animations(filming_client: Client):
    wait_for_end(filming_client, filming_client.post(ADDRESS, json=REQUEST_BODY))
    text = filming_client.get("/metrics").text
    assert 'skugga_animations{status="successful"} 1.0' in text
    assert 'skugga_animations_ended_total{status="successful"} 1.0' in text
    assert f'skugga_cache_bytes{{cache="films"}} {float(filming_client.service.animations.cached_bytes)}' in text
    assert 'route="/animations/{animation}"' in text


@pytest.fixture(scope="module")
def viewed_service(folder: Path) -> Iterator[tuple[Client, Path]]:
    """Yield a client of a real service and its level, which has a perspective view."""
    view = {"kind": "perspective", "eye": EYE, "target": TARGET, "size": [96, 64]}
    level = write_level(folder, "viewed_film", views={"eye": view, "map": {"kind": "map"}})
    with running(create_app(Settings(workers=1), [level, write_level(folder, "site_film", ENGINEERING)])) as client:
        yield client, level


@pytest.mark.parametrize(
    "body_changes",
    [
        {"view": "eye", "size": None, "style": "swiss", "algorithm": "shadow_map"},
        {"view": "map"},
        {"path": {"keys": CAMERA_KEYS, "size": [64, 48]}, "size": None, "to": "2024-06-21T16:00:02+02:00", "step": "1s"},
        {"path": {"keys": CAMERA_KEYS}, "from": None, "to": None, "step": "1s", "azimuth": 100, "altitude": 30},
    ],
    ids=["view", "map", "path", "path under a sun that rests"],
)  # fmt: skip
def test_animation_equals_command_line_and_snapshots(
    viewed_service, tmp_path: Path, body_changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
):
    """Their pixels are equal bit for bit if no encoding has losses."""
    client, level = viewed_service
    body = {key: value for key, value in (REQUEST_BODY | body_changes | {"lossless": True}).items() if value is not None}
    state = wait_for_end(client, client.post("/levels/viewed_film/animations", json=body))
    assert state["status"] == "successful", state["message"]
    pictures = pictures_of(client.get(f"/animations/{state['jobID']}/result").content)
    assert len(pictures) == 3 and not np.array_equal(pictures[0], pictures[2])
    options = {
        f"--{key}": str(body[key])
        for key in ("from", "to", "step", "view", "style", "algorithm", "azimuth", "altitude")
        if key in body
    }
    if "path" in body:
        camera = tmp_path / "camera.yaml"
        camera.write_text(json.dumps(body["path"]), encoding="utf-8")
        options["--path"] = str(camera)
    if "size" in body:
        options["--size"] = "x".join(map(str, body["size"]))
    output = tmp_path / "film.webp"
    arguments = [argument for pair in options.items() for argument in pair]
    monkeypatch.setattr(sys, "argv", ["skugga", "render", str(level), *arguments, "--lossless", "-o", str(output)])
    with pytest.raises(SystemExit) as command:
        cli.main()
    assert command.value.code == 0
    expected = pictures_of(output.read_bytes())
    assert all(np.array_equal(*pair) for pair in zip(pictures, expected, strict=True))
    if "path" not in body:
        for number, picture in enumerate(pictures):
            query = {
                "view": body["view"],
                "time": f"2024-06-21T{16 + number}:00:00+02:00",
                "size": "x".join(map(str, body.get("size", (96, 64)))),
            }
            query |= {key: body[key] for key in ("style", "algorithm") if key in body}
            snapshot = client.get("/levels/viewed_film/snapshot.png", params=query)
            assert snapshot.status_code == 200, snapshot.text
            assert np.array_equal(picture, np.asarray(Image.open(io.BytesIO(snapshot.content)).convert("RGB"))), number


def test_webp_is_lossy_as_of_the_command_line(viewed_service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Both write the same file. A lossless film is another one, and larger."""
    client, level = viewed_service
    films, body = {}, REQUEST_BODY | {"view": "eye", "size": [192, 128]}
    for lossless in (False, True):
        state = wait_for_end(
            client, client.post("/levels/viewed_film/animations", json=body | ({"lossless": True} if lossless else {}))
        )
        films[lossless] = client.get(f"/animations/{state['jobID']}/result").content
    assert b"VP8 " in films[False] and b"VP8L" not in films[False]
    assert b"VP8L" in films[True] and b"VP8 " not in films[True]
    assert 2 * len(films[False]) < len(films[True])
    output = tmp_path / "film.webp"
    span = [argument for key in ("from", "to", "step") for argument in (f"--{key}", REQUEST_BODY[key])]
    arguments = ["render", str(level), *span, "--view", "eye", "--size", "192x128", "-o", str(output)]
    monkeypatch.setattr(sys, "argv", ["skugga", *arguments])
    with pytest.raises(SystemExit) as command:
        cli.main()
    assert command.value.code == 0
    assert output.read_bytes() == films[False]


@pytest.mark.parametrize(
    ("level", "body_changes", "status", "parameter", "expected_text"),
    [
        (
            "viewed_film",
            {"path": {"keys": [CAMERA_KEYS[0], CAMERA_KEYS[1] | {"eye": [0, 0, 100]}]}},
            422,
            "path.keys.1.eye",
            "on the terrain's data",
        ),
        (
            "viewed_film",
            {"path": {"keys": UNDERGROUND_KEYS}, "step": "1h"},
            422,
            "path",
            "frame 2 (2024-06-21T17:00:00+02:00): eye",
        ),
        ("site_film", {}, 422, "from", "azimuth"),
        ("viewed_film", {"view": "eye", "algorithm": "planar"}, 422, None, ""),
    ],
)
def test_scene_errors_are_reported_on_post(
    viewed_service, level: str, body_changes: dict[str, Any], status: int, parameter: str, expected_text: str
):
    client, _ = viewed_service
    answer = client.post(f"/levels/{level}/animations", json=REQUEST_BODY | body_changes)
    assert answer.status_code == status, answer.text
    problem = answer.json()
    if parameter is not None:
        assert problem["parameter"] == parameter
    assert expected_text in problem["detail"]
