"""Time to the first result of a new and a used installation: wall and CPU seconds of whole processes.

"Empty caches" means an empty home folder: no stored loops, no shaders, no calibration. The benchmark sends requests to a service
like a browser: for the viewer, then for a tile in the middle of the first level as soon as ``/readyz`` answers 200, then for
``/readyz`` until all loops are compiled.
"""

from __future__ import annotations

import json
import os
import resource
import shlex
import signal
import socket
import subprocess
import tempfile
import time as clock
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

TIMEOUT_S = 900.0
"""Timeout of a command or of a service's start."""

REFERENCE_PROGRAM = """
import time
import numba
@numba.njit
def warm(x):
    return x + 1
warm(1)
start = time.process_time()
@numba.njit
def smooth(a, b):
    for i in range(1, a.shape[0] - 1):
        for j in range(1, a.shape[1] - 1):
            b[i, j] = (a[i - 1, j] + a[i + 1, j] + a[i, j - 1] + a[i, j + 1] - 4.0 * a[i, j]) / (1.0 + abs(a[i, j]))
smooth.compile("void(float64[:,::1], float64[:,::1])")
print(time.process_time() - start)
"""
"""Program that prints the CPU seconds to compile one small loop, a reference to compare machines."""


@dataclass(frozen=True)
class StartTime:
    """A row of the table: its label, wall seconds from the start to each event, and CPU seconds until the last event."""

    label: str
    event_times_s: tuple[float, ...]
    cpu_s: float


def measure_and_format(python: str, wheel_python: str | None, one_core: bool = True) -> Iterator[str]:
    """Measure everything, and yield the lines of a Markdown table.

    Parameters
    ----------
    python
        Interpreter of an environment with a clone of the repository.
    wheel_python
        Interpreter of an environment that has only a wheel with compiled loops; ``None`` omits its rows.
    one_core
        Whether to start a service on one core too.
    """
    yield f"reference: {float(_run([python, '-c', REFERENCE_PROGRAM], {})[2]):.2f} CPU seconds to compile one small loop"
    yield "| what | wall, s | CPU, s |"
    yield "| --- | --- | --- |"
    for row in _measure_starts(python, wheel_python, one_core):
        yield f"| {row.label} | {' / '.join(f'{elapsed_s:.2f}' for elapsed_s in row.event_times_s)} | {row.cpu_s:.1f} |"


