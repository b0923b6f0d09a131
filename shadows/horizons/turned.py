"""Turn grids for an azimuth, and prepare what the compiled loops need: the ground, the eyes and the rays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.march import (
    BLOCK_COLS,
    BLOCK_ROWS,
    NO_EYE_M,
    NO_GROUND_M,
    RUN,
    TALL_BLOCK_ROWS,
    Ground,
    Rays,
    march,
    write_blocks,
    write_turned,
)  # fmt: skip
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import run_in_chunks
from skugga.terrain.heightfield.walks import curvature_drop_m

MAX_CHORD_ERROR = float(np.tan(np.radians(0.5)))
"""Tangent of the largest angle that may be lost between two crossings of rows (``skugga.shadows.horizons.march``).

The bound is far from tight: in mountains 0.003 degrees are lost in the mean, and 0.05 at one node in a hundred.
"""


NODE_TOLERANCE = 1e-6
"""Distance in cells within which a ray meets a node."""


@dataclass(frozen=True)
class Direction:
    """An azimuth on a turned grid.

    Attributes
    ----------
    number
        Index of the azimuth.
    azimuth_deg
        Azimuth, clockwise from north.
    columns_per_row
        Columns by which rays move to the right in each row, 0 to 1.
    metres_per_row
        Distance from row to row along a ray.
    """

    number: int
    azimuth_deg: float
    columns_per_row: float
    metres_per_row: float


def directions_by_orientation(
    east_north_of_cell_m: np.ndarray, azimuth_deg: Iterable[float]
) -> dict[GridOrientation, list[Direction]]:
    """Return azimuths by the orientation that turns a grid for them: rays then run towards row 0 and to the right."""
    cells_of_east_north = np.linalg.inv(east_north_of_cell_m)
    directions: dict[GridOrientation, list[Direction]] = {}
    for number, azimuth in enumerate(azimuth_deg):
        angle = np.radians(azimuth)
        down, right = cells_of_east_north @ (np.sin(angle), np.cos(angle))
        swapped = bool(abs(right) > abs(down))
        main, cross = (right, down) if swapped else (down, right)
        # In a sweep, light comes from where these rays go to, so its columns are mirrored.
        orientation = GridOrientation(swapped, bool(main > 0.0), bool(cross < 0.0))
        direction = Direction(number, float(azimuth), float(abs(cross / main)), float(1.0 / abs(main)))
        directions.setdefault(orientation, []).append(direction)
    return directions


def march_eyes(ground: Ground, rays: Rays, eye_height_m: np.ndarray, first_node: tuple[int, int], tangent: np.ndarray) -> None:
    """Raise the tangents of the horizons of eyes on a turned ground, on all cores; the parameters are those of ``march``."""
    run_in_chunks(len(tangent), march, ground, rays, eye_height_m, *first_node, np.float32(MAX_CHORD_ERROR), tangent)


class TurnedEyes:
    """The eyes of a grid in an orientation.

    Attributes
    ----------
    height_m
        float32 (n, runs * ``RUN``), metres above a common level, ``NO_EYE_M`` where there is no eye.
    rows, cols
        Number of rows and of columns of eyes.
    first_node
        Row and column, on the turned grid, of the first eye.
    """

    def __init__(
        self, eye_height_m: np.ndarray, first_node: tuple[int, int], shape: tuple[int, int], level_m: np.float32,
        orientation: GridOrientation,
    ) -> None:  # fmt: skip
        turned = orientation.sun_aligned_view(eye_height_m)
        self.rows, self.cols = turned.shape
        self.height_m = np.full((self.rows, -(-self.cols // RUN) * RUN), NO_EYE_M, np.float32)
        run_in_chunks(self.rows, write_turned, turned, level_m, NO_EYE_M, self.height_m)
        rows, cols = eye_height_m.shape
        corners = np.array([first_node[0], first_node[0] + rows - 1]), np.array([first_node[1], first_node[1] + cols - 1])
        row, col = orientation.to_sun_aligned(*corners, *shape)
        self.first_node = int(row.min()), int(col.min())


def turned_eyes(grid: HorizonGrid, level_m: np.float32, orientation: GridOrientation) -> TurnedEyes:
    """Return the eyes of a grid in an orientation, with heights above ``level_m``."""
    first_node = grid.eyes[0].start or 0, grid.eyes[1].start or 0
    shape = (grid.height_m.shape[0], grid.height_m.shape[1])
    return TurnedEyes(grid.eye_heights_m, first_node, shape, level_m, orientation)


def turned_ground(height_m: np.ndarray, level_m: np.float32, orientation: GridOrientation) -> Ground:
    """Return the ground of heights (rows, cols) above ``level_m`` in an orientation."""
    turned = orientation.sun_aligned_view(height_m)
    n, m = turned.shape
    padded = np.full((n, (-(-m // RUN) + 2) * RUN), NO_GROUND_M, np.float32)
    run_in_chunks(n, write_turned, turned, level_m, NO_GROUND_M, padded)
    blocks = -(-n // BLOCK_ROWS), padded.shape[1] // BLOCK_COLS
    highest_m, roughness_m = np.empty(blocks, np.float32), np.empty(blocks, np.float32)
    run_in_chunks(blocks[0], write_blocks, padded, highest_m, roughness_m)
    per_tall = TALL_BLOCK_ROWS // BLOCK_ROWS
    tall_m = np.maximum.reduceat(highest_m, np.arange(0, blocks[0], per_tall), axis=0)
    return Ground(padded, padded.reshape(-1), highest_m, tall_m, roughness_m)


def rays_of(rows: int, columns_per_row: float, metres_per_row: float, curvature_per_m: float) -> Rays:
    """Return the rays of one azimuth that move by ``columns_per_row``, 0 to 1, and by ``metres_per_row`` in each row.

    ``rows`` is the number of rows of the grid. The level falls with the distance by ``curvature_drop_m``.
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
        column=column.astype(np.int64),
        row_terms=_terms(share, distance_m, curvature_per_m),
        fall_m=curvature_drop_m(distance_m, curvature_per_m).astype(np.float32),
        distance_m=distance_m.astype(np.float32),
        columns_per_row=np.float32(columns_per_row),
        edge_start=edge_start.astype(np.int64),
        edge_row=interval.astype(np.int64),
        edge_columns=edges[:, 1:].astype(np.int64),
        edge_terms=_terms(edge_share, edges[:, 0] * metres_per_row, curvature_per_m),
    )


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
    fall = curvature_drop_m(distance_m, curvature_per_m) * near
    return np.stack([(1.0 - share) * near, share * near, fall, near], axis=1).astype(np.float32)
