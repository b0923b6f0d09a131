"""Tiles per second of the map service with cast shadows, and of titiler's hillshade without, on one core each.

    python -m benchmarks.tiles --raster FILE --titiler-python PATH [--base FOLDER] [--repeats 5] [--json FILE]

Both services run on loopback, each with all its processes on the same core. The client runs on another core. Both shade the same
cloud-optimised GeoTIFF, made from ``--raster``, and answer requests of one client for the same tiles of 256 x 256 pixels. The
client sends 8 concurrent requests, or single requests in rows with "one alone". Each cold round starts a new service. Figures are
medians over the repeats. The services take turns within a repeat. Only ratios within one run are comparable.

titiler (`pip install titiler.application==2.4.0 uvicorn httptools uvloop`, in an environment of its own whose Python is
``--titiler-python``) runs as its manual recommends, with the GDAL settings there and one process: `hillshade`, `buffer=3`. It casts
no shadows and caches nothing: all its tiles are cold.

``--base`` is a clone of this repository at another commit. With it, the CPU time of one block of terrain is measured in both, in
processes that take turns: cold, and under a new sun over cached ground. Two measurements always run. One is the time to encode a
tile of 512 x 512 pixels. The other compares a block of a village among woods with a block of its terrain only.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import quote
from urllib.request import urlopen

import rasterio
from morecantile import tms as matrix_sets
from rasterio.shutil import copy
from rasterio.warp import transform_bounds

from benchmarks.sweep_speed import processor_name

ROOT = Path(__file__).resolve().parents[1]

MERCATOR = matrix_sets.get("WebMercatorQuad")
ZOOMS = range(9, 15)
"""Zooms of the requested tiles."""
CONCURRENCY = 8
"""Number of connections that request tiles at the same time."""
SERVICE_CORE, CLIENT_CORE = 0, 1
"""Numbers of the processor cores on which the service and this process run."""
START_TIMEOUT_S = 120.0

TITILER_SETTINGS = {
    "CPL_TMPDIR": "/tmp", "GDAL_CACHEMAX": "75%", "GDAL_INGESTED_BYTES_AT_OPEN": "32768",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_HTTP_MERGE_CONSECUTIVE_RANGES": "YES", "GDAL_HTTP_MULTIPLEX": "YES",
    "GDAL_HTTP_VERSION": "2", "PYTHONWARNINGS": "ignore", "VSI_CACHE": "TRUE", "VSI_CACHE_SIZE": "536870912",
}  # fmt: skip
"""Environment variables of titiler, as its manual recommends (page on performance tuning)."""

SUNS = [(75.0 + 9.0 * n, 8.0 + 47.0 * (1.0 - abs(n - 11.5) / 11.5)) for n in range(24)]
"""Azimuths and altitudes of a day's sun, from morning to evening."""

Tile = tuple[int, int, int]
"""Zoom, column and row of a tile."""
Sun = tuple[float, float]
"""Azimuth and altitude of a sun, degrees."""


@dataclass(frozen=True)
class RequestRound:
    """Results of a round of requests.

    Attributes
    ----------
    per_second
        Tiles per second.
    median_ms, p99_ms
        Median and 99th percentile of the milliseconds until an answer.
    mean_bytes
        Mean bytes of a tile.
    """

    per_second: float
    median_ms: float
    p99_ms: float
    mean_bytes: float


@dataclass(frozen=True)
class RunningService:
    """A running service.

    Attributes
    ----------
    process, port
        Its process and its port.
    ready_s
        Seconds from the start until it was ready.
    path_of_tile
        Returns the URL path of a tile under a sun.
    """

    process: subprocess.Popen[bytes]
    port: int
    ready_s: float
    path_of_tile: Callable[[Tile, Sun], str]


