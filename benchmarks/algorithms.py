"""Cost and benefit of shadow algorithms, as ratios within one run: absolute milliseconds do not compare between machines.

    python -m benchmarks.algorithms frames [--repeats 30] [--map-size 512] [--json FILE] [--markdown FILE]
    python -m benchmarks.algorithms cascades [--json FILE] [--markdown FILE]
    python -m benchmarks.algorithms thesis [--scenes thesis_rocks ...] [--size 1280x1024] [--repeats 30] [--cpu] [--json FILE] ...
    python -m benchmarks.algorithms stencil [--scenes thesis_rocks ...] [--size 1280x1024] [--repeats 30] [--cpu] [--json FILE] ...

`frames` draws the SpatialAce level's perspective view at 800 x 600 with one shadow map of 512 x 512 texels. It times whole frames
(``render_frame``) that take turns. The figures are ratios of medians to frames without cast shadows. There are two modes:

* ``redrawn``: the sun moves before every frame by a step that never repeats. No cache holds anything for it, so the map is drawn
  again. Planning is not timed.
* ``kept``: sun and camera rest, so the frame samples the cached map of the previous frame.

`cascades` compares four cascades of 1024 texels a side with one map of 2048 (the same memory). Both are compared with ray-traced
truth. The view is from a summit over houses and 20 km of mountains, with shadow edges near and far.

`thesis` follows J. Sindholt, A comparison of Shadow Algorithms (DTU 2005), section 7. The thesis's algorithms take turns in the
main views of its scenes, each under a spot light and under the sun. Single maps have 1024 texels a side, those of the hybrids 768.
Times cover the shadow pass alone, from the collection of casters to shading. Ratios are median times divided by the median of
``shadow_map``. ``redrawn`` includes all costs of a moving light, ``kept`` the remaining costs while light and casters rest. With
`--cpu`, times are the CPU time of all threads, for machines with other load.

`stencil` compares the ways of counting shadow volumes, and the hybrids with the eye in shadow. A hybrid uses a small shadow map
where the map provably decides, and shadow volumes in the other pixels. Ratios are times divided by those of ``shadow_volume``.
``MiB`` is the peak memory of a pass. ``marked`` and ``tiles`` are the shares of the surface's pixels and 8 x 8 tiles that a hybrid
leaves to its volumes. ``differs`` is the share of pixels whose shadow differs from that of ``shadow_volume``. ``TARGETS`` lists the
targets.

`benchmarks/sweep_speed.py` measures the speed of the line sweep without OpenGL.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from benchmarks.benchmark_views import IN_SHADOW_VIEW, benchmark_view, make_plans, run_interleaved
from skugga.api.catalogue import find_level
from skugga.selector.measure.compare import measure_plan
from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.shadows.volumes.tiles import marked_tiles
from skugga.terrain.describe import describe
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

SPATIALACE_SIZE_PX = (800, 600)
SUN_STEP_DEG = 0.07
"""Degrees that the sun moves between redrawn frames."""

RIDGES_SIDE_M, RIDGES_CELL_M = 24_000, 20
"""Side of the generated mountains, and side of their cells."""
SUMMIT_XY_M = (-9692.0, -11_000.0)
"""A summit in the south-west of generated mountains, (x, y) in the level's frame. The view looks at their middle."""

HOUSE_DISTANCES_M = (60, 90, 130, 190, 280, 400, 600, 900, 1300, 2000, 3000)
"""Distances from the eye of groups of five houses, for shadow edges near and far."""

SUN_ANGLES_DEG = [(100.0, 10.0), (300.0, 15.0), (60.0, 12.0)]
"""Azimuths and altitudes of the suns over the cascades."""

THESIS_LEVELS = [f"thesis_{name}{sun}" for name in ("boxgrid", "rocks", "street", "room", "water_tower") for sun in ("", "_sun")]

