"""``skugga init``: the level file that says what a raster is by itself, with comments on all else that may be said."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from skugga.api.cli.outputs import check_targets
from skugga.api.cli.warnings import say_warnings
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import METRES_PER_UNIT, PerspectiveSpec, SunSpec
from skugga.terrain.level.rasters import is_level_raster
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.viewpoint import good_view
from skugga.terrain.whole_files import write_whole

FIRST_VIEW = "view"
"""Name of the perspective view that is proposed."""


def write_first_level(source: LevelSource, output: Path | None, force: bool) -> Path:
    """Write a raster's level file, by default ``NAME.yaml`` here; its path.

    Raises ``InputError`` for a level that is no raster, and for a file that is there already unless ``force`` is given; else as
    ``build_scene``, and ``OSError``.
    """
    loaded = load_level(source)
    if not is_level_raster(source.path):
        raise InputError("LEVEL", str(source.path), "a raster of heights: this is a level file already")
    path = Path(f"{source.path.stem}.yaml") if output is None else output
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError("--output", str(path), "a level file: .yaml or .yml")
    if path.exists() and not force:
        raise InputError("--output", str(path), "a file that is not there yet; --force writes over one")
    check_targets(source, [("--output", path)])
    scene = build_scene(loaded)
    try:
        say_warnings(scene, with_objects=False)
        view = good_view(scene.world, scene.elevation, scene.sun)
        write_whole(path, level_text(scene, source, view, path.resolve().parent))
    finally:
        scene.close()
    return path


def level_text(scene: Scene, source: LevelSource, view: PerspectiveSpec | None, folder: Path) -> str:
    """The level file of a raster's scene, to lie in a folder.

    Lines that begin with "#" and one blank are comments; the other lines that begin with "#" are parts of a level, left out.
    """
    sun, low_m, unit = scene.loaded.level.sun, scene.height_range_m[0], scene.elevation.vertical.unit
    assert isinstance(sun, SunSpec)
    at = "0, 0" if scene.world.flat else f"{scene.world.anchor_lon_deg:.6f}, {scene.world.anchor_lat_deg:.6f}"
    positions = "metres east and north of the middle" if scene.world.flat else "longitude, latitude"
    nodata = f"  nodata: {source.nodata!r}" if source.nodata is not None else "#  nodata: 0"
    views = ["  map: {kind: map}"]
    if view is not None:
        eye, target = (", ".join(f"{value:.10g}" for value in place) for place in (view.eye, view.target))
        views += [
            f"  # Positions: {positions}, metres above the ground.",
            f"  {FIRST_VIEW}: {{kind: perspective, eye: [{eye}], target: [{target}], fov: {view.fov:g}}}",
        ]
    forest = [f"  - source: {_file(folder, source.canopy)}"] if source.canopy else None
    meshes = [f"  - source: {_file(folder, source.buildings)}"] if source.buildings else None
    return "\n".join(
        [
            "# A level of Skugga. `skugga validate` checks it, `skugga serve` shows it. A line that has no blank behind its # or",
            "# more than one is a part of the level that is left out: take the # away to have it.",
            "version: 1",
            f"title: {_quoted(source.path.stem)}",
            '#attribution: "Whose data these are"',
            "",
            "terrain:",
            f"  source: {_file(folder, source.path)}",
            "# Cells of this value have no height, besides those that the file declares empty.",
            nodata,
            f"# Of heights, where the file does not say: {', '.join(METRES_PER_UNIT)}. Depths are positive down.",
            f"{'  ' if source.units else '#  '}units: {unit if unit in METRES_PER_UNIT else 'm'}",
            f"{'  ' if source.positive else '#  '}positive: {scene.elevation.vertical.positive}",
            "# Heights are multiplied by this.",
            "#  exaggeration: 1",
            "# A picture of the ground, as an RGB raster.",
            "#  imagery: ortho.tif",
            "",
            "# An afternoon's sun of this place, low enough that its slopes throw shadows (at the equinox; beyond 60 degrees of",
            "# latitude at midsummer). Degrees: azimuth clockwise from north, altitude above the horizon. Or a moment, as",
            '# sun: {time: "2024-10-21T16:30:00+02:00"}',
            f"sun: {{azimuth: {sun.azimuth:g}, altitude: {sun.altitude:g}}}",
            "",
            "views:",
            *views,
            "",
            "# Whatever ground lies lower than this (metres) is under water.",
            f"#water: {{level: {low_m:.1f}}}",
            "",
            "# Trees: a raster of canopy heights, points (one a tree), or polygons with a density (trees a hectare).",
            *_part("forest", forest, ["  - source: woods.geojson", "    density: 300", "    height: [9, 22]"]),
            "",
            "# Buildings: footprints with a height in metres, or the name of an attribute that has it; models: OBJ, PLY or glTF.",
            *_part("meshes", meshes, ["  - source: houses.geojson", "    height: height_m"]),
            "",
            f"# Lamps. Positions: {positions}, metres above the ground.",
            "#lights:",
            f"#  lamp: {{kind: omni, position: [{at}, 10]}}",
            "",
            "# Visibility in metres, the share of the sky behind clouds, whether snow lies.",
            "#weather: {visibility: 40000, cloud_cover: 0.3, snow: false}",
            "",
            "# How shadows are made. Left to itself, Skugga chooses, and `skugga select` says why.",
            "#shadows: {algorithm: auto, max_error: 0.03}",
            "",
        ]
    )


def _part(name: str, stated: list[str] | None, example: list[str]) -> list[str]:
    """A part of the level, or an example of it that is left out."""
    return [f"{name}:", *stated] if stated else [f"#{name}:", *(f"#{line}" for line in example)]


def _file(folder: Path, file: Path) -> str:
    """A file's path as a level file in a folder states it: from there if it lies below, else whole."""
    whole = file.resolve()
    return _quoted(os.fspath(whole.relative_to(folder) if whole.is_relative_to(folder) else whole))


def _quoted(text: str) -> Any:
    return json.dumps(text, ensure_ascii=False)
