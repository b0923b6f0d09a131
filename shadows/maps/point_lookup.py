"""Look points of a perspective view up in the sun's map, by a loop on the CPU.

The loop does the work of ``shaders/receiver.glsl`` and ``shaders/shadow_map.frag.glsl`` for points on triangles of their own, in
the same float32 operations and the same order.

A look-up is little work for each of many points. A software rasteriser spends more time on the transfer of points and results than
on the look-ups. A graphics card has to transfer sixteen numbers per point over its bus.

With ``receiver_plane``, points of trees get the normal offset. The sun often grazes a tree's upright pictures, so the plane under
the next texel's centre lies metres up or down the tree, and its leaves say nothing about the point. Half a texel off the picture,
the only surface is leaves. In five wooded views, maps of 1,024 to 4,096 texels misjudge 0.5 to 0.7 times as many points as with
the plane (``tests/shadows/maps/test_point_lookup.py`` compares both). Maps see trees from above, where the plane is better (0.46
against 0.52 % in a hamlet in a wood).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.maps.windows import DepthMap
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.resolve import FOREST


class SunMap(NamedTuple):
    """A map of the sun, as the loop reads it. Floats are float32.

    Attributes
    ----------
    depths
        uint16 in depth steps, or float32 in [0, 1], (rows, cols); rows run upwards in light space.
    depth_step_count
        The largest value of ``depths``: the number of steps in the whole depth, or 1 for float32.
    light_from_frame
        (3, 3): rotation from the frame to the map.
    light_offset_m
        (3,): offset in the map, metres.
    depth_range_m
        Depth of the map, metres.
    texel_m
        (2,): sides of a texel, metres.
    position_error_m
        Upper bound of the float32 error of positions, metres.
    depth_step
        Step between two depths, as a share of the whole depth.
    """

    depths: np.ndarray
    depth_step_count: np.float32
    light_from_frame: np.ndarray
    light_offset_m: np.ndarray
    depth_range_m: np.float32
    texel_m: np.ndarray
    position_error_m: np.float32
    depth_step: np.float32


class DepthComparison(NamedTuple):
    """How a point's depth is compared with the depths in a map: the bias and the filter (``skugga.shadows.maps.settings``).

    Attributes
    ----------
    uses_triangles
        Whether a point's depth is compared on the plane of its own triangle, where that is known and not a tree's.
    uses_offset
        Whether points without a known triangle are moved along their normals.
    bias_scale
        Factor of the offset along the normal, and of the depth's change along the triangle.
    taps
        Taps (sampled texels) along a side.
    taps_without_triangle
        Taps along a side for points without a known triangle.
    """

    uses_triangles: bool
    uses_offset: bool
    bias_scale: np.float32
    taps: int
    taps_without_triangle: int


class LookupPoints(NamedTuple):
    """Points that are looked up.

    Attributes
    ----------
    position
        (n, 3): positions in the frame, metres.
    normal
        (n, 3): unit normals of their triangles.
    crease
        (n,): creases (``GeometryBuffer.crease``).
    corners
        (n, 9): corners of their triangles in the frame, metres.
    surface_kind
        (n,): kinds of their surfaces (``GeometryBuffer.surface_kind``).
    """

    position: np.ndarray
    normal: np.ndarray
    crease: np.ndarray
    corners: np.ndarray
    surface_kind: np.ndarray


def sun_map(depth_map: DepthMap, depths: np.ndarray) -> SunMap:
    """Return a drawn map in the form that the loop reads.

    ``depths`` (rows, cols) are as read from the texture: float32 in [0, 1], or uint16 in steps.
    """
    uniforms = depth_map.uniforms
    single = np.float32
    return SunMap(
        depths, single(1.0 if depths.dtype == single else 2**16 - 1),
        np.array(uniforms["light_from_frame"], single).reshape(3, 3).T.copy(), np.array(uniforms["light_offset_m"], single),
        single(uniforms["window_m"][2]), np.array(uniforms["texel_m"], single), single(uniforms["error_m"]),
        single(uniforms["depth_step"]),
    )  # fmt: skip


def look_up_points(
    drawn_map: SunMap, comparison: DepthComparison, points: LookupPoints, point_indices: np.ndarray, visibility: np.ndarray
) -> None:
    """Write the visibility of points in a map of the sun to ``visibility`` (n,) float32: the share of lit taps, in [0, 1].

    The points are those of ``points`` with the indices ``point_indices`` (k,), and only their entries are written. ``comparison``
    tells how their depths are compared with the map's.
    """
    run_in_chunks(len(point_indices), _look_up_chunk, drawn_map, comparison, points, point_indices, visibility)


@compiled
def _look_up_chunk(first, last, drawn_map, comparison, points, point_indices, visibility):
    """Write the visibility of a chunk of points in a map of the sun to ``visibility`` (n,): the share of lit taps, in [0, 1].

    The chunk is ``point_indices[first:last]``, the indices of points in ``points`` (``LookupPoints``) and in ``visibility``.
    ``drawn_map`` is the ``SunMap``. ``comparison`` (``DepthComparison``) tells by which bias and how many taps the points' depths
    are compared with the map's.
    """
    _, _, _, taps, taps_without_triangle = comparison
    for m in range(first, last):
        i = point_indices[m]
        uses_triangle = comparison.uses_triangles and points.surface_kind[i] != FOREST
        p = translate_to_light(drawn_map, rotate_to_light(drawn_map, points.position, i, 0))
        is_empty = uses_triangle and is_free_of_casters(drawn_map, p, taps)
        if uses_triangle and not is_empty:
            lit, total_weight = weights_on_triangle(drawn_map, comparison, p, points.corners, i)
            if total_weight > np.float32(0.0):
                visibility[i] = lit / total_weight
                continue
        moved_point = move_off_surface(
            drawn_map, comparison, p, rotate_to_light(drawn_map, points.normal, i, 0), abs(points.crease[i])
        )
        if is_empty:
            if is_free_of_casters(drawn_map, moved_point, taps_without_triangle):
                visibility[i] = np.float32(1.0)
                continue
            lit, total_weight = weights_on_triangle(drawn_map, comparison, p, points.corners, i)
            if total_weight > np.float32(0.0):
                visibility[i] = lit / total_weight
                continue
        visibility[i] = lit_share_without_triangle(drawn_map, comparison, moved_point)


@internal
def rotate_to_light(drawn_map, vectors, i, first):
    """Return the vector ``vectors[i, first : first + 3]``, metres of the frame, along the light's axes, as a tuple.

    ``drawn_map`` is a ``SunMap``. Allocating an array would cost more than all other work.
    """
    x, y, z = np.float32(vectors[i, first]), np.float32(vectors[i, first + 1]), np.float32(vectors[i, first + 2])
    axes = drawn_map.light_from_frame
    return (
        axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z,
        axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z,
        axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z,
    )


@internal
def translate_to_light(drawn_map, rotated):
    """Return a vector along the light's axes as a position in the map, metres: right, up and depth.

    ``rotated`` is the vector, a tuple of three (``rotate_to_light``), and ``drawn_map`` the ``SunMap``.
    """
    offset = drawn_map.light_offset_m
    return rotated[0] + offset[0], rotated[1] + offset[1], rotated[2] + offset[2]


@internal
def move_off_surface(drawn_map, comparison, point_m, normal, crease):
    """Return a point moved along its normal, off every surface that passes through it.

    ``point_m`` is a position in the map, metres, and ``normal`` a unit vector along the light's axes, tuples of three. ``crease``
    is at least 0 (``LookupPoints.crease``). Without ``comparison.uses_offset`` the point is returned unchanged. ``drawn_map`` is
    the ``SunMap``.
    """
    if not comparison.uses_offset:
        return point_m
    side = np.float32(-1.0) if normal[2] > np.float32(0.0) else np.float32(1.0)  # foliage is lit from either side
    half, one = np.float32(0.5), np.float32(1.0)
    taps = half * np.float32(comparison.taps_without_triangle) + np.float32(1.0 / 128.0)
    x, y = taps * drawn_map.texel_m[0], taps * drawn_map.texel_m[1]
    offset = x * abs(normal[0]) + y * abs(normal[1]) + np.sqrt(x * x + y * y) * crease
    offset /= max(one - half * crease * crease, np.float32(0.25))
    distance = side * (comparison.bias_scale * offset + drawn_map.position_error_m)
    return (
        point_m[0] + normal[0] * distance,
        point_m[1] + normal[1] * distance,
        point_m[2] + normal[2] * distance - drawn_map.position_error_m,
    )


@internal
def first_tap(drawn_map, point_m, side_taps):
    """Return the column and the row of the first texel of a square of taps around a point, and two offsets of the square.

    The square has ``side_taps`` taps along a side. The offsets, in columns and in rows, lead from the texel to the square's corner,
    in [0, 1). ``point_m`` is a position in the map, metres. ``drawn_map`` is the ``SunMap``.
    """
    half = np.float32(0.5) * np.float32(side_taps - 1)
    x, y = point_m[0] / drawn_map.texel_m[0] - half, point_m[1] / drawn_map.texel_m[1] - half
    left, low = np.floor(x), np.floor(y)
    return np.int64(left), np.int64(low), x - left, y - low


@internal
def is_free_of_casters(drawn_map, point_m, side_taps):
    """Return whether a map holds no caster in a square of ``side_taps`` x ``side_taps`` taps around a point.

    ``drawn_map`` is the ``SunMap``, and ``point_m`` a position in it, metres.
    """
    left, low, _, _ = first_tap(drawn_map, point_m, side_taps)
    rows, cols = drawn_map.depths.shape
    for r in range(max(low, 0), min(low + side_taps, rows)):
        for c in range(max(left, 0), min(left + side_taps, cols)):
            if np.float32(drawn_map.depths[r, c]) < drawn_map.depth_step_count:
                return False
    return True


@internal
def is_lit(drawn_map, depth_rounding, row, col, depth_m):
    """Return whether a point at the depth ``depth_m``, metres, is not behind the map's depth at a texel.

    ``row`` and ``col`` are those of the texel; outside of the map every point is lit. ``depth_rounding`` is subtracted from the
    point's depth, as a share of the map's depth range. ``drawn_map`` is the ``SunMap``.
    """
    rows, cols = drawn_map.depths.shape
    if row < 0 or col < 0 or row >= rows or col >= cols:
        return True
    return (
        min(depth_m / drawn_map.depth_range_m - depth_rounding, np.float32(1.0))
        <= np.float32(drawn_map.depths[row, col]) / drawn_map.depth_step_count
    )


@internal
def tap_weight(side_taps, tap_index, fraction):
    """Return the overlap, in [0, 1], along one axis, of a tap with the square of ``side_taps`` - 1 texels around the point.

    ``tap_index`` is in [0, ``side_taps``). ``fraction`` is the offset of ``first_tap`` along this axis.
    """
    if tap_index == 0:
        return np.float32(1.0) - fraction
    return fraction if tap_index == side_taps - 1 else np.float32(1.0)


@internal
def weights_on_triangle(drawn_map, comparison, point_m, corners, i):
    """Return the lit and the total weight of the taps whose texel centres lie in the own triangle of point ``i``.

    ``point_m`` is the point's position in the map, metres, and ``corners`` are those of ``LookupPoints``. Both weights are 0 if no
    texel centre lies in the triangle, or if the triangle is unknown. ``drawn_map`` is the ``SunMap``, and ``comparison`` the
    ``DepthComparison``.
    """
    lit, total_weight = np.float32(0.0), np.float32(0.0)
    if corners[i, 0] == corners[i, 3] and corners[i, 1] == corners[i, 4] and corners[i, 2] == corners[i, 5]:
        return lit, total_weight
    zero, one = np.float32(0.0), np.float32(1.0)
    ax, ay, az = translate_to_light(drawn_map, rotate_to_light(drawn_map, corners, i, 0))
    ex, ey, ez = translate_to_light(drawn_map, rotate_to_light(drawn_map, corners, i, 3))
    gx, gy, gz = translate_to_light(drawn_map, rotate_to_light(drawn_map, corners, i, 6))
    ex, ey, ez, gx, gy, gz = ex - ax, ey - ay, ez - az, gx - ax, gy - ay, gz - az
    texel = drawn_map.texel_m
    area = ex * gy - ey * gx
    slope_x, slope_y = (ez * gy - gz * ey) / area, (gz * ex - ez * gx) / area
    grid = np.float32(1.0 / 128.0)
    slack = abs(slope_x) * (texel[0] * grid + drawn_map.position_error_m) + abs(slope_y) * (
        texel[1] * grid + drawn_map.position_error_m
    )
    max_slack = np.sqrt(ex * ex + ey * ey + ez * ez) + np.sqrt(gx * gx + gy * gy + gz * gz)
    slack = min(slack, max_slack) + drawn_map.position_error_m
    gx, gy, ex, ey = gx / area, gy / area, ex / area, ey / area
    scale, taps = comparison.bias_scale, comparison.taps
    rounding = np.float32(0.5) * drawn_map.depth_step if comparison.uses_offset else zero
    left, low, fraction_x, fraction_y = first_tap(drawn_map, point_m, taps)
    for row in range(taps):
        offset_y = (np.float32(low + row) + np.float32(0.5)) * texel[1] - ay
        for col in range(taps):
            offset_x = (np.float32(left + col) + np.float32(0.5)) * texel[0] - ax
            u, v = offset_x * gy - offset_y * gx, ex * offset_y - ey * offset_x
            if not (u >= zero and v >= zero and u + v <= one):
                continue
            triangle_z = az + (slope_x * offset_x + slope_y * offset_y)
            z = point_m[2] * (one - scale) + triangle_z * scale - slack
            weight = one
            if taps > 1:
                weight = max(tap_weight(taps, col, fraction_x) * tap_weight(taps, row, fraction_y), np.float32(1e-6))
            if is_lit(drawn_map, rounding, low + row, left + col, z):
                lit += weight
            total_weight += weight
    return lit, total_weight


@internal
def lit_share_without_triangle(drawn_map, comparison, moved_point):
    """Return the lit share, in [0, 1], of the taps around a point that was moved off its surface, wherever their texels lie.

    ``moved_point`` is a position in the map, metres (``move_off_surface``). ``drawn_map`` is the ``SunMap``, and ``comparison``
    the ``DepthComparison``.
    """
    count, zero, one = comparison.taps_without_triangle, np.float32(0.0), np.float32(1.0)
    rounding = np.float32(0.5) * drawn_map.depth_step if comparison.uses_offset else zero
    left, low, fraction_x, fraction_y = first_tap(drawn_map, moved_point, count)
    lit, total_weight = zero, zero
    for row in range(count):
        for col in range(count):
            weight = one
            if count > 1:
                weight = max(tap_weight(count, col, fraction_x) * tap_weight(count, row, fraction_y), np.float32(1e-6))
            if is_lit(drawn_map, rounding, low + row, left + col, moved_point[2]):
                lit += weight
            total_weight += weight
    return lit / total_weight
