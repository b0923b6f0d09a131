"""Positions of a stand's trees: a jittered lattice from the CRS's origin, with one tree in each cell.

- A tree's position depends on the seed and its cell's indices only, not on the stand's outline or the view.
- Positions are uniform in their cells. A uniform jitter leaves no trace of the lattice in the stand (M. A. Klatt, J. Kim,
  S. Torquato: Cloaking the underlying long-range order of randomly perturbed lattices, Phys. Rev. E 101, 2020).
- The one exception is a minimum spacing of half a cell between trees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely

from skugga.terrain.compiled import compiled, internal

MIN_SPACING_CELLS = 0.5
"""Minimum distance between two trees, in cells. A cell's centre is at least as far from all trees in other cells."""

HECTARE_M2 = 10_000.0

_MAX_ATTEMPTS = 24
"""Random positions tried in a cell before its centre is used."""

_TILE_CELLS = 128
"""Side in cells of the tiles that are filled with trees one at a time."""

_HALO_CELLS = 3
"""Width in cells of the border of a tile on which the tile's positions depend.

A cell depends on neighbours of three earlier colours (``_jittered_positions``), each one cell further away.
"""

_GOLDEN_GAMMA, _MIX_MULTIPLIER_1, _MIX_MULTIPLIER_2 = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
_SHIFT_11, _SHIFT_27, _SHIFT_30, _SHIFT_31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)


@dataclass(frozen=True, eq=False)
class TreePositions:
    """Positions of n trees.

    Attributes
    ----------
    x, y
        Coordinates float64 (n,) in a CRS.
    key
        Hash uint64 (n,) of each tree, the source of its other random properties.
    """

    x: np.ndarray
    y: np.ndarray
    key: np.ndarray

    def __len__(self) -> int:
        return len(self.key)


