"""What a map's pixels show of bare ground, whatever the sun: kept, so that another sun shades it anew and reads nothing.

A geometry buffer knows each pixel's triangle, which takes ten times as long. Ground that is shaded needs its height, its smooth
normal and its share of the sky. The numbers are those of a geometry buffer (``terrain.gbuffer.geometry``), for pixels on nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from terrain.cache import MIB, cached
from terrain.compiled import compiled
from terrain.gbuffer.geometry import normal_reach
from terrain.geo.grid import MapView
from terrain.geo.world import LocalFrame, World
from terrain.ground.elevation import Elevation
from terrain.ground.sky_view_factor import SkyView, cell_in_plane, hidden_on, in_plane, pyramid_level
from terrain.ground.surface import Surface, between_columns, between_rows, map_pixel_m, on_row
from terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class BareGround:
    """The ground in a map's pixels: ``there`` bool (rows, cols), where there is any. All else is of a ``window`` of the pixels,
    beside which there is none.

    ``height_m`` float32 (r, c); ``normal_frame`` float32 (r, c, 3), the smooth unit normal; ``sky_share`` float32 (r, c), how much
    of the sky is seen; all three mean something where there is ground.
    """

    view: MapView
    frame: LocalFrame
    there: np.ndarray
    window: tuple[slice, slice]
    height_m: np.ndarray
    normal_frame: np.ndarray
    sky_share: np.ndarray

    @property
    def window_view(self) -> MapView:
        """The window's pixels."""
        down, right = self.window
        return self.view.part(down.start, right.start, down.stop - down.start, right.stop - right.start)


def bare_ground(scene: Scene, view: MapView, sky: SkyView | None) -> BareGround | None:
    """The bare ground in the pixels of a map on its grid's nodes; its share of the sky with what ground hides of it, or without.

    ``None`` where ground is so narrow that it has no smooth normal.
    """
    return _bare_ground(scene.world, scene.elevation, view, sky)


def forget_ground_before(most: int) -> None:
    """Let go of the ground of all blocks but the ``most`` seen last: of a raster that is gone through once."""
    _bare_ground.cache.trim(most)


@cached("scene", 448 * MIB)
def _bare_ground(world: World, elevation: Elevation, view: MapView, sky: SkyView | None) -> BareGround | None:
    frame, surface = world.frame_near(view.grid.crs, *view.centre), Surface(world, elevation, view.grid)
    reach = normal_reach(surface)
    row0, col0 = int(view.row0) - reach, int(view.col0) - reach
    nodes = surface.height_window(row0, col0, view.rows + 2 * reach, view.cols + 2 * reach)
    height, shown = nodes.height_m, nodes.there
    own = shown[reach:-reach, reach:-reach]
    rows, cols = (np.flatnonzero(own.any(axis=axis)) for axis in (1, 0))
    there = np.zeros((view.rows, view.cols), np.bool_)
    if not len(rows):
        nothing = np.zeros((0, 0), np.float32)
        return BareGround(view, frame, there, (slice(0, 0), slice(0, 0)), nothing, np.zeros((0, 0, 3), np.float32), nothing)
    window = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)
    around = tuple(slice(side.start, side.stop + 2 * reach) for side in window)
    height, shown = np.ascontiguousarray(height[around]), np.ascontiguousarray(shown[around])
    row0, col0 = row0 + window[0].start, col0 + window[1].start
    exact, first_row, first_col = surface.exact_verticals(row0, col0, height.shape[0], height.shape[1], frame)
    across = np.stack(
        [between_columns(np.ascontiguousarray(exact[..., k]), first_col, surface.stride, col0, height.shape[1]) for k in range(6)]
    )
    normal, share, known, complete = _smooth_ground(
        across, first_row, surface.stride, row0, height, shown, reach,
        world.up_from(frame), None if sky is None else sky.finder.cells, *_finder_of(sky, frame, map_pixel_m(world, view)),
    )  # fmt: skip
    if not complete:
        return None
    there[window] = known
    return BareGround(view, frame, there, window, height[reach:-reach, reach:-reach].copy(), normal, share)


def _finder_of(sky: SkyView | None, frame: LocalFrame, pixel_m: float) -> tuple[Any, ...]:
    """What the loop below needs of a ``SkyView``, its lattice apart: numba compiles it without where there is none."""
    if sky is None:
        nothing, no_values = np.zeros(2), np.zeros(0, np.float32)
        level = pyramid_level(np.zeros((1, 3), np.int64), 1.0)
        return frame.frame_from_earth, frame.origin_earth_m, 0, np.eye(3), nothing, nothing, no_values, level, 1.0
    finder, (values, table) = sky.finder, sky.means
    return (
        frame.frame_from_earth, frame.origin_earth_m, finder.plane, finder.axes, finder.first, finder.step, values,
        pyramid_level(table, pixel_m / sky.node_m), 2.0**sky.level,
    )  # fmt: skip


