"""Bound the slopes of a ground's facets in every direction, to compare any sun with all facets at once.

A facet with the normal (-a, -b, 1), in the east-north-up axes of the level's anchor, has the slope (a, b). It faces the sun in the
direction (e, n, u) if u > a e + b n. Over all facets, the right side has its maximum and minimum at corners of the convex hull of
the slopes. The hull is stored by its support function: the maximum of a cos(t) + b sin(t), for ``SUPPORT_DIRECTION_COUNT`` angles
t. These values define a polygon that contains the hull and exceeds it by at most 0.12 %.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.overview_cells import overview_on_grid
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.ground_mesh import GroundMesh
from skugga.terrain.geo.grid import BLOCK_PX, Grid
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.surface import Surface

SUPPORT_DIRECTION_COUNT = 64

MAX_SLOPE = 50.0
"""Maximum slope of a facet, metres per metre: 89 degrees. With steeper facets, also on another side of the earth, the support is
unknown.
"""


class SlopeSupport(NamedTuple):
    """Support functions of a ground's slopes, metres per metre: maximum slopes in ``SUPPORT_DIRECTION_COUNT`` directions from the
    east.

    Attributes
    ----------
    casting_facets
        (``SUPPORT_DIRECTION_COUNT``,), over all facets that cast shadows, also those of the rim (one node of ground beyond the
        raster).
    visible_facets
        (``SUPPORT_DIRECTION_COUNT``,), over the facets that an image shows.
    """

    casting_facets: np.ndarray
    visible_facets: np.ndarray


def facing_range_of_slopes(support: SlopeSupport | None, to_sun_enu: np.ndarray) -> tuple[float | None, float | None]:
    """Return the minimum of u - (a e + b n) over all casting facets, and its maximum over all visible facets.

    ``to_sun_enu`` (3,) is the unit direction to the sun (e, n, u) at the anchor. (a, b) is a facet's slope to the east and to the
    north. A facet faces the sun if the value is positive. Both results are ``None`` if ``support`` is.
    """
    if support is None:
        return None, None
    minimum, maximum = (
        _facing_range_of_support(support.casting_facets, to_sun_enu),
        _facing_range_of_support(support.visible_facets, to_sun_enu),
    )
    return minimum[0], maximum[1]


def _facing_range_of_support(support: np.ndarray, to_sun_enu: np.ndarray) -> tuple[float, float]:
    """Return the minimum and the maximum of u - (a e + b n) over all slopes (a, b) with the support ``support``.

    ``support`` (``SUPPORT_DIRECTION_COUNT``,) is a field of ``SlopeSupport``. The symbols are those of ``facing_range_of_slopes``.
    """
    turn = 2.0 * np.pi / SUPPORT_DIRECTION_COUNT
    angle, next_support = np.arange(SUPPORT_DIRECTION_COUNT) * turn, np.roll(support, -1)
    # Corners of the polygon: intersections of the lines of neighbouring directions.
    across = (next_support - support * np.cos(turn)) / np.sin(turn)
    corners = np.column_stack([support * np.cos(angle) - across * np.sin(angle), support * np.sin(angle) + across * np.cos(angle)])
    along = corners @ to_sun_enu[:2]
    return float(to_sun_enu[2] - along.max()), float(to_sun_enu[2] - along.min())


Corridor = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Region of a local frame, as three arrays: a matrix (2, 3), offsets (2,) and bounds (2, 2).

The matrix and the offsets map frame points to two coordinates. The bounds are the minimum and maximum of each coordinate, as rows.
"""


def facing_range_of_mesh(
    world: World, ground: GroundMesh, frame: LocalFrame, corridor: Corridor, to_sun_enu: np.ndarray
) -> tuple[float | None, float | None]:
    """Return the minimum and maximum of u - (a e + b n) over the facets of a mesh that may intersect a corridor.

    The mesh is the ground of a perspective view. The symbols are those of ``facing_range_of_slopes``. The mesh and the corridor are
    in ``frame``. Both values are infinite without facets, and ``None`` if a facet is steeper than ``MAX_SLOPE``.
    """
    rows, offsets, bounds = corridor
    to_frame = frame.frame_from_earth @ world.earth_from_anchor
    minimum, maximum = _facing_range(
        ground.position_frame_m, ground.triangles, rows, offsets, bounds, to_frame @ to_sun_enu, to_frame[:, 2]
    )
    return (None, None) if np.isnan(minimum) else (float(minimum), float(maximum))


@cached("scene", 64 * MIB)
def slope_support(world: World, elevation: Elevation, grid: Grid) -> SlopeSupport | None:
    """Return the support of the slopes of the level's whole ground on a map grid.

    ``None`` if a facet is steeper than ``MAX_SLOPE``, or if no facet is visible.
    """
    surface, directions = Surface(world, elevation, grid), _directions()
    casting, visible = _empty_support(), _empty_support()
    (first_row, last_row), (first_col, last_col) = extent_on_grid(world, elevation, grid)
    for row in range(first_row, last_row, BLOCK_PX):
        for col in range(first_col, last_col, BLOCK_PX):
            rows, cols = min(BLOCK_PX, last_row - row) + 1, min(BLOCK_PX, last_col - col) + 1
            middle = float(grid.x(col + cols / 2)), float(grid.y(row + rows / 2))
            frame = world.frame_near(grid.crs, *middle)
            window, rotation = surface.window(row, col, rows, cols, frame), world.anchor_from_frame(frame)[0]
            _extend_support(window.sheet.normals_frame.reshape(-1, 3), rotation, directions, visible)
            if window.rim is not None:
                _extend_support(window.with_rim.sheet.normals_frame.reshape(-1, 3), rotation, directions, casting)
            if np.isposinf(visible).any() or np.isposinf(casting).any():
                return None
    if not np.isfinite(visible).all():
        return None
    return SlopeSupport(np.maximum(casting, visible), visible)


