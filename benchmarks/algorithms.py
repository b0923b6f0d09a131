"""What algorithms cost and gain, as ratios within one run: absolute milliseconds do not travel from one machine to another.

    python benchmarks/algorithms.py frames [--repeats 30] [--map-size 512] [--json FILE] [--markdown FILE]
    python benchmarks/algorithms.py cascades [--json FILE] [--markdown FILE]

`frames` draws the SpatialAce level's perspective view at 800 x 600 with one map of 512 x 512 texels: whole frames
(``render_frame``), taking turns, medians over those without cast shadows. ``redrawn``: before every frame the sun moves by a
step that it never takes twice, so that nothing that depends on a sun is at hand; its plan is made outside of the clock.
``kept``: sun and camera rest, and the map of the frame before is looked up again.

`cascades` holds four cascades of 1024 against one map of 2048 texels a side (the same memory) against ray-traced truth, seen
from a summit over houses and 20 km of mountains: shadow edges near and far.

The line sweep's speed has a script of its own, `benchmarks/sweep_speed.py`: it needs no OpenGL.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from api.catalogue import find_level
from selector.compare import measure
from selector.rules import choose
from shadows.plan import Plan
from shadows.render import Frame, render_frame
from terrain.descriptor import describe
from terrain.gl import device
from terrain.level import load_level
from terrain.level_parts import SunSpec
from terrain.scene import Scene, build_scene

SIZE = (800, 600)
SUN_STEP_DEG = 0.07
"""How far the sun moves from one redrawn frame to the next."""

RIDGES_M, RIDGES_CELL_M = 24_000, 20
EYE_M = (-9692.0, -11_000.0)
"""A summit in the south-west of generated mountains; the middle of them is looked at."""

HOUSES_AT_M = (60, 90, 130, 190, 280, 400, 600, 900, 1300, 2000, 3000)
"""Distances from the eye at which five houses each stand, so that there are shadow edges near as well as far."""

SUNS = [(100.0, 10.0), (300.0, 15.0), (60.0, 12.0)]
"""Azimuths and altitudes that the cascades are measured under."""

Row = dict[str, Any]


def frames(repeats: int, map_size: int) -> list[Row]:
    """Frame times without shadows, with the map redrawn for every frame, and with the map kept."""
    scene = build_scene(load_level(find_level("spatialace")))
    view = scene.view("main", size=SIZE)
    assert scene.sun is not None
    azimuth, altitude = scene.sun.azimuth_deg, scene.sun.altitude_deg

    def plan_under(lit: Scene, algorithm: str) -> Plan:
        asked = {"algorithm": algorithm, "map_size": map_size, "cascades": 1}
        return choose(describe(lit, view, "main"), lit.loaded.level, asked)

    def under(number: int) -> Scene:
        return scene.with_sun(SunSpec(azimuth=azimuth + SUN_STEP_DEG * number, altitude=altitude))

    still = {name: plan_under(scene, algorithm) for name, algorithm in (("none", "none"), ("kept", "shadow_map"))}

    def turn(number: int) -> list[tuple[str, Scene, Plan]]:
        moved = under(number + 1)
        return [("none", scene, still["none"]), ("redrawn", moved, plan_under(moved, "shadow_map")), ("kept", scene, still["kept"])]

    times: dict[str, list[float]] = {}
    drawn: dict[str, Frame] = {}
    for number in range(repeats + 2):
        for name, lit, plan in turn(number):
            start = time.perf_counter()
            drawn[name] = render_frame(lit, view, plan)
            if number >= 2:  # the first ones compile, allocate, and draw the map that is kept
                times.setdefault(name, []).append(time.perf_counter() - start)
    rows = []
    for name, taken in times.items():
        passes = drawn[name].passes
        rows.append({
            "row": name,
            "ratio": float(np.median(taken) / np.median(times["none"])),
            "median_ms": 1000.0 * float(np.median(taken)),
            "p95_ms": 1000.0 * float(np.quantile(taken, 0.95)),
            "map_draws": sum(record.draws for record in passes if record.name.endswith("depth map")),
            "pass_mib": max(record.bytes for record in passes) / 2**20,
            "passes_ms": {record.name: round(record.ms, 1) for record in passes},
        })  # fmt: skip
    return rows


def ridges(folder: Path) -> Scene:
    """Mountains of 24 x 24 km, seen from a summit over houses and more than 20 km of ground."""
    trimesh.creation.box(extents=(12.0, 9.0, 8.0)).export(folder / "house.obj")
    rng, eye = np.random.default_rng(1), np.array(EYE_M)
    ahead = -eye / np.linalg.norm(eye)
    aside = np.array([-ahead[1], ahead[0]])
    away_m = np.repeat(HOUSES_AT_M, 5)
    along, across = rng.uniform(1.0, 1.2, len(away_m)), rng.uniform(-0.4, 0.4, len(away_m))
    houses = eye + (away_m * along)[:, None] * ahead + (away_m * across)[:, None] * aside
    level = {
        "version": 1,
        "terrain": {"generate": {"kind": "ridges", "size": [RIDGES_M, RIDGES_M], "cell": RIDGES_CELL_M, "relief": 1500, "seed": 3}},
        "meshes": [{"source": "house.obj", "at": houses.round(1).tolist(), "turn": 20}],
        "views": {"main": {"kind": "perspective", "eye": [*EYE_M, 25], "target": [0, 0, -100], "fov": 50, "size": list(SIZE)}},
    }
    path = folder / "ridges.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


def cascades() -> list[Row]:
    """Errors of four cascades and of one map in the same memory."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        whole = ridges(Path(folder))
        view = whole.view("main")
        for azimuth, altitude in SUNS:
            scene = whole.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
            descriptor = describe(scene, view, "main")
            for count, size in ((1, 2048), (4, 1024)):
                asked = {"algorithm": "shadow_map", "cascades": count, "map_size": size, "depth_bits": 24}
                plan = choose(descriptor, scene.loaded.level, asked)
                figures = measure(scene, view, plan).figures
                keys = ("edge_p95", "edge_mean", "wrong_cast", "false_shadow", "missed_shadow", "interior", "boundary")
                ends = [cascade.far_m for cascade in plan.settings["sun"]["relief"].cascades]  # type: ignore[union-attr]
                name = f"sun {azimuth:.0f}/{altitude:.0f}, {count} x {size}"
                texels = figures["counters"]["map_texels"]
                rows.append({"row": name, **{key: figures[key] for key in keys}, "map_texels": texels, "far_m": ends})
    return rows


MEASUREMENTS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "frames": lambda given: frames(given.repeats, given.map_size),
    "cascades": lambda given: cascades(),
}


def table(rows: list[Row]) -> str:
    """Rows as a Markdown table; what is no number or word is left to the JSON."""
    keys = [key for key, value in rows[0].items() if isinstance(value, int | float | str)]
    lines = [keys, ["---"] * len(keys), *([_cell(row[key]) for key in keys] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cell(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(MEASUREMENTS))
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--map-size", type=int, default=512)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    given = parser.parse_args()
    rows = MEASUREMENTS[given.what](given)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    where = f"{device().renderer}; peak memory {peak_mib:.0f} MiB"
    print(where, table(rows), sep="\n\n", end="")
    if given.markdown:
        given.markdown.write_text(f"{where}\n\n{table(rows)}", encoding="utf-8")
    if given.json:
        report = {"renderer": device().renderer, "peak_mib": peak_mib, "repeats": given.repeats, "rows": rows}
        given.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