def request_all(port: int, paths: list[str], concurrency: int = CONCURRENCY) -> RequestRound:
    """Request URL paths over ``concurrency`` persistent connections. Raises ``RuntimeError`` for a status other than 200."""
    pending_paths, latencies_s, sizes = list(reversed(paths)), [], []

    async def client() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        while pending_paths:
            path = pending_paths.pop()
            start = time.perf_counter()
            writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            head = (await reader.readuntil(b"\r\n\r\n")).lower()
            value_start = head.index(b"content-length:") + 15
            body = await reader.readexactly(int(head[value_start : head.index(b"\r\n", value_start)]))
            latencies_s.append(time.perf_counter() - start)
            sizes.append(len(body))
            if head[9:12] != b"200":
                raise RuntimeError(f"{path}: {head[9:12].decode()} {body[:200]!r}")
        writer.close()

    async def all_clients() -> None:
        await asyncio.gather(*(client() for _ in range(concurrency)))

    start = time.perf_counter()
    asyncio.run(all_clients())
    total_s = time.perf_counter() - start
    ordered = sorted(latencies_s)
    return RequestRound(
        len(paths) / total_s, 1e3 * statistics.median(ordered), 1e3 * ordered[min(int(0.99 * len(ordered)), len(ordered) - 1)],
        statistics.mean(sizes),
    )  # fmt: skip


@contextmanager
def run_service(
    command: list[str], port: int, ready_path: str, path_of_tile: Callable[[Tile, Sun], str], **env: str
) -> Iterator[RunningService]:
    """Run a service on one core, as a context manager. Raises ``RuntimeError`` if it does not start.

    The service is ready as soon as ``ready_path`` returns status 200. ``path_of_tile`` is that of ``RunningService``, and ``env``
    are further environment variables.
    """
    start = time.perf_counter()
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command, env={**os.environ, **env}, stdout=output, stderr=output, cwd=ROOT,
            preexec_fn=lambda: os.sched_setaffinity(0, {SERVICE_CORE}),
        )  # fmt: skip
        try:
            while True:
                if process.poll() is not None or time.perf_counter() - start > START_TIMEOUT_S:
                    output.seek(0)
                    raise RuntimeError(f"{command[0]} did not start: {output.read()[-2000:].decode()}")
                try:
                    with urlopen(f"http://127.0.0.1:{port}{ready_path}") as answer:
                        if answer.status == 200:
                            break
                except OSError:
                    time.sleep(0.02)
            yield RunningService(process, port, time.perf_counter() - start, path_of_tile)
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(20)


def run_skugga(cog: Path, folder: Path, port: int = 8781) -> AbstractContextManager[RunningService]:
    """Run Skugga's service of a raster with one render process and default settings. Its level file is written into ``folder``."""
    level = folder / "cog.yaml"
    level.write_text(json.dumps({"version": 1, "terrain": {"source": str(cog)}, "sun": {"azimuth": 225, "altitude": 30}}))

    def path(tile: Tile, sun: Sun) -> str:
        z, x, y = tile
        return f"/levels/cog/tiles/WebMercatorQuad/{z}/{x}/{y}.png?azimuth={sun[0]:g}&altitude={sun[1]:g}"

    command = [sys.executable, "-c", "from skugga.api.cli.main import main; main()", "serve", str(level), "--port", str(port)]
    return run_service(
        command, port, "/readyz", path, PYTHONPATH=str(ROOT), SKUGGA_CALIBRATE_WHEN_IDLE="false", SKUGGA_PROBE_WHEN_IDLE="false"
    )


def run_titiler(cog: Path, python: Path, port: int = 8782) -> AbstractContextManager[RunningService]:
    """Run titiler with one process. ``python`` is the interpreter in whose environment it is installed."""

    def path(tile: Tile, sun: Sun) -> str:
        z, x, y = tile
        algorithm_params = quote(json.dumps({"azimuth": sun[0], "angle_altitude": sun[1]}))
        return (
            f"/cog/tiles/WebMercatorQuad/{z}/{x}/{y}.png?url={cog}&algorithm=hillshade&buffer=3&algorithm_params={algorithm_params}"
        )

    command = [str(python), "-m", "uvicorn", "titiler.application.main:app", "--port", str(port), "--log-level", "warning"]
    return run_service(command, port, "/healthz", path, **TITILER_SETTINGS)


def tiles_over_raster(cog: Path) -> list[Tile]:
    """Return the tiles of all zooms that show a part of a raster, row by row."""
    with rasterio.open(cog) as dataset:
        bounds = transform_bounds(dataset.crs, "OGC:CRS84", *dataset.bounds)
    return sorted(
        ((z, x, y) for x, y, z in MERCATOR.tiles(*bounds, zooms=list(ZOOMS))), key=lambda tile: (tile[0], tile[2], tile[1])
    )


