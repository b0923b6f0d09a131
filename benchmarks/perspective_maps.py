"""Perspective shadow maps and shadow maps of the same size: errors against truth, and times as ratios within one run.

    python -m benchmarks.perspective_maps errors [LEVEL ...] [--size 640 512] [--map-size 1024] [--filter 3] [--json FILE]
    python -m benchmarks.perspective_maps times [LEVEL ...] [--size 1280 1024] [--map-size 1024] [--repeats 40] [--json FILE]

The default levels are those of the thesis (J. Sindholt 2005), with all their perspective views. `errors` compares one perspective
map with one shadow map, fitted ``tight`` and ``stable``. `times` draws a map and samples it; the kinds of maps take turns. It
reports ratios of median times, and bytes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from skugga.api.catalogue import find_level
from skugga.selector.measure.compare import measure_plan
from skugga.selector.planner.planner import make_plan
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.visibility import fill_steps
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

THESIS_LEVELS = [f"thesis_{name}{sun}" for name in ("rocks", "street", "boxgrid", "room", "water_tower") for sun in ("", "_sun")]
"""Bundled levels of the thesis, each under a spot light and under the sun."""

MAP_FITS = ("tight", "stable")
"""Ways of fitting the shadow map to the visible points."""

Row = dict[str, Any]
"""Figures of one view, or of one map in a view, by column of the table."""


def perspective_views(levels: list[str], size: tuple[int, int]) -> Iterator[tuple[str, Scene, str, PerspectiveView]]:
    """Yield the perspective views of levels, each as name of the level, scene, name of the view, and view.

    ``size`` is (width, height) in pixels.
    """
    for name in levels:
        scene = build_scene(load_level(find_level(name)))
        for view_name, spec in scene.loaded.level.views.items():
            if spec.kind == "perspective":
                yield name, scene, view_name, scene.view(view_name, size=size)


def make_plans(scene: Scene, view: PerspectiveView, name: str, map_size: int, taps: int) -> dict[str, Plan]:
    """Return the plans to compare by name. All have one map of the same size, with the same filter taps and depth bits.

    ``name`` is the name of the view. ``map_size`` is the number of texels a side, and ``taps`` that of filter taps a side.
    """
    descriptor, level = describe(scene, view, name), scene.loaded.level
    overrides = {"map_size": map_size, "filter": taps, "depth_bits": 24 if descriptor.highest_sun_deg is not None else 32}
    maps = {
        fit: make_plan(descriptor, level, {**overrides, "algorithm": "shadow_map", "cascades": 1, "fit": fit}) for fit in MAP_FITS
    }
    return {**maps, "perspective": make_plan(descriptor, level, {**overrides, "algorithm": "perspective_shadow_map"})}


def measure_errors(args: argparse.Namespace) -> list[Row]:
    """Return the errors of all plans against ray-traced truth, a row for each view and map."""
    keys = (
        "edge_p95", "edge_mean", "wrong", "wrong_cast", "false_shadow", "missed_shadow", "interior", "interior_parts",
        "interior_sees",
    )  # fmt: skip
    rows = []
    for level, scene, name, view in perspective_views(args.levels, tuple(args.size)):
        for map_name, plan in make_plans(scene, view, name, args.map_size, args.filter).items():
            figures = measure_plan(scene, view, plan).figures
            rows.append({"view": f"{level} {name}", "map": map_name, **{key: figures[key] for key in keys}})
            print(*rows[-1].values(), flush=True)
    return rows


def measure_times(args: argparse.Namespace) -> list[Row]:
    """Return times and memory of all plans that take turns, a row for each view."""
    rows = []
    for level, scene, name, view in perspective_views(args.levels, tuple(args.size)):
        buffer = geometry_buffer(scene, view)
        casters = find_casters(scene, buffer)
        times_by_map: dict[str, list[float]] = {}
        map_bytes, notes = {}, {}
        todo = make_plans(scene, view, name, args.map_size, args.filter)
        for number in range(args.repeats + 2):
            for map_name in [*todo][:: 1 if number % 2 else -1]:
                device().depth_targets.clear()
                log, start = PassLog(), time.perf_counter()
                for light in todo[map_name].lights:
                    fill_steps(todo[map_name].steps_of_light(light), buffer, scene, casters, todo[map_name].effect_names, log)
                if number >= 2:  # the first turns compile and allocate
                    times_by_map.setdefault(map_name, []).append(time.perf_counter() - start)
                map_bytes[map_name] = max(record.bytes for record in log.records.values())
                notes[map_name] = " ".join(record.note for record in log.records.values()).strip()
        medians = {map_name: float(np.median(milliseconds)) for map_name, milliseconds in times_by_map.items()}
        row = {"view": f"{level} {name}", "ms": 1000.0 * medians["perspective"]}
        row |= {f"over {fit}": medians["perspective"] / medians[fit] for fit in MAP_FITS}
        row |= {f"MiB {map_name}": count / 2**20 for map_name, count in map_bytes.items()}
        rows.append({**row, "note": notes["perspective"]})
        print(*rows[-1].values(), flush=True)
    return rows


def main() -> None:
    """Run the measurement that the command line names, and print and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("errors", "times"))
    parser.add_argument("levels", nargs="*", default=THESIS_LEVELS)
    parser.add_argument("--size", type=int, nargs=2)
    parser.add_argument("--map-size", type=int, default=1024)
    parser.add_argument("--filter", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    args.size = args.size or {"errors": (640, 512), "times": (1280, 1024)}[args.what]
    rows = {"errors": measure_errors, "times": measure_times}[args.what](args)
    keys = list(rows[0])
    table = [keys, ["---"] * len(keys), *([f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows)]
    print(device().renderer, "", *(f"| {' | '.join(line)} |" for line in table), sep="\n")
    if args.json:
        args.json.write_text(json.dumps({"renderer": device().renderer, "rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
