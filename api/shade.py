"""Shading of whole rasters: a map of any size, block by block, on a raster's own grid or another one, under many suns in one run.

Memory is bounded by the block: far casters come from overviews, by the one rule that tiles follow (``terrain.casters.reach``).
What does not depend on the sun (heights, normals) is read once for a block and serves all suns.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from affine import Affine
from pyproj import CRS
from rasterio.errors import RasterioError

from api.device_calibration import calibration_for
from api.raster_file import RasterCells, RasterFile, RasterNotes, cog
from api.shade_layers import SHADE_LAYERS
from selector.select import plan_of_view
from terrain.errors import MISSING_VALUE, InputError, SourceError
from terrain.gbuffer.bare_ground import forget_ground_before
from terrain.geo.grid import Grid, MapView, blocks_of, step_at_anchor_m
from terrain.level.level import spelt
from terrain.level.parts import SunSpec
from terrain.level.rasters import open_raster
from terrain.scene import Scene

Bounds = tuple[float, float, float, float]

SQUARE = 1e-6
"""How far a raster's cells may be from square, as a share."""

MAX_RESOLUTION = 1e8
"""Units of a CRS: in metres, more than twice round the earth."""

MOST_CELLS = 2.0**40
"""Of a raster that is written."""


def raster_view(
    scene: Scene,
    bounds: Bounds | None = None,
    crs: str | None = None,
    resolution: float | None = None,
    like: Path | RasterCells | None = None,
) -> MapView:
    """The cells of a raster of shade, each a node of its grid: those of the level's own raster, or of one that it shall be like;
    else square ones of a ``resolution`` (default: the raster's) whose sides lie on multiples of it. Raises ``InputError``.
    """
    if like is not None:
        for name, value in (("bounds", bounds), ("crs", crs), ("resolution", resolution)):
            if value is not None:
                raise InputError(name, value, f"nothing beside like: the cells are those of {like}")
        return _like(cells_of_raster(like) if isinstance(like, Path) else like)
    asked = scene.view("map", bounds, crs)  # checks what was asked
    target = asked.grid.crs if isinstance(asked, MapView) else scene.map_crs
    nothing_asked = crs is None and bounds is None
    if resolution is None and scene.elevation.upright and (nothing_asked or target == scene.elevation.crs):
        own = _own(scene)
        return own if bounds is None else _within(own, bounds)
    west, south, east, north = bounds or scene.default_bounds(target)
    if resolution is None:
        cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
        resolution = float(f"{cell_m / step_at_anchor_m(scene.world, Grid(target, 0.0, 0.0, 1.0)):.3g}")
    if not 0.0 < resolution <= MAX_RESOLUTION or (east - west) / resolution * (north - south) / resolution > MOST_CELLS:
        raise InputError(
            "resolution",
            resolution,
            f"more than 0 units of {target.name}, at most {MAX_RESOLUTION:g}, and fewer than 2^40 cells in all",
        )
    col0, row0 = np.floor(west / resolution + 1e-9), np.floor(-north / resolution + 1e-9)
    cols, rows = np.ceil(east / resolution - 1e-9) - col0, np.ceil(-south / resolution - 1e-9) - row0
    grid = Grid(target, resolution / 2.0, -resolution / 2.0, resolution)
    return MapView(grid, float(row0), float(col0), 1.0, 1.0, int(rows), int(cols))


