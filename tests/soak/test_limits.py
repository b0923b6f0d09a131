"""A service and its commands at the limits of the operating system: threads, file handles, memory, disk, and killed processes.

The limits are real: of the running processes (prlimit(2)), or of a small disk (tmpfs). Each test prints what it measured. At a
limit each answer is a picture, or a refusal with a time to come back. Afterwards the service is whole, and pictures are the same to
the byte.
"""

from __future__ import annotations

import hashlib
import http.client
import itertools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.api.conftest import write_level
from tests.soak.service import (
    TILE,
    is_ready,
    new_sun_paths,
    render_processes,
    run_command,
    service,
    skugga_process,
    wait_until_ready,
)

pytestmark = pytest.mark.soak

MOMENT_COUNT, MOMENT_S = 7, 4.0
"""Number of moments without a free thread, and their duration."""

PAUSE_S = float(os.environ.get("SOAK_PAUSE_S", "31"))
"""Seconds between the starts of two such moments: a check of a level's files is given up after 30 s."""

ALLOWED_STATUSES = {200, 202, 304, 429, 503, 504}
"""Statuses at a limit. Requests for films are answered by 202."""

SNAPSHOT = "/levels/hills/snapshot.png?view=map&size=320x240"
DAY = {"from": "2024-06-21T06:00:00+02:00", "to": "2024-06-21T18:00:00+02:00", "step": "1h", "size": [320, 240]}

UNPRIVILEGED_UID = 65534
"""User without processes of its own: the kernel does not apply the limit of processes to root."""


@dataclass
class Answer:
    """The status, the headers and the body of an answer. Status 0 stands for a connection that ended early."""

    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> Any:
        """Return the content of a JSON body."""
        return json.loads(self.body)


@dataclass
class ObservedAnswers:
    """Statuses by kind of request, seconds of each answer, and descriptions of answers that must not occur."""

    allowed: set[int] = field(default_factory=lambda: set(ALLOWED_STATUSES))
    statuses: dict[str, Counter[int]] = field(default_factory=dict)
    slowest_s: dict[str, float] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    kinds_cut_short: set[str] = field(default_factory=set)

    def add(self, kind: str, answer: Answer, seconds: float) -> None:
        """Record an answer to a kind of request that took ``seconds``."""
        self.statuses.setdefault(kind, Counter())[answer.status] += 1
        self.slowest_s[kind] = max(self.slowest_s.get(kind, 0.0), seconds)
        allowed = {200} if kind == "health" else self.allowed | ({0} if kind in self.kinds_cut_short else set())
        is_allowed = answer.status in allowed
        if not is_allowed or (answer.status in (429, 503) and "retry-after" not in answer.headers):
            self.faults.append(f"{kind}: {answer.status} {answer.body[:500]!r} {answer.headers}")

    def check(self) -> None:
        """Fail if an answer occurred that must not, with some examples of each kind."""
        kinds = Counter(fault[:60] for fault in self.faults)
        examples = [next(fault for fault in self.faults if fault.startswith(kind)) for kind in kinds]
        assert not self.faults, "\n".join([f"{len(self.faults)} wrong answers: {self.summary()}", *examples[:8]])

    def count(self, status: int) -> int:
        """Return the number of answers with a status, over all kinds of requests."""
        return sum(counter[status] for counter in self.statuses.values())

    def summary(self) -> str:
        """Format statuses and slowest answers by kind of request."""
        kinds = (
            f"{kind} {dict(sorted(counter.items()))} in up to {self.slowest_s[kind]:.1f} s"
            for kind, counter in sorted(self.statuses.items())
        )
        return f"{sum(counter.total() for counter in self.statuses.values())} answers: {'; '.join(kinds)}"


