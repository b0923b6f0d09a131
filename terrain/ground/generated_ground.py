"""Generate ground procedurally: a flat floor, mountains or a small landscape, in an engineering CRS in metres.

Cell centres are the ground's nodes: ``cells`` quads a side need one more raster cell a side, and the outermost centres lie on the
rim of ``size``. The centre is at (0, 0).

The same seed gives the same ground on any machine. Random numbers are integer hashes, and the arithmetic uses only addition,
multiplication, division and square roots, whose rounding IEEE 754 defines.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from affine import Affine
from rasterio.crs import CRS
from rasterio.io import MemoryFile

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, map_on_cores
from skugga.terrain.ground.erosion import erode
from skugga.terrain.ground.noise import fractal_grid, noise_at, ridged_at
from skugga.terrain.level.parts import FlatGround, GeneratedGround, Terrain

ENGINEERING_CRS_WKT = (
    'ENGCRS["made ground",EDATUM["made ground"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
)

STRIP_ROWS = 128
"""Rows that a thread computes at a time."""

COARSEST_GRID_CELLS = 48
"""Cells along the longest side of the grid on which main valleys form."""

MAX_HALVINGS = 4
"""Maximum number of refinements of the eroded grid.

Rivers reach down to cells of 1/768 of the side of the generated ground. Finer slopes get their roughness from noise.
"""

ERODED_SIDE_FACTOR = 1.5
"""Side of the eroded ground as a multiple of the part that becomes the raster, so that valleys lead out of the raster."""

MEANDER_CELLS, MEANDER_WAVELENGTH_CELLS = 1.1, 7.3
"""Sideways displacement of the eroded ground by noise, and the wavelength of the noise, in cells of the eroded grid.

It makes rivers wind: on the eroded grid they run in only eight directions.
"""

GULLY_WAVELENGTH_CELLS, GULLY_HEIGHT_RATIO = 3.0, 0.05
"""Gullies: wavelength of their longest octave in cells of the eroded grid, and their height over wavelength times slope."""

SEDIMENT_HEIGHTS, SEDIMENT_BLEND_HEIGHT, LAKE_SHARE = (0.13, 0.07), 0.05, 0.05
"""Valley fill of ``landscape``: its mean height and variation, its blend width to the hills, and the lake's share of the ground.

