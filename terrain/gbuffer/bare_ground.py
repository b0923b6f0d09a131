"""Compute the bare ground (ground without objects) that a map's pixels show: heights, smooth normals and visible shares of the sky.

These values do not depend on the sun. They are cached, so that shading under another sun reads no heights.

The pixels must lie on nodes of the map's grid. There the values equal those of a geometry buffer
(``skugga.terrain.gbuffer.geometry``). A geometry buffer takes ten times as long, because it also finds each pixel's triangle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.geometry import normal_stencil_radius
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.cell_finder import STEREOGRAPHIC_PLANE, cell_in_square, lattice_square, project_to_plane, square_corners
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.sky_view_factor import SkyView, mip_pair, sky_occlusion_row
from skugga.terrain.ground.surface import Surface, map_pixel_m
from skugga.terrain.ground.surface_loops import add_heights, interpolate_columns, interpolate_row_between
from skugga.terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class BareGround:
    """The bare ground in a map's pixels.

    Arrays with the shape (r, c) or (r, c, 3) cover the part ``window`` of the view. Their values are undefined in pixels without
    ground.

    Attributes
    ----------
    view, frame
        The view, and the local frame of the normals and directions.
    valid
        bool (rows, cols), whether a pixel of the view shows ground.
    window
        The smallest rectangle of pixels that contains all ground, as slices of rows and columns.
    height_m
        float32 (r, c), metres.
    normal_frame
        float32 (r, c, 3), the smooth unit normal.
    up_frame
        float32 (r, c, 3), the unit vector away from the earth's centre.
    visible_sky_share
        float32 (r, c), the share of the sky, in [0, 1], that the ground sees.
    """

    view: MapView
    frame: LocalFrame
    valid: np.ndarray
    window: tuple[slice, slice]
    height_m: np.ndarray
    normal_frame: np.ndarray
    up_frame: np.ndarray
    visible_sky_share: np.ndarray

    @property
    def window_view(self) -> MapView:
        """The view of the window's pixels."""
        down, right = self.window
        return self.view.part(down.start, right.start, down.stop - down.start, right.stop - right.start)


def bare_ground(scene: Scene, view: MapView, sky_view: SkyView | None) -> BareGround | None:
    """Return the bare ground in the pixels of a map whose pixels lie on nodes of its grid.

    Parameters
    ----------
    scene, view
        The scene, and the view of the map.
    sky_view
        The sky that surrounding ground hides, which reduces the visible shares of the sky. ``None``: a point sees all sky above the
        plane of its own slope.

    Returns
    -------
    BareGround | None
        The ground; ``None`` if ground is somewhere too narrow for a triangle or a smooth normal.
    """
    return _bare_ground(scene.world, scene.elevation, view, sky_view)


def trim_bare_ground_cache(max_entries: int) -> None:
    """Remove all but the ``max_entries`` last used blocks from the cache, for a raster that is processed once from end to end."""
    _bare_ground.cache.trim(max_entries)