@cached("scene", MIB)
def node_count(world: World, elevation: Elevation, grid: Grid) -> int:
    """Return the approximate number of nodes of a grid that lie on a raster."""
    rows, cols = extent_on_grid(world, elevation, grid)
    return (rows[1] - rows[0] + 1) * (cols[1] - cols[0] + 1)


def extent_on_grid(world: World, elevation: Elevation, grid: Grid) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first and last row, and the first and last column, of a grid's nodes that a raster may cover."""
    row, col, half = overview_on_grid(world, elevation, grid)
    valid = np.isfinite(row) & np.isfinite(col) & np.isfinite(half)
    if not valid.any():
        return (0, 0), (0, 0)
    rows, cols = (
        (int(np.floor((v - half)[valid].min())), int(np.ceil((v + half)[valid].max()))) for v in (row, col)
    )  # fmt: skip
    return rows, cols


def _directions() -> np.ndarray:
    """Return the horizontal unit vectors (``SUPPORT_DIRECTION_COUNT``, 2) east and north of a support function's directions."""
    angle = np.arange(SUPPORT_DIRECTION_COUNT) * (2.0 * np.pi / SUPPORT_DIRECTION_COUNT)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _empty_support() -> np.ndarray:
    """Return the support function (``SUPPORT_DIRECTION_COUNT``,) of no slopes."""
    return np.full(SUPPORT_DIRECTION_COUNT, -np.inf)


@compiled
def _extend_support(normals, anchor_from_frame, directions, support):
    """Extend a support function in place by the slopes of facets with the normals (n, 3), of any length, in a frame.

    ``anchor_from_frame`` (3, 3) rotates normals to the anchor's axes. ``directions`` (k, 2) are those of ``support`` (k,). If a
    facet is steeper than ``MAX_SLOPE``, all of ``support`` becomes infinite.
    """
    inner = 0.0  # slopes shorter than this cannot extend the support
    t = anchor_from_frame
    for i in range(len(normals)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        up = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z
        if not (np.isfinite(up) and (x != 0.0 or y != 0.0 or z != 0.0)):
            continue
        east = t[0, 0] * x + t[0, 1] * y + t[0, 2] * z
        north = t[1, 0] * x + t[1, 1] * y + t[1, 2] * z
        if up * MAX_SLOPE < np.sqrt(x * x + y * y + z * z):
            support[:] = np.inf
            return
        a, b = -east / up, -north / up
        if a * a + b * b < inner * inner:
            continue
        is_extended = False
        for k in range(len(directions)):
            projection = a * directions[k, 0] + b * directions[k, 1]
            if projection > support[k]:
                support[k] = projection
                is_extended = True
        if is_extended:
            min_support = support[0]
            for k in range(len(directions)):
                min_support = support[k] if support[k] < min_support else min_support
            inner = max(min_support, 0.0)


@compiled
def _facing_range(position, triangles, rows, offsets, bounds, to_sun, upward):
    """Return the result of ``facing_range_of_mesh``, with NaN instead of ``None``.

    ``position`` (n, 3) and ``triangles`` (m, 3) are the mesh. ``rows`` (2, 3), ``offsets`` (2,) and ``bounds`` (2, 2) are the
    corridor. ``to_sun`` and ``upward`` (3,) are the directions to the sun and up at the anchor, in the mesh's frame.
    """
    minimum, maximum = np.inf, np.inf
    for t in range(len(triangles)):
        o, p, q = position[triangles[t, 0]], position[triangles[t, 1]], position[triangles[t, 2]]
        inside = True
        for k in range(2):
            r = rows[k]
            first = r[0] * o[0] + r[1] * o[1] + r[2] * o[2] + offsets[k]
            second = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + offsets[k]
            third = r[0] * q[0] + r[1] * q[1] + r[2] * q[2] + offsets[k]
            if min(first, second, third) > bounds[k, 1] or max(first, second, third) < bounds[k, 0]:
                inside = False
                break
        if not inside:
            continue
        ax, ay, az = p[0] - o[0], p[1] - o[1], p[2] - o[2]
        bx, by, bz = q[0] - o[0], q[1] - o[1], q[2] - o[2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        up = upward[0] * x + upward[1] * y + upward[2] * z
        if not length > 0.0:
            continue
        if up * MAX_SLOPE < length:
            return np.nan, np.nan
        facing = (to_sun[0] * x + to_sun[1] * y + to_sun[2] * z) / up
        minimum, maximum = min(minimum, facing), facing if maximum == np.inf else max(maximum, facing)
    return minimum, maximum