Heights and width are shares of the relief.
"""


def generated_ground(terrain: Terrain) -> MemoryFile:
    """Return the raster of ``terrain.flat`` or ``terrain.generate`` in memory: heights in metres, float32. Results are cached.

    Generated heights run from 0 to ``relief``. ``ridges`` are mountains eroded by rivers. ``landscape`` has hills, a few peaks, and
    filled valleys with a lake at height 0.
    """
    spec = terrain.flat or terrain.generate
    assert spec is not None, "terrain has neither flat nor generate"
    return _generate(spec)


@cached("process", 640 * MIB, size_of=len)
def _generate(spec: FlatGround | GeneratedGround) -> MemoryFile:
    """Return the raster of a description of generated ground, in memory."""
    if isinstance(spec, FlatGround):
        cols, rows = spec.cells
        return _height_raster(np.zeros((rows + 1, cols + 1), np.float32), spec.size[0] / cols, spec.size[1] / rows)
    cols, rows = (round(side / spec.cell) for side in spec.size)
    heights = (_ridges if spec.kind == "ridges" else _landscape)(rows, cols, spec.seed)
    heights -= heights.min()
    heights /= heights.max()
    heights *= np.float32(spec.relief)
    return _height_raster(heights, spec.cell, spec.cell)


def _height_raster(heights: np.ndarray, cell_width_m: float, cell_height_m: float) -> MemoryFile:
    """Return an in-memory GeoTIFF of heights (rows, cols), metres, from north to south, centred on the origin."""
    rows, cols = heights.shape
    memory = MemoryFile(ext=".tif")
    with memory.open(
        driver="GTiff", width=cols, height=rows, count=1, dtype="float32", crs=CRS.from_wkt(ENGINEERING_CRS_WKT),
        transform=Affine(cell_width_m, 0, -cols * cell_width_m / 2, 0, -cell_height_m, rows * cell_height_m / 2), tiled=True,
        blockxsize=256, blockysize=256,
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
    return memory


def _ridges(rows: int, cols: int, seed: int) -> np.ndarray:
    """Return the heights of mountains in massifs, (rows + 1, cols + 1) float32, in arbitrary units from an arbitrary zero."""
    return _uplift_and_erode(rows, cols, seed, lambda x, y: np.maximum(0.55 + 0.9 * fractal_grid(2.2 * x, 2.2 * y, 2, seed), 0.05))


def _landscape(rows: int, cols: int, seed: int) -> np.ndarray:
    """Return the heights of hills, a few peaks, and valleys filled to flat floors, (rows + 1, cols + 1) float32.

    They are in arbitrary units from an arbitrary zero.
    """

    def uplift(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        peaks = np.maximum(fractal_grid(1.7 * x, 1.7 * y, 2, seed + 1), 0.0)
        return np.maximum(0.25 + 0.35 * fractal_grid(2.6 * x, 2.6 * y, 2, seed) + 4.0 * peaks * peaks, 0.03)

    height = _uplift_and_erode(rows, cols, seed, uplift).astype(np.float64)
    height = (height - height.min()) / np.ptp(height)
    y, x = (np.arange(cells + 1) / max(rows, cols) for cells in (rows, cols))
    floor = SEDIMENT_HEIGHTS[0] + SEDIMENT_HEIGHTS[1] * fractal_grid(2.0 * x, 2.0 * y, 2, seed + 2)
    above = height - floor
    filled = floor + 0.5 * (above + np.sqrt(above * above + SEDIMENT_BLEND_HEIGHT**2))
    lake = np.partition(filled.ravel(), int(LAKE_SHARE * filled.size))[int(LAKE_SHARE * filled.size)]
    return np.maximum(filled, lake).astype(np.float32)


def _uplift_and_erode(rows: int, cols: int, seed: int, uplift: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
    """Return heights (rows + 1, cols + 1) float32 of ground that was uplifted and eroded by rivers.

    ``uplift`` returns the rate of uplift (m, n) for columns x (n,) and rows y (m,). These are in units of the raster's longest
    side.
    """
    longest = max(rows, cols)
    halvings = int(np.clip(np.ceil(np.log2(longest * ERODED_SIDE_FACTOR / COARSEST_GRID_CELLS)), 0, MAX_HALVINGS))
    # The shorter side gets cells in proportion, but enough for a valley.
    nodes_y, nodes_x = (max(round(COARSEST_GRID_CELLS * cells / longest), 4) + 1 for cells in (rows, cols))
    x, y = (np.arange(n) * (ERODED_SIDE_FACTOR / COARSEST_GRID_CELLS) for n in (nodes_x, nodes_y))
    start = 0.02 * fractal_grid(6.0 * x, 6.0 * y, 3, seed + 10)
    eroded = erode(start, uplift(x, y), halvings, seed + 20)
    scale = COARSEST_GRID_CELLS * 2**halvings / (ERODED_SIDE_FACTOR * longest)  # eroded cells per cell
    first_row, first_col = ((n - 1 - cells * scale) / 2 for n, cells in zip(eroded.shape, (rows, cols), strict=True))
    octaves = max(int(np.log2(GULLY_WAVELENGTH_CELLS / scale)), 0)  # down to wavelengths of two cells
    return _fill_strips(_add_roughness, rows, cols, eroded, first_row, first_col, scale, octaves, seed + 40)


def _fill_strips(function: Callable[..., None], rows: int, cols: int, *parameters: Any) -> np.ndarray:
    """Return an array (rows + 1, cols + 1) float32 that a function fills strip by strip, in several threads.

    ``function(out, row0, *parameters)`` fills the strip ``out``, whose first row is ``row0``.
    """
    out = np.empty((rows + 1, cols + 1), np.float32)
    map_on_cores(lambda row: function(out[row : row + STRIP_ROWS], row, *parameters), range(0, rows + 1, STRIP_ROWS))
    return out


@internal
def _cubic(a, b, c, d, t):
    """Return the value and the slope at ``t`` of the Catmull-Rom cubic between b (``t`` = 0) and c (``t`` = 1)."""
    p, q, r = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c)
    return b + t * (p + t * (q + t * r)), p + t * (2.0 * q + 3.0 * t * r)


@compiled
def _add_roughness(out, row0, eroded, first_row, first_col, scale, octaves, seed):
    """Fill ``out`` with the eroded ground, interpolated between its nodes, with gullies and knolls on steep slopes.

    ``row0`` is the row of ``out`` in the raster. Raster node (0, 0) is at (``first_row``, ``first_col``) in the grid ``eroded``,
    and ``scale`` is the distance between raster nodes in that grid. Gullies are ``octaves`` octaves of ridged noise.
    """
    rows, cols = eroded.shape
    row_heights, row_slopes = np.empty(4), np.empty(4)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            y, x = first_row + (row0 + i) * scale, first_col + j * scale
            u, v = (0.8 * x - 0.6 * y) / MEANDER_WAVELENGTH_CELLS, (0.6 * x + 0.8 * y) / MEANDER_WAVELENGTH_CELLS
            x += MEANDER_CELLS * noise_at(u, v, seed)
            y += MEANDER_CELLS * noise_at(u + 31.7, v + 47.1, seed + 3)
            y, x = min(max(y, 0.0), rows - 1.0), min(max(x, 0.0), cols - 1.0)
            r, c = min(int(y), rows - 2), min(int(x), cols - 2)
            left, right = max(c - 1, 0), min(c + 2, cols - 1)
            for k in range(4):
                n = min(max(r - 1 + k, 0), rows - 1)
                row_heights[k], row_slopes[k] = _cubic(eroded[n, left], eroded[n, c], eroded[n, c + 1], eroded[n, right], x - c)
            height, slope_y = _cubic(row_heights[0], row_heights[1], row_heights[2], row_heights[3], y - r)
            slope_x, _ = _cubic(row_slopes[0], row_slopes[1], row_slopes[2], row_slopes[3], y - r)
            if octaves > 0:
                slope = np.sqrt(slope_y * slope_y + slope_x * slope_x)
                gullies = ridged_at(x / GULLY_WAVELENGTH_CELLS, y / GULLY_WAVELENGTH_CELLS, octaves, seed + 6) - 0.85
                height += GULLY_HEIGHT_RATIO * GULLY_WAVELENGTH_CELLS * slope * gullies
            out[i, j] = height