@cached("scene", 448 * MIB)
def _bare_ground(world: World, elevation: Elevation, view: MapView, sky_view: SkyView | None) -> BareGround | None:
    """Return the bare ground in the pixels of a map view. The parameters and the result are those of ``bare_ground``.

    Its pixels must lie on nodes of the view's grid.
    """
    frame, surface = world.frame_near(view.grid.crs, *view.centre), Surface(world, elevation, view.grid)
    stencil_radius = normal_stencil_radius(surface)
    row0, col0 = int(view.row0) - stencil_radius, int(view.col0) - stencil_radius
    nodes = surface.height_window(row0, col0, view.rows + 2 * stencil_radius, view.cols + 2 * stencil_radius)
    height, node_valid = nodes.height_m, nodes.valid
    inner_valid = node_valid[stencil_radius:-stencil_radius, stencil_radius:-stencil_radius]
    rows, cols = (np.flatnonzero(inner_valid.any(axis=axis)) for axis in (1, 0))
    valid = np.zeros((view.rows, view.cols), np.bool_)
    if not len(rows):
        empty = np.zeros((0, 0), np.float32)
        empty_3d = np.zeros((0, 0, 3), np.float32)
        return BareGround(view, frame, valid, (slice(0, 0), slice(0, 0)), empty, empty_3d, empty_3d, empty)
    window = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)
    node_window = tuple(slice(side.start, side.stop + 2 * stencil_radius) for side in window)
    height, node_valid = np.ascontiguousarray(height[node_window]), np.ascontiguousarray(node_valid[node_window])
    row0, col0 = row0 + window[0].start, col0 + window[1].start
    exact, first_row, first_col = surface.exact_verticals(row0, col0, height.shape[0], height.shape[1], frame)
    exact_rows = np.stack(
        [
            interpolate_columns(np.ascontiguousarray(exact[..., k]), first_col, surface.stride, col0, height.shape[1])
            for k in range(6)
        ]
    )
    normal, up, share, window_valid, is_complete = _smooth_ground(
        exact_rows, first_row, surface.stride, row0, height, node_valid, stencil_radius,
        world.up_origin(frame), None if sky_view is None else sky_view.cell_finder.node_cells, *_sky_arguments(sky_view, frame,
        map_pixel_m(world,
        view)),
    )  # fmt: skip
    if not is_complete:
        return None
    valid[window] = window_valid
    return BareGround(
        view, frame, valid, window, height[stencil_radius:-stencil_radius, stencil_radius:-stencil_radius].copy(), normal, up, share
    )


def _sky_arguments(sky_view: SkyView | None, frame: LocalFrame, pixel_m: float) -> tuple[Any, ...]:
    """Return the last arguments of ``_smooth_ground``, from ``frame_from_earth`` on, for pixels ``pixel_m`` metres wide.

    They come from ``sky_view``. Without it they are placeholders: the argument ``lattice`` is then ``None``, and numba compiles the
    loop without the code that uses them.
    """
    if sky_view is None:
        empty, empty_values = np.zeros(2), np.zeros(0, np.float32)
        mip_level = mip_pair(np.zeros((1, 3), np.int64), 1.0)
        return frame.frame_from_earth, frame.origin_earth_m, 0, np.eye(3), empty, empty, empty_values, mip_level, 1.0
    finder, (values, table) = sky_view.cell_finder, sky_view.mean_pyramid
    return (
        frame.frame_from_earth, frame.origin_earth_m, finder.plane, finder.axes_earth, finder.first_node_xy,
        finder.node_spacing_xy, values,
        mip_pair(table, pixel_m / sky_view.node_spacing_m), 2.0**sky_view.lod,
    )  # fmt: skip


