"""Accuracy of `shadow_map` on real rasters: error against truth, per raster and sun, at azimuths off the 45-degree axes.

    python benchmarks/shadow_map_accuracy.py FOLDER [--map-size 4096] [--filter 1] [--pixels 512] [--json FILE]

Every raster below FOLDER that is a terrain or a surface is drawn at its own resolution (at most ``--pixels`` a side, from its
middle), steepest first by the 95th percentile of slope.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from selector.compare import texel_footprint_px
from selector.rules import choose
from shadows import shadow_map
from shadows.attached import attached
from shadows.metrics import errors_of
from shadows.passes import PassLog
from shadows.truth import truth_of
from terrain.descriptor import describe
from terrain.errors import SkuggaError
from terrain.geometry import map_geometry
from terrain.level import SunSpec, load_level
from terrain.reach import casters_of
from terrain.scene import Scene, build_scene

SUNS = [(202.0, 60.0), (113.0, 30.0), (67.0, 10.0), (293.0, 3.0)]


def scene_of(raster: Path, folder: Path) -> Scene:
    path = folder / "level.yaml"
    path.write_text(json.dumps({"version": 1, "terrain": {"source": str(raster.resolve())}}), encoding="utf-8")
    return build_scene(load_level(path))


def measure(scene: Scene, pixels: int, map_size: int, taps: int) -> list[dict]:
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    unit_m = 111_320.0 if scene.map_crs.is_geographic else scene.world.metres_per_unit
    side = min(pixels, max(scene.elevation.shape))
    x, y = scene.view(size=(8, 8)).centre
    half = side * cell_m / unit_m / 2
    rows = []
    for azimuth, altitude in SUNS:
        lit = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        view = lit.view(bounds=(x - half, y - half, x + half, y + half), size=(side, side))
        frame = lit.world.frame_near(view.grid.crs, *view.centre)
        buffer = map_geometry(lit.surface(view.grid), view, frame)
        casters = casters_of(lit, buffer)
        truth = truth_of(buffer, lit, casters)
        descriptor = describe(lit, view)
        plan = choose(descriptor, lit.loaded.level, {"algorithm": "shadow_map", "map_size": map_size, "filter": taps})
        settings = plan.settings.get("sun", {}).get("relief")
        if settings is None:
            continue
        visibility = shadow_map.fill(buffer, lit, casters, settings, PassLog())
        visibility[attached(buffer, lit)] = 0.0
        found = errors_of(visibility, truth, descriptor.pixel_m, texel_footprint_px(lit, settings, descriptor.pixel_m))
        shadowed = float((~truth.lit & truth.there).sum() / max(truth.there.sum(), 1))
        rows.append({"azimuth": azimuth, "altitude": altitude, "shadow": shadowed, **asdict(found)})
    return rows


def slope_p95_deg(scene: Scene) -> float:
    heights, cell = scene.elevation.overview.heights_m, scene.elevation.cell_size_m(scene.world.metres_per_unit)
    if min(heights.shape) < 2:
        return 0.0
    gradient = np.hypot(*np.gradient(heights, cell * 2**scene.elevation.overview.level))
    return float(np.degrees(np.arctan(np.nanquantile(gradient, 0.95))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--map-size", type=int, default=4096)
    parser.add_argument("--filter", type=int, default=1)
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scenes = []
        for raster in sorted(given.folder.rglob("*.tif")):
            try:
                scene = scene_of(raster, Path(folder))
            except SkuggaError as error:
                print(f"left out: {error}")
                continue
            scenes.append((slope_p95_deg(scene), raster, scene))
        scenes.sort(key=lambda item: -item[0])
        said = []
        print(f"{'raster':40s} slope  azimuth altitude shadow% wrong_cast% false% missed% edge_p95 interior% parts boundary%")
        for slope, raster, scene in scenes:
            for row in measure(scene, given.pixels, given.map_size, given.filter):
                said.append({"raster": raster.name, "slope_p95_deg": slope, **row})
                print(
                    f"{raster.stem[:39]:40s} {slope:5.1f}  {row['azimuth']:7.0f} {row['altitude']:8.0f} {100 * row['shadow']:7.2f} "
                    f"{100 * row['wrong_cast']:11.2f} {100 * row['false_shadow']:6.3f} {100 * row['missed_shadow']:7.3f} "
                    f"{row['edge_p95']:8.2f} {100 * row['interior']:9.4f} {row['interior_parts']:5d} {100 * row['boundary']:9.2f}",
                    flush=True,
                )
    if given.json:
        given.json.write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