def pair_keys(seed: int, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return the hashes uint64 (n,) of pairs of integers."""
    return _hash_pairs(seed, np.asarray(i, np.int64), np.asarray(j, np.int64))


def point_keys(seed: int, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the hashes uint64 (n,) of points (metres), equal for points in the same millimetre."""
    return pair_keys(seed, np.rint(np.asarray(x_m) * 1000.0), np.rint(np.asarray(y_m) * 1000.0))


def uniform_numbers(key: np.ndarray, stream: int) -> np.ndarray:
    """Return uniform random numbers float64 (n,) in [0, 1), independent for each hash and each stream (random sequence)."""
    return _uniform_numbers(key, stream)


def scatter_trees(
    area: shapely.Polygon | shapely.MultiPolygon, density_per_ha: float, seed: int, unit_m: float = 1.0
) -> TreePositions:
    """Return the positions of trees of a density in an area. The mean density is exact.

    ``unit_m`` is the unit of the area's CRS in metres.
    """
    pitch = np.sqrt(HECTARE_M2 / density_per_ha) / unit_m
    return _concatenate_positions(
        [positions for part in shapely.get_parts(area) for positions in _scatter_in_polygon(part, pitch, seed)]
    )


def join_positions(position_sets: list[TreePositions]) -> tuple[TreePositions, np.ndarray]:
    """Join sets of positions, without duplicates and sorted by hash.

    Returns
    -------
    places, first
        The positions, and their indices in the concatenated sets.
    """
    all_places = _concatenate_positions(position_sets)
    key, first = np.unique(all_places.key, return_index=True)
    return TreePositions(all_places.x[first], all_places.y[first], key), first


def _concatenate_positions(position_sets: list[TreePositions]) -> TreePositions:
    """Return the positions of all sets, in order."""
    if not position_sets:
        return TreePositions(np.empty(0), np.empty(0), np.empty(0, np.uint64))
    return TreePositions(*(np.concatenate([getattr(positions, name) for positions in position_sets]) for name in ("x", "y", "key")))


def _scatter_in_polygon(area: shapely.Polygon, cell_side: float, seed: int) -> Iterator[TreePositions]:
    """Yield the positions of the lattice's trees in a polygon, tile by tile.

    ``cell_side`` is the side of the lattice's cells, in units of the polygon's CRS.
    """
    west, south, east, north = (int(np.floor(v / cell_side)) for v in area.bounds)
    cols, rows = (v.ravel() for v in np.meshgrid(np.arange(west, east + 1, _TILE_CELLS), np.arange(south, north + 1, _TILE_CELLS)))
    shapely.prepare(area)
    is_within = np.zeros(len(cols), bool)
    if len(cols) > 1:
        tiles = shapely.box(cols * cell_side, rows * cell_side, (cols + _TILE_CELLS) * cell_side, (rows + _TILE_CELLS) * cell_side)
        is_touched = shapely.intersects(area, tiles)
        cols, rows, is_within = cols[is_touched], rows[is_touched], shapely.contains_properly(area, tiles[is_touched])
    for col, row, is_inside in zip(cols.tolist(), rows.tolist(), is_within.tolist(), strict=True):
        x, y, key = _jittered_positions(seed, row, col, min(_TILE_CELLS, north + 1 - row), min(_TILE_CELLS, east + 1 - col))
        x, y = x * cell_side, y * cell_side
        if not is_inside:
            is_in_polygon = shapely.contains_xy(area, x, y)
            x, y, key = x[is_in_polygon], y[is_in_polygon], key[is_in_polygon]
        yield TreePositions(x, y, key)


@internal
def _splitmix64(x):
    """Return splitmix64 of x (G. L. Steele, D. Lea, C. H. Flood: Fast splittable pseudorandom number generators, OOPSLA 2014)."""
    x = x + _GOLDEN_GAMMA
    x = (x ^ (x >> _SHIFT_30)) * _MIX_MULTIPLIER_1
    x = (x ^ (x >> _SHIFT_27)) * _MIX_MULTIPLIER_2
    return x ^ (x >> _SHIFT_31)


@internal
def pair_key(seed, i, j):
    """Return the hash uint64 of a pair of integers, for compiled loops."""
    return _splitmix64(_splitmix64(_splitmix64(np.uint64(seed)) ^ np.uint64(i)) ^ np.uint64(j))


@internal
def _uniform_number(key, stream):
    """Return a uniform random number in [0, 1) from a hash and the number of a stream (random sequence)."""
    return np.float64(_splitmix64(key ^ _splitmix64(np.uint64(stream))) >> _SHIFT_11) * 2.0**-53


@compiled
def _hash_pairs(seed, i, j):
    """Return the hashes uint64 (n,) of ``pair_keys``."""
    out = np.empty(i.size, np.uint64)
    for n in range(i.size):
        out[n] = pair_key(seed, i[n], j[n])
    return out


@compiled
def _uniform_numbers(key, stream):
    """Return the random numbers float64 (n,) of ``uniform_numbers``."""
    out = np.empty(key.size)
    for n in range(key.size):
        out[n] = _uniform_number(key[n], stream)
    return out


@compiled
def _jittered_positions(seed, row0, col0, rows, cols):
    """Return x, y (in cells) and hashes of the trees of a window of ``rows`` x ``cols`` cells from (row0, col0) on, row by row.

    Cells have four colours in a 2 x 2 pattern, and the loop fills them colour by colour. A cell uses its first random position that
    keeps the minimum spacing to its neighbours of earlier colours, or else its centre.
    """
    high, wide = rows + 2 * _HALO_CELLS, cols + 2 * _HALO_CELLS
    xs, ys = np.full((high, wide), np.inf), np.full((high, wide), np.inf)
    for colour in range(4):
        for r in range(high):
            row = row0 + r - _HALO_CELLS
            for c in range(wide):
                col = col0 + c - _HALO_CELLS
                if (row & 1) * 2 + (col & 1) != colour:
                    continue
                key = pair_key(seed, row, col)
                px, py = col + 0.5, row + 0.5
                for attempt in range(_MAX_ATTEMPTS):
                    x, y = col + _uniform_number(key, 100 + 2 * attempt), row + _uniform_number(key, 101 + 2 * attempt)
                    nearest = np.inf
                    for m in range(max(r - 1, 0), min(r + 2, high)):
                        for n in range(max(c - 1, 0), min(c + 2, wide)):
                            nearest = min(nearest, (xs[m, n] - x) ** 2 + (ys[m, n] - y) ** 2)
                    if nearest >= MIN_SPACING_CELLS**2:
                        px, py = x, y
                        break
                xs[r, c], ys[r, c] = px, py
    x, y, key = np.empty(rows * cols), np.empty(rows * cols), np.empty(rows * cols, np.uint64)
    for r in range(rows):
        for c in range(cols):
            n = r * cols + c
            x[n], y[n], key[n] = (
                xs[r + _HALO_CELLS, c + _HALO_CELLS],
                ys[r + _HALO_CELLS, c + _HALO_CELLS],
                pair_key(seed, row0 + r, col0 + c),
            )
    return x, y, key
