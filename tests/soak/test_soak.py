"""A service as operators run it, under more load than it can bear, and while its render processes are killed and stopped.

Each test prints what it measured (``make test-soak``). The tests assert three things: every answer has a status that the interface
documents; work that cannot be done is refused with a time after which to ask again; and the service answers as before afterwards.
"""

from __future__ import annotations

import asyncio
import hashlib
import io
import itertools
import json
import os
import random
import resource
import signal
import time
import urllib.request
from pathlib import Path

import pytest
from PIL import Image, ImageSequence

from tests.api.conftest import CORNER, ZOOM
from tests.api.http.test_serve import is_running
from tests.soak.clients import Answers, Connection, closed_loop, open_loop
from tests.soak.service import (
    EXPECTED_STATUSES,
    TILE,
    WORKERS,
    is_ready,
    new_sun_paths,
    render_processes,
    request_until_accepted,
    service,
    wait_until_ready,
)

pytestmark = pytest.mark.soak

DURATION_S = float(os.environ.get("SOAK_SECONDS", "20"))
TILE_COUNT = int(os.environ.get("SOAK_TILES", "2000"))
"""Number of tiles that the clients request. The figures in the documentation are for 100,000."""

KILL_COUNT, CLIENT_COUNT, WALK_TILES = 12, 4, 16
"""Number of killed render processes; number of clients at a time; number of neighbouring tiles that a client requests under one sun
before it moves elsewhere.
"""

WARM_UP_S = 15.0
"""Seconds of overload before the measurement. The service accepts the first burst and draws it meanwhile."""

ANIMATION_COUNT = 3
"""The first is not disturbed; render processes are killed while the others are drawn."""

DAY = {"from": "2024-06-21T06:00:00+02:00", "to": "2024-06-21T18:00:00+02:00", "step": "20m", "size": [320, 240]}


def resident_mib(pid: int) -> float:
    """Return the resident memory of a process, MiB."""
    pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
    return int(pages) * resource.getpagesize() / 2**20


