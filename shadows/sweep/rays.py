"""The sun's rays over a map grid: their positions on the grid, and the ground between the sun and a view."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import numpy as np

from skugga.shadows.sweep.grid import (
    HIGHER_DIAGONALS,
    NO_RAY_HEIGHTS,
    GridOrientation,
    Window,
    allocate_bordered_grid,
    close_border,
    copy_into,
    orientation_towards,
    position_cubics,
)
from skugga.shadows.sweep.lines import TurnedGrid
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_nodes
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.light_space import LightSpace
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import HeightWindow, NodeHeights
from skugga.terrain.scene import Scene

FIT_POINTS = 256
"""Number of points whose positions are computed exactly, to fit polynomials that give the positions of all others."""

FIT_TOLERANCE_NODES = 0.01
"""Tolerance of fitted positions on the grid, in nodes. A ray's position across the lines (t) is always exact."""

RANK_TOLERANCE = 1e-9
"""Relative size of a pivot of the fit's QR decomposition below which the terms count as linearly dependent."""

RAY_DIRECTION_TOLERANCE = 0.05
"""Tolerance in columns per row for the direction of rays.

On the round earth, rays that shift to the right at one position of a grid may shift to the left at another one, by at most this.
"""


@dataclass(frozen=True, eq=False)
class SunRays:
    """The sun's rays over a grid, and the coordinates in which a sweep uses them.

    t is the position across the rays, in cells. The ray height is the coordinate at right angles to the rays, in the vertical plane
    of the sun. The turned grid is rotated and mirrored so that the sun stands before row 0.

    Attributes
    ----------
    scene
        The scene.
    light
        Light space, rotated about the sun's direction until its right axis is horizontal at the reference position.
    grid
        The map grid at full detail.
    orientation
        How the grid is turned.
    height_m
        Metres: the mean height of the ground, for which the rays' positions on the grid are computed.
    right_m
        Metres: light space's right coordinate at t = 0.
    cell_m
        Metres of light space's right axis per unit of t; negative where columns of the turned grid run to the left.
    up_m
        Metres: light space's up coordinate at ray height 0.
    ray_height_per_metre
        Change of the ray height per metre of height.
    columns_per_row
        Columns of the turned grid by which rays shift to the right per row, at the reference position.
    """

    scene: Scene
    light: LightSpace
    grid: Grid
    orientation: GridOrientation
    height_m: float
    right_m: float
    cell_m: float
    up_m: float
    ray_height_per_metre: float
    columns_per_row: float

    def ray_coordinates(
        self, point_frame_m: np.ndarray, frame: LocalFrame, which: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return t, ray heights and metres towards the sun of some points of a frame, (n,) each.

        ``point_frame_m`` is (..., 3) metres, and ``which`` (n,) holds flat indices of the points.
        """
        out = np.empty((3, len(which)))
        run_in_chunks(
            len(which), _write_ray_coordinates, point_frame_m.reshape(-1, 3), which, *self.light.transform_from_frame(frame),
            self.right_m,
            self.cell_m, self.up_m, out,
        )  # fmt: skip
        return out[0], out[1], out[2]

    def rows_and_columns(self, point_frame_m: np.ndarray, frame: LocalFrame, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fractional rows and columns on the grid of some points of a frame, (n,) each.

        ``point_frame_m`` is (..., 3) metres, and ``which`` (n,) holds flat indices of the points. The results are accurate to
        ``FIT_TOLERANCE_NODES``. For many points, cubics are fitted to the exact positions of a few, because PROJ takes a
        microsecond per point.
        """
        points = point_frame_m.reshape(-1, 3)
        if len(which) <= 2 * FIT_POINTS:
            return self._exact_rows_and_columns(points[which], frame)
        fit_points = points[which[np.linspace(0, len(which) - 1, FIT_POINTS).astype(int)]]
        exact = np.stack(self._exact_rows_and_columns(fit_points, frame), axis=1)
        middle, scale = fit_points.mean(axis=0), max(float(np.abs(fit_points - fit_points.mean(axis=0)).max()), 1.0)
        factors = _fit_factors(_cubic_terms((fit_points - middle) / scale), exact)
        approximate = _apply_fit(fit_points, np.arange(FIT_POINTS), middle, scale, factors)
        if not np.abs(np.stack(approximate, axis=1) - exact).max() <= FIT_TOLERANCE_NODES:
            return self._exact_rows_and_columns(points[which], frame)
        return _apply_fit(points, which, middle, scale, factors)

    def _exact_rows_and_columns(self, point_frame_m: np.ndarray, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        x, y, _ = self.scene.world.map_position(self.grid.crs, frame.points_to_earth(point_frame_m))
        return self.grid.row(y), self.grid.col(x)

    def turned(self, values: np.ndarray) -> np.ndarray:
        """Return values (rows, cols) float32 of the grid's nodes as a turned grid with border columns."""
        with_border, inside = allocate_bordered_grid(*(values.shape[::-1] if self.orientation.swapped else values.shape))
        copy_into(values, self.orientation.restored(inside))
        return close_border(with_border)

    def turned_window(self, row: int, col: int, shape: tuple[int, int], rows: int, cols: int) -> Window:
        """Return the rows and columns of the turned grid that a window of a grid becomes.

        The window starts at ``row`` and ``col`` of a grid with ``rows`` rows and ``cols`` columns, and has the given shape.
        """
        ends = self.orientation.to_turned(np.array([row, row + shape[0] - 1]), np.array([col, col + shape[1] - 1]), rows, cols)
        (top, bottom), (left, right) = ((int(axis.min()), int(axis.max()) + 1) for axis in ends)
        return (top, bottom), (left, right)

    def window_cubics(self, detail: int, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return ``position_cubics`` for a window of the grid at a level of detail.

        The grid at this level has every 2**detail-th node. ``row0`` and ``col0`` are the window's first row and column on it.
        """
        grid = self.grid.coarser(detail)

        def t_of(i: np.ndarray, j: np.ndarray) -> np.ndarray:
            row, col = self.orientation.from_turned(i, j, rows, cols)
            point, up = self.scene.world.points_at_zero_height(grid.crs, grid.x(col + col0), grid.y(row + row0))
            return (self.light.points_from_earth(point + self.height_m * up)[..., 0] - self.right_m) / (self.cell_m * 2**detail)

        return position_cubics(t_of, *((cols, rows) if self.orientation.swapped else (rows, cols)), self.grid.crs.name)

    def write_ray_heights(self, detail: int, windows: list[NodeHeights], out: list[np.ndarray]) -> None:
        """Write the ray heights of windows of nodes, metres, to ``out``: one array (rows, cols) float32 for each window."""
        up = self.light.light_from_earth[1]
        self.scene.surface(self.grid.coarser(detail)).write_axis_coordinates(
            up, self.light.origin_earth_m + self.up_m * up, windows, out
        )

    def write_towards(self, detail: int, windows: list[NodeHeights], out: list[np.ndarray]) -> None:
        """Write the metres towards the sun of windows of nodes to ``out``: one array (rows, cols) float32 for each window."""
        towards = -self.light.light_from_earth[2]
        self.scene.surface(self.grid.coarser(detail)).write_axis_coordinates(towards, self.light.origin_earth_m, windows, out)


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
    column_right_m = (per_row if orientation.swapped else per_col)[0]
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


@dataclass(frozen=True, eq=False)
class GroundWindow:
    """A window (rows, cols) of a grid at one level of detail, turned for the sweep.

    Attributes
    ----------
    detail
        Level of detail: every 2**detail-th node of the finest grid.
    row0, col0
        Row and column of the window's first node, on the grid at this level of detail.
    shape
        Rows and columns of the window before turning.
    turned_grid
        The ray heights on the turned grid, and the positions of its lines.
    towards_m
        float32, turned and with borders: metres of the nodes towards the sun; empty unless the sun is a disc.
    first_ground_row
        First turned row that may hold ground.
    """

    detail: int
    row0: int
    col0: int
    shape: tuple[int, int]
    turned_grid: TurnedGrid
    towards_m: np.ndarray
    first_ground_row: int = 0

    def with_raised_sun(self, angle_rad: float) -> TurnedGrid:
        """Return the turned grid for a sun that is higher by ``angle_rad``. Angles other than 0 need ``towards_m``."""
        if angle_rad == 0.0:
            return self.turned_grid
        ray_height = np.float32(np.cos(angle_rad)) * self.turned_grid.ray_height - np.float32(np.sin(angle_rad)) * self.towards_m
        return self.turned_grid._replace(ray_height=ray_height)


def grounds_of_block(
    rays: SunRays, block: NodeHeights, patches: Iterable[Patch], soft_edges: bool, culled: Collection[Patch] = ()
) -> list[GroundWindow]:
    """Return the ground that casts shadows on a map's block, by level of detail: the coarsest first, the block's own last.

    ``soft_edges`` tells whether to compute ``GroundWindow.towards_m``. The heights of ``culled`` patches are not read, since they
    cast no shadow on the block.
    """
    patches = [patch for patch in patches if not (patch.lod and _lies_behind(rays, patch, block))]
    grounds: list[GroundWindow] = []
    for detail in sorted({0, *(patch.lod for patch in patches)}, reverse=True):
        surface = rays.scene.surface(rays.grid.coarser(detail))
        detail_patches = [patch for patch in patches if patch.lod == detail]
        casting = [patch for patch in detail_patches if patch not in culled and not _lies_behind(rays, patch, block)]
        windows = [surface.height_window(*window, includes_rim=True) for window in patch_windows(casting)]
        if detail and not windows and not grounds:
            continue  # no ray heights to pass on
        grounds.append(_ground(rays, detail, windows if detail else [block, *windows], soft_edges, detail_patches))
    return grounds


def patch_windows(patches: list[Patch]) -> list[tuple[int, int, int, int]]:
    """Return windows of nodes that cover exactly some patches, each as first row, first column, number of rows and of columns.

    Adjacent patches that form a rectangle are merged into one window.
    """
    runs: dict[tuple[int, int], list[int]] = {}  # first and last column of adjacent patches -> first and last row with them
    windows = []
    rows: dict[int, list[int]] = {}
    for row, col in sorted((patch.row, patch.col) for patch in patches):
        rows.setdefault(row, []).append(col)
    end_row = max(rows, default=0) + 1
    for row, cols in [*rows.items(), (end_row, [])]:
        breaks = np.flatnonzero(np.diff(cols) > 1) + 1
        row_runs = {(int(run[0]), int(run[-1])) for run in np.split(np.array(cols), breaks) if len(run)}
        for run in [run for run, (_, last) in runs.items() if run not in row_runs or last + 1 != row]:
            first, last = runs.pop(run)
            windows.append((first, run[0], last - first + 1, run[1] - run[0] + 1))
        for run in row_runs:
            runs[run] = [runs[run][0] if run in runs else row, row]
    return [
        (row * PATCH_QUADS, col * PATCH_QUADS, down * PATCH_QUADS + 1, right * PATCH_QUADS + 1)
        for row, col, down, right in sorted(windows)
    ]


def _lies_behind(rays: SunRays, patch: Patch, block: NodeHeights) -> bool:
    """Return whether a patch lies behind a block, as seen from the sun, and casts no shadow on it.

    On the turned grid the rays lead down and to the right. If they lead almost straight down, some may lead to the left. This is
    considered for patches at full detail only: a coarser patch takes part only if it lies towards the sun.
    """
    side = PATCH_QUADS * 2**patch.lod
    rows, cols = block.shape
    i, j = rays.orientation.to_turned(np.array([0, side]) + patch.row * side, np.array([0, side]) + patch.col * side, 0, 0)
    block_i, block_j = rays.orientation.to_turned(np.array([0, rows - 1]) + block.row0, np.array([0, cols - 1]) + block.col0, 0, 0)
    lean = patch.lod == 0 and rays.columns_per_row < RAY_DIRECTION_TOLERANCE
    return bool(i.min() >= block_i.max() or (j.min() >= block_j.max() and not lean))


@cached("light", 1024 * MIB)
def ground_of_view(scene: Scene, ground_mesh: GroundMesh, frame: LocalFrame, soft_edges: bool) -> tuple[SunRays, GroundWindow]:
    """Return the sun's rays over the ground of a perspective view, and this ground as a turned grid. The last result is cached.

    If the drawn ground is decimated (drawn with fewer nodes), all other nodes get values on the drawn triangles. Quads are then cut
    along the sides of these triangles.
    """
    nodes = ground_nodes(scene)
    rows, cols = nodes.height_m.shape
    rays = rays_at(scene, nodes.grid, nodes.row0 + (rows - 1) / 2, nodes.col0 + (cols - 1) / 2)
    if nodes.decimation_errors is None:
        return rays, _ground(
            rays, 0, [HeightWindow(nodes.row0, nodes.col0, nodes.height_m, np.isfinite(nodes.height_m))], soft_edges
        )
    row, col = (
        np.rint((ground_mesh.grid.y0 - ground_mesh.y) / ground_mesh.grid.step),
        np.rint((ground_mesh.x - ground_mesh.grid.x0) / ground_mesh.grid.step),
    )
    corner = np.stack([row - nodes.row0, col - nodes.col0], axis=1).astype(np.int32)
    _, ray_height_m, towards_m = rays.ray_coordinates(
        ground_mesh.position_frame_m, frame, np.arange(len(ground_mesh.position_frame_m))
    )
    ray_heights = rays.turned(_interpolate_on_triangles(corner, ray_height_m, ground_mesh.triangles, rows, cols))
    towards = (
        rays.turned(_interpolate_on_triangles(corner, towards_m, ground_mesh.triangles, rows, cols))
        if soft_edges
        else NO_RAY_HEIGHTS
    )
    is_cut_nw_se = np.pad(rays.orientation.turned_cuts(_falling_quads(corner, ground_mesh.triangles, rows, cols)), ((0, 0), (1, 1)))
    turned_grid = TurnedGrid(ray_heights, *rays.window_cubics(0, nodes.row0, nodes.col0, rows, cols), is_cut_nw_se)
    return rays, GroundWindow(0, nodes.row0, nodes.col0, (rows, cols), turned_grid, towards)


def _ground(
    rays: SunRays, detail: int, windows: list[NodeHeights], soft_edges: bool, patches: Iterable[Patch] = ()
) -> GroundWindow:
    """Return the ground of windows of heights as one turned grid.

    The grid also covers ``patches`` without heights, because the fitted positions of its lines depend on its size. Outside of the
    windows it holds no ground. ``soft_edges`` tells whether to compute ``GroundWindow.towards_m``.
    """
    starts = [(w.row0, w.col0) for w in windows] + [(p.row * PATCH_QUADS, p.col * PATCH_QUADS) for p in patches]
    ends = [(w.row0 + w.shape[0], w.col0 + w.shape[1]) for w in windows]
    ends += [((p.row + 1) * PATCH_QUADS + 1, (p.col + 1) * PATCH_QUADS + 1) for p in patches]
    row0, col0 = (min(axis) for axis in zip(*starts, strict=True))
    rows, cols = max(row for row, _ in ends) - row0, max(col for _, col in ends) - col0

    spans = [rays.turned_window(w.row0 - row0, w.col0 - col0, w.shape, rows, cols) for w in windows]
    first_ground_row = max(min((first for (first, _), _ in spans), default=rows) - 1, 0)
    # no row beside ``filled_rows`` is read
    filled_rows = (0, None) if soft_edges or detail else (first_ground_row, max(end for (_, end), _ in spans))

    def turned(put: Callable[[int, list[NodeHeights], list[np.ndarray]], None]) -> np.ndarray:
        with_border, inside = allocate_bordered_grid(
            *((cols, rows) if rays.orientation.swapped else (rows, cols)), slice(*filled_rows), *spans[:1]
        )
        grid_view = rays.orientation.restored(inside)
        if windows:
            put(detail, windows, [grid_view[w.row0 - row0 :, w.col0 - col0 :][: w.shape[0], : w.shape[1]] for w in windows])
        return close_border(with_border, slice(*filled_rows))

    turned_grid = TurnedGrid(turned(rays.write_ray_heights), *rays.window_cubics(detail, row0, col0, rows, cols), HIGHER_DIAGONALS)
    towards_m = turned(rays.write_towards) if soft_edges else NO_RAY_HEIGHTS
    return GroundWindow(detail, row0, col0, (rows, cols), turned_grid, towards_m, first_ground_row)


@compiled
def _interpolate_on_triangles(corner, value, triangles, rows, cols):
    """Interpolate values linearly on triangles, at all nodes of a grid: float32 (rows, cols), NaN outside of the triangles.

    ``corner`` int (n, 2) holds the row and column of each corner, which is a node, and ``value`` (n,) its value. ``triangles``
    (m, 3) holds indices of corners.
    """
    out = np.full((rows, cols), np.nan, np.float32)
    for n in range(len(triangles)):
        a, b, c = corner[triangles[n, 0]], corner[triangles[n, 1]], corner[triangles[n, 2]]
        v0, v1, v2 = value[triangles[n, 0]], value[triangles[n, 1]], value[triangles[n, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        for row in range(min(a[0], b[0], c[0]), max(a[0], b[0], c[0]) + 1):
            for col in range(min(a[1], b[1], c[1]), max(a[1], b[1], c[1]) + 1):
                v = ((row - a[0]) * (c[1] - a[1]) - (col - a[1]) * (c[0] - a[0])) / area
                w = ((b[0] - a[0]) * (col - a[1]) - (b[1] - a[1]) * (row - a[0])) / area
                if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
                    out[row, col] = v0 + v * (v1 - v0) + w * (v2 - v0)
    return out


@compiled
def _falling_quads(corner, triangles, rows, cols):
    """Return which quads a triangle's side cuts from north-west to south-east: bool (rows - 1, cols - 1).

    ``corner`` and ``triangles`` are those of ``_interpolate_on_triangles``. A quad without a cut is planar.
    """
    is_falling = np.zeros((rows - 1, cols - 1), np.bool_)
    for n in range(len(triangles)):
        for k in range(3):
            start, end = corner[triangles[n, k]], corner[triangles[n, (k + 1) % 3]]
            if end[0] - start[0] == end[1] - start[1]:
                for step in range(abs(end[0] - start[0])):
                    is_falling[min(start[0], end[0]) + step, min(start[1], end[1]) + step] = True
    return is_falling


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
    points: np.ndarray, which: np.ndarray, middle: np.ndarray, scale: float, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the two fitted values, (n,) each, of the points (m, 3) with indices ``which`` (n,).

    They are the polynomial terms of the points, relative to ``middle`` and divided by ``scale``, times ``factors`` (13, 2).
    """
    out = np.empty((2, len(which)))
    run_in_chunks(len(which), _sum_of_terms, points, which, middle, scale, factors, out)
    return out[0], out[1]


@compiled
def _sum_of_terms(first, last, points, which, middle, scale, factors, out):
    for n in range(first, last):
        p = points[which[n]]
        x, y, z = (p[0] - middle[0]) / scale, (p[1] - middle[1]) / scale, (p[2] - middle[2]) / scale
        terms = (1.0, x, y, z, x * x, x * y, y * y, x * z, y * z, x * x * x, x * x * y, x * y * y, y * y * y)
        a = b = 0.0
        for k in range(13):
            a += terms[k] * factors[k, 0]
            b += terms[k] * factors[k, 1]
        out[0, n], out[1, n] = a, b


@compiled
def _write_ray_coordinates(first, last, points, which, rotation, translation, right0_m, cell_m, up0_m, out):
    """Write t, ray height and metres towards the sun of the points (m, 3) with indices ``which`` (n,) to ``out`` (3, n)."""
    for n in range(first, last):
        p = points[which[n]]
        right = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        up = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        away_from_sun = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        out[0, n], out[1, n], out[2, n] = (right - right0_m) / cell_m, up - up0_m, -away_from_sun
