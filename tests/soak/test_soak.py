"""A service as operators run it, under more load than it can bear, and while its render processes are killed and stopped.

Each test prints what it measured (``make test-soak``). What is held: every answer is one that the interface knows, what cannot be
done is refused with a time to come back, and the service is whole afterwards.
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
from tests.api.http.test_serve import alive
from tests.soak.clients import Answers, Connection, closed_loop, open_loop
from tests.soak.service import (
    EXPECTED_STATUSES,
    TILE,
    WORKERS,
    ask,
    is_ready,
    new_sun_paths,
    render_processes,
    service,
    wait_until_ready,
)

pytestmark = pytest.mark.soak

SECONDS = float(os.environ.get("SOAK_SECONDS", "20"))
TILES = int(os.environ.get("SOAK_TILES", "2000"))
"""How many tiles the long walk asks for; its figures are told for 100,000."""

KILLS, CLIENTS, WALK = 12, 4, 16
"""Render processes killed on the way; who asks at a time, and for how many neighbours under one sun before looking elsewhere."""

SETTLED_S = 15.0
"""How long an overload lasts before it is measured: a burst is let in, and has to be worked off first."""

ANIMATIONS = 3
"""The first is not disturbed; render processes are killed while the others are drawn."""

DAY = {"from": "2024-06-21T06:00:00+02:00", "to": "2024-06-21T18:00:00+02:00", "step": "20m", "size": [320, 240]}


def resident_mib(pid: int) -> float:
    """Memory that a process takes now."""
    pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
    return int(pages) * resource.getpagesize() / 2**20


def test_four_times_the_load(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Accepted requests keep their latency, others are refused with a time to come back, and what is kept is answered at once."""
    suns = new_sun_paths()
    with service(tmp_path) as (port, _, log):
        asyncio.run(closed_loop(port, lambda: next(suns), WORKERS, 5.0))
        sustained = asyncio.run(closed_loop(port, lambda: next(suns), WORKERS, SECONDS))
        rate = sustained.count(200) / SECONDS
        tag = asyncio.run(_tag(port))

        async def saturated() -> list[Answers]:
            return await asyncio.gather(
                open_loop(port, lambda: next(suns), 4.0 * rate, SECONDS, skip_s=SETTLED_S),
                open_loop(port, lambda: TILE, 20.0, SECONDS + SETTLED_S),
                open_loop(port, lambda: "/healthz", 20.0, SECONDS + SETTLED_S),
                open_loop(port, lambda: TILE, 20.0, SECONDS + SETTLED_S, f"If-None-Match: {tag}\r\n"),
            )

        new_sun_answers, cached_answers, health, unchanged = asyncio.run(saturated())
        size = log.stat().st_size
    with capsys.disabled():
        print(f"\nsustained: {rate:.1f} tiles a second under new suns; {sustained.line('tiles')}")
        print(f"at four times that, {new_sun_answers.line('new suns')}")
        for name, answers in (("kept tiles", cached_answers), ("/healthz", health), ("304", unchanged)):
            print(f"meanwhile, {answers.line(name)}")
        print(f"log: {size} bytes")
    assert set(new_sun_answers.statuses) <= EXPECTED_STATUSES
    assert new_sun_answers.retry_after_count == new_sun_answers.count(503), "a refusal says when to come back"
    assert new_sun_answers.count(200) > 0.5 * rate * SECONDS, "throughput holds under overload"
    for answers, status in ((cached_answers, 200), (health, 200), (unchanged, 304)):
        assert set(answers.statuses) == {status}
    assert size < 1_000_000


async def _tag(port: int) -> str:
    connection = Connection(port)
    response_headers = await connection.get(TILE, Answers())
    connection.close()
    return response_headers["etag"]


def test_processes_killed_and_stopped_under_load(tmp_path: Path, capsys: pytest.CaptureFixture):
    suns, chosen = new_sun_paths(), random.Random(7)
    with service(tmp_path) as (port, process, _):

        async def harm() -> int:
            kill_count, until = 0, time.monotonic() + SECONDS
            while time.monotonic() < until:
                await asyncio.sleep(chosen.uniform(1.0, 3.0))
                workers = await asyncio.to_thread(render_processes, process.pid)
                if workers:
                    os.kill(chosen.choice(workers), chosen.choice([signal.SIGKILL, signal.SIGSTOP]))
                    kill_count += 1
            return kill_count

        async def both() -> tuple[Answers, Answers, int]:
            return await asyncio.gather(
                closed_loop(port, lambda: next(suns), 4, SECONDS), open_loop(port, lambda: "/healthz", 10.0, SECONDS), harm()
            )

        tiles, health, harmed = asyncio.run(both())
        mended_s = wait_until_ready(port)
        workers = render_processes(process.pid)
        process.kill()
        process.wait()
        time.sleep(1.0)
        left = [pid for pid in workers if alive(pid)]
    with capsys.disabled():
        print(f"\n{harmed} processes killed or stopped in {SECONDS:g} s: {tiles.line('tiles')}; whole again after {mended_s:.1f} s")
    assert set(tiles.statuses) <= EXPECTED_STATUSES and tiles.count(200) > 0
    assert set(health.statuses) == {200}
    assert not left, "processes outlived a service that was killed"


