"""Speed of ``skugga seed`` with one worker, two workers and a Dask cluster, and of other tools that tile a finished hillshade.

    python -m benchmarks.seed DATA [--copies 6] [--zooms 8-13] [--gdal2tiles gdal2tiles.py] [--rio rio] [--json FILE]

``DATA`` is a folder of real rasters with ``mountain/bigtujunga_30m_utm11.tif``. The raster is mirrored into a seamless mosaic of
``--copies`` copies a side. The commands run one after another in a temporary folder. Only ratios of one run are comparable. An
untimed run on a small part compiles all loops first.

`gdal2tiles.py` (Debian's `gdal-bin` and `python3-gdal`) and `rio pmtiles` (`pip install rio-pmtiles`, in Skugga's environment or in
one that ``--rio`` names) read a finished hillshade of the same raster, without cast shadows. Tools that are not installed are
reported and skipped. Figures belong in docs/reports/scale.md, with date, commit and device.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from pmtiles.reader import MmapSource, Reader

SUN_OPTIONS = "--azimuth", "225", "--altitude", "20"
"""Options of ``skugga seed`` for the sun."""

SKUGGA_COMMAND = [sys.executable, "-c", "from skugga.api.cli.main import main; main()"]


@dataclass(frozen=True)
class SeedRow:
    """A timed run.

    The fields from ``drawing_s`` on come from the summary that ``skugga seed`` prints, and are ``None`` for other tools.

    Attributes
    ----------
    name
        Name of the run.
    total_s
        Total wall time, seconds.
    tiles
        Number of tiles that the run wrote.
    drawing_s, publishing_s
        Wall time of drawing tiles and of packing them into the archive, seconds.
    task_s
        Sum of the seconds of all tasks.
    peak_bytes
        Peak memory of the largest worker, bytes.
    """

    name: str
    total_s: float
    tiles: int
    drawing_s: float | None = None
    publishing_s: float | None = None
    task_s: float | None = None
    peak_bytes: int | None = None


def write_mosaic(source: Path, copies: int, target: Path) -> None:
    """Write a raster mirrored ``copies`` x ``copies`` times to the file ``target``."""
    with rasterio.open(source) as dataset:
        part, profile = dataset.read(1), dataset.profile
    rows = [[part[:: 1 if i % 2 == 0 else -1, :: 1 if j % 2 == 0 else -1] for j in range(copies)] for i in range(copies)]
    mosaic_cells = np.block(rows)
    profile |= {"height": mosaic_cells.shape[0], "width": mosaic_cells.shape[1], "tiled": True, "compress": "deflate"}
    profile |= {"blockxsize": 256, "blockysize": 256}
    with rasterio.open(target, "w", **profile) as dataset:
        dataset.write(mosaic_cells, 1)


def run_seed(folder: Path, name: str, raster: Path, zooms: str, *options: str) -> SeedRow:
    """Run ``skugga seed`` into a new archive in ``folder``, and return its times.

    ``zooms`` are the first and the last zoom, as "8-13". ``options`` are further words of the command line.
    """
    output = folder / f"{name.replace(' ', '-')}.pmtiles"
    command = [*SKUGGA_COMMAND, "seed", str(raster), "--zooms", zooms, *SUN_OPTIONS, "-o", str(output), "--json", *options]
    start = time.perf_counter()
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    took = time.perf_counter() - start
    log = [json.loads(line) for line in (Path(f"{output}.seed") / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    tasks = [entry for entry in log if "seconds" in entry]
    return SeedRow(
        name, took, count_tiles(output), report["drawing_s"], report["publishing_s"], sum(entry["seconds"] for entry in tasks),
        max(entry["peak_bytes"] for entry in tasks),
    )  # fmt: skip


def count_tiles(archive: Path) -> int:
    """Return the number of tiles in an archive."""
    with archive.open("rb") as file:
        return int(Reader(MmapSource(file)).header()["addressed_tiles_count"])


@contextmanager
def dask_cluster(folder: Path, workers: int) -> Iterator[str]:
    """Run a Dask cluster with ``workers`` processes of one thread on this machine, and yield the address of its scheduler."""
    with socket.socket() as probe_socket:
        probe_socket.bind(("127.0.0.1", 0))
        port = probe_socket.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"

    def start(kind: str, *arguments: str) -> subprocess.Popen[bytes]:
        code = f"import sys\nfrom distributed.cli.dask_{kind} import main\nsys.argv[0] = 'dask'\nmain()"
        return subprocess.Popen(
            [sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ}
        )

    processes = [start("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", "--no-show")]
    try:
        for _ in range(workers):
            processes.append(
                start("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder))
            )
        time.sleep(8.0)
        yield address
    finally:
        for process in processes:
            process.kill()
            process.wait()


def run_other_tools(folder: Path, raster: Path, zooms: str, gdal2tiles: str, rio: str) -> list[SeedRow]:
    """Run tools that tile and encode a hillshade of the raster, and return their times. Missing tools are skipped.

    ``gdal2tiles`` and ``rio`` are the tools' commands. ``zooms`` are the first and the last zoom, as "8-13".
    """
    if not shutil.which("gdaldem") or not shutil.which(gdal2tiles):
        print("gdaldem or gdal2tiles.py is not installed: skipped")
        return []
    shade, rgb, result = folder / "hillshade.tif", folder / "rgb.tif", []
    quiet: dict[str, Any] = {"check": True, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run(["gdaldem", "hillshade", str(raster), str(shade), "-az", "225", "-alt", "20", "-co", "TILED=YES"], **quiet)
    tiles = folder / "gdal2tiles"
    command = [gdal2tiles, "--processes", "2", "-z", zooms, "--xyz", "-w", "none", "-r", "average", str(shade), str(tiles)]
    start = time.perf_counter()
    subprocess.run(command, **quiet)
    result.append(SeedRow("gdal2tiles --processes 2", time.perf_counter() - start, sum(1 for _ in tiles.rglob("*.png"))))
    if not shutil.which(rio):
        print("rio is not installed: skipped")
        return result
    subprocess.run(["gdal_translate", "-b", "1", "-b", "1", "-b", "1", "-co", "TILED=YES", str(shade), str(rgb)], **quiet)
    archive = folder / "rio.pmtiles"
    first, last = zooms.split("-")
    command = [
        rio, "pmtiles", str(rgb), str(archive), "--format", "PNG", "--tile-size", "256", "--zoom-levels", f"{first}..{last}",
        "-j", "2", "--resampling", "bilinear", "--silent",
    ]  # fmt: skip
    start = time.perf_counter()
    subprocess.run(command, **quiet)
    result.append(SeedRow("rio pmtiles -j 2", time.perf_counter() - start, count_tiles(archive)))
    return result


def print_report(rows: list[SeedRow]) -> None:
    """Print the rows, and the targets."""
    print("| run | seconds | tiles | tiles a second | drawing | packing | largest worker |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for row in rows:
        drawing, packing = ("" if v is None else f"{v:.1f} s" for v in (row.drawing_s, row.publishing_s))
        peak = "" if row.peak_bytes is None else f"{row.peak_bytes / 2**20:.0f} MiB"
        print(f"| {row.name} | {row.total_s:.1f} | {row.tiles} | {row.tiles / row.total_s:.0f} | {drawing} | {packing} | {peak} |")
    by_name = {row.name: row for row in rows}
    one_worker, two_workers = by_name["one worker"], by_name["two workers"]
    print(f"\ntwo workers: {one_worker.total_s / two_workers.total_s:.2f} times as fast as one (target 1.8)")
    assert one_worker.task_s is not None and two_workers.publishing_s is not None and two_workers.drawing_s is not None
    print(f"tiles per second and core within tasks: {one_worker.tiles / one_worker.task_s:.0f} (target 100, stretch goal 150)")
    print(f"packing: {two_workers.publishing_s / two_workers.total_s:.1%} of the run with two workers (target at most 5 %)")
    if (dask := by_name.get("Dask, two workers")) is not None and dask.drawing_s is not None:
        print(f"Dask: drawing takes {dask.drawing_s / two_workers.drawing_s - 1.0:+.1%} of two local workers (target at most +5 %)")
    for name in ("gdal2tiles --processes 2", "rio pmtiles -j 2"):
        if name in by_name:
            other = by_name[name]
            rate = (two_workers.tiles / two_workers.total_s) / (other.tiles / other.total_s)
            print(
                f"two workers: {rate:.2f} times the tiles per second of {name}; {name} takes "
                f"{other.total_s / two_workers.total_s:.2f} times as long"
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--copies", type=int, default=6)
    parser.add_argument("--zooms", default="8-13")
    parser.add_argument("--gdal2tiles", default="gdal2tiles.py")
    parser.add_argument("--rio", default="rio")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    source = args.data / "mountain" / "bigtujunga_30m_utm11.tif"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raster, small = folder / "mosaic.tif", folder / "small.tif"
        write_mosaic(source, args.copies, raster)
        write_mosaic(source, 1, small)
        with rasterio.open(raster) as dataset:
            print(f"{dataset.width} x {dataset.height} cells of {dataset.transform.a:g} m, zooms {args.zooms}\n")
        run_seed(folder, "warm-up", small, "11-13")
        rows = [run_seed(folder, f"{word} worker{'s' * (count > 1)}", raster, args.zooms, "--workers", str(count))
                for word, count in (("one", 1), ("two", 2))]  # fmt: skip
        with dask_cluster(folder, 2) as address:
            rows.append(run_seed(folder, "Dask, two workers", raster, args.zooms, "--scheduler", address))
        rows += run_other_tools(folder, raster, args.zooms, args.gdal2tiles, args.rio)
    print_report(rows)
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