def tiles_served_by_titiler(tiles: list[Tile], running: RunningService) -> list[Tile]:
    """Return the tiles that titiler serves too. It clips the corners of a rotated raster more tightly than Skugga."""
    result = []
    for tile in tiles:
        try:
            urlopen(f"http://127.0.0.1:{running.port}{running.path_of_tile(tile, SUNS[0])}").read()
        except OSError:
            continue
        result.append(tile)
    return result


def central_tiles(tiles: list[Tile]) -> list[Tile]:
    """Return the tiles that fill a screen at the zoom before the last: 6 x 4 tiles in the middle of the raster."""
    zoom = ZOOMS[-2]
    xs, ys = ([tile[axis] for tile in tiles if tile[0] == zoom] for axis in (1, 2))
    x0, y0 = (min(xs) + max(xs)) // 2 - 2, (min(ys) + max(ys)) // 2 - 1
    return [(zoom, x, y) for y in range(y0, y0 + 4) for x in range(x0, x0 + 6) if (zoom, x, y) in set(tiles)]


Rounds = dict[str, list[RequestRound]]
"""Results of rounds of requests, by name of the round; one for each repeat."""
ServiceFactory = Callable[[], AbstractContextManager[RunningService]]
"""A function that starts a service as a context manager."""


def measure_service(
    tiles: list[Tile], start_service: ServiceFactory, has_cache: bool, rounds: Rounds, scalar_figures: dict[str, list[float]]
) -> None:
    """Run all rounds of requests once with a service, and add their results to ``rounds`` and ``scalar_figures``.

    ``scalar_figures`` has seconds until the service is ready and until its first tile. A service without a cache receives the
    repeated requests only once.
    """
    shuffled, viewport_tiles = random.Random(23).sample(tiles, len(tiles)), central_tiles(tiles)
    with start_service() as running:
        scalar_figures.setdefault("ready s", []).append(running.ready_s)

        def run_round(name: str, tile_requests: list[tuple[Tile, Sun]], concurrency: int = CONCURRENCY) -> RequestRound:
            result = request_all(running.port, [running.path_of_tile(*tile_request) for tile_request in tile_requests], concurrency)
            rounds.setdefault(name, []).append(result)
            return result

        first = run_round("first tile", [(viewport_tiles[0], (200.0, 35.0))], 1)
        scalar_figures.setdefault("first tile s", []).append(first.median_ms / 1e3)
        run_round("cold, row order", [(tile, SUNS[6]) for tile in tiles])
        run_round("24 suns", [(tile, sun) for sun in SUNS for tile in viewport_tiles])
        run_round("again", [(tile, SUNS[6]) for tile in tiles] * (4 if has_cache else 1))
        if has_cache:
            run_round("again, one alone", [(tile, SUNS[6]) for tile in tiles], 1)
        rate = rounds["24 suns"][-1].per_second / 2
        paths = [running.path_of_tile(tile, (sun[0] + 1.0, sun[1])) for sun in SUNS[::3] for tile in viewport_tiles]
        rounds.setdefault("24 suns, half the peak", []).append(asyncio.run(request_at_rate(running.port, paths, rate)))
    with start_service() as running:
        run_round("cold, random order", [(tile, SUNS[6]) for tile in shuffled])
    with start_service() as running:
        sampled_tiles = [tile for n, tile in enumerate(tiles) if n % 9 == 0]
        run_round("cold, one alone", [(tile, SUNS[6]) for tile in sampled_tiles], 1)


async def request_at_rate(port: int, paths: list[str], requests_per_s: float) -> RequestRound:
    """Request URL paths at a steady rate, even while earlier requests are still pending."""
    latencies_s: list[float] = []
    sizes: list[int] = []

    async def send_request(path: str) -> None:
        start = time.perf_counter()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
        sizes.append(len(await reader.read()))
        latencies_s.append(time.perf_counter() - start)
        writer.close()

    tasks = []
    for path in paths:
        tasks.append(asyncio.create_task(send_request(path)))
        await asyncio.sleep(1.0 / requests_per_s)
    await asyncio.gather(*tasks)
    ordered = sorted(latencies_s)
    return RequestRound(
        requests_per_s, 1e3 * statistics.median(ordered), 1e3 * ordered[int(0.99 * len(ordered))], statistics.mean(sizes)
    )


