"""Accuracy of `shadow_map` in the bundled levels' views; time and memory of a perspective frame with a million trees.

    python -m benchmarks.scenes accuracy [LEVEL ...] [--size 512x410] [--map-size 4096] [--markdown FILE]
    python -m benchmarks.scenes trees [--trees 1000000] [--repeats 5]
    python -m benchmarks.scenes thinning [--trees 1000000]

`accuracy` compares every view of the levels (default: all bundled levels) with ray-traced truth, for the first light of each level
(docs/reports/scene-accuracy.md).
`trees` draws two 1280 x 1024 views of 10 x 10 km of hills under one wood. It reports median times, the process's peak memory and
the device. `thinning` compares the share of ray-traced shadow in the same views, with decimated distant trees and with all trees.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

import skugga.terrain.gbuffer.tree_instances as stand_module
from skugga.api.catalogue import bundled_levels, find_level
from skugga.selector.measure.compare import measure_plan
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.shadows.truth.metrics import block_shadow_shares, coverage_error
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

SIDE_M = 10_000.0
"""Side of the square of wooded hills."""
CELL_M = 10.0
WINDOW_ORIGINS = [(row, col) for row in (400, 600, 800) for col in (100, 512, 900)]
"""First row and column of the windows of the picture in which ``thinning`` traces rays."""
WINDOW_PX = 128
"""Rows and columns of a window."""


def measure_accuracy(levels: list[str], size: tuple[int, int], map_size: int) -> list[dict]:
    """Return the errors of ``shadow_map`` in all views of bundled levels, a row for each view. Without names, use all levels.

    ``size`` is (width, height) in pixels, and ``map_size`` the number of texels a side of shadow maps.
    """
    rows = []
    for path in [find_level(name) for name in levels] or bundled_levels():
        scene = build_scene(load_level(path))
        for name in scene.loaded.level.views:
            view = scene.view(name, size=size)
            plan = make_plan(describe(scene, view, name), scene.loaded.level, {"algorithm": "shadow_map", "map_size": map_size})
            figures = measure_plan(scene, view, plan).figures
            rows.append({"level": path.stem, "view": name, "casters": ", ".join(scene.objects.caster_kinds), **figures})
            print(accuracy_row(rows[-1]), flush=True)
    return rows


def accuracy_row(row: dict) -> str:
    """Format the errors of a view as a row of the Markdown table, shares in per cent."""
    keys = ("wrong_cast", "false_shadow", "missed_shadow", "interior", "interior_sees", "coverage", "boundary")
    shares = " | ".join(f"{100 * row[key]:.3f}" for key in keys)
    return f"| {row['level']} | {row['view']} | {row['casters']} | {shares} | {row['edge_p95']:.2f} |"


def write_wooded_hills(folder: Path, trees: int) -> Path:
    """Write a level of 10 x 10 km of hills in UTM zone 32N under one wood of about ``trees`` trees. Return the level file."""
    y, x = np.mgrid[: int(SIDE_M / CELL_M), : int(SIDE_M / CELL_M)] * CELL_M
    heights = 300 + 120 * np.sin(x / 900) * np.cos(y / 1100) + 40 * np.sin(x / 210 + y / 330) + 15 * np.cos(y / 90)
    west, north = 500_000.0, 5_210_000.0
    with rasterio.open(
        folder / "hills.tif", "w", driver="GTiff", width=heights.shape[1], height=heights.shape[0], count=1, dtype="float32",
        crs="EPSG:32632", transform=Affine(CELL_M, 0, west, 0, -CELL_M, north),
    ) as dataset:  # fmt: skip
        dataset.write(heights.astype(np.float32), 1)
    east, south = west + SIDE_M, north - SIDE_M
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    wood = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}},
        "features": [{"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}],
    }
    (folder / "wood.geojson").write_text(json.dumps(wood), encoding="utf-8")
    eye, target = [9.02, 46.98], [9.06, 47.0, 20]
    level = {
        "version": 1,
        "terrain": {"source": "hills.tif"},
        "forest": [
            {"source": "wood.geojson", "density": 1.005 * trees / (SIDE_M / 100) ** 2, "height": [9, 22], "species": "mixed"}
        ],
        "sun": {"azimuth": 230, "altitude": 25},
        "views": {
            "low": {"kind": "perspective", "eye": [*eye, 60], "target": target, "fov": 50, "size": [1280, 1024]},
            "high": {"kind": "perspective", "eye": [*eye, 900], "target": target, "fov": 50, "size": [1280, 1024]},
        },
    }
    path = folder / "hills.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return path


def measure_tree_frames(count: int, repeats: int) -> None:
    """Print times and peak memory of the views of a wood of about ``count`` trees.

    Each view is drawn ``repeats`` times after an untimed frame.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = build_scene(load_level(write_wooded_hills(Path(folder), count)))
        print(
            f"{device().renderer}; {0 if scene.objects.trees is None else len(scene.objects.trees.thinning_rank)} trees", flush=True
        )
        for name in scene.loaded.level.views:
            times: list[float] = []
            for _ in range(repeats + 1):
                start = time.perf_counter()
                view = scene.view(name)
                plan = make_plan(describe(scene, view, name), scene.loaded.level)
                frame = None  # release the last frame before the next is made, as a service does
                frame = render_frame(scene, view, plan)
                times.append(time.perf_counter() - start)
            passes = ", ".join(f"{record.name} {record.ms:.0f}" for record in frame.passes)
            print(f"{name}: median {np.median(times[1:]):.2f} s with the plan (first {times[0]:.1f} s); last passes, ms: {passes}")
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


