"""The sun's rays over a map grid: where they run, and which ground they pass on the way to a view."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import numpy as np

from skugga.shadows.sweep.grid import (
    HIGHER_DIAGONALS,
    NO_LEVELS,
    GridOrientation,
    Window,
    bordered,
    close_border,
    copy_into,
    orientation_towards,
    position_cubics,
)
from skugga.shadows.sweep.lines import TurnedGrid
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.reach import PATCH_QUADS, Patch
from skugga.terrain.compiled import compiled, in_shares
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_nodes
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.light_space import LightSpace
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import HeightWindow, NodeHeights
from skugga.terrain.scene import Scene

FITTED_POINTS = 256
"""Points whose places are computed exactly, and that the places of more are fitted to."""

FITTED_NODES = 0.01
"""How far, in nodes, fitted places may lie beside the exact ones. What a ray passes is found by its t, which is never fitted."""

SAME_TERM = 1e-9
"""Share of the largest part that a term has of its own by which the fit's smallest counts as none."""

LEAN = 0.05
"""Columns by which rays that run to the right at one place of a view may run to the left at another: the earth is round."""


@dataclass(frozen=True, eq=False)
class SunRays:
    """Rays over a grid. A place's t is its coordinate to the right in ``light``, less ``right_m``, in cells of ``cell_m`` (negative
    where columns of the turned grid run to the left); its level is the one up, less ``level_m``; ``rise`` is what a metre of height
    adds to it. ``height_m`` is the ground's middling height, for which the rays' places on the grid are computed. ``aside`` is by
    how many columns of the turned grid rays run to the right from row to row, at the place that they are computed for.
    """

    scene: Scene
    light: LightSpace
    grid: Grid
    turn: GridOrientation
    height_m: float
    right_m: float
    cell_m: float
    level_m: float
    rise: float
    aside: float

    def t_level_towards(
        self, point_frame_m: np.ndarray, frame: LocalFrame, which: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """t, levels, and metres towards the sun (n,) of those points (..., 3) of a frame that have some numbers (n,)."""
        out = np.empty((3, len(which)))
        in_shares(
            len(which), _in_rays, point_frame_m.reshape(-1, 3), which, *self.light.from_frame(frame), self.right_m, self.cell_m,
            self.level_m, out,
        )  # fmt: skip
        return out[0], out[1], out[2]

    def rows_and_columns(self, point_frame_m: np.ndarray, frame: LocalFrame, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (n,) on the grid, right to ``FITTED_NODES``, of those points (..., 3) of a frame that have some numbers
        (n,).

        Of many points most are placed by cubics that are fitted to some: PROJ takes a microsecond for each.
        """
        points = point_frame_m.reshape(-1, 3)
        if len(which) <= 2 * FITTED_POINTS:
            return self._exact_rows_and_columns(points[which], frame)
        fit_points = points[which[np.linspace(0, len(which) - 1, FITTED_POINTS).astype(int)]]
        exact = np.stack(self._exact_rows_and_columns(fit_points, frame), axis=1)
        middle, scale = fit_points.mean(axis=0), max(float(np.abs(fit_points - fit_points.mean(axis=0)).max()), 1.0)
        known = _fitted(_cubic_terms((fit_points - middle) / scale), exact)
        approximate = _placed(fit_points, np.arange(FITTED_POINTS), middle, scale, known)
        if not np.abs(np.stack(approximate, axis=1) - exact).max() <= FITTED_NODES:
            return self._exact_rows_and_columns(points[which], frame)
        return _placed(points, which, middle, scale, known)

    def _exact_rows_and_columns(self, point_frame_m: np.ndarray, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
        x, y, _ = self.scene.world.map_position(self.grid.crs, frame.points_to_earth(point_frame_m))
        return self.grid.row(y), self.grid.col(x)

    def turned(self, values: np.ndarray) -> np.ndarray:
        """Values (rows, cols) float32 of the grid's nodes in the turned grid's order, between borders."""
        with_border, inside = bordered(*(values.shape[::-1] if self.turn.swapped else values.shape))
        copy_into(values, self.turn.back(inside))
        return close_border(with_border)

    def turned_window(self, row: int, col: int, shape: tuple[int, int], rows: int, cols: int) -> Window:
        """The rows and columns of the turned grid in which a window of a grid (rows, cols) lies."""
        ends = self.turn.onto(np.array([row, row + shape[0] - 1]), np.array([col, col + shape[1] - 1]), rows, cols)
        (top, bottom), (left, right) = ((int(axis.min()), int(axis.max()) + 1) for axis in ends)
        return (top, bottom), (left, right)

    def places(self, detail: int, row0: int, col0: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
        """``sweep_grid.places`` of a window of the grid of every 2**detail-th node."""
        grid = self.grid.coarser(detail)

        def t_of(i: np.ndarray, j: np.ndarray) -> np.ndarray:
            row, col = self.turn.origin(i, j, rows, cols)
            point, up = self.scene.world.ground(grid.crs, grid.x(col + col0), grid.y(row + row0))
            return (self.light.from_earth(point + self.height_m * up)[..., 0] - self.right_m) / (self.cell_m * 2**detail)

        return position_cubics(t_of, *((cols, rows) if self.turn.swapped else (rows, cols)), self.grid.crs.name)

    def put_levels(self, detail: int, windows: list[NodeHeights], out: list[np.ndarray]) -> None:
        """Put the levels of windows' nodes into arrays (rows, cols) float32."""
        up = self.light.light_from_earth[1]
        self.scene.surface(self.grid.coarser(detail)).along(up, self.light.origin_earth_m + self.level_m * up, windows, out)

    def put_towards(self, detail: int, windows: list[NodeHeights], out: list[np.ndarray]) -> None:
        """Put how far towards the sun windows' nodes lie, metres, into arrays (rows, cols) float32."""
        towards = -self.light.light_from_earth[2]
        self.scene.surface(self.grid.coarser(detail)).along(towards, self.light.origin_earth_m, windows, out)


def rays_over(scene: Scene, grid: Grid, row: float, col: float) -> SunRays:
    """The rays over a grid round one of its places."""
    height_m = float(np.mean(scene.height_range_m))
    cells = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], float) + (row, col)
    point, up = scene.world.ground(grid.crs, grid.x(cells[:, 1]), grid.y(cells[:, 0]))
    assert scene.light is not None
    light = upright(scene.light, up[0])
    space = light.from_earth(point + height_m * up)
    per_row, per_col = (space[2] - space[1]) / 2.0, (space[4] - space[3]) / 2.0
    towards = np.array([per_col[0], -per_row[0]])  # along it, nothing moves to the right
    towards *= np.sign(light.towards_sun_m(towards[0] * per_row + towards[1] * per_col)) or 1.0
    turn = orientation_towards(*towards)
    across = (per_row if turn.swapped else per_col)[0]
    return SunRays(
        scene, light, grid, turn, height_m, float(space[0, 0]), float(-across if turn.cols_reversed else across),
        float(space[0, 1]), float(light.light_from_earth[1] @ up[0]), float(np.abs(towards).min() / np.abs(towards).max()),
    )  # fmt: skip