@compiled
def _smooth_ground(
    exact_rows, first_row, stride, row0, height, node_valid, stencil_radius, up_origin,
    lattice, frame_from_earth, origin, plane, axes_earth, first_node_xy, node_spacing_xy, values, mip_level, cells_per_node,
):  # fmt: skip
    """Return unit normals, unit vectors up, sky shares and valid mask of a window, and whether all of its ground has normals.

    The results have the shapes (rows, cols, 3), (rows, cols, 3), (rows, cols) and (rows, cols).

    Parameters
    ----------
    exact_rows, first_row, stride
        (6, m, cols), points at height 0 and unit verticals of every ``stride``-th row of the grid; the number of the first of these
        rows, which is row ``first_row * stride`` of the grid.
    row0, height, node_valid
        First row on the grid, heights and valid mask of the nodes. They have ``stencil_radius`` more nodes on each side than the
        results.
    stencil_radius
        Nodes in each direction over which the differences of normals extend.
    up_origin
        (3,), the frame point from which up vectors point away.
    lattice
        ``node_cells`` of the ``CellFinder``; ``None`` without a ``SkyView``, whose values the remaining parameters hold.
    frame_from_earth, origin
        Rotation and earth-fixed origin of the local frame.
    plane, axes_earth, first_node_xy, node_spacing_xy
        The fields of the ``CellFinder``.
    values, mip_level, cells_per_node
        Mean pyramid of hidden shares of the sky, the ``MipPair`` for the pixels, and raster cells between two nodes of it.
    """
    side = 2 * stencil_radius + 1
    rows, cols = height.shape[0] - 2 * stencil_radius, height.shape[1] - 2 * stencil_radius
    points = np.empty((side, 3, height.shape[1]))  # ring buffer of the rows round the current one
    row_is_complete = np.empty(side, np.bool_)  # whether each of these rows has all its points
    normal, share = np.empty((rows, cols, 3), np.float32), np.empty((rows, cols), np.float32)
    up = np.empty((rows, cols, 3), np.float32)
    valid = np.empty((rows, cols), np.bool_)
    own_normal, plane_position = np.empty((3, cols), np.float32), np.empty((2, cols))  # of the current row
    is_complete = True
    for i in range(-stencil_radius, rows + stencil_radius):
        ring_index = (i + stencil_radius) % side
        _write_points(exact_rows, first_row, stride, row0 + stencil_radius + i, height[i + stencil_radius], points[ring_index])
        row_is_complete[ring_index] = _is_complete_row(points[ring_index, 2], height[i + stencil_radius])
        window_row = i - stencil_radius
        if window_row < 0:
            continue
        middle, above, below = (
            points[(window_row + stencil_radius) % side],
            points[window_row % side],
            points[(window_row + 2 * stencil_radius) % side],
        )
        is_interior = True
        for k in range(side):
            is_interior = is_interior and row_is_complete[k]
        if is_interior:
            for j in range(cols):
                valid[window_row, j] = node_valid[window_row + stencil_radius, stencil_radius + j]
            row_complete = _write_interior_normals(above, middle, below, stencil_radius, valid[window_row], own_normal)
        else:
            row_connected = _write_valid(height, node_valid, window_row + stencil_radius, stencil_radius, valid[window_row])
            row_complete = _write_rim_normals(above, middle, below, stencil_radius, valid[window_row], own_normal) and row_connected
        is_complete = is_complete and row_complete
        _copy_normals(own_normal, valid[window_row], normal[window_row])
        x, y, z = (
            middle[0, stencil_radius : stencil_radius + cols],
            middle[1, stencil_radius : stencil_radius + cols],
            middle[2, stencil_radius : stencil_radius + cols],
        )
        _write_open_sky(x, y, z, own_normal, (up_origin[0], up_origin[1], up_origin[2]), share[window_row])
        _write_up_vectors(x, y, z, (up_origin[0], up_origin[1], up_origin[2]), up[window_row])
        if lattice is not None:
            own_height = height[window_row + stencil_radius, stencil_radius : stencil_radius + cols]
            _write_plane_positions(
                x, y, z, own_height, frame_from_earth, origin, plane, axes_earth, first_node_xy, node_spacing_xy, plane_position
            )
            _convert_to_cells(plane_position, first_node_xy, node_spacing_xy, lattice, cells_per_node)
            _subtract_hidden_sky(plane_position[0], plane_position[1], values, mip_level, share[window_row])
    return normal, up, share, valid, is_complete


@internal
def _is_complete_row(z, height):
    """Return whether a row of nodes has no missing point or height."""
    missing = 0
    for j in range(z.size):
        missing += 0 if np.isfinite(z[j]) & np.isfinite(height[j]) else 1
    return missing == 0


# The next loops compile to SIMD instructions, because components are separate contiguous rows, slices have equal lengths, each loop
# uses few arrays, and loop invariants are scalars.