def measure_thinning(count: int) -> None:
    """Print how much decimation of distant trees changes ray-traced shadow of a wood of about ``count`` trees."""
    whole_px = stand_module.FULL_STAND_TREE_PX
    with tempfile.TemporaryDirectory() as folder:
        for name in ("low", "high"):
            shares = []
            for stand_module.FULL_STAND_TREE_PX in (1e-6, whole_px):
                scene = build_scene(
                    load_level(write_wooded_hills(Path(folder), count))
                )  # a new scene each time: the scene caches stands
                view, tree_count, parts = scene.view(name), 0, []
                for row, col in WINDOW_ORIGINS:
                    buffer = geometry_buffer(scene, view.part(row, col, WINDOW_PX, WINDOW_PX))
                    tree_count = len(buffer.tree_instances)
                    lit = lit_mask(buffer, scene, "sun", ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS))
                    parts.append(block_shadow_shares(np.where(buffer.valid, 1.0 - lit, np.nan)))
                shares.append(np.array(parts))
            means = [float(np.nanmean(share)) for share in shares]
            print(f"{name}: {tree_count} of {count} trees; shadow share {means[1]:.4f} against {means[0]:.4f}, "
                  f"coverage {coverage_error(shares[1], shares[0]):.4f}", flush=True)  # fmt: skip


def main() -> None:
    """Run the measurement that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("accuracy", "trees", "thinning"))
    parser.add_argument("levels", nargs="*")
    parser.add_argument("--size", default="512x410")
    parser.add_argument("--map-size", type=int, default=4096)
    parser.add_argument("--trees", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    if args.what == "trees":
        measure_tree_frames(args.trees, args.repeats)
    elif args.what == "thinning":
        measure_thinning(args.trees)
    else:
        width, height = (int(part) for part in args.size.split("x"))
        shares = "wrong cast % | false % | missed % | interior % | it sees % | coverage % | boundary %"
        head = f"| level | view | casters | {shares} | edge p95 px |\n|{' --- |' * 11}"
        print(head)
        rows = measure_accuracy(args.levels, (width, height), args.map_size)
        if args.markdown:
            args.markdown.write_text(head + "\n" + "\n".join(accuracy_row(row) for row in rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