COMPARED_VARIANTS: dict[str, dict[str, Any]] = {
    "shadow_map": {"algorithm": "shadow_map", "map_size": 1024, "cascades": 1},
    "shadow_map tight": {"algorithm": "shadow_map", "map_size": 1024, "cascades": 1, "fit": "tight"},
    "perspective_shadow_map": {"algorithm": "perspective_shadow_map", "map_size": 1024},
    "shadow_volume": {"algorithm": "shadow_volume"},
    "hybrid": {"algorithm": "hybrid"},
    "hybrid original": {"algorithm": "hybrid", "mask": "original"},
}
"""Names and overrides that take turns in the thesis's scenes."""

COUNTING_VARIANTS: dict[str, dict[str, Any]] = {
    "shadow_volume": {"algorithm": "shadow_volume"},
    "two passes": {"algorithm": "shadow_volume", "stencil": "two_pass"},
    "all z-fail": {"algorithm": "shadow_volume", "counting": "z_fail"},
    "hybrid": COMPARED_VARIANTS["hybrid"],
    "hybrid original": COMPARED_VARIANTS["hybrid original"],
}
"""Ways of counting shadow volumes, as overrides by name. The first draws both sides of faces at a time, with z-pass where it is
valid."""

STENCIL_VIEWS_BY_SCENE = {"boxgrid": ("main", IN_SHADOW_VIEW, "close"), "rocks": ("main",), "street": ("main",)}
"""Views for the ways of counting. (The box grids' close views have their eyes in the shadow, too.)"""

TARGETS = [
    ("rocks", "main", "perspective_shadow_map", "shadow_map", "at most", 1.15),
    ("rocks", "main", "perspective_shadow_map", "shadow_map tight", "at most", 1.15),
    ("street", "main", "shadow_volume", "perspective_shadow_map", "under", 1.0),
    ("boxgrid", "main", "shadow_volume", "two passes", "under", 1.0),
    ("boxgrid", IN_SHADOW_VIEW, "hybrid", "shadow_volume", "at most", 0.7),
    ("boxgrid", "close", "hybrid", "shadow_volume", "at most", 0.7),
]
"""Scene, view, the algorithm that should be fast, its reference, and the target ratio of their times."""

MAX_MARKED_SHARE = 0.25
"""The largest share of the box grids' pixels that the hybrid may leave to its volumes with the eye in the shadow."""

Row = dict[str, Any]
"""Figures of one algorithm in one view and mode, by column of the table or key of the JSON file."""


def measure_frames(repeats: int, map_size: int) -> list[Row]:
    """Measure frame times without shadows, with the shadow map redrawn for every frame, and with a cached map."""
    return list(measure_frames_by_map_size(repeats, (map_size,)).values())