def send(port: int, path: str, body: dict[str, Any] | None = None, timeout_s: float = 120.0) -> Answer:
    """Send a request over a connection of its own."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=timeout_s)
    try:
        content = None if body is None else json.dumps(body)
        headers = {"Connection": "close"} | ({} if body is None else {"Content-Type": "application/json"})
        connection.request("GET" if body is None else "POST", path, content, headers)
        response = connection.getresponse()
        return Answer(response.status, {name.lower(): value for name, value in response.getheaders()}, response.read())
    except (OSError, http.client.HTTPException) as error:
        return Answer(0, {}, repr(error).encode())
    finally:
        connection.close()


def fetch_picture(port: int, path: str, within_s: float = 300.0) -> bytes:
    """Return the body of a picture, requested again after refusals."""
    deadline = time.monotonic() + within_s
    while (answer := send(port, path)).status != 200:
        assert answer.status in ALLOWED_STATUSES and time.monotonic() < deadline, (path, answer)
        time.sleep(0.5)
    return answer.body


def fetch_film(port: int, film_order: dict[str, Any], within_s: float = 300.0) -> bytes:
    """Return a film, ordered again after refusals and after failures for want of resources."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        answer = send(port, "/levels/hills/animations", film_order)
        if answer.status in (200, 202):
            answer = result_of_film(port, answer, ObservedAnswers())
        if answer.status == 200:
            return answer.body
        assert answer.status in {*ALLOWED_STATUSES, 507}, answer
        time.sleep(0.5)
    raise AssertionError("no film was drawn in time")


def address_of_ended_film(port: int, accepted: Answer, observed_answers: ObservedAnswers) -> str:
    """Wait until an accepted film has ended, and return the address of its result."""
    location = accepted.headers["location"]
    address = location[location.index("/animations") :]
    deadline = time.monotonic() + 600.0
    while True:
        start_s = time.monotonic()
        assert start_s < deadline, "the film has not ended within ten minutes"
        state = send(port, address)
        observed_answers.add("film's state", state, time.monotonic() - start_s)
        if state.status == 200 and state.json()["status"] not in ("accepted", "running"):
            return f"{address}/result"
        time.sleep(0.3)


def result_of_film(port: int, accepted: Answer, observed_answers: ObservedAnswers) -> Answer:
    """Wait until an accepted film has ended, and return the answer to a request for its result."""
    return send(port, address_of_ended_film(port, accepted, observed_answers))


