"""The records of a grid whose horizons are computed, of its eyes, and of the ground beyond it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class FarGround:
    """Ground beyond a grid, on coarser nodes: every ``factor`` nodes of the grid, counted from its first eye.

    Attributes
    ----------
    height_m
        float32 (rows, cols), metres; NaN without ground, and where finer ground is known.
    factor
        Nodes of the grid from one node of this ground to the next.
    first_node
        Row and column of the first node, in nodes of this ground from the first eye.
    """

    height_m: np.ndarray
    factor: int
    first_node: tuple[int, int]


@dataclass(frozen=True, eq=False)
class HorizonGrid:
    """A grid of heights, and the eyes on it whose horizons are computed.

    Attributes
    ----------
    height_m
        float32 (rows, cols), metres; NaN without ground.
    east_north_of_cell_m
        (2, 2), metres: east and north (rows) of a step to the next row and of one to the next column (columns of the matrix).
    curvature_per_m
        1 over the radius, metres, by which the level falls with the distance: that of the earth, or 0 in a flat world.
    eyes
        The rows and columns of the grid on which eyes stand; all by default.
    shows_ground
        bool (rows, cols), the nodes that show ground. Others with a height, beyond the edge of the data or in holes, only hide the
        sky. ``None``: all with a height.
    eye_height_m
        float32, the eyes' heights, metres, if they do not stand on the ground; NaN for eyes that do not exist.
    far
        Ground beyond the grid, from fine to coarse.
    """

    height_m: np.ndarray
    east_north_of_cell_m: np.ndarray
    curvature_per_m: float = 0.0
    eyes: tuple[slice, slice] = (slice(None), slice(None))
    shows_ground: np.ndarray | None = None
    eye_height_m: np.ndarray | None = None
    far: tuple[FarGround, ...] = ()

    @property
    def eye_heights_m(self) -> np.ndarray:
        """The heights of the eyes, float32 (eye rows, eye cols), metres; NaN for eyes that do not exist."""
        return self.shown_height_m[self.eyes] if self.eye_height_m is None else self.eye_height_m

    @property
    def shown_height_m(self) -> np.ndarray:
        """The heights of the nodes that show ground, float32 (rows, cols), metres; NaN at others."""
        return self.height_m if self.shows_ground is None else np.where(self.shows_ground, self.height_m, np.float32(np.nan))


def grid_of_array(height_m: np.ndarray, cell_m: tuple[float, float]) -> HorizonGrid:
    """Return the grid of an array of heights (rows, cols) in a flat world, row 0 north; ``cell_m`` are the sides of a cell.

    The ground extends by one cell beyond the outermost nodes, as for shadows: it must end with the cells, not with their middles.
    """
    inside = slice(1, height_m.shape[0] + 1), slice(1, height_m.shape[1] + 1)
    shows_ground = np.zeros((height_m.shape[0] + 2, height_m.shape[1] + 2), np.bool_)
    shows_ground[inside] = np.isfinite(height_m)
    padded = np.pad(np.asarray(height_m, np.float32), 1, mode="edge")
    return HorizonGrid(padded, north_up_cell(*cell_m), eyes=inside, shows_ground=shows_ground)


def north_up_cell(down_m: float, right_m: float) -> np.ndarray:
    """Return ``HorizonGrid.east_north_of_cell_m`` of cells whose columns run north-south; row 0 is north.

    ``down_m`` and ``right_m`` are the sides of a cell along a column and along a row, metres.
    """
    return np.array([[0.0, right_m], [-down_m, 0.0]])