BLOCK_PROGRAM = """
import json, sys, time
from pathlib import Path
from morecantile import tms
from skugga.selector.select import plan_of_view
from skugga.shadows.render import render_frame
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.geo.grid import BLOCK_PX, MapView, tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
files_of = None
try:
    from skugga.api.compute import draw_picture
    from skugga.api.request import ProductRequest
    from skugga.api.workers.block_tiles import tiles_of_picture
    request = ProductRequest()
    def draw(scene, view, plan):
        return draw_picture(scene, view, request.product_record, plan)
    def files_of(scene, view, drawn):
        return tiles_of_picture(drawn, request, scene, view, "png", 2)
except ImportError:  # an older commit
    try:
        from skugga.shadows.ground_pictures import shown_map as draw
    except ImportError:
        draw = render_frame
    try:
        from skugga.api.workers.block_tiles import PicturedBlock, encoded_tiles
        def files_of(scene, view, drawn):
            return encoded_tiles(PicturedBlock(drawn.color, drawn.opacity, drawn.there), "color", "png", 2)
    except ImportError:
        pass
level, zoom, suns = sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3])
def block(scene):
    grid = tile_grid(tms.get("WebMercatorQuad"), zoom)
    (north, south), (west, east) = extent_on_grid(scene.world, scene.elevation, grid)
    row, col = (float((low + high) / 2 // BLOCK_PX * BLOCK_PX) for low, high in ((north, south), (west, east)))
    return MapView(grid, row, col, 1.0, 1.0, BLOCK_PX, BLOCK_PX)
def cpu_ms(scene, view, sun):
    scene = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    plan = plan_of_view(scene, view, "map", {})
    start = time.process_time()
    drawn = draw(scene, view, plan)
    passes.append({each.name: round(each.ms) for each in drawn.passes})
    took_ms = 1e3 * (time.process_time() - start)
    if files_of is not None:
        start = time.process_time()
        files = files_of(scene, view, drawn)
        encoding.append(1e3 * (time.process_time() - start) / len(files))
    return took_ms
passes, encoding = [], []
for number in range(2):
    scene = build_scene(load_level(Path(level)))
    view = block(scene)
    plan_of_view(scene, view, "map", {})
    out = {"cold": cpu_ms(scene, view, suns[0]), "new sun": [cpu_ms(scene, view, sun) for sun in suns[1:]], "encoding": encoding}
    scene.close()
count = len(suns)
print("passes, ms, cold:", passes[-count], "new sun:", passes[1 - count], file=sys.stderr)
print(json.dumps(out))
"""
"""Program that prints CPU milliseconds of a block as JSON, and those of its passes on standard error. A first run compiles all
loops."""


def measure_block_cpu_ms(folder: Path, level: Path, zoom: int) -> dict[str, float]:
    """Return CPU milliseconds of a block, computed by the code in ``folder``: cold, and the median of new suns.

    ``level`` is a level file. If the code has a function that encodes tiles, the milliseconds to encode a tile of 512 x 512 pixels
    are added.
    """
    suns = [SUNS[6], *SUNS[1::4]]
    process = subprocess.run(
        [sys.executable, "-c", BLOCK_PROGRAM, str(level), str(zoom), json.dumps(suns)], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(folder), "LP_NUM_THREADS": "1"}, check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {SERVICE_CORE}),
    )  # fmt: skip
    print(folder, process.stderr.splitlines()[-1], flush=True)
    times_ms = json.loads(process.stdout.splitlines()[-1])
    medians = {name: statistics.median(times_ms[name]) for name in ("new sun", "encoding") if times_ms[name]}
    return {"cold": times_ms["cold"], **medians}


def software_versions(python: Path) -> dict[str, str]:
    """Return versions of the software and the machine. ``python`` is the interpreter in whose environment titiler is installed."""
    modules = "titiler.application, rio_tiler, rasterio, uvicorn"
    program = f"import {modules}; print(*(m.__version__ for m in ({modules})), rasterio.__gdal_version__)"
    package_versions = subprocess.run([str(python), "-c", program], capture_output=True, text=True, check=True).stdout.split()
    names = ("titiler", "rio-tiler", "rasterio", "uvicorn", "GDAL")
    return {**dict(zip(names, package_versions, strict=True)), "Python": platform.python_version(), "processor": processor_name()}


