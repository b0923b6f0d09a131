"""Horizons of all nodes of a grid towards many azimuths, one azimuth at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from skugga.shadows.horizons.march import BLOCK_ROWS, NO_GROUND_M, RUN, TALL_BLOCK_ROWS, Ground, Rays, march, write_blocks
from skugga.shadows.sweep.orientation import GridOrientation, copy_in_blocks
from skugga.terrain.compiled import run_in_chunks

MAX_CHORD_ERROR = float(np.tan(np.radians(1.0)))
"""Tangent of the largest angle that may be lost between two crossings of rows (``skugga.shadows.horizons.march``).

The bound is far from tight: in mountains 0.005 degrees are lost in the mean, and 0.08 at one node in a hundred.
"""


NODE_TOLERANCE = 1e-6
"""Distance in cells within which a ray meets a node."""


@dataclass(frozen=True, eq=False)
class HorizonGrid:
    """A grid of heights whose horizons are computed.

    Attributes
    ----------
    height_m
        float32 (rows, cols), metres; NaN without ground.
    east_north_of_cell_m
        (2, 2), metres: east and north (rows) of a step to the next row and of one to the next column (columns of the matrix).
    curvature_per_m
        1 over the radius, metres, by which the level falls with the distance: that of the earth, with refraction if any; 0 in a
        flat world.
    """

    height_m: np.ndarray
    east_north_of_cell_m: np.ndarray
    curvature_per_m: float = 0.0


@dataclass(frozen=True, eq=False)
class AzimuthHorizons:
    """The horizons of all nodes towards one azimuth.

    Attributes
    ----------
    number
        Index of the azimuth.
    azimuth_deg
        Azimuth, clockwise from north.
    orientation
        How the grid was turned.
    tangent
        float32 (n, m) in the order of the turned grid: tangents of the horizon angles. Below ``NO_GROUND_TANGENT`` there is no
        ground. The next azimuth overwrites it.
    """

    number: int
    azimuth_deg: float
    orientation: GridOrientation
    tangent: np.ndarray


def horizons_towards(grid: HorizonGrid, azimuth_deg: Iterable[float]) -> Iterator[AzimuthHorizons]:
    """Yield the horizons of a grid towards azimuths, ordered by the orientation of the grid and not by azimuth.

    The ground of one orientation is prepared once and serves all of its azimuths.
    """
    cells_of_east_north = np.linalg.inv(grid.east_north_of_cell_m)
    directions = []
    for number, azimuth in enumerate(azimuth_deg):
        angle = np.radians(azimuth)
        down, right = cells_of_east_north @ (np.sin(angle), np.cos(angle))
        swapped = abs(right) > abs(down)
        main, cross = (right, down) if swapped else (down, right)
        # Rays run towards row 0 and to the right; in a sweep the light comes from there, so its columns are mirrored.
        directions.append((GridOrientation(swapped, main > 0.0, cross < 0.0), number, float(azimuth), abs(main), abs(cross)))
    known = np.isfinite(grid.height_m)
    level_m = np.float32(0.0) if not known.any() else np.float32(np.mean(grid.height_m[known], dtype=np.float64))

    def sort_key(direction: tuple[GridOrientation, int, float, float, float]) -> tuple[bool, bool, bool]:
        orientation = direction[0]
        return orientation.axes_swapped, orientation.rows_reversed, orientation.cols_reversed

    for _, group in groupby(sorted(directions, key=sort_key), key=sort_key):
        members = list(group)
        orientation = members[0][0]
        ground, cols = turned_ground(grid.height_m, level_m, orientation)
        rows = len(ground.height_m)
        tangent = np.empty((rows, -(-cols // RUN) * RUN), np.float32)
        for _, number, azimuth, main, cross in members:
            rays = rays_of(rows, cross / main, 1.0 / main, grid.curvature_per_m)
            run_in_chunks(rows, march, ground, rays, np.float32(MAX_CHORD_ERROR), tangent)
            yield AzimuthHorizons(number, azimuth, orientation, tangent[:, :cols])


def turned_ground(height_m: np.ndarray, level_m: np.float32, orientation: GridOrientation) -> tuple[Ground, int]:
    """Return the ground of heights (rows, cols) above ``level_m`` in an orientation, and the number of its columns of nodes."""
    turned = orientation.sun_aligned_view(height_m)
    n, m = turned.shape
    runs = -(-m // RUN)
    padded = np.full((n, (runs + 2) * RUN), NO_GROUND_M, np.float32)
    copy_in_blocks(turned, padded[:, :m])
    nodes = padded[:, :m]
    nodes -= level_m
    nodes[~np.isfinite(nodes)] = NO_GROUND_M
    blocks = -(-n // BLOCK_ROWS), -(-padded.shape[1] // RUN)
    highest_m, roughness_m = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    run_in_chunks(blocks[0], write_blocks, padded, highest_m, roughness_m)
    per_tall = TALL_BLOCK_ROWS // BLOCK_ROWS
    tall_m = np.maximum.reduceat(highest_m, np.arange(0, blocks[0], per_tall), axis=0)
    return Ground(padded, padded.reshape(-1), highest_m, tall_m, roughness_m), m


def rays_of(rows: int, columns_per_row: float, metres_per_row: float, curvature_per_m: float) -> Rays:
    """Return the rays of one azimuth that move by ``columns_per_row``, 0 to 1, and by ``metres_per_row`` in each row.

    ``rows`` is the number of rows of the grid. The level falls by half the squared distance times ``curvature_per_m``.
    """
    k = np.arange(rows + 4, dtype=np.float64)
    column = np.floor(k * columns_per_row + NODE_TOLERANCE)
    share = k * columns_per_row - column
    share = np.where(share > NODE_TOLERANCE, share, 0.0)  # a ray that meets a node does not look at the next one
    distance_m = k * metres_per_row
    edges = _edges(rows + 4, columns_per_row)
    order = np.argsort(edges[:, 0], kind="stable")
    edges = edges[order]
    interval = np.ceil(edges[:, 0] - 1e-9)
    edge_start = np.searchsorted(interval, np.arange(rows + 5))
    edge_share = edges[:, 0] - (interval - 1.0)
    return Rays(
        column.astype(np.int64), _terms(share, distance_m, curvature_per_m),
        (0.5 * curvature_per_m * distance_m**2).astype(np.float32), distance_m.astype(np.float32), edge_start.astype(np.int64),
        interval.astype(np.int64), edges[:, 1:].astype(np.int64), _terms(edge_share, edges[:, 0] * metres_per_row, curvature_per_m),
    )  # fmt: skip


def _edges(rows: int, columns_per_row: float) -> np.ndarray:
    """Return the crossings of columns and diagonals, float64 (edges, 3).

    They are the distance in rows, and the columns of the edge's ends: in the row before the crossing, as seen from the node, and in
    the row behind it. Crossings at a row are left out: there the row's crossing says the same.
    """
    parts = []
    end = float(rows - 1)

    def add(crossings: np.ndarray, near_column: np.ndarray, far_column: np.ndarray) -> None:
        is_between = np.abs(crossings - np.rint(crossings)) > NODE_TOLERANCE
        parts.append(np.stack([crossings, near_column, far_column], axis=1)[is_between])

    if columns_per_row > NODE_TOLERANCE / rows:  # columns
        column = np.arange(1.0, np.floor(end * columns_per_row) + 1.0)
        add(column / columns_per_row, column, column)
    if 1.0 - columns_per_row > NODE_TOLERANCE / rows:  # diagonals from (k - 1, c) to (k, c + 1)
        number = np.arange(1.0, np.floor(end * (1.0 - columns_per_row)) + 1.0)
        crossing = number / (1.0 - columns_per_row)
        near_column = np.ceil(crossing) - 1.0 - number
        add(crossing, near_column, near_column + 1.0)
    number = np.arange(1.0, np.floor(end * (1.0 + columns_per_row)) + 1.0)  # diagonals from (k - 1, c + 1) to (k, c)
    crossing = number / (1.0 + columns_per_row)
    far_column = number - np.ceil(crossing)
    add(crossing, far_column + 1.0, far_column)
    return np.concatenate(parts)


def _terms(share: np.ndarray, distance_m: np.ndarray, curvature_per_m: float) -> np.ndarray:
    """Return the terms of ``Rays`` for crossings at a share of the way between two nodes, float32 (crossings, 4)."""
    with np.errstate(divide="ignore"):
        near = np.where(distance_m > 0.0, 1.0 / distance_m, 0.0)
    return np.stack([(1.0 - share) * near, share * near, 0.5 * curvature_per_m * distance_m, near], axis=1).astype(np.float32)


def horizon_angles_deg(grid: HorizonGrid, azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the horizon angles of all nodes, float32 (azimuths, rows, cols), in degrees.

    They are -90 where no ground lies towards an azimuth, and NaN at nodes without ground.
    """
    angles = np.empty((len(azimuth_deg), *grid.height_m.shape), np.float32)
    for horizons in horizons_towards(grid, azimuth_deg):
        band = angles[horizons.number]
        np.degrees(np.arctan(horizons.orientation.grid_order_view(horizons.tangent), out=band), out=band)
    angles[:, ~np.isfinite(grid.height_m)] = np.nan
    return angles


def north_up_cell(down_m: float, right_m: float) -> np.ndarray:
    """Return ``HorizonGrid.east_north_of_cell_m`` of cells whose columns run north-south; row 0 is north.

    ``down_m`` and ``right_m`` are the sides of a cell along a column and along a row, metres.
    """
    return np.array([[0.0, right_m], [-down_m, 0.0]])