def _measure_starts(python: str, wheel_python: str | None, one_core: bool) -> Iterator[StartTime]:
    """Measure commands and services with empty and with filled caches, and yield a row for each.

    Parameters are those of ``measure_and_format``.
    """
    skugga = [python, "-c", "from skugga.api.cli.main import main; main()"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dem = write_dem(folder / "dem.tif")
        shade = ["shade", str(dem), "--azimuth", "237", "--altitude", "12", "-o", str(folder / "mask.tif")]
        with _empty_home(folder) as home:
            yield StartTime("empty caches: first `shade`", *_measure_command([*skugga, *shade], home))
            yield StartTime("then: `shade`", *_measure_command([*skugga, *shade], home))
        with _empty_home(folder) as home:
            yield StartTime(
                "empty caches: `serve dem.tif`: page / first tile / everything",
                *_measure_service([*skugga, "serve", str(dem)], home),
            )
            yield StartTime(
                "then: `serve dem.tif`: page / first tile / everything", *_measure_service([*skugga, "serve", str(dem)], home)
            )
            if one_core:
                yield StartTime("the same on one core", *_measure_service(["taskset", "-c", "0", *skugga, "serve", str(dem)], home))
            yield StartTime("warm: `--help`", *_measure_command([*skugga, "--help"], home))
            yield StartTime("warm: `--version`", *_measure_command([*skugga, "--version"], home))
            yield StartTime("warm: `import skugga`", *_measure_command([python, "-c", "import skugga"], home))
        with _empty_home(folder) as home:
            yield StartTime(
                "empty caches: `serve`, bundled levels: page / first tile / everything", *_measure_service([*skugga, "serve"], home)
            )
        if wheel_python is not None:
            from_wheel = [str(Path(wheel_python).with_name("skugga"))]
            with _empty_home(folder) as home:
                yield StartTime("wheel, empty home: first `shade`", *_measure_command([*from_wheel, *shade], home, folder))
                serve = [*from_wheel, "serve", str(dem)]
                yield StartTime(
                    "wheel, empty home: `serve dem.tif`: page / first tile / everything", *_measure_service(serve, home, folder)
                )


def write_dem(path: Path) -> Path:
    """Write a raster of 1000 x 1000 cells of hills, EPSG:32632, 30 m."""
    rows, cols = np.mgrid[:1000, :1000] / 60.0
    heights = (800.0 + 500.0 * np.sin(rows) * np.cos(1.3 * cols) + 60.0 * np.sin(4.0 * rows + 7.0 * cols)).astype(np.float32)
    with rasterio.open(
        path, "w", driver="GTiff", width=1000, height=1000, count=1, dtype="float32", crs="EPSG:32632",
        transform=Affine(30, 0, 600_000, 0, -30, 5_150_000),
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
    return path


@contextmanager
def _empty_home(folder: Path) -> Iterator[dict[str, str]]:
    """Yield the environment variables of a process whose home folder is empty."""
    with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as home:
        yield {"HOME": home, "XDG_CACHE_HOME": f"{home}/.cache", "SKUGGA_CALIBRATE_WHEN_IDLE": "false"}


def _environment(home: dict[str, str]) -> dict[str, str]:
    """Return this process's environment with another home, and without numba settings that name folders or processors."""
    return {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")} | home


def _run(command: Sequence[str], home: dict[str, str], cwd: Path | None = None) -> tuple[float, float, str]:
    """Run a command to its end in the folder ``cwd``. Return wall and CPU seconds, and its standard output.

    ``home`` has the environment variables of ``_empty_home``.
    """
    before, start = _children_cpu_s(), clock.perf_counter()
    process = subprocess.run(
        command, env=_environment(home), cwd=cwd, stdout=subprocess.PIPE, text=True, check=True, timeout=TIMEOUT_S
    )
    return clock.perf_counter() - start, _children_cpu_s() - before, process.stdout


def _measure_command(command: Sequence[str], home: dict[str, str], cwd: Path | None = None) -> tuple[tuple[float], float]:
    """Run a command to its end. Return wall seconds, as a tuple of one event, and CPU seconds."""
    wall_s, cpu_s, _ = _run(command, home, cwd)
    return (wall_s,), cpu_s


def _measure_service(
    command: Sequence[str], home: dict[str, str], cwd: Path | None = None
) -> tuple[tuple[float, float, float], float]:
    """Start a service and send requests like a browser. Return wall seconds until three events, and CPU seconds.

    The events are the response with the viewer, the response with the first tile, and the end of compilation.
    """
    port = _free_port()
    url = f"http://127.0.0.1:{port}"
    before, start = _children_cpu_s(), clock.perf_counter()
    with subprocess.Popen([*command, "--port", str(port)], env=_environment(home), cwd=cwd, stderr=subprocess.DEVNULL) as server:
        try:
            _wait_until(lambda: _fetch(f"{url}/") is not None, start, shlex.join(command))
            page_s = clock.perf_counter() - start
            _wait_until(lambda: _fetch(f"{url}/readyz") is not None, start, shlex.join(command))
            _wait_until(lambda: _fetch(_middle_tile_url(url)) is not None, start, shlex.join(command))
            tile_s = clock.perf_counter() - start
            _wait_until(
                lambda: json.loads(_fetch(f"{url}/readyz") or b"{}").get("preparing", "?") is None, start, shlex.join(command)
            )
            all_s = clock.perf_counter() - start
        finally:
            server.send_signal(signal.SIGINT)
    return (page_s, tile_s, all_s), _children_cpu_s() - before


def _middle_tile_url(url: str) -> str:
    """Return the address of the tile in the middle of the first level, at its first zoom."""
    name = json.loads(_fetch(f"{url}/levels") or b"[]")[0]["name"]
    tilejson = json.loads(_fetch(f"{url}/levels/{name}/WebMercatorQuad/tilejson.json") or b"{}")
    west, south, east, north = tilejson["bounds"]
    zoom = int(tilejson["minzoom"])
    size = 2.0**zoom
    latitude = np.radians((south + north) / 2.0)
    x, y = ((west + east) / 2.0 + 180.0) / 360.0 * size, (1.0 - np.arcsinh(np.tan(latitude)) / np.pi) / 2.0 * size
    return f"{url}/levels/{name}/tiles/WebMercatorQuad/{zoom}/{int(x)}/{int(y)}.png"


def _fetch(url: str) -> bytes | None:
    """Return the body of a successful response; ``None`` if the service is not reachable or answers with an error."""
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as answer:
            return bytes(answer.read())
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


def _wait_until(condition: object, start: float, event: str) -> None:
    """Call ``condition`` until it is true. ``start`` is the clock's time at the start of the service.

    Raises ``TimeoutError``, with ``event`` in its message, ``TIMEOUT_S`` seconds after the start.
    """
    assert callable(condition)
    while not condition():
        if clock.perf_counter() - start > TIMEOUT_S:
            raise TimeoutError(f"{event}: not ready after {TIMEOUT_S:g} s")
        clock.sleep(0.02)


def _free_port() -> int:
    """Return the number of a TCP port that no process uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _children_cpu_s() -> float:
    """Return the CPU seconds of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