def film_orders() -> Iterator[dict[str, Any]]:
    """Yield orders of short films, all different."""
    return (DAY | {"fps": 1 + number % 30, "size": [320 + 2 * (number // 30), 240]} for number in itertools.count())


class BackgroundLoad:
    """Clients in threads that request pictures and films of a service until they are stopped."""

    def __init__(self, port: int, observed_answers: ObservedAnswers) -> None:
        self._port, self._observed = port, observed_answers
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._suns, self._orders = new_sun_paths(), film_orders()
        self._requests: list[Callable[[], object]] = [
            lambda: self._get("new tile", self._next_tile(), 0.05),
            lambda: self._get("cached tile", TILE, 0.2),
            lambda: self._get("snapshot", self._next_snapshot(), 0.1),
            lambda: self._get("health", "/healthz", 0.2),
            lambda: self._get("page's file", "/docs/assets/swagger-ui.css", 0.3),
            self._film,
        ]

    @contextmanager
    def running(self) -> Iterator[None]:
        """Send requests within the block. At its end, wait for the last answers."""
        self._stop.clear()
        threads = [threading.Thread(target=self._repeat, args=(request,)) for request in self._requests]
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            self._stop.set()
            for thread in threads:
                thread.join()

    def _repeat(self, request: Callable[[], object]) -> None:
        while not self._stop.is_set():
            request()

    def _next_tile(self) -> str:
        with self._lock:
            return next(self._suns)

    def _next_snapshot(self) -> str:
        return self._next_tile().replace(TILE, SNAPSHOT).replace("240?", "240&")

    def _get(self, kind: str, path: str, pause_s: float) -> Answer:
        start_s = time.monotonic()
        answer = send(self._port, path)
        with self._lock:
            self._observed.add(kind, answer, time.monotonic() - start_s)
        time.sleep(pause_s)
        return answer

    def _film(self) -> None:
        start_s = time.monotonic()
        accepted = send(self._port, "/levels/hills/animations", next(self._orders))
        self._observed.add("film's order", accepted, time.monotonic() - start_s)
        if accepted.status == 202:
            start_s = time.monotonic()
            self._observed.add("film", result_of_film(self._port, accepted, self._observed), time.monotonic() - start_s)
        else:
            time.sleep(0.5)


def replace_raster(folder: Path, upside_down: bool) -> None:
    """Replace the raster of the level of ``service``, by one with its rows in the opposite order or by the original one."""
    import numpy as np
    import rasterio

    raster = folder / "hills.tif"
    new = folder / "new"
    new.mkdir(exist_ok=True)
    write_level(new, "hills")
    if upside_down:
        with rasterio.open(new / "hills.tif", "r+") as dataset:
            dataset.write(np.ascontiguousarray(dataset.read(1)[::-1]), 1)
    os.replace(new / "hills.tif", raster)


def wait_for_picture(port: int, expected: Callable[[bytes], bool], within_s: float = 60.0) -> float:
    """Wait until the level's tile is as expected, and return the seconds that it took."""
    start_s = time.monotonic()
    while not expected(fetch_picture(port, TILE)):
        assert time.monotonic() - start_s < within_s, "the replaced raster was not read"
        time.sleep(0.5)
    return time.monotonic() - start_s


def descriptor_count(pid: int) -> int:
    """Return the number of open files of a process."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def address_space(pid: int) -> int:
    """Return the bytes of a process's address space."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * resource.getpagesize()


@contextmanager
def soft_limit(resource_kind: int, value_by_pid: dict[int, int]) -> Iterator[None]:
    """Lower a soft limit of running processes within the block."""
    before = {}
    for pid, value in value_by_pid.items():
        with suppress(ProcessLookupError):
            before[pid] = resource.prlimit(pid, resource_kind)
            resource.prlimit(pid, resource_kind, (value, before[pid][1]))
    try:
        yield
    finally:
        for pid, limits in before.items():
            with suppress(ProcessLookupError):
                resource.prlimit(pid, resource_kind, limits)


def kill_render_processes(service_pid: int) -> None:
    """Kill all render processes of a service."""
    for pid in render_processes(service_pid):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def remaining_after_wait(processes: Callable[[], list[int]], timeout_s: float = 15.0) -> list[int]:
    """Return processes that have not ended after some seconds."""
    deadline = time.monotonic() + timeout_s
    while (remaining := processes()) and time.monotonic() < deadline:
        time.sleep(0.2)
    return remaining


# Threads


def limited_user_command() -> list[str]:
    """Return a command that runs another one as a user whose number of processes is limited.

    Root's is not. The other user may read and write all files, since the interpreter can be in root's home folder.
    """
    if os.geteuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("root has no limit of processes, and setpriv is not installed")
    capabilities = "-all,+dac_override"
    return [
        "setpriv", f"--reuid={UNPRIVILEGED_UID}", "--clear-groups", f"--inh-caps={capabilities}", f"--ambient-caps={capabilities}",
        "--",
    ]  # fmt: skip


def set_process_limit(pid: int, limit: int) -> None:
    """Set the soft limit of the processes and threads of a process's user (RLIMIT_NPROC), for the calls of that process."""
    soft = "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
    subprocess.run([*limited_user_command(), "prlimit", f"--pid={pid}", f"--nproc={soft}:"], check=True, timeout=30)


def test_service_survives_moments_without_threads(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Seven moments at which the service can start neither threads nor processes, then a replaced raster.

    The limit is RLIMIT_NPROC of the running service. The kernel does not apply it to root. If root runs the test, the service runs
    as another user, with the capability to read all files.
    """
    if shutil.which("prlimit") is None:
        pytest.skip("prlimit is not installed")
    observed_answers, ready_after_s = ObservedAnswers(), []
    with service(tmp_path, limited_user_command(), SKUGGA_LEVEL_CHECK_S="0.2") as (port, process, log):
        original = fetch_picture(port, TILE)
        replace_raster(tmp_path, upside_down=True)
        wait_for_picture(port, lambda body: body != original)
        finished_film = address_of_ended_film(
            port, send(port, "/levels/hills/animations", DAY | {"size": [256, 256]}), ObservedAnswers()
        )
        load = BackgroundLoad(port, observed_answers)
        original_limit = resource.getrlimit(resource.RLIMIT_NPROC)[0]
        for moment in range(MOMENT_COUNT):
            start_s = time.monotonic()
            set_process_limit(process.pid, 1)
            with load.running():
                time.sleep(MOMENT_S / 2)
                if moment % 2:
                    kill_render_processes(process.pid)
                time.sleep(MOMENT_S / 2)
                observed_answers.add("finished film", send(port, finished_film), 0.0)
                set_process_limit(process.pid, original_limit)
            ready_after_s.append(wait_until_ready(port))
            if moment < MOMENT_COUNT - 1:
                time.sleep(max(PAUSE_S - (time.monotonic() - start_s), 0.0))
        text = log.read_text()
        replace_raster(tmp_path, upside_down=False)
        reread_s = wait_for_picture(port, lambda body: body == original)
        assert fetch_film(port, DAY | {"fps": 29})
        assert process.poll() is None
    with capsys.disabled():
        print(f"\n{MOMENT_COUNT} moments without threads: {observed_answers.summary()}")
        print(f"ready again after {max(ready_after_s):.1f} s at most; the replaced raster was served after {reread_s:.1f} s")
    observed_answers.check()
    assert observed_answers.count(503) > 0, "the limit was not reached"
    assert "its files cannot be checked" in text, "the limit was not reached by checks of the level"
    assert "Traceback" not in text, text[text.index("Traceback") - 500 :][:4000]


# File handles


def test_service_survives_few_file_handles(tmp_path: Path, capsys: pytest.CaptureFixture):
    """A limit of 64 open files of the running service and its render processes, then limits just above what they have open."""
    # Starlette opens a file after it has sent the headers.
    observed_answers, ready_after_s, counts = ObservedAnswers(kinds_cut_short={"page's file"}), [], []
    with service(tmp_path, SKUGGA_LEVEL_CHECK_S="0.2") as (port, process, log):
        original = fetch_picture(port, TILE)
        for number, spare in enumerate((None, 8, 4, 2, 1, 0)):
            pids = [process.pid, *render_processes(process.pid)]
            open_counts = {pid: descriptor_count(pid) for pid in pids}
            counts.append(open_counts[process.pid])
            limits = {pid: 64 if spare is None else count + spare for pid, count in open_counts.items()}
            load = BackgroundLoad(port, observed_answers)
            with load.running():
                time.sleep(0.5)
                with soft_limit(resource.RLIMIT_NOFILE, limits):
                    time.sleep(2.0)
                    replace_raster(tmp_path, upside_down=not number % 2)
                    time.sleep(2.0)
                    if number % 2:
                        kill_render_processes(process.pid)
                    time.sleep(4.0)
            ready_after_s.append(wait_until_ready(port))
        text = log.read_text()
        replace_raster(tmp_path, upside_down=False)
        reread_s = wait_for_picture(port, lambda body: body == original)
        assert fetch_film(port, DAY | {"fps": 29})
        assert process.poll() is None
    with capsys.disabled():
        print(f"\nfew file handles: {observed_answers.summary()}")
        print(
            f"{counts} open files before each limit; ready again after {max(ready_after_s):.1f} s at most; "
            f"raster read in {reread_s:.1f} s"
        )
    observed_answers.check()
    assert observed_answers.count(503) > 0 and "connections cannot be accepted" in text, "the limit was not reached"
    assert max(counts) < min(counts) + 16, "descriptors leak"
    assert "Traceback" not in text, text[text.index("Traceback") - 500 :][:4000]


# Memory

SERVICE_SPARE_MIB = 96
"""Address space that the service keeps at least: a stack has 8 MiB, and an arena of malloc reserves 64 MiB."""


def test_service_survives_little_memory(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Limits of the address space just above what the render processes have, and somewhat above what the service has.

    The service keeps memory for the stacks of its threads: in Python 3.11 ``Thread.start`` waits for ever for a thread that cannot
    allocate its first objects.
    """
    observed_answers, ready_after_s, sizes_mib = ObservedAnswers(), [], []
    with service(tmp_path, SKUGGA_LEVEL_CHECK_S="0.2") as (port, process, log):
        original = fetch_picture(port, TILE)
        for number, spare_mib in enumerate((256, 64, 8, 0)):
            load = BackgroundLoad(port, observed_answers)
            with load.running():
                time.sleep(0.5)
                sizes = {pid: address_space(pid) for pid in [process.pid, *render_processes(process.pid)]}
                sizes_mib.append(sizes[process.pid] // 2**20)
                limits = {pid: size + spare_mib * 2**20 for pid, size in sizes.items()}
                limits[process.pid] = sizes[process.pid] + max(spare_mib, SERVICE_SPARE_MIB) * 2**20
                with soft_limit(resource.RLIMIT_AS, limits):
                    time.sleep(2.0)
                    replace_raster(tmp_path, upside_down=not number % 2)
                    time.sleep(4.0)
                    if number % 2:
                        kill_render_processes(process.pid)
                    time.sleep(2.0)
            assert process.poll() is None, log.read_text()[-2000:]
            kill_render_processes(process.pid)  # those that were started meanwhile have inherited the limit
            time.sleep(1.0)
            ready_after_s.append(wait_until_ready(port))
        replace_raster(tmp_path, upside_down=False)
        reread_s = wait_for_picture(port, lambda body: body == original)
        assert fetch_film(port, DAY | {"fps": 29})
    with capsys.disabled():
        print(f"\nlittle memory: {observed_answers.summary()}")
        print(
            f"address space {sizes_mib} MiB; ready again after {max(ready_after_s):.1f} s at most; raster read in {reread_s:.1f} s"
        )
    observed_answers.check()
    assert observed_answers.count(503) > 0, "the limit was not reached"


# A full disk


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """Mount a disk in memory with a size in bytes on a folder, and unmount it at the end."""
    folder.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mount.returncode:
        pytest.skip(f"no disk can be mounted: {mount.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill_disk(disk: Path, free_bytes: int = 0) -> Path:
    """Fill a disk to the last byte with a file, then truncate the file by some bytes. Return the file."""
    path = disk / "filler"
    with path.open("ab", buffering=0) as file, suppress(OSError):
        while file.write(bytes(2**16)):
            pass
    with path.open("ab", buffering=0) as file, suppress(OSError):
        while file.write(b"0"):
            pass
    os.truncate(path, path.stat().st_size - free_bytes)
    return path


def test_full_disk_leaves_no_damaged_output(tmp_path: Path, capsys: pytest.CaptureFixture):
    """A small disk with all caches, temporary files and outputs is full while pictures, films and an archive are made."""
    undisturbed = tmp_path / "undisturbed.pmtiles"
    assert run_command(seed_arguments(write_level(tmp_path, "hills"), undisturbed))[0] == 0
    loops = Path(os.environ["NUMBA_CACHE_DIR"])
    disk_size = 4 * 2**20 + sum(path.stat().st_size + 4096 for path in loops.iterdir())
    observed_answers, messages = ObservedAnswers(ALLOWED_STATUSES | {507}), []
    with small_disk(tmp_path / "disk", disk_size) as disk:
        shutil.copytree(loops, disk / "loops")
        (disk / "tmp").mkdir()
        environment = {
            "NUMBA_CACHE_DIR": str(disk / "loops"), "XDG_CACHE_HOME": str(disk / "cache"), "TMPDIR": str(disk / "tmp"),
            "MESA_SHADER_CACHE_DIR": str(disk / "shaders"),
        }  # fmt: skip
        with service(tmp_path, **environment) as (port, process, log):
            film_order = DAY | {"size": [256, 256]}
            first_tile, first_snapshot, first_film = (
                fetch_picture(port, TILE),
                fetch_picture(port, SNAPSHOT),
                fetch_film(port, film_order),
            )
            archive = disk / "hills.pmtiles"
            for free_bytes in (0, 4096, 2**16):
                filler = fill_disk(disk, free_bytes)
                with BackgroundLoad(port, observed_answers).running():
                    status, output = run_command(seed_arguments(tmp_path / "hills.yaml", archive), environment)
                    messages.append(output.strip().splitlines()[-1])
                    assert status == 1 and "No space left on device" in output and "Traceback" not in output, (status, output)
                    assert not archive.exists(), "an archive was published that cannot be whole"
                    kill_render_processes(process.pid)
                    wait_until_ready(port)
                    fill_disk(disk, free_bytes)
                    time.sleep(2.0)
                filler.unlink()
            start_s = time.monotonic()
            status, output = run_command(seed_arguments(tmp_path / "hills.yaml", archive), environment)
            seed_s = time.monotonic() - start_s
            assert status == 0, output
            assert archive.read_bytes() == undisturbed.read_bytes()
            later_results = fetch_picture(port, TILE), fetch_picture(port, SNAPSHOT), fetch_film(port, film_order)
            assert later_results == (first_tile, first_snapshot, first_film)
            assert fetch_film(port, film_order | {"fps": 7})
            remaining = [path.name for path in (disk / "tmp").iterdir()]
            text = log.read_text()
    with capsys.disabled():
        print(f"\na full disk: {observed_answers.summary()}")
        print(f"skugga seed ended with {messages}; afterwards it took {seed_s:.1f} s")
    observed_answers.check()
    assert observed_answers.count(507) > 0, "the limit was not reached"
    assert not remaining, "temporary files are left behind"
    assert "Traceback" not in text, text[text.index("Traceback") - 500 :][:4000]


# Killed processes

KILL_COUNT = int(os.environ.get("SOAK_KILLS", "6"))
"""Number of kills of each kind of work."""


def seed_arguments(level: Path, archive: Path) -> list[str | Path]:
    """Return the arguments of ``skugga`` that seed an archive."""
    return ["seed", level, "--layer", "shadow", "--zooms", "10-14", "--workers", "2", "--output", archive]


def processes_of(folder: Path) -> list[int]:
    """Return the processes with a folder's path in an environment variable or an argument."""
    result, text = [], os.fsencode(folder)
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if int(path.name) != os.getpid() and text in (path / "environ").read_bytes() + (path / "cmdline").read_bytes():
                result.append(int(path.name))
    return result


def child_pids(parent_pid: int) -> list[int]:
    """Return the children of a process."""
    result = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError):
            if int((path / "stat").read_text().rpartition(")")[2].split()[1]) == parent_pid:
                result.append(int(path.name))
    return result


def kill_random(pids: list[int], rng: random.Random) -> bool:
    """Kill one of some processes, and return whether there was one."""
    with suppress(ProcessLookupError):
        if pids:
            os.kill(rng.choice(sorted(pids)), signal.SIGKILL)
            return True
    return False


@pytest.mark.parametrize("request_kind", ["tile", "snapshot", "film"])
def test_killed_render_processes_change_no_picture(request_kind: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Render processes are killed while they draw: pictures are the same to the byte, or refused with a time to come back."""
    rng, observed_answers, kill_count = random.Random(request_kind), ObservedAnswers(), 0
    digest_of = hashlib.sha256
    with service(tmp_path) as (port, process, log):

        def draw(number: int) -> bytes:
            if request_kind == "film":
                return fetch_film(port, DAY | {"fps": 1 + number})
            address = TILE if request_kind == "tile" else SNAPSHOT
            return fetch_picture(port, f"{address}{'&' if '?' in address else '?'}azimuth={100 + number}&altitude=17")

        undisturbed = [digest_of(draw(number)).digest() for number in range(3)]
        wait_until_ready(port)
        duration_s = 3.0 if request_kind == "film" else 0.4
        start_s = time.monotonic()
        load = BackgroundLoad(port, observed_answers)
        with load.running():
            while kill_count < KILL_COUNT:
                time.sleep(rng.uniform(0.2, 0.2 + duration_s))
                kill_count += kill_random(render_processes(process.pid), rng)
                if kill_count % 2:
                    wait_until_ready(port)
        wait_until_ready(port)
        seconds = time.monotonic() - start_s
    with service(tmp_path) as (port, process, log):  # nothing is cached
        disturbed, stop, disturbing_kills = [], threading.Event(), 0

        def kill_repeatedly() -> None:
            nonlocal disturbing_kills
            while not stop.wait(rng.uniform(0.0, 4.0) if disturbing_kills else 0.0):
                if is_ready(port):  # else none of them would ever finish its start
                    disturbing_kills += kill_random(render_processes(process.pid), rng)

        killer = threading.Thread(target=kill_repeatedly)
        killer.start()
        try:
            disturbed = [digest_of(draw(number)).digest() for number in range(3)]
        finally:
            stop.set()
            killer.join()
        wait_until_ready(port)
        pids = [process.pid, *render_processes(process.pid)]
        text = log.read_text()
    remaining = remaining_after_wait(lambda: [pid for pid in pids if Path(f"/proc/{pid}").exists()])
    with capsys.disabled():
        print(f"\n{kill_count} kills in {seconds:.0f} s, {request_kind}: {observed_answers.summary()}")
    observed_answers.check()
    assert disturbing_kills and disturbed == undisturbed
    assert not remaining, "processes outlived the service"
    assert "Traceback" not in text


def shard_count(archive: Path) -> int:
    """Return the number of shards that ``skugga seed`` has drawn for an archive."""
    return len(list(Path(f"{archive}.seed", "shards").glob("*/*.tiles")))


def wait_for_shards(archive: Path, count: int, process: subprocess.Popen[str]) -> None:
    """Wait until a command has drawn some shards of an archive, or has ended."""
    while process.poll() is None and shard_count(archive) < count:
        time.sleep(0.02)


def test_seed_run_again_after_kills_writes_the_same(tmp_path: Path, capsys: pytest.CaptureFixture):
    """An archive is whole and the same to the byte, although the command or its render processes are killed at random moments."""
    rng, kills = random.Random(5), Counter[str]()
    level, undisturbed, archive = write_level(tmp_path, "hills"), tmp_path / "a.pmtiles", tmp_path / "b.pmtiles"
    start_s = time.monotonic()
    assert run_command(seed_arguments(level, undisturbed))[0] == 0
    duration_s = time.monotonic() - start_s
    for number in range(KILL_COUNT):
        with skugga_process(seed_arguments(level, archive)) as process:
            wait_for_shards(archive, rng.randrange(shard_count(undisturbed)), process)
            time.sleep(rng.uniform(0.0, 0.3))
            if number % 2:  # a render process: the command goes on
                kills["render process"] += kill_random(child_pids(process.pid), rng)
                output, _ = process.communicate(timeout=300)
                assert process.returncode == 0 and archive.read_bytes() == undisturbed.read_bytes(), output
                shutil.rmtree(f"{archive}.seed")
                archive.unlink()
                continue
            process.kill()
            kills["command"] += 1
        assert not remaining_after_wait(lambda: processes_of(archive)), "processes outlived the command"
        assert not archive.exists() or archive.read_bytes() == undisturbed.read_bytes()
        if number % 4 == 2:  # each second time it is resumed at once
            status, output = run_command(seed_arguments(level, archive))
            assert status == 0 and archive.read_bytes() == undisturbed.read_bytes(), output
            shutil.rmtree(f"{archive}.seed")
            archive.unlink()
    status, output = run_command(seed_arguments(level, archive))
    assert status == 0, output
    remaining = [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert kills["command"] and (kills["render process"] or KILL_COUNT < 2), "the command had ended before"
    with capsys.disabled():
        print(f"\nskugga seed, {duration_s:.1f} s undisturbed: {dict(kills)} killed, archives of {archive.stat().st_size} bytes")
    assert archive.read_bytes() == undisturbed.read_bytes()
    assert not remaining, "temporary files are left behind"


STORE_ESTIMATE_SCRIPT = """
from skugga.selector.cost.device_estimate import typical_profile
from skugga.selector.cost.device_profile import save_profile
from skugga.terrain.gl.device import renderer_and_version
print(save_profile(typical_profile(*renderer_and_version())))
"""
"""Program that stores a calibration without measuring one, and prints its path."""

READ_PROFILE_SCRIPT = """
from skugga.selector.cost.device_profile import load_profile
from skugga.terrain.gl.device import renderer_and_version
print(load_profile(*renderer_and_version()).model_dump_json())
"""


def run_program(program: str, environment: dict[str, str]) -> str:
    """Run a Python program in a new process with further environment variables, and return its output."""
    return subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, **environment}, capture_output=True, text=True, check=True, timeout=120
    ).stdout.strip()


def test_killed_calibrate_leaves_a_readable_profile(tmp_path: Path, capsys: pytest.CaptureFixture):
    """The old calibration stays readable when the command is killed, also at the moment at which it stores the new one."""
    rng, environment = random.Random(9), {"XDG_CACHE_HOME": str(tmp_path)}
    path = Path(run_program(STORE_ESTIMATE_SCRIPT, environment))
    before = path.read_bytes()
    old_profile = run_program(READ_PROFILE_SCRIPT, environment)
    moments_s = [rng.uniform(1.0, 60.0) for _ in range(KILL_COUNT // 2)]
    for moment_s in [*moments_s, None]:
        with skugga_process(["calibrate"], environment) as process:
            deadline = time.monotonic() + (600.0 if moment_s is None else moment_s)
            while time.monotonic() < deadline and process.poll() is None:
                if moment_s is not None:
                    time.sleep(0.05)
                elif len(os.listdir(path.parent)) > 1:  # the file is being written beside the old one
                    break
            was_running = process.poll() is None
            process.kill()
        assert not remaining_after_wait(lambda: processes_of(tmp_path)), "processes outlived the command"
        assert was_running, "the command ended before it was killed"
        assert path.read_bytes() == before or moment_s is None
        assert run_program(READ_PROFILE_SCRIPT, environment), "the calibration cannot be read"
    unchanged = path.read_bytes() == before
    assert not unchanged or run_program(READ_PROFILE_SCRIPT, environment) == old_profile
    status, output = run_command(["calibrate"], environment)
    assert status == 0, output
    remaining = [name for name in os.listdir(path.parent) if name != path.name]
    with capsys.disabled():
        moments = ", ".join(f"{moment_s:.0f}" for moment_s in moments_s)
        print(f"\nskugga calibrate killed after {moments} s and at its write, which left the {'old' if unchanged else 'new'} file")
    assert path.read_bytes() != before and run_program(READ_PROFILE_SCRIPT, environment) != old_profile
    assert len(remaining) <= 1, "more temporary files are left behind than that of the kill at the write"


def test_killed_compile_is_completed_by_the_next_run(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Loops are compiled by the next run when the command or one of its processes is killed at random moments."""
    rng, counts = random.Random(2), []
    loops = tmp_path / "loops"
    environment = {"NUMBA_CACHE_DIR": str(loops)}
    for number in range(KILL_COUNT):
        with skugga_process(["compile"], environment) as process:
            stored_count = len(list(loops.glob("*.loop"))) + rng.randrange(1, 20)
            while process.poll() is None and len(list(loops.glob("*.loop"))) < stored_count:
                time.sleep(0.05)
            time.sleep(rng.uniform(0.0, 1.0))
            other_pids = [pid for pid in processes_of(loops) if pid != process.pid]
            if number % 2 == 0 and kill_random(other_pids, rng):  # the command ends by itself, with or without success
                output, _ = process.communicate(timeout=300)
                assert process.returncode in (0, 1) and "Traceback" not in output, output
            process.kill()
        assert not remaining_after_wait(lambda: processes_of(loops)), "processes outlived the command"
        counts.append(len(list(loops.glob("*.loop"))))
        if number % 2 == 0:
            shutil.rmtree(loops)
    start_s = time.monotonic()
    status, output = run_command(["compile"], environment)
    seconds = time.monotonic() - start_s
    assert status == 0, output
    assert min(counts) < len(list(loops.glob("*.loop"))), "the command had always ended before"
    status, second_output = run_command(["compile"], environment)
    assert status == 0 and "Nothing to compile" in second_output, second_output
    partial_files = [path.name for path in loops.iterdir() if path.suffix != ".loop" and not path.name.endswith(".lock")]
    archive, other = tmp_path / "a.pmtiles", tmp_path / "b.pmtiles"
    level = write_level(tmp_path, "hills")
    assert run_command(seed_arguments(level, archive), environment)[0] == 0
    assert run_command(seed_arguments(level, other))[0] == 0
    with capsys.disabled():
        print(f"\nskugga compile killed {KILL_COUNT} times: {counts} loops stored after each; the last run took {seconds:.0f} s")
        print(f"{output.strip()}; {len(partial_files)} partial files are left")
    assert archive.read_bytes() == other.read_bytes()
