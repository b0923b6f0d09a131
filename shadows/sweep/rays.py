"""The sun's rays over a map grid: their positions on the grid, and the coordinates in which a sweep uses them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.sweep.grid import GridWindow, allocate_bordered_grid, close_border
from skugga.shadows.sweep.orientation import GridOrientation, copy_values, orientation_towards
from skugga.shadows.sweep.position_cubics import position_cubics
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.light_space import LightSpace
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import NodeHeights
from skugga.terrain.scene import Scene

FIT_POINTS = 256
"""Number of points whose positions are computed exactly, to fit polynomials that give the positions of all others."""

FIT_TOLERANCE_NODES = 0.01
"""Tolerance of fitted positions on the grid, in nodes. A ray's position across the lines (t) is always exact."""

RANK_TOLERANCE = 1e-9
"""Relative size of a pivot of the fit's QR decomposition below which the terms count as linearly dependent."""


@dataclass(frozen=True, eq=False)
class SunRays:
    """The sun's rays over a grid, and the coordinates in which a sweep uses them.

    t is the position across the rays, in cells. The ray height is the coordinate at right angles to the rays, in the vertical plane
    of the sun. The sun-aligned grid is rotated and mirrored so that the sun stands before row 0.

    Attributes
    ----------
    scene
        The scene.
    light
        Light space, rotated about the sun's direction until its right axis is horizontal at the reference position.
    grid
        The map grid at full detail.
    orientation
        How the grid is turned to become the sun-aligned grid.
    mean_height_m
        Metres: the mean height of the ground, for which the rays' positions on the grid are computed.
    right_origin_m
        Metres: light space's right coordinate at t = 0.
    right_m_per_cell
        Metres of light space's right axis per unit of t; negative where columns of the sun-aligned grid run to the left.
    up_origin_m
        Metres: light space's up coordinate at ray height 0.
    ray_height_per_metre
        Change of the ray height per metre of height.
    columns_per_row
        Columns of the sun-aligned grid by which rays shift to the right per row, at the reference position.
    """

    scene: Scene
    light: LightSpace
    grid: Grid
    orientation: GridOrientation
    mean_height_m: float
    right_origin_m: float
    right_m_per_cell: float
    up_origin_m: float
    ray_height_per_metre: float
    columns_per_row: float

    def ray_coordinates(
        self, point_frame_m: np.ndarray, frame: LocalFrame, point_indices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return t and ray heights of some points of a frame, (n,) each.

        ``point_frame_m`` is (..., 3) metres, and ``point_indices`` (n,) holds flat indices of the points.
        """
        out = np.empty((2, len(point_indices)))
        run_in_chunks(
            len(point_indices), _write_ray_coordinates, point_frame_m.reshape(-1, 3), point_indices,
            *self.light.transform_from_frame(frame), self.right_origin_m, self.right_m_per_cell, self.up_origin_m, out,
        )  # fmt: skip
        return out[0], out[1]

    def rows_and_columns(
        self, point_frame_m: np.ndarray, frame: LocalFrame, point_indices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the fractional rows and columns on the grid of some points of a frame, (n,) each.

        ``point_frame_m`` is (..., 3) metres, and ``point_indices`` (n,) holds flat indices of the points. The results are accurate
        to ``FIT_TOLERANCE_NODES``. For many points, cubics are fitted to the exact positions of a few, because PROJ takes a
        microsecond per point.
        """
        points = point_frame_m.reshape(-1, 3)
        if len(point_indices) <= 2 * FIT_POINTS:
            return self._exact_rows_and_columns(points[point_indices], frame)
        fit_points = points[point_indices[np.linspace(0, len(point_indices) - 1, FIT_POINTS).astype(int)]]
        exact = np.stack(self._exact_rows_and_columns(fit_points, frame), axis=1)
        middle, scale = fit_points.mean(axis=0), max(float(np.abs(fit_points - fit_points.mean(axis=0)).max()), 1.0)
        factors = _fit_factors(_cubic_terms((fit_points - middle) / scale), exact)
        approximate = _apply_fit(fit_points, np.arange(FIT_POINTS), middle, scale, factors)
        if not np.abs(np.stack(approximate, axis=1) - exact).max() <= FIT_TOLERANCE_NODES:
            return self._exact_rows_and_columns(points[point_indices], frame)
        return _apply_fit(points, point_indices, middle, scale, factors)

    def _exact_rows_and_columns(self, point_frame_m: np.ndarray, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and columns of points (n, 3), computed by PROJ."""
        x, y, _ = self.scene.world.map_position(self.grid.crs, frame.points_to_earth(point_frame_m))
        return self.grid.row(y), self.grid.col(x)

    def bordered_sun_aligned_copy(self, values: np.ndarray) -> np.ndarray:
        """Return values (rows, cols) float32 of the grid's nodes as a sun-aligned grid with border columns."""
        with_border, inside = allocate_bordered_grid(*(values.shape[::-1] if self.orientation.axes_swapped else values.shape))
        copy_values(values, self.orientation.grid_order_view(inside))
        return close_border(with_border)

    def sun_aligned_window(self, row: int, col: int, shape: tuple[int, int], rows: int, cols: int) -> GridWindow:
        """Return the rows and columns of the sun-aligned grid that a window of a grid becomes.

        The window starts at ``row`` and ``col`` of a grid with ``rows`` rows and ``cols`` columns, and has the given shape.
        """
        ends = self.orientation.to_sun_aligned(np.array([row, row + shape[0] - 1]), np.array([col, col + shape[1] - 1]), rows, cols)
        (top, bottom), (left, right) = ((int(axis.min()), int(axis.max()) + 1) for axis in ends)
        return (top, bottom), (left, right)

    def window_cubics(self, lod: int, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return ``position_cubics`` for a window of the grid at a level of detail.

        The grid at this level has every 2**lod-th node. ``row0`` and ``col0`` are the window's first row and column on it.
        """
        grid = self.grid.coarser(lod)

        def t_of(i: np.ndarray, j: np.ndarray) -> np.ndarray:
            row, col = self.orientation.from_sun_aligned(i, j, rows, cols)
            point, up = self.scene.world.points_at_zero_height(grid.crs, grid.x(col + col0), grid.y(row + row0))
            return (self.light.points_from_earth(point + self.mean_height_m * up)[..., 0] - self.right_origin_m) / (
                self.right_m_per_cell * 2**lod
            )

        return position_cubics(t_of, *((cols, rows) if self.orientation.axes_swapped else (rows, cols)), self.grid.crs.name)

    def write_ray_heights(self, lod: int, windows: list[NodeHeights], out: list[np.ndarray]) -> None:
        """Write the ray heights of windows of nodes, metres, to ``out``: one array (rows, cols) float32 for each window."""
        up = self.light.light_from_earth[1]
        self.scene.surface(self.grid.coarser(lod)).write_axis_coordinates(
            up, self.light.origin_earth_m + self.up_origin_m * up, windows, out
        )


def rays_at(scene: Scene, grid: Grid, row: float, col: float) -> SunRays:
    """Return the sun's rays over a grid, with ``row`` and ``col`` as the reference position of their coordinates."""
    height_m = float(np.mean(scene.height_range_m))
    cells = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], float) + (row, col)
    point, up = scene.world.points_at_zero_height(grid.crs, grid.x(cells[:, 1]), grid.y(cells[:, 0]))
    assert scene.light_space is not None
    light = with_upright_axes(scene.light_space, up[0])
    space = light.points_from_earth(point + height_m * up)
    per_row, per_col = (space[2] - space[1]) / 2.0, (space[4] - space[3]) / 2.0
    towards = np.array([per_col[0], -per_row[0]])  # in this direction light space's right coordinate is constant
    towards *= np.sign(light.horizontal_sunward_m(towards[0] * per_row + towards[1] * per_col)) or 1.0
    orientation = orientation_towards(*towards)
    column_right_m = (per_row if orientation.axes_swapped else per_col)[0]
    return SunRays(
        scene, light, grid, orientation, height_m, float(space[0, 0]),
        float(-column_right_m if orientation.cols_reversed else column_right_m), float(space[0, 1]),
        float(light.light_from_earth[1] @ up[0]), float(np.abs(towards).min() / np.abs(towards).max()),
    )  # fmt: skip


def with_upright_axes(light: LightSpace, up: np.ndarray) -> LightSpace:
    """Return the light space, rotated about the sun's direction until its right axis is horizontal where the vertical is ``up``.

    Its up axis does not point down.

    The level's own light space has a horizontal right axis at the level's anchor only. Elsewhere a summit would have another t (the
    position across the rays) than the ground below it.
    """
    right, forward, away_from_sun = light.light_from_earth
    columns_per_row, ray_height_per_metre = right @ up, forward @ up
    cosine, sine = (
        (ray_height_per_metre, -columns_per_row) / np.hypot(columns_per_row, ray_height_per_metre)
        if columns_per_row or ray_height_per_metre
        else (1.0, 0.0)
    )
    axes = np.array([cosine * right + sine * forward, cosine * forward - sine * right, away_from_sun])
    return LightSpace(axes, light.origin_earth_m, float(np.degrees(np.arcsin(np.clip(-away_from_sun @ up, -1.0, 1.0)))))


def _cubic_terms(p: np.ndarray) -> np.ndarray:
    """Return the polynomial terms (n, 13) of points (n, 3): cubic in the first two coordinates, linear in the third one."""
    x, y, z = p.T
    return np.stack([np.ones_like(x), x, y, z, x * x, x * y, y * y, x * z, y * z, x**3, x * x * y, x * y * y, y**3], axis=1)


def _fit_factors(terms: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the least-squares factors (k, 2) that map terms (n, k) to values (n, 2)."""
    q, r = np.linalg.qr(terms)
    diagonal = np.abs(np.diagonal(r))
    if diagonal.min() > RANK_TOLERANCE * diagonal.max():
        return np.linalg.solve(r, q.T @ exact)
    return np.linalg.lstsq(terms, exact, rcond=None)[0]  # coplanar points: some terms depend on one another


def _apply_fit(
    points: np.ndarray, point_indices: np.ndarray, middle: np.ndarray, scale: float, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the two fitted values, (n,) each, of the points (m, 3) with indices ``point_indices`` (n,).

    They are the polynomial terms of the points, relative to ``middle`` and divided by ``scale``, times ``factors`` (13, 2).
    """
    out = np.empty((2, len(point_indices)))
    run_in_chunks(len(point_indices), _sum_of_terms, points, point_indices, middle, scale, factors, out)
    return out[0], out[1]


@compiled
def _sum_of_terms(first, last, points, point_indices, middle, scale, factors, out):
    """Write the two fitted values of the points ``point_indices[first:last]`` to ``out`` (2, n), as ``_apply_fit`` returns them."""
    for n in range(first, last):
        p = points[point_indices[n]]
        x, y, z = (p[0] - middle[0]) / scale, (p[1] - middle[1]) / scale, (p[2] - middle[2]) / scale
        terms = (1.0, x, y, z, x * x, x * y, y * y, x * z, y * z, x * x * x, x * x * y, x * y * y, y * y * y)
        a = b = 0.0
        for k in range(13):
            a += terms[k] * factors[k, 0]
            b += terms[k] * factors[k, 1]
        out[0, n], out[1, n] = a, b


@compiled
def _write_ray_coordinates(first, last, points, point_indices, rotation, translation, right0_m, cell_m, up0_m, out):
    """Write t and ray height of some points to ``out`` (2, n), for the indices n in [``first``, ``last``).

    The points are those of ``points`` (m, 3) with the indices ``point_indices`` (n,). ``rotation`` (3, 3) and ``translation`` (3,)
    transform them to light space: right, up and away from the sun, metres. ``right0_m`` and ``up0_m`` are the coordinates there of
    t = 0 and of ray height 0; ``cell_m`` is the size of a cell along the right axis.
    """
    for n in range(first, last):
        p = points[point_indices[n]]
        right = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        up = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        out[0, n], out[1, n] = (right - right0_m) / cell_m, up - up0_m