def measure_frames_by_map_size(
    repeats: int, map_sizes: Sequence[int], clock: Callable[[], float] = time.perf_counter, **settings: Any
) -> dict[tuple[str, int], Row]:
    """Return the rows of ``measure_frames`` for several shadow map sizes that take turns.

    Keys are the mode and the map size. The mode is ``none`` (no shadows, with size 0), ``redrawn`` (the sun has moved) or ``kept``
    (the map is cached). ``clock`` times whole frames; the engine times its own passes. ``settings`` are overrides for every map.
    """
    scene = build_scene(load_level(find_level("spatialace")))
    view = scene.view("main", size=SPATIALACE_SIZE_PX)
    assert scene.sun is not None
    azimuth, altitude = scene.sun.azimuth_deg, scene.sun.altitude_deg

    def plan_under(lit_scene: Scene, algorithm: str, map_size: int) -> Plan:
        overrides = {"algorithm": algorithm, "map_size": map_size, "cascades": 1, **settings}
        return make_plan(describe(lit_scene, view, "main"), lit_scene.loaded.level, overrides)

    def scene_with_sun_number(number: int) -> Scene:
        return scene.with_sun(SunSpec(azimuth=azimuth + SUN_STEP_DEG * number, altitude=altitude))

    unshadowed_plan = plan_under(scene, "none", map_sizes[0])
    cached_plans = {size: plan_under(scene, "shadow_map", size) for size in map_sizes}

    def frames_of_turn(number: int) -> Iterator[tuple[tuple[str, int], Scene, Plan]]:
        yield ("none", 0), scene, unshadowed_plan
        for size_number, size in enumerate(map_sizes, start=1):
            moved_scene = scene_with_sun_number(number * len(map_sizes) + size_number)
            yield ("redrawn", size), moved_scene, plan_under(moved_scene, "shadow_map", size)
            yield ("kept", size), scene, cached_plans[size]

    times: dict[tuple[str, int], list[float]] = {}
    passes_ms: dict[tuple[str, int], dict[str, list[float]]] = {}
    frame_by_key: dict[tuple[str, int], Frame] = {}
    for number in range(repeats + 2):
        for key, frame_scene, plan in frames_of_turn(number):
            start = clock()
            frame_by_key[key] = render_frame(frame_scene, view, plan)
            if number >= 2:  # the first turns compile, allocate, and draw the map that is cached
                times.setdefault(key, []).append(clock() - start)
                for record in frame_by_key[key].passes:
                    passes_ms.setdefault(key, {}).setdefault(record.name, []).append(record.ms)
    rows = {}
    for key, milliseconds in times.items():
        passes = frame_by_key[key].passes
        rows[key] = {
            "row": key[0],
            "ratio": float(np.median(milliseconds) / np.median(times["none", 0])),
            "least_ms": 1000.0 * float(np.min(milliseconds)),
            "median_ms": 1000.0 * float(np.median(milliseconds)),
            "p95_ms": 1000.0 * float(np.quantile(milliseconds, 0.95)),
            "map_draws": sum(record.draws for record in passes if record.name.endswith("depth map")),
            "maps_kept": sum(record.kept for record in passes if record.name.endswith("depth map")),
            "pass_mib": max(record.bytes for record in passes) / 2**20,
            "passes_ms": {name: round(float(np.median(values)), 2) for name, values in passes_ms[key].items()},
            "least_passes_ms": {name: round(float(np.min(values)), 2) for name, values in passes_ms[key].items()},
        }
    return rows


def ridges_scene(folder: Path) -> Scene:
    """Return a scene of mountains of 24 x 24 km, seen from a summit over houses and more than 20 km of ground."""
    trimesh.creation.box(extents=(12.0, 9.0, 8.0)).export(folder / "house.obj")
    rng, eye = np.random.default_rng(1), np.array(SUMMIT_XY_M)
    forward = -eye / np.linalg.norm(eye)
    sideways = np.array([-forward[1], forward[0]])
    distance_m = np.repeat(HOUSE_DISTANCES_M, 5)
    forward_factor, sideways_factor = rng.uniform(1.0, 1.2, len(distance_m)), rng.uniform(-0.4, 0.4, len(distance_m))
    houses = eye + (distance_m * forward_factor)[:, None] * forward + (distance_m * sideways_factor)[:, None] * sideways
    level = {
        "version": 1,
        "terrain": {
            "generate": {"kind": "ridges", "size": [RIDGES_SIDE_M, RIDGES_SIDE_M], "cell": RIDGES_CELL_M, "relief": 1500, "seed": 3}
        },
        "meshes": [{"source": "house.obj", "at": houses.round(1).tolist(), "turn": 20}],
        "views": {
            "main": {
                "kind": "perspective",
                "eye": [*SUMMIT_XY_M, 25],
                "target": [0, 0, -100],
                "fov": 50,
                "size": list(SPATIALACE_SIZE_PX),
            }
        },
    }
    path = folder / "ridges.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


