"""Time to the first result of a new and a used installation: wall and CPU seconds of whole processes.

Empty caches are an empty home: no stored loops, no shaders, no calibration. The benchmark requests a service's pages as a browser
does: its page, then a tile in the middle of the first level as soon as ``/readyz`` allows it, then ``/readyz`` until all loops are
compiled.
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

LIMIT_S = 900.0
"""Timeout of a start, seconds."""

YARDSTICK = """
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
"""Compiles one small loop that is independent of ours, to compare machines."""


@dataclass(frozen=True)
class Row:
    """A row of the table: its label, wall seconds until each of its events, and CPU seconds until the last event."""

    what: str
    seconds: tuple[float, ...]
    cpu_s: float


def table(python: str, wheel_python: str | None, one_core: bool = True) -> Iterator[str]:
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
    yield f"yardstick: {float(_run([python, '-c', YARDSTICK], {})[2]):.2f} s of CPU to compile one small loop"
    yield "| what | wall, s | CPU, s |"
    yield "| --- | --- | --- |"
    for row in _rows(python, wheel_python, one_core):
        yield f"| {row.what} | {' / '.join(f'{elapsed_s:.2f}' for elapsed_s in row.seconds)} | {row.cpu_s:.1f} |"


def _rows(python: str, wheel_python: str | None, one_core: bool) -> Iterator[Row]:
    skugga = [python, "-c", "from skugga.api.cli.main import main; main()"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dem = write_dem(folder / "dem.tif")
        shade = ["shade", str(dem), "--azimuth", "237", "--altitude", "12", "-o", str(folder / "mask.tif")]
        with _home(folder) as home:
            yield Row("empty caches: first `shade`", *_command([*skugga, *shade], home))
            yield Row("then: `shade`", *_command([*skugga, *shade], home))
        with _home(folder) as home:
            yield Row(
                "empty caches: `serve dem.tif`: page / first tile / everything", *_service([*skugga, "serve", str(dem)], home)
            )
            yield Row("then: `serve dem.tif`: page / first tile / everything", *_service([*skugga, "serve", str(dem)], home))
            if one_core:
                yield Row("the same on one core", *_service(["taskset", "-c", "0", *skugga, "serve", str(dem)], home))
            yield Row("warm: `--help`", *_command([*skugga, "--help"], home))
            yield Row("warm: `--version`", *_command([*skugga, "--version"], home))
            yield Row("warm: `import skugga`", *_command([python, "-c", "import skugga"], home))
        with _home(folder) as home:
            yield Row("empty caches: `serve`, bundled levels: page / first tile / everything", *_service([*skugga, "serve"], home))
        if wheel_python is not None:
            from_wheel = [str(Path(wheel_python).with_name("skugga"))]
            with _home(folder) as home:
                yield Row("wheel, empty home: first `shade`", *_command([*from_wheel, *shade], home, folder))
                serve = [*from_wheel, "serve", str(dem)]
                yield Row("wheel, empty home: `serve dem.tif`: page / first tile / everything", *_service(serve, home, folder))


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
def _home(folder: Path) -> Iterator[dict[str, str]]:
    """Yield the environment variables of a process whose home folder is empty."""
    with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as home:
        yield {"HOME": home, "XDG_CACHE_HOME": f"{home}/.cache", "SKUGGA_CALIBRATE_WHEN_IDLE": "false"}


def _environment(home: dict[str, str]) -> dict[str, str]:
    """Return this process's environment with another home, and without numba settings that name folders or processors."""
    return {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")} | home


def _run(command: Sequence[str], home: dict[str, str], cwd: Path | None = None) -> tuple[float, float, str]:
    """Run a command to its end. Return wall and CPU seconds, and its output."""
    before, start = _children_cpu_s(), clock.perf_counter()
    process = subprocess.run(
        command, env=_environment(home), cwd=cwd, stdout=subprocess.PIPE, text=True, check=True, timeout=LIMIT_S
    )
    return clock.perf_counter() - start, _children_cpu_s() - before, process.stdout


def _command(command: Sequence[str], home: dict[str, str], cwd: Path | None = None) -> tuple[tuple[float], float]:
    wall_s, cpu_s, _ = _run(command, home, cwd)
    return (wall_s,), cpu_s


def _service(command: Sequence[str], home: dict[str, str], cwd: Path | None = None) -> tuple[tuple[float, float, float], float]:
    """Start a service and request its pages as a browser does. Return wall seconds until three events, and CPU seconds.

    The events are the answer with its page, the answer with its first tile, and the end of compiling.
    """
    port = _free_port()
    url = f"http://127.0.0.1:{port}"
    before, start = _children_cpu_s(), clock.perf_counter()
    with subprocess.Popen([*command, "--port", str(port)], env=_environment(home), cwd=cwd, stderr=subprocess.DEVNULL) as server:
        try:
            _until(lambda: _get(f"{url}/") is not None, start, shlex.join(command))
            page_s = clock.perf_counter() - start
            _until(lambda: _get(f"{url}/readyz") is not None, start, shlex.join(command))
            _until(lambda: _get(_middle_tile(url)) is not None, start, shlex.join(command))
            tile_s = clock.perf_counter() - start
            _until(lambda: json.loads(_get(f"{url}/readyz") or b"{}").get("preparing", "?") is None, start, shlex.join(command))
            all_s = clock.perf_counter() - start
        finally:
            server.send_signal(signal.SIGINT)
    return (page_s, tile_s, all_s), _children_cpu_s() - before


def _middle_tile(url: str) -> str:
    """Return the address of the tile in the middle of the first level, at its first zoom."""
    name = json.loads(_get(f"{url}/levels") or b"[]")[0]["name"]
    tilejson = json.loads(_get(f"{url}/levels/{name}/WebMercatorQuad/tilejson.json") or b"{}")
    west, south, east, north = tilejson["bounds"]
    zoom = int(tilejson["minzoom"])
    size = 2.0**zoom
    latitude = np.radians((south + north) / 2.0)
    x, y = ((west + east) / 2.0 + 180.0) / 360.0 * size, (1.0 - np.arcsinh(np.tan(latitude)) / np.pi) / 2.0 * size
    return f"{url}/levels/{name}/tiles/WebMercatorQuad/{zoom}/{int(x)}/{int(y)}.png"


def _get(url: str) -> bytes | None:
    try:
        with urllib.request.urlopen(url, timeout=LIMIT_S) as answer:
            return bytes(answer.read())
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


def _until(condition: object, start: float, event: str) -> None:
    assert callable(condition)
    while not condition():
        if clock.perf_counter() - start > LIMIT_S:
            raise TimeoutError(f"{event}: not done after {LIMIT_S:g} s")
        clock.sleep(0.02)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