def test_overload_is_refused_and_latency_holds(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Clients send four times the requests that the service can draw.

    Accepted requests keep their latency, others are refused with a Retry-After header, and cached pictures are sent at once.
    """
    suns = new_sun_paths()
    with service(tmp_path) as (port, _, log):
        asyncio.run(closed_loop(port, lambda: next(suns), WORKERS, 5.0))
        sustained = asyncio.run(closed_loop(port, lambda: next(suns), WORKERS, DURATION_S))
        rate = sustained.count(200) / DURATION_S
        etag = asyncio.run(tile_etag(port))

        async def overload() -> list[Answers]:
            return await asyncio.gather(
                open_loop(port, lambda: next(suns), 4.0 * rate, DURATION_S, warm_up_s=WARM_UP_S),
                open_loop(port, lambda: TILE, 20.0, DURATION_S + WARM_UP_S),
                open_loop(port, lambda: "/healthz", 20.0, DURATION_S + WARM_UP_S),
                open_loop(port, lambda: TILE, 20.0, DURATION_S + WARM_UP_S, f"If-None-Match: {etag}\r\n"),
            )

        new_sun_answers, cached_answers, health, unchanged = asyncio.run(overload())
        log_bytes = log.stat().st_size
    with capsys.disabled():
        print(f"\nsustained: {rate:.1f} tiles a second under new suns; {sustained.summary('tiles')}")
        print(f"at four times that, {new_sun_answers.summary('new suns')}")
        for name, answers in (("cached tiles", cached_answers), ("/healthz", health), ("304", unchanged)):
            print(f"meanwhile, {answers.summary(name)}")
        print(f"log: {log_bytes} bytes")
    assert set(new_sun_answers.statuses) <= EXPECTED_STATUSES
    assert new_sun_answers.retry_after_count == new_sun_answers.count(503), "each refusal has a Retry-After header"
    assert new_sun_answers.count(200) > 0.5 * rate * DURATION_S, "throughput holds under overload"
    for answers, status in ((cached_answers, 200), (health, 200), (unchanged, 304)):
        assert set(answers.statuses) == {status}
    assert log_bytes < 1_000_000


async def tile_etag(port: int) -> str:
    """Return the entity tag of a tile."""
    connection = Connection(port)
    response_headers = await connection.get(TILE, Answers())
    connection.close()
    return response_headers["etag"]


def test_service_survives_killed_and_stopped_processes(tmp_path: Path, capsys: pytest.CaptureFixture):
    suns, rng = new_sun_paths(), random.Random(7)
    with service(tmp_path) as (port, process, _):

        async def kill_repeatedly() -> int:
            kill_count, deadline = 0, time.monotonic() + DURATION_S
            while time.monotonic() < deadline:
                await asyncio.sleep(rng.uniform(1.0, 3.0))
                workers = await asyncio.to_thread(render_processes, process.pid)
                if workers:
                    os.kill(rng.choice(workers), rng.choice([signal.SIGKILL, signal.SIGSTOP]))
                    kill_count += 1
            return kill_count

        async def run_together() -> tuple[Answers, Answers, int]:
            return await asyncio.gather(
                closed_loop(port, lambda: next(suns), 4, DURATION_S),
                open_loop(port, lambda: "/healthz", 10.0, DURATION_S),
                kill_repeatedly(),
            )

        tiles, health, kill_count = asyncio.run(run_together())
        ready_after_s = wait_until_ready(port)
        workers = render_processes(process.pid)
        process.kill()
        process.wait()
        time.sleep(1.0)
        remaining_pids = [pid for pid in workers if is_running(pid)]
    with capsys.disabled():
        print(
            f"\n{kill_count} processes killed or stopped in {DURATION_S:g} s: {tiles.summary('tiles')}; "
            f"ready again after {ready_after_s:.1f} s"
        )
    assert set(tiles.statuses) <= EXPECTED_STATUSES and tiles.count(200) > 0
    assert set(health.statuses) == {200}
    assert not remaining_pids, "processes outlived a service that was killed"


def test_many_tiles_leave_memory_bounded(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Clients request tiles of many places under 24 suns while render processes are killed.

    Equal requests get equal bytes from every process, no request fails, and memory does not grow.
    """
    rng, digest_by_path, answers = random.Random(11), {}, Answers()
    suns = [(60.0 + 10.0 * hour, 4.0 + 2.0 * min(hour, 23 - hour)) for hour in range(24)]
    with service(tmp_path, SKUGGA_RECYCLE_BLOCKS="300") as (port, process, _):
        walk_numbers = itertools.count()

        async def walk() -> None:
            connection = Connection(port)
            while next(walk_numbers) * WALK_TILES < TILE_COUNT:
                zoom, sun = rng.choice((ZOOM - 1, ZOOM, ZOOM, ZOOM + 1, ZOOM + 1, ZOOM + 1)), rng.choice(suns)
                scale = 2.0 ** (zoom - ZOOM)
                x0, y0 = (int((corner + rng.uniform(-2.0, 2.0)) * scale) for corner in CORNER)
                for n in range(WALK_TILES):
                    x, y = x0 + n % 4, y0 + n // 4
                    path = f"/levels/hills/tiles/WebMercatorQuad/{zoom}/{x}/{y}.png?azimuth={sun[0]:g}&altitude={sun[1]:g}"
                    for _ in range(20):  # wait for the time in the Retry-After header of a refusal
                        response_headers = await connection.get(path, answers)
                        if answers.statuses[-1] not in (503, 504):
                            break
                        await asyncio.sleep(float(response_headers.get("retry-after", "1")))
                    if connection.body and answers.statuses[-1] == 200:
                        digest = hashlib.blake2b(connection.body, digest_size=16).digest()
                        assert digest_by_path.setdefault(path, digest) == digest, f"another picture of {path}"
            connection.close()

        async def kill_and_measure_memory() -> list[tuple[float, float]]:
            """Return the MiB of the service and of its largest render process before each kill."""
            memory = []
            for number in range(1, KILL_COUNT + 1):
                while len(answers.statuses) < number * TILE_COUNT / (KILL_COUNT + 1):
                    await asyncio.sleep(0.2)
                workers = await asyncio.to_thread(render_processes, process.pid)
                memory.append((resident_mib(process.pid), max(map(resident_mib, workers), default=0.0)))
                if workers:
                    os.kill(rng.choice(workers), signal.SIGKILL)
            return memory

        async def run_together() -> list[tuple[float, float]]:
            *_, memory = await asyncio.gather(*(walk() for _ in range(CLIENT_COUNT)), kill_and_measure_memory())
            return memory

        start_s = time.monotonic()
        memory = asyncio.run(run_together())
        seconds = time.monotonic() - start_s
    service_mib, worker_mib = zip(*memory, strict=True)
    with capsys.disabled():
        print(
            f"\n{answers.count(200)} tiles in {seconds:.0f} s, {len(digest_by_path)} different ones, {KILL_COUNT} kills; "
            + answers.summary("tiles")
        )
        print(f"service: {service_mib[0]:.0f} to {service_mib[-1]:.0f} MiB; largest render process: {max(worker_mib):.0f} MiB")
    assert set(answers.statuses) <= {200, 503}, "a request failed"
    assert answers.count(200) >= TILE_COUNT - CLIENT_COUNT * WALK_TILES
    cache_mib = (64 + 256) * 1.3  # what the caches may fill on the way, with what stands around them
    assert service_mib[-1] < service_mib[0] + cache_mib
    assert max(worker_mib[KILL_COUNT // 2 :]) < 1.3 * max(worker_mib[: KILL_COUNT // 2]), "a render process does not grow"


def test_killed_processes_change_no_animation(tmp_path: Path, capsys: pytest.CaptureFixture):
    """An animation has equal frames whether or not its render processes are killed."""
    rng, kills, finished = random.Random(3), 0, []
    with service(tmp_path) as (port, process, _):
        for run in range(ANIMATION_COUNT):
            address = request_until_accepted(port, "/levels/hills/animations", DAY | {"fps": 10 + run})["location"]
            while (status := request_until_accepted(port, address)["body"]["status"]) in ("accepted", "running"):
                time.sleep(rng.uniform(0.0, 2.0))
                if run and is_ready(port) and (workers := render_processes(process.pid)):
                    os.kill(rng.choice(workers), signal.SIGKILL)
                    kills += 1
            assert status == "successful", json.dumps(request_until_accepted(port, address)["body"])
            with urllib.request.urlopen(f"http://127.0.0.1:{port}{address}/result", timeout=30) as answer:
                finished.append(frames_of(answer.read()))
    with capsys.disabled():
        print(f"\n{ANIMATION_COUNT} animations of {len(finished[0])} frames, {kills} processes killed")
    assert kills >= ANIMATION_COUNT - 1
    assert all(frames == finished[0] for frames in finished)


def frames_of(webp: bytes) -> list[bytes]:
    """Return the hash of each frame of an animation. Whole files differ, because each animation has another frame rate."""
    with Image.open(io.BytesIO(webp)) as film:
        return [hashlib.sha256(frame.convert("RGB").tobytes()).digest() for frame in ImageSequence.Iterator(film)]


def test_service_answers_with_200_idle_connections(tmp_path: Path, capsys: pytest.CaptureFixture):
    """A limit of 64 open files, and clients that hold 200 connections: the service answers, replaces processes, and logs little."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))
        context = service(tmp_path)
        port, process, log = context.__enter__()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    try:

        async def hold_idle_connections() -> Answers:
            idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(200)]
            for pid in render_processes(process.pid):
                os.kill(pid, signal.SIGKILL)
            answers = await open_loop(port, lambda: "/healthz", 10.0, DURATION_S)
            for _, writer in idle:
                writer.close()
            return answers

        health = asyncio.run(hold_idle_connections())
        wait_until_ready(port)
        tiles = asyncio.run(closed_loop(port, lambda: TILE, 1, 2.0))
        log_bytes = log.stat().st_size
    finally:
        context.__exit__(None, None, None)
    with capsys.disabled():
        print(
            f"\n200 idle connections, 64 open files: {health.summary('/healthz')}; {tiles.summary('tiles')}; log {log_bytes} bytes"
        )
    assert health.count(200) > 0.9 * len(health.statuses)
    assert tiles.count(200) > 0
    assert log_bytes < 100_000