def measure_cascades() -> list[Row]:
    """Measure the errors of four cascades and of one map of the same memory."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        base_scene = ridges_scene(Path(folder))
        view = base_scene.view("main")
        for azimuth, altitude in SUN_ANGLES_DEG:
            scene = base_scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
            descriptor = describe(scene, view, "main")
            for count, size in ((1, 2048), (4, 1024)):
                overrides = {"algorithm": "shadow_map", "cascades": count, "map_size": size, "depth_bits": 24}
                plan = make_plan(descriptor, scene.loaded.level, overrides)
                figures = measure_plan(scene, view, plan).figures
                keys = ("edge_p95", "edge_mean", "wrong_cast", "false_shadow", "missed_shadow", "interior", "boundary")
                ends = [cascade.far_m for cascade in plan.settings["sun"]["relief"].cascades]  # type: ignore[union-attr]
                name = f"sun {azimuth:.0f}/{altitude:.0f}, {count} x {size}"
                texels = figures["counters"]["map_texels"]
                rows.append({"row": name, **{key: figures[key] for key in keys}, "map_texels": texels, "far_m": ends})
    return rows


def measure_thesis_scenes(args: argparse.Namespace) -> list[Row]:
    """Measure all algorithms in the main views of the thesis's scenes."""
    return [row for level in args.scenes or THESIS_LEVELS for row in _interleaved_rows(level, "main", COMPARED_VARIANTS, args)]


def measure_stencil(args: argparse.Namespace) -> list[Row]:
    """Measure the ways of counting shadow volumes in the stencil buffer."""
    levels = args.scenes or [level for level in THESIS_LEVELS if _scene_name(level) in STENCIL_VIEWS_BY_SCENE]
    shots = [(level, name) for level in levels for name in STENCIL_VIEWS_BY_SCENE.get(_scene_name(level), ("main",))]
    return [row for level, name in shots for row in _interleaved_rows(level, name, COUNTING_VARIANTS, args)]


def _scene_name(level: str) -> str:
    """Return the name of a thesis level's scene, without the prefix ``thesis_`` and the suffix ``_sun``."""
    return level.removeprefix("thesis_").removesuffix("_sun")


def _interleaved_rows(level: str, name: str, overrides_by_name: dict[str, dict[str, Any]], args: argparse.Namespace) -> list[Row]:
    """Return a row for each plan of the view ``name`` of a bundled level.

    Ratios are those of its times to the times of the first plan. Overrides change the level's ``shadows``.
    """
    timed_view = benchmark_view(level, name, args.size)
    plans = make_plans(timed_view, overrides_by_name)
    runs = {key: (timed_view, plan) for key, plan in plans.items()}
    measured_times = run_interleaved(runs, args.repeats, time.process_time if args.cpu else time.perf_counter)
    times, logs, shadow_masks = measured_times.times_ms, measured_times.logs, measured_times.shadow_masks
    first = [*plans][0]
    medians = {key: float(np.median(milliseconds)) for key, milliseconds in times.items()}
    valid, rows = timed_view.valid, []
    tiles = int(marked_tiles(*np.nonzero(valid), valid.shape).sum())
    for key in plans:
        records = logs[key].records.values()
        row: Row = {"scene": level.removeprefix("thesis_"), "view": name, "row": key}
        for mode in ("redrawn", "kept"):
            row |= {mode: medians[key, mode] / medians[first, mode], f"{mode}_ms": medians[key, mode]}
            row |= {f"{mode}_p95_ms": float(np.quantile(times[key, mode], 0.95))}
        row |= {"MiB": max(record.bytes for record in records) / 2**20}
        row |= {
            counter: sum(getattr(record, counter) for record in records)
            for counter in ("edges", "triangles", "draws", "map_texels")
        }
        row |= {"marked": sum(record.marked for record in records) / valid.sum()}
        row |= {"tiles": sum(record.tiles for record in records) / tiles}
        row |= {"differs": float((shadow_masks[key] != shadow_masks["shadow_volume"]).sum() / valid.sum())}
        rows.append({**row, "passes_ms": {record.name: round(record.ms, 1) for record in records}})
        print(level, name, key, f"{row['redrawn']:.2f}", f"{row['kept']:.2f}", flush=True)
    return rows


