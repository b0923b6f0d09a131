"""Accuracy of map views on real rasters: error against truth, per raster and sun, at azimuths off the 45-degree axes.

    python -m benchmarks.map_accuracy FOLDER [--algorithm shadow_map] [--map-size 4096] [--filter 1] [--pixels 400]
                                      [--markdown FILE]

Every terrain or surface raster below FOLDER is drawn at its own resolution (at most ``--pixels`` a side, from its middle). Rasters
are sorted by the 95th percentile of their slope, steepest first. Truth is ray-traced on the triangles that are drawn.
The stored table is docs/reports/shadow-map-accuracy.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from benchmarks.report_pages import format_provenance, measured_here
from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.truth.metrics import error_metrics
from skugga.shadows.truth.truth import trace_truth
from skugga.shadows.visibility import fill_steps
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.errors import SkuggaError
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.gl.device import device
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

SUN_ANGLES_DEG = [(202.0, 60.0), (113.0, 30.0), (67.0, 10.0), (293.0, 3.0)]
"""Azimuths and altitudes of the sun."""


def raster_scene(raster: Path, folder: Path) -> Scene:
    """Return the scene of a raster file. Its level file is written into ``folder``."""
    path = folder / "level.yaml"
    path.write_text(json.dumps({"version": 1, "terrain": {"source": str(raster.resolve())}}), encoding="utf-8")
    return build_scene(load_level(path))


def measure(scene: Scene, max_side_px: int, algorithm: AlgorithmName, map_size: int, taps: int) -> list[dict]:
    """Return the errors of an algorithm against ray-traced truth in the middle of a raster, a row for each sun.

    ``max_side_px`` limits the side of the picture, which has one pixel per cell. ``map_size`` is the number of texels a side of
    shadow maps, and ``taps`` that of filter taps a side. Rows have the shadow's share of the valid pixels and the fields of
    ``error_metrics``. Suns under which the algorithm has no step in the plan are omitted.
    """
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    unit_m = 111_320.0 if scene.map_crs.is_geographic else scene.world.metres_per_unit
    side = min(max_side_px, max(scene.elevation.shape))
    x, y = scene.view(size=(8, 8)).centre
    half = side * cell_m / unit_m / 2
    rows = []
    for azimuth, altitude in SUN_ANGLES_DEG:
        lit = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        south, north = (np.clip(v, -90, 90) if lit.map_crs.is_geographic else v for v in (y - half, y + half))
        view = lit.view(bounds=(x - half, south, x + half, north), size=(side, side))
        frame = lit.world.frame_near(view.grid.crs, *view.centre)
        buffer = map_geometry(lit.surface(view.grid), view, frame)
        casters = find_casters(lit, buffer)
        truth = trace_truth(buffer, lit, casters)
        descriptor = describe(lit, view)
        plan = make_plan(descriptor, lit.loaded.level, {"algorithm": algorithm, "map_size": map_size, "filter": taps})
        step = next((step for step in plan.steps if step.algorithm == algorithm), None)
        if step is None:
            continue
        visibility = fill_steps([step], buffer, lit, casters, plan.effect_names, PassLog())
        visibility[attached_shadow_mask(buffer, lit)] = 0.0
        metrics = error_metrics(visibility, truth, descriptor.pixel_m, texel_footprint_px(lit, step, buffer, descriptor.pixel_m))
        shadow_share = float((~truth.lit & truth.valid).sum() / max(truth.valid.sum(), 1))
        rows.append({"azimuth": azimuth, "altitude": altitude, "shadow": shadow_share, **asdict(metrics)})
    return rows


def slope_p95_deg(scene: Scene) -> float:
    """Return the 95th percentile of the slope in a scene's overview, degrees; 0 if it has a single row or column."""
    heights, cell = scene.elevation.overview.mean_heights_m, scene.elevation.cell_size_m(scene.world.metres_per_unit)
    if min(heights.shape) < 2:
        return 0.0
    gradient = np.hypot(*np.gradient(heights, cell * 2**scene.elevation.overview.lod))
    return float(np.degrees(np.arctan(np.nanquantile(gradient, 0.95))))


def main() -> None:
    """Measure all rasters of a folder, and print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--algorithm", choices=("shadow_map", "sweep"), default="shadow_map")
    parser.add_argument("--map-size", type=int, default=4096)
    parser.add_argument("--filter", type=int, default=1)
    parser.add_argument("--pixels", type=int, default=400)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scenes = []
        for raster in sorted(args.folder.rglob("*.tif")):
            try:
                scene = raster_scene(raster, Path(folder))
            except SkuggaError as error:
                print(f"skipped: {error}")
                continue
            scenes.append((slope_p95_deg(scene), raster, scene))
        scenes.sort(key=lambda item: -item[0])
        maps = f", map {args.map_size}, {args.filter} tap(s) a side" if args.algorithm == "shadow_map" else ""
        lines = [
            f"# Report: `{args.algorithm}` against truth, {args.pixels} pixels{maps}",
            "",
            format_provenance(
                replace(measured_here("python -m benchmarks.map_accuracy FOLDER --markdown FILE"), device=device().renderer)
            ),
            "",
            "Shares in per cent, edges in pixels ([metrics](../accuracy.md#metrics)).",
            "",
            "| raster | slope p95 | azimuth / altitude | shadow | `wrong` | `wrong_cast` | false | missed | `edge_p95` | "
            "`interior` | boundary |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        print(lines[-2])
        for slope, raster, scene in scenes:
            for row in measure(scene, args.pixels, args.algorithm, args.map_size, args.filter):
                shares = (100 * row[key] for key in ("shadow", "wrong", "wrong_cast", "false_shadow", "missed_shadow"))
                lines.append(
                    f"| {raster.parent.name}/{raster.stem} | {slope:.0f}° | {row['azimuth']:.0f} / {row['altitude']:.0f} | "
                    + " | ".join(f"{share:.3f}" for share in shares)
                    + f" | {row['edge_p95']:.2f} | {100 * row['interior']:.4f} | {100 * row['boundary']:.1f} |"
                )
                print(lines[-1], flush=True)
    if args.markdown:
        args.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
