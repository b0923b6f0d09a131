"""The occlusion of the sky around a point by triangles, for example of buildings and models.

A direction is an azimuth. Its vertical plane cuts a triangle in a straight segment, which ends on two of the triangle's edges. The
elevation angle of the segment, seen from the eye, is largest at one end. A ray in the plane meets the triangle if it passes between
the ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.point.directions import Directions, direction_range
from skugga.terrain.compiled import compiled, internal

MIN_DISTANCE_M = 1e-6
"""Minimum distance in metres from the vertical line through the eye. Nearer parts of segments are ignored."""


class Sighting(NamedTuple):
    """The object seen in each direction (n,).

    Attributes
    ----------
    tangent
        (n,): tangent of the elevation angle of the point that is seen.
    distance_m
        (n,), metres: horizontal distance of the point from the eye; inf without an object.
    object_index
        (n,): index of the object, a triangle or a tree; -1 without one.
    """

    tangent: np.ndarray
    distance_m: np.ndarray
    object_index: np.ndarray


def empty_sighting(count: int, tangent: float = -np.inf) -> Sighting:
    """Return a sighting without objects in ``count`` directions, with an initial ``tangent``."""
    return Sighting(np.full(count, tangent), np.full(count, np.inf), np.full(count, -1, np.int64))


def highest_solids(point_enu_m: np.ndarray, triangles: np.ndarray, directions: Directions, sighting: Sighting) -> None:
    """Replace entries of ``sighting`` by triangles in their directions, where these have larger elevation angles.

    ``triangles`` (m, 3) holds indices of points. ``point_enu_m`` (k, 3) are metres east, north and up from the eye.
    """
    _update_with_triangles(point_enu_m, triangles, directions, sighting.tangent, True, sighting)


def nearest_solids(
    point_enu_m: np.ndarray, triangles: np.ndarray, directions: Directions, tangent: np.ndarray, sighting: Sighting
) -> None:
    """Replace entries of ``sighting`` by triangles that rays meet, where these are nearer.

    ``tangent`` (n,) is the tangent of each ray's elevation angle, in the order of ``directions``. The other parameters are those of
    ``highest_solids``.
    """
    _update_with_triangles(point_enu_m, triangles, directions, tangent, False, sighting)


@compiled
def _update_with_triangles(point, triangles, directions, tangent, seeks_highest, sighting):
    """Update the entries of ``sighting`` with all triangles.

    ``seeks_highest`` is true for ``highest_solids`` and false for ``nearest_solids``; the other parameters are those of these
    functions.
    """
    count = len(directions.azimuth_deg)
    if count == 0:
        return
    azimuth = np.empty(3)
    for m in range(len(triangles)):
        a, b, c = point[triangles[m, 0]], point[triangles[m, 1]], point[triangles[m, 2]]
        if _is_overhead(a, b, c):
            low, high = 0.0, 360.0
        else:
            azimuth[0], azimuth[1], azimuth[2] = azimuth_deg_of(a), azimuth_deg_of(b), azimuth_deg_of(c)
            low, high = azimuth[0], azimuth[0]
            for k in range(1, 3):
                unwrapped = azimuth[0] + (azimuth[k] - azimuth[0] + 540.0) % 360.0 - 180.0
                low, high = min(low, unwrapped), max(high, unwrapped)
            wrap_deg = 360.0 if low < 0.0 else 0.0
            low, high = low + wrap_deg, high + wrap_deg
            if low >= 360.0:
                low, high = low - 360.0, high - 360.0
        begin, end = direction_range(directions, low, high)
        for k in range(begin, end):
            n = k % count
            _update_with_triangle(a, b, c, directions.sine[n], directions.cosine[n], tangent[n], seeks_highest, sighting, n, m)


@internal
def azimuth_deg_of(point):
    """Return the azimuth in degrees, in [0, 360), of a point (east, north, ...)."""
    angle = np.degrees(np.arctan2(point[0], point[1])) % 360.0
    return angle if angle < 360.0 else 0.0


@internal
def _is_overhead(a, b, c):
    """Return whether the vertical line through the eye meets a triangle or its rim.

    The corners ``a``, ``b`` and ``c`` (3,) are east, north and up from the eye.
    """
    ab, bc, ca = a[0] * b[1] - a[1] * b[0], b[0] * c[1] - b[1] * c[0], c[0] * a[1] - c[1] * a[0]
    return (ab >= 0.0 and bc >= 0.0 and ca >= 0.0) or (ab <= 0.0 and bc <= 0.0 and ca <= 0.0)


@internal
def _update_with_triangle(a, b, c, sine, cosine, tangent, seeks_highest, sighting, n, m):
    """Update the entry ``n`` of ``sighting`` with the triangle of index ``m`` and the corners ``a``, ``b`` and ``c`` (3,).

    Corners are metres east, north and up from the eye. ``sine`` and ``cosine`` are those of the direction's azimuth. ``tangent``
    and ``seeks_highest`` are those of ``update_with_segment``.
    """
    crossings = 0
    s0 = z0 = s1 = z1 = 0.0
    for k in range(3):
        p, q = (a, b) if k == 0 else (b, c) if k == 1 else (c, a)
        p_offset, q_offset = p[0] * cosine - p[1] * sine, q[0] * cosine - q[1] * sine
        if (p_offset < 0.0) == (q_offset < 0.0):
            continue
        share = p_offset / (p_offset - q_offset)
        p_distance, q_distance = p[0] * sine + p[1] * cosine, q[0] * sine + q[1] * cosine
        s, z = p_distance + share * (q_distance - p_distance), p[2] + share * (q[2] - p[2])
        if crossings == 0:
            s0, z0 = s, z
        else:
            s1, z1 = s, z
        crossings += 1
    if crossings == 2:
        update_with_segment(s0, z0, s1, z1, tangent, seeks_highest, sighting, n, m)


@internal
def update_with_segment(s0, z0, s1, z1, tangent, seeks_highest, sighting, n, m):
    """Update the entry ``n`` of ``sighting`` with a straight segment in the vertical plane of its direction.

    The segment belongs to the object with index ``m``. It leads from the distance ``s0`` and the height ``z0`` above the eye to
    ``s1`` and ``z1``, metres. If ``seeks_highest``, it replaces the entry if its elevation angle is larger. Otherwise it does so if
    the ray whose elevation angle has the tangent ``tangent`` meets it at a smaller distance.
    """
    if s0 > s1:
        s0, z0, s1, z1 = s1, z1, s0, z0
    if s1 <= MIN_DISTANCE_M:
        return
    if s0 < MIN_DISTANCE_M:
        z0 = z0 + (MIN_DISTANCE_M - s0) / (s1 - s0) * (z1 - z0)
        s0 = MIN_DISTANCE_M
    if seeks_highest:
        for s, z in ((s0, z0), (s1, z1)):
            if z > sighting.tangent[n] * s:
                sighting.tangent[n], sighting.distance_m[n], sighting.object_index[n] = z / s, s, m
    else:
        over, under = z0 - tangent * s0, z1 - tangent * s1
        if (over > 0.0) == (under > 0.0) and over != 0.0 and under != 0.0:
            return
        s = s0 + (over / (over - under) if over != under else 0.0) * (s1 - s0)
        if s < sighting.distance_m[n]:
            sighting.tangent[n], sighting.distance_m[n], sighting.object_index[n] = tangent, s, m
