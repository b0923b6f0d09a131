"""Looking points of a perspective view up in the sun's map, on the processor: what ``shaders/receiver.glsl`` and
``shaders/shadow_map.frag.glsl`` do for points that lie on triangles of their own, in the same float32 and in the same order.

A look-up is little work for each of many points. A software rasteriser pays more for taking them in and giving them back than for
that; a hardware one has to fetch sixteen numbers a point over its bus.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shadows.maps.windows import DepthMap
from terrain.compiled import compiled, in_shares


class SunMap(NamedTuple):
    """A map of the sun, as the loop takes it: depths (rows, cols) in steps, of which ``steps`` are the whole depth, uint16 or
    float32, rows upwards in light space; rotation (3, 3) and offset (3,) of a frame's points to it, ``window_m`` deep, ``texel_m``
    (2,); all float32. The rest are ``DepthMap.uniforms``.
    """

    depths: np.ndarray
    steps: np.float32
    light_from_frame: np.ndarray
    light_offset_m: np.ndarray
    window_m: np.float32
    texel_m: np.ndarray
    error_m: np.float32
    depth_step: np.float32


class DepthComparison(NamedTuple):
    """How depths are compared (``shadows.maps.settings``): on triangles that are known, or moved along normals, or neither; taps a
    side, and those where no triangle is known.
    """

    by_triangles: bool
    by_offset: bool
    bias_scale: np.float32
    taps: int
    taps_beside: int


class LitPoints(NamedTuple):
    """Points (n, ...) that are looked up: in the frame, with unit normals of their triangles, creases (n,) and corners (n, 9)."""

    position: np.ndarray
    normal: np.ndarray
    crease: np.ndarray
    corners: np.ndarray


def sun_map(drawn: DepthMap, depths: np.ndarray) -> SunMap:
    """A map that was drawn, with its depths (rows, cols) as they were read: float32, or uint16 in steps."""
    given = drawn.uniforms
    single = np.float32
    return SunMap(
        depths, single(1.0 if depths.dtype == single else 2**16 - 1),
        np.array(given["light_from_frame"], single).reshape(3, 3).T.copy(), np.array(given["light_offset_m"], single),
        single(given["window_m"][2]), np.array(given["texel_m"], single), single(given["error_m"]), single(given["depth_step"]),
    )  # fmt: skip


def look_points_up(sun: SunMap, comparison: DepthComparison, points: LitPoints, chosen: np.ndarray, visibility: np.ndarray) -> None:
    """Put the share of lit texels round the ``chosen`` points (indices) into ``visibility`` (n,) float32."""
    in_shares(len(chosen), _look_up, sun, comparison, points, chosen, visibility)


@compiled
def _look_up(first, last, sun, comparison, points, chosen, visibility):
    by_triangles, _, _, taps, beside = comparison
    p, n, clear = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for m in range(first, last):
        i = chosen[m]
        _in_light(sun, points.position[i], True, p)
        is_empty = by_triangles and _is_empty(sun, p, taps)
        if by_triangles and not is_empty:
            lit, counted = _on_own_triangle(sun, comparison, p, points.corners[i])
            if counted > np.float32(0.0):
                visibility[i] = lit / counted
                continue
        _in_light(sun, points.normal[i], False, n)
        if n[2] > np.float32(0.0):  # foliage is lit from either side
            n[0], n[1], n[2] = -n[0], -n[1], -n[2]
        _clear_of(sun, comparison, p, n, abs(points.crease[i]), clear)
        if is_empty:
            if _is_empty(sun, clear, beside):
                visibility[i] = np.float32(1.0)
                continue
            lit, counted = _on_own_triangle(sun, comparison, p, points.corners[i])
            if counted > np.float32(0.0):
                visibility[i] = lit / counted
                continue
        visibility[i] = _beside_triangles(sun, comparison, clear)


@compiled
def _in_light(sun, vector, moved, out):
    x, y, z = np.float32(vector[0]), np.float32(vector[1]), np.float32(vector[2])
    axes = sun.light_from_frame
    for k in range(3):
        out[k] = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
        if moved:
            out[k] += sun.light_offset_m[k]


@compiled
def _clear_of(sun, comparison, p, n, crease, out):
    """A point moved clear of every surface that passes through it."""
    out[0], out[1], out[2] = p[0], p[1], p[2]
    if not comparison.by_offset:
        return
    half, one = np.float32(0.5), np.float32(1.0)
    taps = half * np.float32(comparison.taps_beside) + np.float32(1.0 / 128.0)
    x, y = taps * sun.texel_m[0], taps * sun.texel_m[1]
    offset = x * abs(n[0]) + y * abs(n[1]) + np.sqrt(x * x + y * y) * crease
    offset /= max(one - half * crease * crease, np.float32(0.25))
    away = comparison.bias_scale * offset + sun.error_m
    for k in range(3):
        out[k] += n[k] * away
    out[2] -= sun.error_m


@compiled
def _first_tap(sun, p, count, axis):
    """The first texel of a square of taps round a point along an axis, and how far beyond its corner the square begins."""
    at = p[axis] / sun.texel_m[axis] - np.float32(0.5) * np.float32(count - 1)
    low = np.floor(at)
    return np.int64(low), at - low


@compiled
def _is_empty(sun, p, count):
    """Whether the map holds nothing in a square of taps round a point."""
    left, _ = _first_tap(sun, p, count, 0)
    low, _ = _first_tap(sun, p, count, 1)
    rows, cols = sun.depths.shape
    for r in range(max(low, 0), min(low + count, rows)):
        for c in range(max(left, 0), min(left + count, cols)):
            if np.float32(sun.depths[r, c]) < sun.steps:
                return False
    return True


@compiled
def _is_lit(sun, rounding, row, col, z):
    rows, cols = sun.depths.shape
    if row < 0 or col < 0 or row >= rows or col >= cols:
        return True
    return min(z / sun.window_m - rounding, np.float32(1.0)) <= np.float32(sun.depths[row, col]) / sun.steps


@compiled
def _weight(count, n, beyond):
    """How much of a tap lies in the square of count - 1 texels round the point, along one axis."""
    if n == 0:
        return np.float32(1.0) - beyond
    return beyond if n == count - 1 else np.float32(1.0)


@compiled
def _on_own_triangle(sun, comparison, p, corners):
    """The lit and all of the weight of those taps whose texels' centres fall into a point's own triangle."""
    lit, counted = np.float32(0.0), np.float32(0.0)
    if corners[0] == corners[3] and corners[1] == corners[4] and corners[2] == corners[5]:
        return lit, counted
    zero, one = np.float32(0.0), np.float32(1.0)
    a, e, g = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    _in_light(sun, corners[0:3], True, a)
    _in_light(sun, corners[3:6], True, e)
    _in_light(sun, corners[6:9], True, g)
    for k in range(3):
        e[k] -= a[k]
        g[k] -= a[k]
    texel = sun.texel_m
    area = e[0] * g[1] - e[1] * g[0]
    slope_x, slope_y = (e[2] * g[1] - g[2] * e[1]) / area, (g[2] * e[0] - e[2] * g[0]) / area
    grid = np.float32(1.0 / 128.0)
    slack = abs(slope_x) * (texel[0] * grid + sun.error_m) + abs(slope_y) * (texel[1] * grid + sun.error_m)
    around = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) + np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    slack = min(slack, around) + sun.error_m
    gx, gy, ex, ey = g[0] / area, g[1] / area, e[0] / area, e[1] / area
    scale, taps = comparison.bias_scale, comparison.taps
    rounding = np.float32(0.5) * sun.depth_step if comparison.by_offset else zero
    left, beyond_x = _first_tap(sun, p, taps, 0)
    low, beyond_y = _first_tap(sun, p, taps, 1)
    for row in range(taps):
        aside_y = (np.float32(low + row) + np.float32(0.5)) * texel[1] - a[1]
        for col in range(taps):
            aside_x = (np.float32(left + col) + np.float32(0.5)) * texel[0] - a[0]
            u, v = aside_x * gy - aside_y * gx, ex * aside_y - ey * aside_x
            if not (u >= zero and v >= zero and u + v <= one):
                continue
            there = a[2] + (slope_x * aside_x + slope_y * aside_y)
            z = p[2] * (one - scale) + there * scale - slack
            weight = one
            if taps > 1:
                weight = max(_weight(taps, col, beyond_x) * _weight(taps, row, beyond_y), np.float32(1e-6))
            if _is_lit(sun, rounding, low + row, left + col, z):
                lit += weight
            counted += weight
    return lit, counted


@compiled
def _beside_triangles(sun, comparison, clear):
    """The lit share of the taps round a point that was moved clear, wherever their texels lie."""
    count, zero, one = comparison.taps_beside, np.float32(0.0), np.float32(1.0)
    rounding = np.float32(0.5) * sun.depth_step if comparison.by_offset else zero
    left, beyond_x = _first_tap(sun, clear, count, 0)
    low, beyond_y = _first_tap(sun, clear, count, 1)
    lit, counted = zero, zero
    for row in range(count):
        for col in range(count):
            weight = one
            if count > 1:
                weight = max(_weight(count, col, beyond_x) * _weight(count, row, beyond_y), np.float32(1e-6))
            if _is_lit(sun, rounding, low + row, left + col, clear[2]):
                lit += weight
            counted += weight
    return lit / counted
