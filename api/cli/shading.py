"""``skugga compute``, ``shade`` and ``sunhours``: from requests to files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skugga.api.cli.outputs import check_targets
from skugga.api.cli.times import paths_by_time
from skugga.api.cli.warnings import say_own_sun, say_reach_beside, say_warnings, say_written
from skugga.api.compute import OnBlock, write_rasters
from skugga.api.products.visibility import VISIBILITY
from skugga.api.raster_file import RasterCells
from skugga.api.raster_view import Bounds, raster_view
from skugga.api.request import ProductRequest
from skugga.api.stac_item import read_stac_item
from skugga.terrain.compiling.ahead import MAPS_OF_CASTERS, MASKS, PICTURES, SUN_HOURS
from skugga.terrain.compiling.hooks import need
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.covered_nodes import is_bare
from skugga.terrain.level.level import load_level, spelt
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene

SUFFIXES = ".tif", ".tiff"


@dataclass(frozen=True)
class RasterPlace:
    """Which cells a raster has, as ``raster_view`` takes them; all ``None``: the level's own."""

    bounds: Bounds | None = None
    crs: str | None = None
    resolution: float | None = None
    like: Path | RasterCells | None = None


def write_product(
    level: LevelSource,
    output: Path,
    requests: Sequence[ProductRequest],
    place: RasterPlace,
    overrides: dict[str, Any],
    on_step: OnBlock | None = None,
    contours: tuple[Path, Sequence[float]] | None = None,
) -> None:
    """Write a product of a level by each of some requests, as rasters. Raises ``SkuggaError`` and ``OSError``."""
    product, suns = requests[0].record, [request.sun for request in requests]
    for name, value in overrides.items():
        if value is not None and product.when != "sun":
            said = spelt(value) if name == "algorithm" else value
            raise InputError(f"--{name.replace('_', '-')}", said, f"nothing: {product.name} has no shadows")
    paths = files_of(output, suns)
    others = [] if contours is None else [("--contours", contours[0])]
    like = place.like if isinstance(place.like, Path) else None
    check_targets(level, [*(("--output", path) for path in paths), *others], like)
    need(SUN_HOURS if product.when == "days" else MASKS if product.needs == VISIBILITY else PICTURES)
    scene = build_scene(load_level(level))
    if not is_bare(scene) and product.when != "days":
        need(MAPS_OF_CASTERS)
    say_warnings(scene)
    try:
        raster = raster_view(scene, place.bounds, place.crs, place.resolution, place.like)
        if place.like is not None:
            say_reach_beside(scene, raster)
        if product.when == "sun" and None in suns:
            say_own_sun(scene)
        write_rasters(scene, raster, requests, paths, overrides, on_step, contours)
        about, unit = product.about_of(requests[0].options)
        say_written(paths, f"{product.name}, {about}" + (f" ({unit})" if len(unit) > 1 or unit.isalpha() else ""), raster)
    finally:
        scene.close()


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