def evaluate_targets(rows: Sequence[Row]) -> list[Row]:
    """Evaluate the targets that have rows, and return a table row for each.

    The time ratio with a redrawn shadow map decides. The ratio with a cached map is only listed.
    """
    row_by_key = {(row["scene"], row["view"], row["row"]): row for row in rows if "differs" in row}
    result = []
    for scene, view, variant, reference, comparison, limit in TARGETS:
        for scene_name in (scene, f"{scene}_sun"):
            a, b = row_by_key.get((scene_name, view, variant)), row_by_key.get((scene_name, view, reference))
            if a is not None and b is not None:
                measured, cached_ratio = (a[mode] / b[mode] for mode in ("redrawn", "kept"))
                met = measured < limit if comparison == "under" else measured <= limit
                result.append(
                    _target_row(scene_name, view, f"{variant} / {reference}: {comparison} {limit}", measured, cached_ratio, met)
                )
    for (scene, view, key), row in row_by_key.items():
        if key == "hybrid" and view in (IN_SHADOW_VIEW, "close"):
            share = row["marked"]
            result.append(
                _target_row(scene, view, f"marked pixels: at most {MAX_MARKED_SHARE}", share, share, share <= MAX_MARKED_SHARE)
            )
    return result


def ratio_rows(rows: Sequence[Row]) -> list[Row]:
    """Return a table row for each view: the time ratio of each algorithm with a redrawn and with a cached map."""
    lines: dict[tuple[str, str], Row] = {}
    for row in rows:
        if "differs" in row:
            line = lines.setdefault((row["scene"], row["view"]), {"scene": row["scene"], "view": row["view"]})
            line[row["row"]] = f"{row['redrawn']:.2f} / {row['kept']:.2f}"
    return list(lines.values())


def _target_row(scene: str, view: str, target: str, measured: float, cached_ratio: float, is_met: bool) -> Row:
    """Return a row of the table of targets.

    ``measured`` and ``cached_ratio`` are time ratios with a redrawn and with a cached shadow map.
    """
    return {
        "scene": scene,
        "view": view,
        "target": target,
        "measured": measured,
        "kept": cached_ratio,
        "met": "yes" if is_met else "NO",
    }


MEASUREMENTS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "frames": lambda args: measure_frames(args.repeats, args.map_size),
    "cascades": lambda args: measure_cascades(),
    "thesis": measure_thesis_scenes,
    "stencil": measure_stencil,
}


def markdown_table(rows: list[Row]) -> str:
    """Return rows as a Markdown table of their numbers and strings. Other values are only in the JSON file."""
    keys = [key for key, value in rows[0].items() if isinstance(value, int | float | str)]
    lines = [keys, ["---"] * len(keys), *([_format_cell(row[key]) for key in keys] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _format_cell(value: float | str) -> str:
    """Format a cell of a table, floats with four significant digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _parse_size(text: str) -> tuple[int, int]:
    """Parse a picture size such as "1280x1024" to (width, height), pixels."""
    width, height = (int(side) for side in text.split("x"))
    return width, height


def main() -> None:
    """Run the measurement that the command line names, and print and write its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(MEASUREMENTS))
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--map-size", type=int, default=512, help="texels per side of the shadow map; for frames")
    parser.add_argument("--scenes", nargs="+", help="bundled levels; for thesis and stencil")
    parser.add_argument("--size", type=_parse_size, default=(1280, 1024), help="picture size; for thesis and stencil")
    parser.add_argument("--cpu", action="store_true", help="measure the CPU time of all threads; for thesis and stencil")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    rows = MEASUREMENTS[args.what](args)
    target_rows = evaluate_targets(rows)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    clock = "CPU time of all threads" if args.cpu else "wall clock"
    machine = f"{device().renderer}; peak memory {peak_mib:.0f} MiB; {clock}, {args.repeats} repeats"
    text = "\n".join(
        [f"{machine}\n", *(markdown_table(table_rows) for table_rows in (rows, ratio_rows(rows), target_rows) if table_rows)]
    )
    print(text, end="")
    if args.markdown:
        args.markdown.write_text(text, encoding="utf-8")
    if args.json:
        report = {"renderer": device().renderer, "peak_mib": peak_mib, "repeats": args.repeats, "cpu": args.cpu}
        report |= {"rows": rows, "targets": target_rows}
        args.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