@internal
def _write_open_sky(px, py, pz, normal, up_origin, sky_share):
    """Write the share of the sky that lies above the tangent plane of each point's slope.

    ``px``, ``py`` and ``pz`` (n,) are the points, ``normal`` (3, n) their unit normals. ``up_origin`` is a tuple.
    """
    nx, ny, nz = normal[0], normal[1], normal[2]
    for j in range(sky_share.size):
        x, y, z = px[j] - up_origin[0], py[j] - up_origin[1], pz[j] - up_origin[2]
        sky_share[j] = 0.5 + 0.5 * (nx[j] * x + ny[j] * y + nz[j] * z) / np.sqrt(x * x + y * y + z * z)


@internal
def _write_up_vectors(px, py, pz, up_origin, out):
    """Write the unit vectors up (n, 3) of a row of points ``px``, ``py``, ``pz`` (n,): away from ``up_origin``."""
    for j in range(px.size):
        x, y, z = px[j] - up_origin[0], py[j] - up_origin[1], pz[j] - up_origin[2]
        length = np.sqrt(x * x + y * y + z * z)
        out[j, 0], out[j, 1], out[j, 2] = x / length, y / length, z / length


@internal
def _write_plane_positions(
    px, py, pz, height, frame_from_earth, origin, plane, axes_earth, first_node_xy, node_spacing_xy, plane_position
):
    """Write the positions (2, n) of a row of frame points in the plane of a ``CellFinder`` to ``plane_position``.

    ``px``, ``py`` and ``pz`` (n,) are the points, ``height`` (n,) their heights. The other parameters are those of
    ``_smooth_ground``.
    """
    m00, m10, m20 = frame_from_earth[0, 0], frame_from_earth[1, 0], frame_from_earth[2, 0]
    m01, m11, m21 = frame_from_earth[0, 1], frame_from_earth[1, 1], frame_from_earth[2, 1]
    m02, m12, m22 = frame_from_earth[0, 2], frame_from_earth[1, 2], frame_from_earth[2, 2]
    ox, oy, oz = origin[0], origin[1], origin[2]
    axis_rows = (
        (axes_earth[0, 0], axes_earth[0, 1], axes_earth[0, 2]), (axes_earth[1, 0], axes_earth[1, 1], axes_earth[1, 2]),
        (axes_earth[2, 0], axes_earth[2, 1], axes_earth[2, 2]),
    )  # fmt: skip
    first_xy, step_xy = (first_node_xy[0], first_node_xy[1]), (node_spacing_xy[0], node_spacing_xy[1])
    out_x, out_y = plane_position[0], plane_position[1]
    if plane == STEREOGRAPHIC_PLANE:
        for j in range(height.size):
            x = m00 * px[j] + m10 * py[j] + m20 * pz[j] + ox
            y = m01 * px[j] + m11 * py[j] + m21 * pz[j] + oy
            z = m02 * px[j] + m12 * py[j] + m22 * pz[j] + oz
            out_x[j], out_y[j] = project_to_plane(x, y, z, height[j], STEREOGRAPHIC_PLANE, axis_rows, first_xy, step_xy)
    else:
        for j in range(height.size):
            x = m00 * px[j] + m10 * py[j] + m20 * pz[j] + ox
            y = m01 * px[j] + m11 * py[j] + m21 * pz[j] + oy
            z = m02 * px[j] + m12 * py[j] + m22 * pz[j] + oz
            out_x[j], out_y[j] = project_to_plane(x, y, z, height[j], plane, axis_rows, first_xy, step_xy)


@internal
def _convert_to_cells(plane_position, first_node_xy, node_spacing_xy, lattice, cells_per_node):
    """Convert positions (2, cols) in the plane of a ``CellFinder`` to rows and columns of the nodes of a ``SkyView``, in place.

    Consecutive positions in one square of the finder's lattice are converted together.
    """
    x, y, begin, by = (
        plane_position[0],
        plane_position[1],
        (first_node_xy[0], first_node_xy[1]),
        (node_spacing_xy[0], node_spacing_xy[1]),
    )
    rows, cols = lattice.shape[0], lattice.shape[1]
    square_j, square_i = np.empty(x.size, np.int32), np.empty(x.size, np.int32)
    for j in range(x.size):
        x[j], y[j], square_j[j], square_i[j] = lattice_square(x[j], y[j], begin, by, rows, cols)
    start = 0
    while start < x.size:
        end, at_j, at_i = start + 1, square_j[start], square_i[start]
        while end < x.size and square_j[end] == at_j and square_i[end] == at_i:
            end += 1
        _convert_run_to_cells(x[start:end], y[start:end], square_corners(lattice, at_i, at_j), at_j, at_i, cells_per_node)
        start = end


