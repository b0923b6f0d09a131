"""``skugga init``: write a level file with the defaults of a raster, and with comments on further keys."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.warnings import print_warnings
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import METRES_PER_UNIT, PerspectiveSpec, SunSpec
from skugga.terrain.level.rasters import is_level_raster
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.viewpoint import find_viewpoint

FIRST_VIEW_NAME = "view"
"""Name of the suggested perspective view."""


def write_first_level(source: LevelSource, output: Path | None, force: bool) -> Path:
    """Write the level file of a raster and return the file's path.

    The default path is ``NAME.yaml`` in the current folder. Raises ``InputError`` if the level is not a raster, or if the file
    exists and ``force`` is false. Raises ``OSError``, and the errors of ``build_scene``.
    """
    loaded = load_level(source)
    if not is_level_raster(source.path):
        raise InputError("LEVEL", str(source.path), "a raster of heights; this is already a level file")
    path = Path(f"{source.path.stem}.yaml") if output is None else output
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError("--output", str(path), "a file name that ends in .yaml or .yml")
    if path.exists() and not force:
        raise InputError("--output", Problem(f"{path} exists"), "Use --force to overwrite it")
    check_output_files(source, [("--output", path)])
    scene = build_scene(loaded)
    try:
        print_warnings(scene, includes_objects=False)
        view = find_viewpoint(scene.world, scene.elevation, scene.sun)
        write_atomically(path, level_text(scene, source, view, path.resolve().parent))
    finally:
        scene.close()
    return path


def level_text(scene: Scene, source: LevelSource, view: PerspectiveSpec | None, folder: Path) -> str:
    """Return the text of a level file for a raster's scene. Paths in it are relative to ``folder``.

    Lines that begin with "#" and exactly one space are comments. Other lines that begin with "#" are optional keys.
    """
    sun, low_m, unit = scene.loaded.level.sun, scene.height_range_m[0], scene.elevation.vertical.unit
    assert isinstance(sun, SunSpec)
    example_position = "0, 0" if scene.world.is_flat else f"{scene.world.anchor_lon_deg:.6f}, {scene.world.anchor_lat_deg:.6f}"
    positions = "metres east and north of the centre" if scene.world.is_flat else "longitude, latitude"
    nodata = f"  nodata: {source.nodata!r}" if source.nodata is not None else "#  nodata: 0"
    views = ["  map: {kind: map}"]
    if view is not None:
        eye, target = (", ".join(f"{value:.10g}" for value in place) for place in (view.eye, view.target))
        views += [
            f"  # Positions: {positions}, metres above the ground.",
            f"  {FIRST_VIEW_NAME}: {{kind: perspective, eye: [{eye}], target: [{target}], fov: {view.fov:g}}}",
        ]
    forest = [f"  - source: {_quoted_path(folder, source.canopy)}"] if source.canopy else None
    meshes = [f"  - source: {_quoted_path(folder, source.buildings)}"] if source.buildings else None
    return "\n".join(
        [
            "# A level of Skugga. `skugga validate` checks it, `skugga serve` shows it. Lines with # and exactly one space are",
            "# comments. All other lines with # are optional keys of the level: remove the # to use them.",
            "version: 1",
            f"title: {_quoted(source.path.stem)}",
            '#attribution: "Whose data these are"',
            "",
            "terrain:",
            f"  source: {_quoted_path(folder, source.path)}",
            "# Cells of this value have no height, in addition to the nodata cells of the file.",
            nodata,
            f"# Unit of heights if the file states none: {', '.join(METRES_PER_UNIT)}. Depths are positive down.",
            f"{'  ' if source.units else '#  '}units: {unit if unit in METRES_PER_UNIT else 'm'}",
            f"{'  ' if source.positive else '#  '}positive: {scene.elevation.vertical.positive}",
            "# Factor of heights.",
            "#  exaggeration: 1",
            "# Colour of the ground: an RGB raster.",
            "#  imagery: ortho.tif",
            "",
            "# An afternoon sun of this place, low enough for its slopes to cast shadows (at the equinox; beyond 60 degrees of",
            "# latitude at midsummer). Degrees: azimuth clockwise from north, altitude above the horizon. Or a time, such as",
            '# sun: {time: "2024-10-21T16:30:00+02:00"}',
            f"sun: {{azimuth: {sun.azimuth:g}, altitude: {sun.altitude:g}}}",
            "",
            "views:",
            *views,
            "",
            "# Ground below this height (metres) is under water.",
            f"#water: {{level: {low_m:.1f}}}",
            "",
            "# Trees: a raster of canopy heights, points (one per tree), or polygons with a density (trees per hectare).",
            *_key_lines("forest", forest, ["  - source: woods.geojson", "    density: 300", "    height: [9, 22]"]),
            "",
            "# Buildings: footprints with a height in metres or the name of a height attribute; or models: OBJ, PLY or glTF.",
            *_key_lines("meshes", meshes, ["  - source: houses.geojson", "    height: height_m"]),
            "",
            f"# Lamps. Positions: {positions}, metres above the ground.",
            "#lights:",
            f"#  lamp: {{kind: omni, position: [{example_position}, 10]}}",
            "",
            "# Visibility in metres, share of the sky under clouds (0 to 1), and whether snow lies.",
            "#weather: {visibility: 40000, cloud_cover: 0.3, snow: false}",
            "",
            "# Shadow algorithm and target. By default Skugga chooses; `skugga select` gives the reasons.",
            "#shadows: {algorithm: auto, max_error: 0.03}",
            "",
        ]
    )


def _key_lines(name: str, lines: list[str] | None, example_lines: list[str]) -> list[str]:
    """Return the lines of the key ``name`` of the level file.

    Without ``lines``, return ``example_lines`` as a commented example.
    """
    return [f"{name}:", *lines] if lines else [f"#{name}:", *(f"#{line}" for line in example_lines)]


def _quoted_path(folder: Path, file: Path) -> str:
    """Return the quoted path of a file for a level file: relative if the file lies in the folder, else absolute."""
    absolute = file.resolve()
    return _quoted(os.fspath(absolute.relative_to(folder) if absolute.is_relative_to(folder) else absolute))


def _quoted(text: str) -> Any:
    """Return a text in double quotes, which YAML reads as the same text."""
    return json.dumps(text, ensure_ascii=False)
