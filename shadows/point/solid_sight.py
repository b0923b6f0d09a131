"""The occlusion of the sky around a point by triangles, for example of buildings and models.

The vertical plane of a direction cuts a triangle in a straight segment, which ends on two of the triangle's edges. Its elevation
angle is largest at one end. A ray of the direction meets the triangle if it passes between the ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.point.directions import Directions, direction_range
from skugga.terrain.compiled import compiled, internal

MIN_AWAY_M = 1e-6
"""Minimum distance in metres from the vertical through the eye; nearer segments are clipped there."""


class Sighting(NamedTuple):
    """The object seen in each direction (n,).

    Attributes
    ----------
    tangent
        (n,): tangent of its elevation angle above the eye's level.
    distance
        (n,) metres; inf without an object.
    number
        (n,): index of the object; -1 without one.
    """

    tangent: np.ndarray
    distance: np.ndarray
    number: np.ndarray


def nothing_sighted(count: int, tangent: float = -np.inf) -> Sighting:
    """Return a sighting without objects, in so many directions."""
    return Sighting(np.full(count, tangent), np.full(count, np.inf), np.full(count, -1, np.int64))


def highest_solids(point_enu_m: np.ndarray, triangles: np.ndarray, directions: Directions, found: Sighting) -> None:
    """Replace entries of ``found`` by triangles (m, 3) of points (k, 3) with larger tangents towards directions.

    The points are in metres east, north and up from the eye.
    """
    _sight_triangles(point_enu_m, triangles, directions, found.tangent, True, found)


def nearest_solids(
    point_enu_m: np.ndarray, triangles: np.ndarray, directions: Directions, tangent: np.ndarray, found: Sighting
) -> None:
    """Replace entries of ``found`` by nearer triangles that rays meet, with ``tangent`` (n,) above the eye's level."""
    _sight_triangles(point_enu_m, triangles, directions, tangent, False, found)


@compiled
def _sight_triangles(point, triangles, directions, tangent, highest, found):
    count = len(directions.azimuth)
    if count == 0:
        return
    azimuth = np.empty(3)
    for m in range(len(triangles)):
        a, b, c = point[triangles[m, 0]], point[triangles[m, 1]], point[triangles[m, 2]]
        if _inside(a, b, c):
            low, high = 0.0, 360.0
        else:
            azimuth[0], azimuth[1], azimuth[2] = azimuth_of(a), azimuth_of(b), azimuth_of(c)
            low, high = azimuth[0], azimuth[0]
            for k in range(1, 3):
                unwrapped = azimuth[0] + (azimuth[k] - azimuth[0] + 540.0) % 360.0 - 180.0
                low, high = min(low, unwrapped), max(high, unwrapped)
            turn = 360.0 if low < 0.0 else 0.0
            low, high = low + turn, high + turn
            if low >= 360.0:
                low, high = low - 360.0, high - 360.0
        begin, end = direction_range(directions, low, high)
        for k in range(begin, end):
            n = k % count
            _sight(a, b, c, directions.sine[n], directions.cosine[n], tangent[n], highest, found, n, m)


@internal
def azimuth_of(p):
    """Return the azimuth in degrees, in [0, 360), of a point (east, north, ...)."""
    angle = np.degrees(np.arctan2(p[0], p[1])) % 360.0
    return angle if angle < 360.0 else 0.0


@internal
def _inside(a, b, c):
    """Return whether the vertical through the eye meets a triangle, or nearly does."""
    ab, bc, ca = a[0] * b[1] - a[1] * b[0], b[0] * c[1] - b[1] * c[0], c[0] * a[1] - c[1] * a[0]
    return (ab >= 0.0 and bc >= 0.0 and ca >= 0.0) or (ab <= 0.0 and bc <= 0.0 and ca <= 0.0)


@internal
def _sight(a, b, c, sine, cosine, tangent, highest, found, n, m):
    """Test one triangle in one direction."""
    met = 0
    s0 = z0 = s1 = z1 = 0.0
    for k in range(3):
        p, q = (a, b) if k == 0 else (b, c) if k == 1 else (c, a)
        beside, other = p[0] * cosine - p[1] * sine, q[0] * cosine - q[1] * sine
        if (beside < 0.0) == (other < 0.0):
            continue
        share = beside / (beside - other)
        along, after = p[0] * sine + p[1] * cosine, q[0] * sine + q[1] * cosine
        s, z = along + share * (after - along), p[2] + share * (q[2] - p[2])
        if met == 0:
            s0, z0 = s, z
        else:
            s1, z1 = s, z
        met += 1
    if met == 2:
        sight_piece(s0, z0, s1, z1, tangent, highest, found, n, m)


@internal
def sight_piece(s0, z0, s1, z1, tangent, highest, found, n, m):
    """Test a straight segment in the plane of a direction, from one distance and height above the eye to another."""
    if s0 > s1:
        s0, z0, s1, z1 = s1, z1, s0, z0
    if s1 <= MIN_AWAY_M:
        return
    if s0 < MIN_AWAY_M:
        z0 = z0 + (MIN_AWAY_M - s0) / (s1 - s0) * (z1 - z0)
        s0 = MIN_AWAY_M
    if highest:
        for s, z in ((s0, z0), (s1, z1)):
            if z > found.tangent[n] * s:
                found.tangent[n], found.distance[n], found.number[n] = z / s, s, m
    else:
        over, under = z0 - tangent * s0, z1 - tangent * s1
        if (over > 0.0) == (under > 0.0) and over != 0.0 and under != 0.0:
            return
        s = s0 + (over / (over - under) if over != under else 0.0) * (s1 - s0)
        if s < found.distance[n]:
            found.tangent[n], found.distance[n], found.number[n] = tangent, s, m