def _own(scene: Scene) -> MapView:
    elevation = scene.elevation
    (x0, x1), (y0, y1) = elevation.xy(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    return _lattice(elevation.crs, float(x0), float(y0), float(x1 - x0), float(y0 - y1), elevation.rows, elevation.cols)


def cells_of_raster(path: Path) -> RasterCells:
    """The cells of a raster file. Raises ``SourceError``."""
    try:
        with warnings.catch_warnings(action="ignore"), open_raster(str(path)) as dataset:
            crs, transform, (rows, cols) = dataset.crs, dataset.transform, dataset.shape
    except RasterioError:
        raise SourceError(str(path), "it cannot be opened", "a raster that GDAL reads") from None
    if crs is None:
        raise SourceError(str(path), "no coordinate reference system", "a raster with a CRS")
    return RasterCells(str(path), CRS.from_user_input(crs.to_wkt()), transform, rows, cols)


def _like(cells: RasterCells) -> MapView:
    transform = cells.transform
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise SourceError(cells.name, "a turned grid", "rows from west to east, the northernmost first")
    west, north = transform.c + transform.a / 2, transform.f + transform.e / 2
    return _lattice(cells.crs, west, north, transform.a, -transform.e, cells.rows, cells.cols)


def _lattice(crs: CRS, x0: float, y0: float, col_step: float, row_step: float, rows: int, cols: int) -> MapView:
    """Cells by the first one's centre and their sides: nodes of a grid if they are square, else pixels between nodes."""
    if abs(row_step / col_step - 1.0) <= SQUARE:
        return MapView(Grid(crs, x0, y0, col_step), 0.0, 0.0, 1.0, 1.0, rows, cols)
    step = min(col_step, row_step)
    return MapView(Grid(crs, x0, y0, step), 0.0, 0.0, row_step / step, col_step / step, rows, cols)


def _within(own: MapView, bounds: Bounds) -> MapView:
    """Those of a view's cells that bounds in its CRS touch."""
    west, south, east, north = bounds
    grid, (down, right) = own.grid, (own.row_step, own.col_step)
    rows = (grid.row(north) / down + 0.5 + 1e-9, grid.row(south) / down + 0.5 - 1e-9)
    cols = (grid.col(west) / right + 0.5 + 1e-9, grid.col(east) / right + 0.5 - 1e-9)
    (top, bottom), (left, end) = ((int(np.floor(low)), int(np.ceil(high))) for low, high in (rows, cols))
    return own.part(top, left, bottom - top, end - left)


def transform_of(view: MapView) -> Affine:
    """The geotransform of a view's pixels."""
    west, _, _, north = view.bounds
    return Affine(view.grid.step * view.col_step, 0.0, west, 0.0, -view.grid.step * view.row_step, north)


@dataclass(frozen=True, eq=False)
class ShadedBlock:
    """A part of a layer under the ``sun``-th of some suns: its ``array`` (rows, cols) or (rows, cols, bands) from a cell on."""

    sun: int
    row: int
    col: int
    array: np.ndarray


def shaded_blocks(
    scene: Scene, view: MapView, layer: str, suns: Sequence[SunSpec | None], overrides: dict[str, Any]
) -> tuple[int, Iterator[ShadedBlock]]:
    """How many blocks a layer of a map under each of some suns (``None``: the level's own) has, and these, one after the other.

    Blocks of one place follow one another: what does not depend on the sun is done once. Raises ``SkuggaError``.
    """
    if layer not in SHADE_LAYERS:
        raise InputError("layer", layer, ", ".join(SHADE_LAYERS))
    if scene.sun is None and None in suns:
        raise InputError("time", MISSING_VALUE, "a time, or an azimuth and an altitude: the level has no sun")
    blocks, scenes = blocks_of(view), [scene.with_sun(sun) for sun in suns]
    device = calibration_for(scene.loaded.level.shadows, overrides)
    middle = blocks[len(blocks) // 2][0]
    plans = [plan_of_view(seen, middle, "map", overrides, device=device) for seen in scenes]

    def made() -> Iterator[ShadedBlock]:
        for block, row, col in blocks:
            inside = slice(max(-row, 0), view.rows - row), slice(max(-col, 0), view.cols - col)
            for sun, (seen, plan) in enumerate(zip(scenes, plans, strict=True)):
                yield ShadedBlock(sun, max(row, 0), max(col, 0), SHADE_LAYERS[layer].make(seen, block, plan)[inside])
            forget_ground_before(1)

    return len(blocks) * len(scenes), made()


def write_shade(
    scene: Scene,
    view: MapView,
    layer: str,
    suns: Sequence[SunSpec | None],
    paths: Sequence[Path],
    overrides: dict[str, Any],
    on_block: Callable[[int, int], None] | None = None,
) -> None:
    """Write a layer of a map under each of some suns into a file of its own. ``on_block(done, total)`` is called after each block
    under each sun. Raises as ``shaded_blocks``, and ``OSError``.
    """
    total, blocks = shaded_blocks(scene, view, layer, suns, overrides)
    made, transform = SHADE_LAYERS[layer], transform_of(view)
    notes = [shade_notes(scene.with_sun(sun), layer, overrides) for sun in suns]
    with ExitStack() as stack:
        files: list[RasterFile] = [
            stack.enter_context(
                cog(path, view.grid.crs, transform, (view.rows, view.cols), made.bands, made.dtype, made.nodata, made.smooth, note)
            )
            for path, note in zip(paths, notes, strict=True)
        ]
        for done, block in enumerate(blocks, start=1):
            files[block.sun].write(block.row, block.col, block.array)
            if on_block is not None:
                on_block(done, total)


def shade_notes(scene: Scene, layer: str, overrides: dict[str, Any]) -> RasterNotes:
    """What a raster of a layer says of itself: the layer, the level, the sun, and what was asked of shadows.

    The sun's angles are those in the middle of the level.
    """
    made, sun = SHADE_LAYERS[layer], scene.sun
    tags = {"layer": layer, "level": scene.loaded.name}
    if sun is not None:
        tags |= {
            "time": "" if sun.time is None else sun.time.isoformat(),
            "sun_azimuth_deg": f"{sun.azimuth_deg:.4f}", "sun_altitude_deg": f"{sun.altitude_deg:.4f}",
        }  # fmt: skip
    asked = {name: value for name, value in overrides.items() if value is not None}
    algorithm = asked.pop("algorithm", scene.loaded.level.shadows.algorithm)
    tags |= {"algorithm": spelt(algorithm), **{f"shadows_{name}": str(value) for name, value in asked.items()}}
    return RasterNotes(f"{layer}: {made.about}", made.band_names, "1" if layer in ("visibility", "cosi") else "", tags)


def shade_array(scene: Scene, view: MapView, layer: str, sun: SunSpec | None, overrides: dict[str, Any]) -> np.ndarray:
    """A layer of a map as one array (rows, cols) or (rows, cols, 4). Raises as ``shaded_blocks``."""
    _, blocks = shaded_blocks(scene, view, layer, [sun], overrides)
    made = SHADE_LAYERS[layer]
    out = np.empty((view.rows, view.cols, *([made.bands] if made.bands > 1 else [])), made.dtype)
    for block in blocks:
        rows, cols = block.array.shape[:2]
        out[block.row : block.row + rows, block.col : block.col + cols] = block.array
    return out