@compiled
def _smooth_ground(
    across, first_row, stride, row0, height, shown, reach, centre,
    lattice, frame_from_earth, origin, plane, axes, first, step, values, level, cells_a_node,
):  # fmt: skip
    """Normals, shares of the sky and where there is ground (rows, cols) in a window that has ``reach`` nodes round it; and whether
    all of it has normals.
    """
    side = 2 * reach + 1
    rows, cols = height.shape[0] - 2 * reach, height.shape[1] - 2 * reach
    points = np.empty((side, 3, height.shape[1]))  # of the rows round the one that is worked on
    normal, share = np.zeros((rows, cols, 3), np.float32), np.zeros((rows, cols), np.float32)
    there = np.empty((rows, cols), np.bool_)
    complete = True
    for i in range(-reach, rows + reach):
        _points_of_row(across, first_row, stride, row0 + reach + i, height[i + reach], points[(i + reach) % side])
        at = i - reach
        if at < 0:
            continue
        here, above, below = points[(at + reach) % side], points[at % side], points[(at + 2 * reach) % side]
        _known_in_row(height, shown, at + reach, reach, there[at])
        if not _normals_of_row(above, here, below, reach, there[at], normal[at]):
            complete = False
        for j in range(cols):
            if not there[at, j]:
                continue
            px, py, pz = here[0, j + reach], here[1, j + reach], here[2, j + reach]
            x, y, z = px - centre[0], py - centre[1], pz - centre[2]
            n = normal[at, j]
            share[at, j] = 0.5 + 0.5 * (n[0] * x + n[1] * y + n[2] * z) / np.sqrt(x * x + y * y + z * z)
        if lattice is not None:
            _hide_row(
                here, height[at + reach], there[at], reach, share[at], lattice, frame_from_earth, origin, plane, axes, first, step,
                values, level, cells_a_node,
            )  # fmt: skip
    return normal, share, there, complete


@compiled
def _hide_row(
    here, height, there, reach, share, lattice, frame_from_earth, origin, plane, axes, first, step, values, level, cells_a_node
):
    """Take from a row's shares of the sky what ground hides there."""
    m00, m10, m20 = frame_from_earth[0, 0], frame_from_earth[1, 0], frame_from_earth[2, 0]
    m01, m11, m21 = frame_from_earth[0, 1], frame_from_earth[1, 1], frame_from_earth[2, 1]
    m02, m12, m22 = frame_from_earth[0, 2], frame_from_earth[1, 2], frame_from_earth[2, 2]
    for j in range(there.size):
        if not there[j]:
            continue
        px, py, pz = here[0, j + reach], here[1, j + reach], here[2, j + reach]
        x = m00 * px + m10 * py + m20 * pz + origin[0]
        y = m01 * px + m11 * py + m21 * pz + origin[1]
        z = m02 * px + m12 * py + m22 * pz + origin[2]
        x, y = in_plane(x, y, z, height[j + reach], plane, axes, first, step)
        row, col = cell_in_plane(x, y, first, step, lattice)
        row, col = (row + 0.5) / cells_a_node - 0.5, (col + 0.5) / cells_a_node - 0.5
        if np.isfinite(row) and np.isfinite(col):
            share[j] *= 1.0 - hidden_on(values, level, row, col)


@compiled
def _points_of_row(across, first_row, stride, row, height, out):
    """Frame points (3, cols) of a row of nodes, from exact rows' points and verticals (6, m, cols)."""
    coarse = row // stride
    weights = (row - coarse * stride) / stride
    m = coarse - first_row
    for k in range(3):
        feet, slopes = across[k], across[k + 3]
        if weights == 0.0:
            on_row(feet[m], slopes[m], height, out[k])
        else:
            between_rows(
                feet[m - 1], feet[m], feet[m + 1], feet[m + 2], slopes[m - 1], slopes[m], slopes[m + 1], slopes[m + 2],
                weights, height, out[k],
            )  # fmt: skip


@compiled
def _known_in_row(height, shown, row, reach, there):
    """Where a row's nodes show ground: those that are a corner of a triangle. A quad that misses one corner is one."""
    for j in range(there.size):
        col = j + reach
        known = False
        if shown[row, col] and np.isfinite(height[row, col]):
            for k in range(4):
                r, c = row - k // 2, col - k % 2
                missing = 0
                for m in range(4):
                    missing += 0 if np.isfinite(height[r + m // 2, c + m % 2]) else 1
                known = known or missing <= 1
        there[j] = known


@compiled
def _normals_of_row(above, here, below, reach, there, out):
    """Smooth unit normals (cols, 3) where there is ground, one-sided at its rim; whether all of it has one."""
    complete = True
    for j in range(there.size):
        if not there[j]:
            continue
        c = j + reach
        w, e = c - reach, c + reach
        west = c if np.isnan(here[2, w]) else w
        east = c if np.isnan(here[2, e]) else e
        north = here if np.isnan(above[2, c]) else above
        south = here if np.isnan(below[2, c]) else below
        ax, ay, az = here[0, east] - here[0, west], here[1, east] - here[1, west], here[2, east] - here[2, west]
        bx, by, bz = north[0, c] - south[0, c], north[1, c] - south[1, c], north[2, c] - south[2, c]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            x, y, z = np.float64(np.float32(x / length)), np.float64(np.float32(y / length)), np.float64(np.float32(z / length))
            length = np.sqrt(x * x + y * y + z * z)
            out[j, 0], out[j, 1], out[j, 2] = x / length, y / length, z / length
        else:
            complete = False
    return complete