@internal
def _convert_run_to_cells(x, y, corners, at_j, at_i, cells_per_node):
    """Convert consecutive positions in one square of a ``CellFinder``'s lattice to nodes of a ``SkyView``, in place.

    ``x`` and ``y`` (n,) are the positions in units of squares, and become rows and columns of nodes. ``corners`` are those of the
    square, whose column and row in the lattice are ``at_j`` and ``at_i``. ``cells_per_node`` is the number of raster cells along
    the distance between two nodes.
    """
    for j in range(x.size):
        row, col = cell_in_square(corners, x[j] - at_j, y[j] - at_i)
        x[j], y[j] = (row + 0.5) / cells_per_node - 0.5, (col + 0.5) / cells_per_node - 0.5


@internal
def _subtract_hidden_sky(row, col, values, mip_level, sky_share):
    """Multiply the sky shares of a row of pixels by the share of the sky that other ground leaves visible, in place.

    ``row`` and ``col`` (n,) are the pixels' positions in nodes of the ``SkyView``. ``values`` and ``mip_level`` are those of
    ``_smooth_ground``.
    """
    hidden_share = np.empty(sky_share.size)
    sky_occlusion_row(values, mip_level, row, col, hidden_share)
    for j in range(sky_share.size):
        has_cell = np.isfinite(row[j]) & np.isfinite(col[j])
        sky_share[j] = sky_share[j] * (1.0 - hidden_share[j]) if has_cell else sky_share[j]


@internal
def _write_points(exact_rows, first_row, stride, row, height, out):
    """Write the frame points (3, cols) of the row ``row`` of the grid, interpolated between exact rows (6, m, cols).

    ``exact_rows``, ``first_row`` and ``stride`` are those of ``_smooth_ground``. The points are raised from height 0 by ``height``
    (cols,).
    """
    exact_row = row // stride
    weights = (row - exact_row * stride) / stride
    m = exact_row - first_row
    feet, slopes = np.empty(height.size), np.empty(height.size)
    for k in range(3):
        interpolate_row_between(exact_rows[k], m, weights, feet)
        interpolate_row_between(exact_rows[k + 3], m, weights, slopes)
        add_heights(feet, slopes, height, out[k])


