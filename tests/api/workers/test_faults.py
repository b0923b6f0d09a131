"""Responses to clients when render processes fail, hang or are too few."""

import functools
import os
import signal
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

import pytest

from skugga.api.workers.worker_main import worker_main
from tests.api.conftest import CORNER, ZOOM, Client
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

X, Y = CORNER
TIMEOUT_S = 30.0


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds. Fail after ``TIMEOUT_S`` seconds."""
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def tile(x: int = X, y: int = Y) -> str:
    """Return the URL path of a tile of the level ``hills``."""
    return f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{x}/{y}.png"


@pytest.fixture
def gated_client(serve_with) -> tuple[Client, Callable[[], None], Callable[[], None]]:
    """Return a client whose service queues one more block, a function that waits until a block has begun, and one that
    releases it.
    """
    spawn = get_context("spawn")
    job_started, may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
    client = serve_with(
        functools.partial(fake_workers.scripted, job_started=job_started, may_finish=may_finish), queue_length=1, queue_work_s=0.1
    )

    def wait_for_start() -> None:
        assert job_started.acquire(timeout=TIMEOUT_S)

    return client, wait_for_start, may_finish.release


def test_a_full_queue_is_503_with_retry_after(gated_client):
    client, wait_for_start, release = gated_client
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(client.get, tile())
        wait_for_start()
        second = threads.submit(client.get, tile(X - 1))
        while client.service.pool.queued_count < 1:
            client.get("/healthz")
        refusal = client.get(tile(X, Y - 1))
        check_problem(refusal, 503, "busy", None)
        assert int(refusal.headers["retry-after"]) >= 1
        release()
        release()
        assert [first.result().status_code, second.result().status_code] == [200, 200]


def test_the_service_answers_while_a_block_waits(gated_client):
    client, wait_for_start, release = gated_client
    with ThreadPoolExecutor(1) as thread:
        drawing = thread.submit(client.get, tile())
        wait_for_start()
        assert client.get("/healthz").status_code == 200
        assert client.get("/levels").status_code == 200
        assert not drawing.done()
        release()
        assert drawing.result().status_code == 200


def test_work_of_a_disconnected_client_is_dropped(gated_client):
    client, wait_for_start, release = gated_client
    with ThreadPoolExecutor(1) as thread:
        first = thread.submit(client.get, tile())
        wait_for_start()
        with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
            connection.sendall(f"GET {tile(X - 1)} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
            while client.service.pool.queued_count < 1:
                client.get("/healthz")
        while client.service.pool.queued_count:
            client.get("/healthz")
        release()
        assert first.result().status_code == 200
    assert client.service.pool.counters.jobs_abandoned == 1


def test_a_block_of_a_killed_process_is_retried(gated_client):
    client, wait_for_start, release = gated_client
    with ThreadPoolExecutor(1) as thread:
        drawing = thread.submit(client.get, tile())
        wait_for_start()
        os.kill(*client.service.pool.ready_pids, signal.SIGKILL)
        wait_for_start()
        release()
        assert drawing.result().status_code == 200, "another process draws the block again"


def test_repeated_crashes_open_the_circuit_breaker(serve_with):
    client = serve_with(functools.partial(fake_workers.scripted, command_for_all="crash"))
    for _ in range(2):
        answer = client.get(tile())
        check_problem(answer, 503, "worker_crash", None)
        assert int(answer.headers["retry-after"]) >= 1
    answer = client.get(tile())
    problem = check_problem(answer, 503, "set_aside", None)
    assert "hills" in problem["detail"]
    assert int(answer.headers["retry-after"]) >= 1
    assert client.service.pool.counters.processes_started <= 5


def test_a_block_that_takes_too_long_is_504(serve_with):
    client = serve_with(fake_workers.hanging, render_timeout_s=0.5)
    check_problem(client.get(tile()), 504, "render_timeout", None)
    assert client.get("/healthz").status_code == 200


def test_a_service_that_cannot_draw_is_503(serve_with):
    client = serve_with(fake_workers.failing_at_start)
    problem = check_problem(client.get(tile()), 503, "graphics", None)
    assert "secret" not in problem["detail"] and "libEGL" not in problem["detail"]
    check_problem(client.get("/readyz"), 503, "not_ready", None)
    assert client.get("/healthz").status_code == 200


def test_a_process_killed_during_warm_up_is_restarted(serve_with):
    """The death of a process is no evidence about OpenGL."""
    may_finish = get_context("spawn").Semaphore(0)
    client = serve_with(functools.partial(fake_workers.compiling, may_finish=may_finish))
    wait_until(lambda: client.service.pool.preparing.task == "compiling loops for map tiles")
    with ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(client.get, tile())
        wait_until(lambda: client.service.pool.queued_count == 1)
        (worker,) = client.service.pool.supervisor.workers
        os.kill(worker.pid, signal.SIGKILL)
        answer = waiting.result()
    problem = check_problem(answer, 503, "worker_start", None)
    assert "OpenGL" not in problem["detail"] and "restarted" in problem["detail"]
    assert int(answer.headers["retry-after"]) >= 1
    may_finish.release()
    wait_until(lambda: client.get("/readyz").status_code == 200)
    assert client.get(tile()).status_code == 200


def test_an_unexpected_renderer_is_503(serve_with):
    client = serve_with(worker_main, expect_renderer="no such renderer")
    check_problem(client.get(tile()), 503, "graphics", None)
    check_problem(client.get("/readyz"), 503, "not_ready", None)


def test_a_first_start_reports_progress_and_tiles_wait(serve_with):
    may_finish = get_context("spawn").Semaphore(0)
    client = serve_with(functools.partial(fake_workers.compiling, may_finish=may_finish))
    with ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(client.get, tile())
        while (problem := check_problem(client.get("/readyz"), 503, "not_ready", None))["preparing"]["total"] == 0:
            pass
        elapsed_s = problem["preparing"].pop("elapsed_s")
        assert problem["preparing"] == {"task": "compiling loops for map tiles", "done": 3, "total": 9}
        time.sleep(1.0)
        later_s = client.get("/readyz").json()["preparing"]["elapsed_s"]
        # Both are rounded to tenths of a second.
        assert 0.85 <= later_s - elapsed_s < TIMEOUT_S, "the seconds count from the service's start, for every client"
        assert client.get("/levels").status_code == 200, "answers that need no drawing are available"
        assert not waiting.done()
        may_finish.release()
        assert waiting.result(TIMEOUT_S).status_code == 200
    ready = client.get("/readyz")
    assert ready.status_code == 200 and ready.json()["preparing"] is None


def test_internal_messages_stay_in_the_log(serve_with, caplog: pytest.LogCaptureFixture):
    problem = check_problem(serve_with(fake_workers.leaking_errors).get(tile()), 500, "render", None)
    assert "secret" not in problem["detail"]


def test_not_ready_before_the_first_process(serve_with):
    client = serve_with(fake_workers.never_ready)
    answer = client.get("/readyz")
    check_problem(answer, 503, "not_ready", None)
    assert int(answer.headers["retry-after"]) >= 1


def test_not_modified_is_answered_without_rendering(serve_with):
    client = serve_with(fake_workers.scripted, block_cache_bytes=0, tile_cache_bytes=0)
    tag = client.get(tile()).headers["etag"]
    for if_none_match in (tag, f'"other", {tag}', f"W/{tag}", "*"):
        answer = client.get(tile(), headers={"If-None-Match": if_none_match})
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["etag"] == tag
        assert "max-age" in answer.headers["cache-control"]
    assert client.service.pool.counters.jobs_answered == 1
    assert client.get(tile(), headers={"If-None-Match": '"other"'}).status_code == 200
    assert client.service.pool.counters.jobs_answered == 2


@pytest.mark.parametrize("policy", ["204", "404"])
def test_empty_tiles_follow_the_configured_policy(serve_with, policy: str):
    client = serve_with(fake_workers.scripted, empty_tile=policy)
    answer = client.get(tile(X + 50))
    if policy == "404":
        check_problem(answer, 404, "not_found", "x")
    else:
        assert (answer.status_code, answer.content) == (204, b"")
        assert answer.headers["etag"]
    assert client.get(tile()).status_code == 200


def test_the_entity_tag_depends_on_the_renderer(serve_with, client: Client):
    fake_response, real_response = serve_with(fake_workers.scripted).get(tile()), client.get(tile())
    assert fake_response.headers["etag"] != real_response.headers["etag"]


def test_an_unexpected_error_is_a_problem_document(serve_with, monkeypatch: pytest.MonkeyPatch):
    client = serve_with(fake_workers.scripted)
    monkeypatch.setattr(client.service.levels, "names", lambda: 1 / 0)
    problem = check_problem(client.get("/levels"), 500, "internal", None)
    assert "division" not in problem["detail"]


def test_links_use_the_public_url(serve_with):
    client = serve_with(fake_workers.scripted, public_url="https://maps.example/shade/")
    (template,) = client.get("/levels/hills/WebMercatorQuad/tilejson.json").json()["tiles"]
    assert template == "https://maps.example/shade/levels/hills/tiles/WebMercatorQuad/{z}/{x}/{y}.png"


def test_only_configured_origins_get_cors_headers(serve_with):
    client = serve_with(fake_workers.scripted, cors_origins=("https://a.example",))
    allowed_response, refused_response = (client.get("/levels", headers={"Origin": f"https://{name}.example"}) for name in "ab")
    assert allowed_response.headers["access-control-allow-origin"] == "https://a.example"
    assert "origin" in allowed_response.headers["vary"].lower()
    assert "access-control-allow-origin" not in refused_response.headers
