"""Services and commands of Skugga in processes of their own, as operators run them."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.api.conftest import CORNER, ZOOM, write_level

ROOT = Path(__file__).resolve().parents[2]
SKUGGA = [sys.executable, "-c", "from skugga.api.cli.main import main; main()"]

WORKERS = 2
TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"
EXPECTED_STATUSES = {200, 304, 429, 503, 504}


@contextmanager
def service(folder: Path, launcher: Sequence[str] = (), **environment: str) -> Iterator[tuple[int, subprocess.Popen[str], Path]]:
    """Run a service of hills in a process of its own, and yield its port, its process and its log when it is ready.

    ``launcher`` is a command that replaces itself by the service, such as setpriv(1).
    """
    level, log = write_level(folder, "hills"), folder / "log"
    settings = {"SKUGGA_WORKERS": str(WORKERS), "SKUGGA_NEW_SUNS_PER_MINUTE": "0", **environment}
    workers = int(settings["SKUGGA_WORKERS"])
    command = [*launcher, *SKUGGA, "serve", str(level), "--port", "0"]
    with log.open("w") as log_file:
        process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, **settings}, stderr=log_file, text=True)
    try:
        deadline = time.monotonic() + 300
        while (port := re.search(r"on http://[\d.]+:(\d+)", log.read_text())) is None or not is_ready(int(port[1]), workers):
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()[-2000:]
            time.sleep(0.2)
        yield int(port[1]), process, log
    finally:
        process.kill()
        process.wait()


@contextmanager
def skugga_process(
    arguments: Sequence[str | Path], environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Run ``skugga`` with arguments in a process of its own, and yield the process. Kill it at the end if it still runs."""
    process = subprocess.Popen(
        [*SKUGGA, *map(str, arguments)],
        cwd=ROOT, env={**os.environ, **(environment or {})}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def run_command(arguments: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> tuple[int, str]:
    """Run ``skugga`` with arguments to its end, and return its exit status and what it printed."""
    with skugga_process(arguments, environment) as process:
        output, _ = process.communicate(timeout=600)
    return process.returncode, output


def is_ready(port: int, workers: int = WORKERS) -> bool:
    """Return whether a service is ready with all of its render processes."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5) as answer:
            return answer.status == 200 and int(json.load(answer)["workers"]) == workers
    except OSError:
        return False


def wait_until_ready(port: int, timeout_s: float = 120.0) -> float:
    """Wait until a service is ready with all of its render processes, and return the seconds that it took."""
    start_s = time.monotonic()
    while not is_ready(port):
        assert time.monotonic() - start_s < timeout_s, "the service did not become ready again"
        time.sleep(0.2)
    return time.monotonic() - start_s


def render_processes(service_pid: int) -> list[int]:
    """Return the ids of the processes that a service has spawned."""
    result = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == service_pid and "spawn_main" in (path / "cmdline").read_text():
                result.append(int(path.name))
        except (OSError, ValueError):
            continue
    return result


def new_sun_paths() -> Iterator[str]:
    """Yield paths of one tile, each with a sun that was not requested before."""
    return (f"{TILE}?azimuth={number % 3600 / 10}&altitude={5 + number / 3600:.3f}" for number in itertools.count())


def request_until_accepted(port: int, path: str, body: dict[str, Any] | None = None) -> dict[str, Any]:
    """Ask the service, again after a refusal with a time to come back: ``location`` and the ``body`` of its answer."""
    data = None if body is None else json.dumps(body).encode()
    while True:
        request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", data, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                location = answer.headers["location"]
                return {"location": location and location[location.index("/animations") :], "body": json.load(answer)}
        except urllib.error.HTTPError as error:
            assert error.code in (429, 503), error.read()
            time.sleep(float(error.headers["retry-after"]))
