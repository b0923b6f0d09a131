"""``skugga compute``, ``shade`` and ``sunhours``: write requested products as raster files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.times import paths_by_time
from skugga.api.cli.warnings import (
    print_default_sun,
    print_extent_warning,
    print_product_warnings,
    print_warnings,
    print_written_files,
)
from skugga.api.compute import ProgressCallback, write_rasters
from skugga.api.products.visibility import NEEDS_VISIBILITY
from skugga.api.raster_file import RasterCells
from skugga.api.raster_view import Bounds, raster_view
from skugga.api.request import ProductRequest
from skugga.api.stac_item import read_stac_item
from skugga.terrain.compiling.ahead_of_time import MAPS_OF_CASTERS, MASKS, PICTURES, SUN_HOURS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.level.level import load_level, override_text
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene

GEOTIFF_SUFFIXES = ".tif", ".tiff"


@dataclass(frozen=True)
class OutputGrid:
    """Extent and cell grid of an output raster, as arguments of ``raster_view``. All ``None``: the level's own grid.

    Attributes
    ----------
    bounds
        West, south, east, north in units of ``crs``.
    crs
        Output CRS.
    resolution
        Side of a cell, units of ``crs``.
    like
        Raster file, or cell grid of a raster, to use instead.
    """

    bounds: Bounds | None = None
    crs: str | None = None
    resolution: float | None = None
    like: Path | RasterCells | None = None


def write_product(
    level: LevelSource,
    output: Path,
    requests: Sequence[ProductRequest],
    output_grid: OutputGrid,
    overrides: dict[str, Any],
    on_step: ProgressCallback | None = None,
    contours: tuple[Path, Sequence[float]] | None = None,
) -> None:
    """Write one raster of a product for each request. Raises ``SkuggaError`` and ``OSError``.

    ``output`` is the path of the raster; with several suns ``{time}`` in its name is replaced. ``overrides`` replace settings
    of the level's ``shadows``. ``on_step(done, total)`` is called after each step. ``contours`` is the file of contours of
    the first raster, and their values.
    """
    product, suns = requests[0].product_record, [request.sun for request in requests]
    for name, value in overrides.items():
        if value is not None and product.when != "sun":
            value_text = override_text(value) if name == "algorithm" else value
            reason = f"'{value_text}' does not apply to {product.name}, which has no shadows"
            raise InputError(f"--{name.replace('_', '-')}", Problem(reason), "Leave it out")
    paths = output_paths(output, suns)
    contour_targets = [] if contours is None else [("--contours", contours[0])]
    like = output_grid.like if isinstance(output_grid.like, Path) else None
    check_output_files(level, [*(("--output", path) for path in paths), *contour_targets], like)
    declare_product(SUN_HOURS if product.when == "days" else MASKS if product.needs == NEEDS_VISIBILITY else PICTURES)
    scene = build_scene(load_level(level))
    if not is_terrain_only(scene) and product.when != "days":
        declare_product(MAPS_OF_CASTERS)
    print_warnings(scene)
    try:
        raster = raster_view(scene, output_grid.bounds, output_grid.crs, output_grid.resolution, output_grid.like)
        if output_grid.like is not None:
            print_extent_warning(scene, raster)
        if product.when == "sun" and None in suns:
            print_default_sun(scene)
        print_product_warnings(product.warnings(requests[0].options, scene))
        write_rasters(scene, raster, requests, paths, overrides, on_step, contours)
        description, unit = product.description_and_unit(requests[0].options)
        print_written_files(
            paths, f"{product.name}, {description}" + (f" ({unit})" if len(unit) > 1 or unit.isalpha() else ""), raster
        )
    finally:
        scene.close()


def sun_and_grid_of_stac_item(
    stac: Path, suns: Sequence[SunSpec | None], like: Path | None, uses_item_grid: bool
) -> tuple[Sequence[SunSpec | None], Path | RasterCells | None]:
    """Return the sun of a STAC item, as a sequence of one, and the grid of the output (``None`` for the level's own).

    ``suns`` are the suns of other options. ``like`` takes precedence over the item's grid. ``uses_item_grid`` is false if other
    options set the grid. Raises ``InputError`` if other options set the sun too.
    """
    item = read_stac_item(stac)
    if any(sun is not None for sun in suns):
        raise InputError.conflict(
            "--stac", "--time, --times, --from or --azimuth", "Use one of them: the item sets the time or the sun"
        )
    return [item.sun], item.cells if uses_item_grid and like is None else like


def output_paths(output: Path, suns: Sequence[SunSpec | None]) -> list[Path]:
    """Return the output path for each sun. Raises ``InputError``, and ``FileNotFoundError`` if the folder does not exist."""
    if output.suffix.lower() not in GEOTIFF_SUFFIXES:
        raise InputError("--output", str(output), f"a GeoTIFF: {' or '.join(GEOTIFF_SUFFIXES)}")
    if not output.parent.is_dir():
        raise FileNotFoundError(2, "folder not found", str(output))
    return paths_by_time(output, suns)