@internal
def _write_valid(height, node_valid, row, stencil_radius, valid):
    """Write which nodes of a row show ground: valid nodes that are a corner of a triangle. Return whether all valid nodes are.

    A quad with one missing corner still has one triangle. A raster that is one node wide has none. ``row`` is the row in ``height``
    and ``node_valid``, which have ``stencil_radius`` more columns on each side than ``valid`` (cols,).
    """
    is_connected = True
    for j in range(valid.size):
        col = j + stencil_radius
        is_valid = False
        if node_valid[row, col] and np.isfinite(height[row, col]):
            for k in range(4):
                r, c = row - k // 2, col - k % 2
                missing = 0
                for m in range(4):
                    missing += 0 if np.isfinite(height[r + m // 2, c + m % 2]) else 1
                is_valid = is_valid or missing <= 1
            is_connected = is_connected and is_valid
        valid[j] = is_valid
    return is_connected


@internal
def _write_interior_normals(above, middle, below, stencil_radius, valid, out):
    """Write the smooth unit normals (3, cols) of a row whose neighbours are all known. Return whether all its ground has a normal.

    ``above``, ``middle`` and ``below`` (3, n) are the points of the rows ``stencil_radius`` nodes north, at and south of it, with
    ``stencil_radius`` more nodes at both ends. ``valid`` (cols,) is the row's valid mask.
    """
    cols = valid.size
    west_x, west_y, west_z = middle[0, :cols], middle[1, :cols], middle[2, :cols]
    east = 2 * stencil_radius
    east_x, east_y, east_z = middle[0, east : east + cols], middle[1, east : east + cols], middle[2, east : east + cols]
    ax, ay, az = np.empty(cols), np.empty(cols), np.empty(cols)
    for j in range(cols):
        ax[j], ay[j], az[j] = east_x[j] - west_x[j], east_y[j] - west_y[j], east_z[j] - west_z[j]
    north_x, north_y, north_z = (
        above[0, stencil_radius : stencil_radius + cols],
        above[1, stencil_radius : stencil_radius + cols],
        above[2, stencil_radius : stencil_radius + cols],
    )
    south_x, south_y, south_z = (
        below[0, stencil_radius : stencil_radius + cols],
        below[1, stencil_radius : stencil_radius + cols],
        below[2, stencil_radius : stencil_radius + cols],
    )
    bx, by, bz = np.empty(cols), np.empty(cols), np.empty(cols)
    for j in range(cols):
        bx[j], by[j], bz[j] = north_x[j] - south_x[j], north_y[j] - south_y[j], north_z[j] - south_z[j]
    out_x, out_y, out_z = out[0], out[1], out[2]
    missing = 0
    for j in range(cols):
        length, x, y, z = _unit_normal(ax[j], ay[j], az[j], bx[j], by[j], bz[j])
        out_x[j], out_y[j], out_z[j] = x, y, z
        missing += 1 if valid[j] & (not length > 0.0) else 0
    return missing == 0


@internal
def _unit_normal(ax, ay, az, bx, by, bz):
    """Return the length of the cross product of the vectors a and b, and the components of its unit vector.

    The unit vector is rounded to float32 as in a geometry buffer, then normalised again.
    """
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = np.float64(np.float32(x / length)), np.float64(np.float32(y / length)), np.float64(np.float32(z / length))
    rounded_length = np.sqrt(x * x + y * y + z * z)
    return length, x / rounded_length, y / rounded_length, z / rounded_length


@internal
def _copy_normals(normal, valid, out):
    """Copy a row's normals (3, cols) to an array (cols, 3) where the row is valid; zeros elsewhere."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    for j in range(valid.size):
        if valid[j]:
            out[j, 0], out[j, 1], out[j, 2] = nx[j], ny[j], nz[j]
        else:
            out[j, 0], out[j, 1], out[j, 2] = 0.0, 0.0, 0.0


@internal
def _write_rim_normals(above, middle, below, stencil_radius, valid, out):
    """Write the smooth unit normals (3, cols) of a row's valid nodes. Return whether all its ground has a normal.

    Where a neighbour is missing, at the edge of the ground, the difference is one-sided. The parameters are those of
    ``_write_interior_normals``.
    """
    is_complete = True
    for j in range(valid.size):
        if not valid[j]:
            continue
        c = j + stencil_radius
        w, e = c - stencil_radius, c + stencil_radius
        west = c if np.isnan(middle[2, w]) else w
        east = c if np.isnan(middle[2, e]) else e
        north = middle if np.isnan(above[2, c]) else above
        south = middle if np.isnan(below[2, c]) else below
        length, x, y, z = _unit_normal(
            middle[0, east] - middle[0, west], middle[1, east] - middle[1, west], middle[2, east] - middle[2, west],
            north[0, c] - south[0, c], north[1, c] - south[1, c], north[2, c] - south[2, c],
        )  # fmt: skip
        if length > 0.0:
            out[0, j], out[1, j], out[2, j] = x, y, z
        else:
            is_complete = False
    return is_complete