def upright(light: LightSpace, up: np.ndarray) -> LightSpace:
    """The light space turned about the sun's direction until right is horizontal, and up not downwards, where ``up`` (3,) is up.

    The level's own is so at its anchor. Elsewhere ground that is higher would stand aside of the rays that pass over its foot.
    """
    right, forward, away = light.light_from_earth
    aside, rise = right @ up, forward @ up
    cosine, sine = (rise, -aside) / np.hypot(aside, rise) if aside or rise else (1.0, 0.0)
    axes = np.array([cosine * right + sine * forward, cosine * forward - sine * right, away])
    return LightSpace(axes, light.origin_earth_m, float(np.degrees(np.arcsin(np.clip(-away @ up, -1.0, 1.0)))))


@dataclass(frozen=True, eq=False)
class GroundWindow:
    """A window (rows, cols) of the grid of every 2**detail-th node, from ``row0`` and ``col0`` on: its turned sheet, and how far
    its nodes lie towards the sun, float32, turned and bordered likewise (empty where nobody asked). Before the turned row ``begin``
    there is no ground.
    """

    detail: int
    row0: int
    col0: int
    shape: tuple[int, int]
    sheet: TurnedGrid
    towards_m: np.ndarray
    begin: int = 0

    def tilted(self, angle: float) -> TurnedGrid:
        """The sheet for a sun that stands higher by an angle, radians."""
        if angle == 0.0:
            return self.sheet
        level = np.float32(np.cos(angle)) * self.sheet.level - np.float32(np.sin(angle)) * self.towards_m
        return self.sheet._replace(level=level)


def grounds_of_block(
    rays: SunRays, block: NodeHeights, patches: Iterable[Patch], soft: bool, idle: Collection[Patch] = ()
) -> list[GroundWindow]:
    """The ground that casts on a map's block, by detail: the coarsest first, its own last. ``soft``: with ``towards_m``. Patches
    that are ``idle`` throw no shadow on it, and are not read.
    """
    patches = [patch for patch in patches if not (patch.level and _lies_behind(rays, patch, block))]
    grounds: list[GroundWindow] = []
    for detail in sorted({0, *(patch.level for patch in patches)}, reverse=True):
        surface = rays.scene.surface(rays.grid.coarser(detail))
        there = [patch for patch in patches if patch.level == detail]
        before = [patch for patch in there if patch not in idle and not _lies_behind(rays, patch, block)]
        windows = [surface.height_window(*window) for window in patch_windows(before)]
        if detail and not windows and not grounds:
            continue  # nothing is handed over
        grounds.append(_ground(rays, detail, windows if detail else [block, *windows], soft, there))
    return grounds