def median_round(rounds: list[RequestRound]) -> RequestRound:
    """Return the medians of the results of some rounds."""
    return RequestRound(
        *(statistics.median(values) for values in zip(*(asdict(measured_round).values() for measured_round in rounds), strict=True))
    )


def _median_by_name(values: list[dict[str, float]]) -> dict[str, float]:
    """Return the median of each figure over dictionaries with the same keys."""
    return {name: statistics.median(entry[name] for entry in values) for name in values[0]}


def main() -> None:
    """Measure, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--raster", type=Path, required=True)
    parser.add_argument("--titiler-python", type=Path, required=True)
    parser.add_argument("--base", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    os.sched_setaffinity(0, {CLIENT_CORE})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cog = folder / "cog.tif"
        copy(args.raster, cog, driver="COG", COMPRESS="DEFLATE", BLOCKSIZE=256, OVERVIEW_RESAMPLING="AVERAGE")
        with run_titiler(cog, args.titiler_python) as running:
            tiles = tiles_served_by_titiler(tiles_over_raster(cog), running)
        rounds_by_service: dict[str, Rounds] = {"titiler": {}, "Skugga": {}}
        scalars_by_service: dict[str, dict[str, list[float]]] = {"titiler": {}, "Skugga": {}}
        blocks: dict[str, list[dict[str, float]]] = {}
        with run_skugga(cog, folder):
            pass  # loops are compiled, and the device is calibrated, once on a machine
        for _ in range(args.repeats):
            measure_service(
                tiles,
                lambda: run_titiler(cog, args.titiler_python),
                False,
                rounds_by_service["titiler"],
                scalars_by_service["titiler"],
            )
            measure_service(tiles, lambda: run_skugga(cog, folder), True, rounds_by_service["Skugga"], scalars_by_service["Skugga"])
            bare, wooded = (ROOT / "configs" / f"jacksboro{kind}.yaml" for kind in ("", "_wooded"))
            code_and_level_by_name = {
                "now": (ROOT, folder / "cog.yaml"),
                "village's ground": (ROOT, bare),
                "village": (ROOT, wooded),
            }
            if args.base is not None:
                code_and_level_by_name["base"] = args.base, folder / "cog.yaml"
            for key, (code, level) in code_and_level_by_name.items():
                blocks.setdefault(key, []).append(measure_block_cpu_ms(code, level, ZOOMS[-1]))
        result = {
            "versions": software_versions(args.titiler_python), "tiles": len(tiles), "repeats": args.repeats,
            "rounds": {
                service_name: {name: asdict(median_round(samples)) for name, samples in rounds.items()}
                for service_name, rounds in rounds_by_service.items()
            },
            "seconds": {
                service_name: {name: statistics.median(samples) for name, samples in values.items()}
                for service_name, values in scalars_by_service.items()
            },
            "block CPU ms": {key: _median_by_name(values) for key, values in blocks.items()},
        }  # fmt: skip
    if args.json:
        args.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(json.dumps(result["versions"] | {"tiles": len(tiles)}))
    print("| what | titiler | Skugga | ratio |\n| --- | --- | --- | --- |")
    for name, titiler_round in result["rounds"]["titiler"].items():
        skugga_round = result["rounds"]["Skugga"][name]
        value = "median_ms" if "alone" in name or name == "first tile" else "per_second"
        unit = "ms" if value == "median_ms" else "tiles/s"
        ratio = titiler_round[value] / skugga_round[value] if value == "median_ms" else skugga_round[value] / titiler_round[value]
        details = (
            f"p99 {skugga_round['p99_ms'] / skugga_round['median_ms']:.1f} x median, {skugga_round['mean_bytes'] / 1e3:.1f} kB"
        )
        print(f"| {name} | {titiler_round[value]:.1f} {unit} | {skugga_round[value]:.1f} {unit}; {details} | {ratio:.2f} |")
    print(json.dumps(result["rounds"]["Skugga"]["again, one alone"]))
    print(json.dumps({**result["seconds"], **result["block CPU ms"]}))


if __name__ == "__main__":
    main()
