"""Horizons by the ground beyond a grid, which is known on coarser nodes only.

Coarse eyes stand at the coarse nodes over the grid. A horizon far away changes little from one eye to its neighbours, except with
their height: so each coarse node has two eyes, at the lowest and at the highest eye of the grid around it. Horizons of the grid's
eyes are interpolated between the four coarse nodes around them, and between both heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from skugga.shadows.horizons.grid import FarGround, HorizonGrid
from skugga.shadows.horizons.march import NO_EYE_M
from skugga.shadows.horizons.turned import Direction, TurnedEyes, march_eyes, rays_of, turned_ground
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import compiled, run_in_chunks

LOWEST_TANGENT = np.float32(-1e4)
"""Tangent below which far ground does not count. It keeps rays from following missing ground."""


class FarHorizons:
    """Far ground in an orientation, and the horizons of its coarse eyes towards one azimuth.

    Attributes
    ----------
    part, orientation
        The far ground, and how it is turned.
    low_m, high_m
        float32 (n, m) in the turned order: the heights of the two eyes of each coarse node above the common level.
    first_position, nodes_per_node
        The position of the first finer eye in coarse nodes (row, column), and coarse nodes from one finer eye to the next. The
        finer eyes are those of the grid, or of the far ground before this one.
    low_tangent, high_tangent
        float32 (n, runs * ``RUN``): the tangents of the horizons of the low and the high eyes.
    """

    def __init__(
        self, part: FarGround, eye_height_m: np.ndarray, finer_shape: tuple[int, int], finer_factor: int, level_m: np.float32,
        orientation: GridOrientation,
    ) -> None:  # fmt: skip
        self.part, self.orientation = part, orientation
        self._ground = turned_ground(part.height_m, level_m, orientation)
        low, high = eye_ranges(eye_height_m, part.factor)
        shape = (part.height_m.shape[0], part.height_m.shape[1])
        first_eye = -part.first_node[0], -part.first_node[1]
        self._low_eyes, self._high_eyes = (TurnedEyes(eyes, first_eye, shape, level_m, orientation) for eyes in (low, high))
        turned_shape = (self._low_eyes.rows, self._low_eyes.cols)
        self.low_m, self.high_m = (eyes.height_m[:, : eyes.cols] for eyes in (self._low_eyes, self._high_eyes))
        self.nodes_per_node = finer_factor / part.factor
        is_reversed = orientation.rows_reversed, orientation.cols_reversed
        self.first_position = tuple(
            (count - 1) - (finer - 1) * self.nodes_per_node if mirrored else 0.0
            for count, finer, mirrored in zip(turned_shape, finer_shape, is_reversed, strict=True)
        )
        self.low_tangent, self.high_tangent = (np.empty(self._low_eyes.height_m.shape, np.float32) for _ in range(2))

    @staticmethod
    def of_grid(grid: HorizonGrid, eyes: TurnedEyes, level_m: np.float32, orientation: GridOrientation) -> list[FarHorizons]:
        """Return the far ground of a grid in an orientation, from fine to coarse; ``eyes`` are the grid's."""
        out: list[FarHorizons] = []
        shape, factor = (eyes.rows, eyes.cols), 1
        for part in grid.far:
            out.append(FarHorizons(part, grid.eye_heights_m, shape, factor, level_m, orientation))
            shape, factor = (out[-1].low_m.shape[0], out[-1].low_m.shape[1]), part.factor
        return out

    def march(self, direction: Direction, curvature_per_m: float, known_tangent: np.ndarray) -> bool:
        """Compute the horizons of the coarse eyes, and return whether any rises above ``known_tangent`` (n, m).

        Those are the lowest horizons, by nearer ground, of the finer eyes around each coarse node: what lies below is not seen.
        """
        m = known_tangent.shape[1]
        known_tangent = np.where(np.isfinite(known_tangent), np.maximum(known_tangent, LOWEST_TANGENT), LOWEST_TANGENT)
        rays = rays_of(
            len(self._ground.height_m), direction.columns_per_row, direction.metres_per_row * self.part.factor, curvature_per_m
        )
        for tangent, eyes in ((self.low_tangent, self._low_eyes), (self.high_tangent, self._high_eyes)):
            tangent.fill(LOWEST_TANGENT)
            tangent[:, :m] = known_tangent
            march_eyes(self._ground, rays, eyes.height_m, eyes.first_node, tangent)
        return bool((self.low_tangent[:, :m] > known_tangent).any())

    def raise_finer(self, eye_height_m: np.ndarray, tangent: np.ndarray) -> None:
        """Raise the tangents of the horizons of finer eyes (n, m) by those of the coarse eyes around them."""
        run_in_chunks(
            len(tangent), _raise_finer, self.low_m, self.high_m, self.low_tangent, self.high_tangent, *self.first_position,
            self.nodes_per_node, eye_height_m, tangent,
        )  # fmt: skip