def test_many_tiles_under_the_suns_of_a_day(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Clients that look around under 24 suns while render processes are killed: a tile is the same to the byte whenever it is asked
    for and whoever draws it, nothing fails, and memory does not grow.
    """
    chosen, digest_by_path, answers = random.Random(11), {}, Answers()
    suns = [(60.0 + 10.0 * hour, 4.0 + 2.0 * min(hour, 23 - hour)) for hour in range(24)]
    with service(tmp_path, SKUGGA_RECYCLE_BLOCKS="300") as (port, process, _):
        left = itertools.count()

        async def look_around() -> None:
            connection = Connection(port)
            while next(left) * WALK < TILES:
                zoom, sun = chosen.choice((ZOOM - 1, ZOOM, ZOOM, ZOOM + 1, ZOOM + 1, ZOOM + 1)), chosen.choice(suns)
                scale = 2.0 ** (zoom - ZOOM)
                x0, y0 = (int((corner + chosen.uniform(-2.0, 2.0)) * scale) for corner in CORNER)
                for n in range(WALK):
                    x, y = x0 + n % 4, y0 + n // 4
                    path = f"/levels/hills/tiles/WebMercatorQuad/{zoom}/{x}/{y}.png?azimuth={sun[0]:g}&altitude={sun[1]:g}"
                    for _ in range(20):  # a refusal says when to come back
                        response_headers = await connection.get(path, answers)
                        if answers.statuses[-1] not in (503, 504):
                            break
                        await asyncio.sleep(float(response_headers.get("retry-after", "1")))
                    if connection.body and answers.statuses[-1] == 200:
                        digest = hashlib.blake2b(connection.body, digest_size=16).digest()
                        assert digest_by_path.setdefault(path, digest) == digest, f"another picture of {path}"
            connection.close()

        async def harm() -> list[tuple[float, float]]:
            """The memory of the service, and of its largest render process, each time before one is killed."""
            memory = []
            for number in range(1, KILLS + 1):
                while len(answers.statuses) < number * TILES / (KILLS + 1):
                    await asyncio.sleep(0.2)
                workers = await asyncio.to_thread(render_processes, process.pid)
                memory.append((resident_mib(process.pid), max(map(resident_mib, workers), default=0.0)))
                if workers:
                    os.kill(chosen.choice(workers), signal.SIGKILL)
            return memory

        async def both() -> list[tuple[float, float]]:
            *_, memory = await asyncio.gather(*(look_around() for _ in range(CLIENTS)), harm())
            return memory

        began = time.monotonic()
        memory = asyncio.run(both())
        seconds = time.monotonic() - began
    service_mib, worker_mib = zip(*memory, strict=True)
    with capsys.disabled():
        print(
            f"\n{answers.count(200)} tiles in {seconds:.0f} s, {len(digest_by_path)} different ones, {KILLS} kills; "
            + answers.line("tiles")
        )
        print(f"service: {service_mib[0]:.0f} to {service_mib[-1]:.0f} MiB; largest render process: {max(worker_mib):.0f} MiB")
    assert set(answers.statuses) <= {200, 503}, "nothing fails"
    assert answers.count(200) >= TILES - CLIENTS * WALK
    kept_mib = (64 + 256) * 1.3  # what the caches may fill on the way, with what stands around them
    assert service_mib[-1] < service_mib[0] + kept_mib
    assert max(worker_mib[KILLS // 2 :]) < 1.3 * max(worker_mib[: KILLS // 2]), "a render process does not grow"


def test_an_animation_outlives_killed_processes(tmp_path: Path, capsys: pytest.CaptureFixture):
    """An animation is the same to the byte whenever its render processes are killed; the service keeps no part of one."""
    chosen, kills, finished = random.Random(3), 0, []
    with service(tmp_path) as (port, process, _):
        for run in range(ANIMATIONS):
            address = ask(port, "/levels/hills/animations", DAY | {"fps": 10 + run})["location"]
            while (status := ask(port, address)["body"]["status"]) in ("accepted", "running"):
                time.sleep(chosen.uniform(0.0, 2.0))
                if run and is_ready(port) and (workers := render_processes(process.pid)):
                    os.kill(chosen.choice(workers), signal.SIGKILL)
                    kills += 1
            assert status == "successful", json.dumps(ask(port, address)["body"])
            with urllib.request.urlopen(f"http://127.0.0.1:{port}{address}/result", timeout=30) as answer:
                finished.append(frames_of(answer.read()))
    with capsys.disabled():
        print(f"\n{ANIMATIONS} animations of {len(finished[0])} frames, {kills} processes killed")
    assert kills >= ANIMATIONS - 1
    assert all(frames == finished[0] for frames in finished)


def frames_of(webp: bytes) -> list[bytes]:
    """Return the hash of each frame of an animation: its speed is another in each, and with it the file."""
    with Image.open(io.BytesIO(webp)) as film:
        return [hashlib.sha256(frame.convert("RGB").tobytes()).digest() for frame in ImageSequence.Iterator(film)]


def test_idle_connections_beyond_the_descriptors(tmp_path: Path, capsys: pytest.CaptureFixture):
    """A limit of 64 open files, and clients that hold 200 connections: the service answers, replaces processes, and logs little."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))
        context = service(tmp_path)
        port, process, log = context.__enter__()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    try:

        async def hold() -> Answers:
            idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(200)]
            for pid in render_processes(process.pid):
                os.kill(pid, signal.SIGKILL)
            answers = await open_loop(port, lambda: "/healthz", 10.0, SECONDS)
            for _, writer in idle:
                writer.close()
            return answers

        health = asyncio.run(hold())
        wait_until_ready(port)
        tiles = asyncio.run(closed_loop(port, lambda: TILE, 1, 2.0))
        size = log.stat().st_size
    finally:
        context.__exit__(None, None, None)
    with capsys.disabled():
        print(f"\n200 idle connections, 64 open files: {health.line('/healthz')}; {tiles.line('tiles')}; log {size} bytes")
    assert health.count(200) > 0.9 * len(health.statuses)
    assert tiles.count(200) > 0
    assert size < 100_000
