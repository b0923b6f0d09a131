"""``skugga shade``: from its options to files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from skugga.api.cli.outputs import check_targets
from skugga.api.cli.times import paths_by_time
from skugga.api.cli.warnings import say_own_sun, say_reach_beside, say_warnings, say_written
from skugga.api.raster_file import RasterCells
from skugga.api.shade import Bounds, raster_view, write_shade
from skugga.api.shade_layers import SHADE_LAYERS
from skugga.api.stac_item import read_stac_item
from skugga.terrain.compiling.ahead import MAPS_OF_CASTERS, MASKS, PICTURES
from skugga.terrain.compiling.hooks import need
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.covered_nodes import is_bare
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene

SUFFIXES = ".tif", ".tiff"


def shade_level(
    level: LevelSource,
    output: Path,
    layer: str,
    suns: Sequence[SunSpec | None],
    bounds: Bounds | None,
    crs: str | None,
    resolution: float | None,
    like: Path | RasterCells | None,
    overrides: dict[str, Any],
    on_block: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write a level's shade under some suns; the files. Raises ``SkuggaError`` and ``OSError``."""
    if layer not in SHADE_LAYERS:
        raise InputError("--layer", layer, ", ".join(SHADE_LAYERS))
    paths = files_of(output, suns)
    check_targets(level, [("--output", path) for path in paths], like if isinstance(like, Path) else None)
    need(MASKS if layer == "mask" else PICTURES)
    loaded = load_level(level)
    scene = build_scene(loaded)
    if not is_bare(scene):
        need(MAPS_OF_CASTERS)
    say_warnings(scene)
    try:
        raster = raster_view(scene, bounds, crs, resolution, like)
        if like is not None:
            say_reach_beside(scene, raster)
        if None in suns:
            say_own_sun(scene)
        write_shade(scene, raster, layer, suns, paths, overrides, on_block)
        say_written(paths, f"{layer}, {SHADE_LAYERS[layer].about}", raster)
    finally:
        scene.close()
    return paths


def scene_of_item(
    stac: Path, suns: Sequence[SunSpec | None], like: Path | None, free: bool
) -> tuple[Sequence[SunSpec | None], Path | RasterCells | None]:
    """The sun and the cells of a STAC item's scene; ``like``, and what else says which cells (not ``free``), go before its own.

    Raises ``InputError`` where other options say when, too.
    """
    item = read_stac_item(stac)
    if any(sun is not None for sun in suns):
        raise InputError(
            "--stac", str(stac), "one way to say when: without --time, --times, --from or --azimuth, for the item says it"
        )
    return [item.sun], item.cells if free and like is None else like


def files_of(output: Path, suns: Sequence[SunSpec | None]) -> list[Path]:
    """A file for each sun. Raises ``InputError``, and ``FileNotFoundError`` where there is no folder."""
    if output.suffix.lower() not in SUFFIXES:
        raise InputError("--output", str(output), f"a GeoTIFF: {' or '.join(SUFFIXES)}")
    if not output.parent.is_dir():
        raise FileNotFoundError(2, "folder not found", str(output))
    return paths_by_time(output, suns)