def raise_by_far_ground(
    far: Sequence[FarHorizons], eyes: TurnedEyes, direction: Direction, curvature_per_m: float, tangent: np.ndarray
) -> None:
    """Raise the tangents of the horizons of a grid's eyes by the ground beyond the grid.

    ``far`` is that ground from fine to coarse; ``tangent`` (n, runs * ``RUN``) holds the horizons by the grid's own ground.
    """
    if not far:
        return
    known = np.where(eyes.height_m < NO_EYE_M, tangent, np.float32(np.inf))[:, : eyes.cols]
    rises = []
    orientation = far[0].orientation
    grid_order = orientation.grid_order_view(known)
    factor = 1
    for part in far:
        lowest = node_ranges(grid_order, part.part.factor // factor, np.inf)[0]
        grid_order, factor = lowest, part.part.factor
        rises.append(part.march(direction, curvature_per_m, orientation.sun_aligned_view(lowest)))
    last = max((number for number, is_higher in enumerate(rises) if is_higher), default=-1)
    for finer, coarser in reversed(list(pairwise(far[: last + 1]))):
        coarser.raise_finer(finer.low_m, finer.low_tangent)
        coarser.raise_finer(finer.high_m, finer.high_tangent)
    if last >= 0:
        far[0].raise_finer(eyes.height_m[:, : eyes.cols], tangent)


def eye_ranges(eye_height_m: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest eye around each coarse node, float32; NaN around which there is none."""
    with np.errstate(invalid="ignore"):
        low = node_ranges(np.where(np.isfinite(eye_height_m), eye_height_m, np.float32(np.inf)), factor, np.inf)[0]
        high = node_ranges(np.where(np.isfinite(eye_height_m), eye_height_m, np.float32(-np.inf)), factor, -np.inf)[1]
    return np.where(np.isfinite(low), low, np.float32(np.nan)), np.where(np.isfinite(high), high, np.float32(np.nan))


def node_ranges(values: np.ndarray, factor: int, padding: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest of the values (rows, cols) within ``factor`` nodes of each coarse node.

    Coarse nodes are every ``factor`` nodes, from the first one to the last one or beyond. ``padding`` stands for missing values.
    """
    counts = [-(-(side - 1) // factor) + 1 for side in values.shape]
    padded = np.full([count * factor for count in counts], padding, np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    cells = padded.reshape(counts[0], factor, counts[1], factor)
    out = []
    for extreme in (np.minimum, np.maximum):
        cell = extreme.reduce(extreme.reduce(cells, axis=3), axis=1)
        with_row = cell.copy()
        extreme(cell[1:], cell[:-1], out=with_row[1:])
        node = with_row.copy()
        extreme(with_row[:, 1:], with_row[:, :-1], out=node[:, 1:])
        out.append(node)
    return out[0], out[1]


@compiled
def _raise_finer(
    first, last, low_m, high_m, low_tangent, high_tangent, first_row, first_col, nodes_per_node, eye_height_m, tangent
):
    """Raise the tangents of rows [first, last) of finer eyes (n, m) by those of coarse eyes (``FarHorizons``).

    The first finer eye is at coarse node (``first_row``, ``first_col``).
    """
    rows, cols = low_m.shape
    for row in range(first, last):
        y = first_row + row * nodes_per_node
        i = max(min(int(np.floor(y)), rows - 2), 0)
        down = np.float32(y - i) if rows > 1 else np.float32(0.0)
        for col in range(eye_height_m.shape[1]):
            x = first_col + col * nodes_per_node
            j = max(min(int(np.floor(x)), cols - 2), 0)
            right = np.float32(x - j) if cols > 1 else np.float32(0.0)
            eye_m, total = eye_height_m[row, col], np.float32(0.0)
            for corner in range(4):
                r, c = min(i + (corner >> 1), rows - 1), min(j + (corner & 1), cols - 1)
                weight = (down if corner >> 1 else np.float32(1.0) - down) * (right if corner & 1 else np.float32(1.0) - right)
                low, high = low_m[r, c], high_m[r, c]
                height_share = (
                    min(max((eye_m - low) / (high - low), np.float32(0.0)), np.float32(1.0)) if high > low else np.float32(0.0)
                )
                total += weight * (low_tangent[r, c] + height_share * (high_tangent[r, c] - low_tangent[r, c]))
            tangent[row, col] = max(tangent[row, col], total)