def patch_windows(patches: list[Patch]) -> list[tuple[int, int, int, int]]:
    """Windows of nodes, first row and column and size, that cover patches in rows and columns of them, and nothing else."""
    runs: dict[tuple[int, int], list[int]] = {}  # first and last column of runs -> first and last row
    windows = []
    rows: dict[int, list[int]] = {}
    for row, col in sorted((patch.row, patch.col) for patch in patches):
        rows.setdefault(row, []).append(col)
    beyond = max(rows, default=0) + 1
    for row, cols in [*rows.items(), (beyond, [])]:
        breaks = np.flatnonzero(np.diff(cols) > 1) + 1
        here = {(int(run[0]), int(run[-1])) for run in np.split(np.array(cols), breaks) if len(run)}
        for run in [run for run, (_, last) in runs.items() if run not in here or last + 1 != row]:
            first, last = runs.pop(run)
            windows.append((first, run[0], last - first + 1, run[1] - run[0] + 1))
        for run in here:
            runs[run] = [runs[run][0] if run in runs else row, row]
    return [
        (row * PATCH_QUADS, col * PATCH_QUADS, down * PATCH_QUADS + 1, right * PATCH_QUADS + 1)
        for row, col, down, right in sorted(windows)
    ]


def _lies_behind(rays: SunRays, patch: Patch, block: NodeHeights) -> bool:
    """Whether the lines pass a patch, which lies beside a block, after the block if at all: on the turned grid they run down and to
    the right, but for some that may lean to the left where all run nearly straight down. Those a coarse patch does without: what it
    hands over has to lie towards the sun.
    """
    side = PATCH_QUADS * 2**patch.level
    rows, cols = block.shape
    i, j = rays.turn.onto(np.array([0, side]) + patch.row * side, np.array([0, side]) + patch.col * side, 0, 0)
    block_i, block_j = rays.turn.onto(np.array([0, rows - 1]) + block.row0, np.array([0, cols - 1]) + block.col0, 0, 0)
    lean = patch.level == 0 and rays.aside < LEAN
    return bool(i.min() >= block_i.max() or (j.min() >= block_j.max() and not lean))


@cached("light", 1024 * MIB)
def ground_of_level(scene: Scene, drawn: GroundMesh, frame: LocalFrame, soft: bool) -> tuple[SunRays, GroundWindow]:
    """The ground that a perspective view draws, on its grid's nodes, and the rays over it; the last one is kept.

    Where the drawn ground leaves out nodes, these lie on the triangles that are drawn, which cut across the bent earth, and quads
    are cut as the triangles' sides cut them.
    """
    nodes = ground_nodes(scene)
    rows, cols = nodes.height_m.shape
    rays = rays_over(scene, nodes.grid, nodes.row0 + (rows - 1) / 2, nodes.col0 + (cols - 1) / 2)
    if nodes.errors is None:
        return rays, _ground(rays, 0, [HeightWindow(nodes.row0, nodes.col0, nodes.height_m, np.isfinite(nodes.height_m))], soft)
    row, col = np.rint((drawn.grid.y0 - drawn.y) / drawn.grid.step), np.rint((drawn.x - drawn.grid.x0) / drawn.grid.step)
    corner = np.stack([row - nodes.row0, col - nodes.col0], axis=1).astype(np.int32)
    _, level_m, towards_m = rays.t_level_towards(drawn.position_frame_m, frame, np.arange(len(drawn.position_frame_m)))
    levels = rays.turned(_on_triangles(corner, level_m, drawn.triangles, rows, cols))
    towards = rays.turned(_on_triangles(corner, towards_m, drawn.triangles, rows, cols)) if soft else NO_LEVELS
    falls = np.pad(rays.turn.turned_cuts(_falling_quads(corner, drawn.triangles, rows, cols)), ((0, 0), (1, 1)))
    sheet = TurnedGrid(levels, *rays.places(0, nodes.row0, nodes.col0, rows, cols), falls)
    return rays, GroundWindow(0, nodes.row0, nodes.col0, (rows, cols), sheet, towards)


def _ground(rays: SunRays, detail: int, windows: list[NodeHeights], soft: bool, patches: Iterable[Patch] = ()) -> GroundWindow:
    """One sheet over windows of heights, as large as if ``patches`` were among them: the lines' places hang on that. Where there is
    no window, there is no ground.
    """
    starts = [(w.row0, w.col0) for w in windows] + [(p.row * PATCH_QUADS, p.col * PATCH_QUADS) for p in patches]
    ends = [(w.row0 + w.shape[0], w.col0 + w.shape[1]) for w in windows]
    ends += [((p.row + 1) * PATCH_QUADS + 1, (p.col + 1) * PATCH_QUADS + 1) for p in patches]
    row0, col0 = (min(axis) for axis in zip(*starts, strict=True))
    rows, cols = max(row for row, _ in ends) - row0, max(col for _, col in ends) - col0

    spans = [rays.turned_window(w.row0 - row0, w.col0 - col0, w.shape, rows, cols) for w in windows]
    begin = max(min((first for (first, _), _ in spans), default=rows) - 1, 0)
    known = (0, None) if soft or detail else (begin, max(end for (_, end), _ in spans))  # no row but these is looked at

    def turned(put: Callable[[int, list[NodeHeights], list[np.ndarray]], None]) -> np.ndarray:
        with_border, inside = bordered(*((cols, rows) if rays.turn.swapped else (rows, cols)), slice(*known), *spans[:1])
        own = rays.turn.back(inside)
        if windows:
            put(detail, windows, [own[w.row0 - row0 :, w.col0 - col0 :][: w.shape[0], : w.shape[1]] for w in windows])
        return close_border(with_border, slice(*known))

    sheet = TurnedGrid(turned(rays.put_levels), *rays.places(detail, row0, col0, rows, cols), HIGHER_DIAGONALS)
    towards_m = turned(rays.put_towards) if soft else NO_LEVELS
    return GroundWindow(detail, row0, col0, (rows, cols), sheet, towards_m, begin)


@compiled
def _on_triangles(corner, value, triangles, rows, cols):
    """Values (rows, cols) float32 of the nodes on triangles whose corners (row, column) are nodes with values (n,); NaN beside
    them.
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
    """Which quads (rows - 1, cols - 1) a triangle's side cuts from north-west to south-east; one that no side cuts is plane."""
    falls = np.zeros((rows - 1, cols - 1), np.bool_)
    for n in range(len(triangles)):
        for k in range(3):
            start, end = corner[triangles[n, k]], corner[triangles[n, (k + 1) % 3]]
            if end[0] - start[0] == end[1] - start[1]:
                for step in range(abs(end[0] - start[0])):
                    falls[min(start[0], end[0]) + step, min(start[1], end[1]) + step] = True
    return falls


def _cubic_terms(p: np.ndarray) -> np.ndarray:
    """Terms (n, 13) of points (n, 3): cubic along the ground, linear in height."""
    x, y, z = p.T
    return np.stack([np.ones_like(x), x, y, z, x * x, x * y, y * y, x * z, y * z, x**3, x * x * y, x * y * y, y**3], axis=1)


def _fitted(terms: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Factors (k, 2) by which terms (n, k) come nearest to values (n, 2)."""
    q, r = np.linalg.qr(terms)
    diagonal = np.abs(np.diagonal(r))
    if diagonal.min() > SAME_TERM * diagonal.max():
        return np.linalg.solve(r, q.T @ exact)
    return np.linalg.lstsq(terms, exact, rcond=None)[0]  # points of a plane: some terms say the same


def _placed(
    points: np.ndarray, which: np.ndarray, middle: np.ndarray, scale: float, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums of the terms of those points (m, 3) that have some numbers (n,) with two columns of factors (13, 2)."""
    out = np.empty((2, len(which)))
    in_shares(len(which), _sum_of_terms, points, which, middle, scale, known, out)
    return out[0], out[1]


@compiled
def _sum_of_terms(first, last, points, which, middle, scale, known, out):
    for n in range(first, last):
        p = points[which[n]]
        x, y, z = (p[0] - middle[0]) / scale, (p[1] - middle[1]) / scale, (p[2] - middle[2]) / scale
        terms = (1.0, x, y, z, x * x, x * y, y * y, x * z, y * z, x * x * x, x * x * y, x * y * y, y * y * y)
        a = b = 0.0
        for k in range(13):
            a += terms[k] * known[k, 0]
            b += terms[k] * known[k, 1]
        out[0, n], out[1, n] = a, b


@compiled
def _in_rays(first, last, points, which, rotation, translation, right_m, cell_m, level_m, out):
    """t, level and metres towards the sun of those points (m, 3) that have some numbers (n,)."""
    for n in range(first, last):
        p = points[which[n]]
        right = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        up = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        away = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        out[0, n], out[1, n], out[2, n] = (right - right_m) / cell_m, up - level_m, -away
