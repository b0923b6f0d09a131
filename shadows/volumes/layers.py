"""Bound the layers of shadow volumes over a point, and split casters into batches whose layers a counter can hold.

The layers over a point are the casting triangles between it and the light. They are at most the triangles that cover the point as
seen from the light. The number of these triangles is the silhouette's winding number. It is 0 where no triangle is. Across a
directed edge, from its right to its left, it grows by the edge's multiplicity. All bounds here count such crossings. They also hold
for triangles moved by rounding, at every point that rounding does not carry across an edge.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.volumes.edges import Edges, connected_parts
from skugga.shadows.volumes.silhouettes import Silhouette, checked_light, silhouette
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.errors import InputError

MAX_STENCIL_LAYERS = 255
"""The largest number of layers that a stencil of 8 bits holds."""

MAX_LUNES = 4096
"""Upper bound of the number of lunes into which directions are cut."""

MIN_LUNES = 16
"""Lower bound of the number of lunes in a full circle. Each lune must remain well below a half-circle."""

LUNE_LINES_PER_EDGE = 0.5
"""Mean number of lines between lunes that an edge may cross."""

MIN_NEAR_PLANE_ANGLE_DEG = 0.1
"""Angle between a light and the near plane up to which the near-clip volume is no larger than rounding."""

ANGLE_TOLERANCE = 1e-9
"""Smallest clearance of an edge from the poles' axis that is safe despite rounding.

It is a share of the edge's distance, or an angle.
"""

POLE_AXIS = np.array([0.4364, 0.2182, 0.8729])
"""A direction of length 1 with which rectangular buildings do not align."""


def max_layers(points: np.ndarray, silhouette: Silhouette, light: np.ndarray) -> int:
    """Return an upper bound of the layers of shadow volumes over any point, at most the number of caps.

    ``points`` (n, 3) are the vertices of the ``silhouette``.

    Directions from the light have an angle phi around an axis. With the axis upwards, phi rises to the left. Half-circles phi =
    phi_k between the poles cut the directions into lunes. Take a plane one unit away from the light, ahead in the middle of a lune.
    On it the half-circles and the edges are straight lines; let v be the height there.

    The number of layers at the lower pole, N(pole), is found triangle by triangle. From there it is known exactly along the
    half-circle phi_k. With rising v it grows by the multiplicity m at an edge that runs to the right, and falls by m at one that
    runs to the left. From the half-circle to the left, within the lune, it grows only at edges that run upwards. So

        N(phi, v) <= N(phi_k, v) + P_k(v)

    where P_k(v) sums the multiplicities of the edges that run upwards through v, cut off at the lune's half-circles. The right-hand
    side is a sum of steps in v. For the sun, the same holds for the points where its rays meet a plane across them, as seen from
    one unit in front of the plane. There, N(pole) = 0.
    """
    light = checked_light(light)
    if not len(silhouette.edges):
        return 0
    vertices = np.asarray(points, np.float32).reshape(-1, 3)
    is_used = np.zeros(len(vertices), bool)
    is_used[silhouette.edges[:, 0]] = True  # each vertex of a closed boundary starts an edge
    edges = (np.cumsum(is_used, dtype=np.int32) - np.int32(1))[silhouette.edges]
    start_vertices = vertices[is_used].astype(np.float64)
    if light[3] == 0.0:
        projected, pole_count = _project_along_sun(start_vertices, light[:3]), 0
    else:
        axes = _oblique_axes_towards(start_vertices.mean(axis=0) - light[:3])
        projected, pole_count = (
            (start_vertices - light[:3]) @ axes.T,
            _count_caps_at_lower_pole((vertices - light[:3]) @ axes[:2].T, silhouette.caps),
        )
    max_winding = _max_winding(projected, edges, silhouette.multiplicity)
    return len(silhouette.caps) if max_winding is None else min(pole_count + max_winding, len(silhouette.caps))


def layer_batches(
    points: np.ndarray,
    triangles: np.ndarray,
    edges: Edges,
    orientations: np.ndarray,
    light: np.ndarray,
    layer_limit: int = MAX_STENCIL_LAYERS,
) -> list[np.ndarray]:
    """Return the casting triangles in groups that cover no point more than ``layer_limit`` times; one group if possible.

    A group is given as the orientations (m,) int8 of all triangles, 0 for triangles outside of it. Any set of triangles casts a
    shadow of its own, and a point is dark where any group's shadow covers it. A group that exceeds the bound is halved between
    connected parts, ordered by their distance from the light. A single part is halved between near and far triangles. Raises
    ``InputError`` for ``layer_limit`` below 1. ``triangles`` (m, 3) holds indices of ``points`` (n, 3).
    """
    if layer_limit < 1:
        raise InputError("layer_limit", layer_limit, "1 or more")
    if max_layers(points, silhouette(triangles, edges, orientations), light) <= layer_limit:
        return [orientations]
    part = connected_parts(edges)
    groups, halves = [], [_sort_by_light_distance(points, triangles, part, orientations, checked_light(light))]
    while halves:
        candidate = halves.pop()
        group = np.zeros_like(orientations)
        group[candidate] = orientations[candidate]
        if max_layers(points, silhouette(triangles, edges, group), light) <= layer_limit:
            groups.append(group)
        else:
            split = _split_index(part[candidate])
            halves += [candidate[split:], candidate[:split]]
    return groups


def may_shade_near_plane(low: np.ndarray, high: np.ndarray, rectangle: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return whether boxes from ``low`` to ``high`` (k, 3) may cast on the near plane's rectangle, bool (k,).

    ``rectangle`` (4, 3) are its corners in order. A box may cast on it if it reaches into the volume swept from the rectangle to
    the light (4,): the near-clip volume of Everitt and Kilgard 2002. The result is False only where a plane separates the two by
    more than rounding: the near plane, a side of the volume or a side of the box. It is True for all where the light lies within
    ``MIN_NEAR_PLANE_ANGLE_DEG`` of the near plane.
    """
    light = checked_light(light)
    low, high, rectangle = (np.asarray(v, np.float64).reshape(-1, 3) for v in (low, high, rectangle))
    to_light = light[:3] - light[3] * rectangle
    normal = np.cross(rectangle[1] - rectangle[0], rectangle[3] - rectangle[0])
    above = to_light @ normal
    min_height = np.sin(np.radians(MIN_NEAR_PLANE_ANGLE_DEG)) * np.linalg.norm(normal) * np.linalg.norm(to_light, axis=1)
    if not (np.abs(above) > min_height).all():
        return np.ones(len(low), bool)
    extent = max(np.abs(low).max(initial=0.0), np.abs(high).max(initial=0.0), np.abs(rectangle).max())
    rounding = 4.0 * float(np.finfo(np.float32).eps) * (extent + light[3] * float(np.abs(light[:3]).max()))
    sides = np.cross(np.roll(rectangle, -1, axis=0) - rectangle, to_light)
    inwards = np.sign(np.einsum("ij,ij->i", sides, rectangle.mean(axis=0) - rectangle))
    planes = np.concatenate([np.sign(above[:1, None]) * normal, inwards[:, None] * sides])
    corners = np.concatenate([rectangle[:1], rectangle])
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    reach = middle @ planes.T - np.einsum("ij,ij->i", planes, corners) + half @ np.abs(planes).T
    inside = (reach >= -rounding * np.abs(planes).sum(axis=1)).all(axis=1)
    far = light[:3] if light[3] else np.where(light[:3] == 0.0, rectangle[0], np.copysign(np.inf, light[:3]))
    lowest, highest = np.minimum(rectangle.min(axis=0), far), np.maximum(rectangle.max(axis=0), far)
    return inside & (high >= lowest - rounding).all(axis=1) & (low <= highest + rounding).all(axis=1)


def _project_along_sun(points: np.ndarray, to_sun: np.ndarray) -> np.ndarray:
    """Return points (n, 3) projected along the sun's rays to a plane one unit ahead, within half a unit of its middle.

    ``to_sun`` (3,) is the direction to the sun. The result (n, 3) is ahead (1), left and up.
    """
    right = np.cross(to_sun, [0.0, 0.0, 1.0]) if to_sun[:2].any() else np.array([1.0, 0.0, 0.0])
    plane = np.stack([axis / np.linalg.norm(axis) for axis in (right, np.cross(right, to_sun))]) @ points.T
    low, high = plane.min(axis=1), plane.max(axis=1)
    scale = max(float((high - low).max()), float(np.finfo(np.float64).tiny))
    return np.stack([np.ones(len(points)), *((plane - (low + high)[:, None] / 2.0) / scale)], axis=-1)


def _oblique_axes_towards(forward: np.ndarray) -> np.ndarray:
    """Return right-handed axes (3, 3): ahead (along ``forward``), left and up.

    Up is oblique, so that rectangular buildings do not align with it. ``forward`` (3,) may be 0; ahead is then ``POLE_AXIS``.
    """
    forward = forward / np.linalg.norm(forward) if forward.any() else POLE_AXIS
    left = np.cross(np.roll(POLE_AXIS, int(np.argmax(np.abs(forward)))), forward)
    left /= np.linalg.norm(left)
    return np.stack([forward, left, np.cross(forward, left)])


def _max_winding(directions: np.ndarray, edges: np.ndarray, multiplicity: np.ndarray) -> int | None:
    """Return the maximum of N(phi_k, v) + P_k(v) - N(pole) in all lunes (``max_layers``).

    ``directions`` (n, 3) are the vertices as seen from the light: ahead, left and up. The result is ``None`` where an edge meets
    the axis through the poles. ``edges`` (e, 2) holds the indices of the silhouette's vertices, and ``multiplicity`` (e,) is that
    of each edge.
    """
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    phi = azimuth[edges]
    phi_change = phi[:, 1] - phi[:, 0]
    wraps = np.abs(phi_change) > np.pi
    phi_change[wraps] -= np.copysign(2.0 * np.pi, phi_change[wraps])
    is_clear = np.hypot(directions[:, 0], directions[:, 1]) > ANGLE_TOLERANCE * np.abs(directions[:, 2])
    if not (is_clear.all() and np.abs(phi_change).max() < np.pi - ANGLE_TOLERANCE):
        return None
    first, span = (-np.pi, 2.0 * np.pi) if wraps.any() else (float(phi.min()), float(np.ptp(phi)))
    if not span:
        return 0
    lines = LUNE_LINES_PER_EDGE * len(multiplicity) * span / max(float(np.abs(phi_change).sum()), 1e-9)
    lunes = int(np.clip(lines, np.ceil(MIN_LUNES * span / (2.0 * np.pi)), MAX_LUNES))
    lune = np.minimum((azimuth - first) / span * lunes, lunes - 1.0).astype(np.int32)[edges]
    position, step = _winding_steps(directions, edges, multiplicity, lune, phi_change > 0.0, first, span / lunes, lunes)
    order = np.argsort(position)
    position, count = position[order], np.cumsum(step[order])
    is_last = np.append(position[1:] > position[:-1], True)  # steps at one position happen at once
    # From pole to pole the count changes by the same amount along every half-circle.
    count -= count[-1] // lunes * position.astype(np.int64)
    return int(count[is_last].max(initial=0))


@compiled
def _winding_steps(directions, edges, multiplicity, lune_of_end, runs_left, first_phi, lune_width, lune_count):
    """Return the positions and sizes of the steps of N(phi_k, v) + P_k(v) in all lunes (``max_layers``), (n,) each.

    A position is the lune's number plus v as a share of 1. ``directions`` (m, 3), ``edges`` (e, 2) and ``multiplicity`` (e,) are
    those of ``_max_winding``. ``lune_of_end`` int (e, 2) is the lune of each end of an edge, and ``runs_left`` bool (e,) tells
    whether phi grows along the edge. The first of the ``lune_count`` lunes starts at the angle ``first_phi``, and each is
    ``lune_width`` wide, radians.
    """
    line = first_phi + lune_width * np.arange(lune_count + 1)
    line_cos, line_sin, cos, sin = np.cos(line), np.sin(line), np.cos(line + 0.5 * lune_width), np.sin(line + 0.5 * lune_width)
    capacity = 0
    for e in range(len(multiplicity)):
        lunes_crossed = lune_of_end[e, 1] - lune_of_end[e, 0] if runs_left[e] else lune_of_end[e, 0] - lune_of_end[e, 1]
        capacity += 2 + 3 * (lunes_crossed % lune_count)
    position, step, n = np.empty(capacity), np.empty(capacity, np.int64), 0
    for e in range(len(multiplicity)):
        a, b, m = directions[edges[e, 0]], directions[edges[e, 1]], multiplicity[e]
        lune, last = lune_of_end[e]
        x, y, z, has_begun = a[0], a[1], a[2], False
        while True:
            start = _lune_height(lune, x * cos[lune] + y * sin[lune], z)
            if has_begun and runs_left[e]:
                position[n], step[n], n = start, -m, n + 1
            if lune == last:
                x, y, z = b[0], b[1], b[2]
            else:
                k = lune + 1 if runs_left[e] else lune
                before = a[1] * line_cos[k] - a[0] * line_sin[k]
                after = b[1] * line_cos[k] - b[0] * line_sin[k]
                share = min(max(before / (before - after), 0.0), 1.0) if before != after else 0.5
                x, y, z = a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])
            end = _lune_height(lune, x * cos[lune] + y * sin[lune], z)
            if end > start:
                position[n], step[n], position[n + 1], step[n + 1], n = start, m, end, -m, n + 2
            if lune == last:
                break
            if not runs_left[e]:
                position[n], step[n], n = end, m, n + 1
            lune, has_begun = (lune + (1 if runs_left[e] else -1)) % lune_count, True
    return position[:n], step[:n]


@internal
def _lune_height(lune, forward, up):
    """Return the number ``lune`` plus a direction's height, as a share of the way between the poles.

    ``forward`` and ``up`` are the direction's components ahead in the middle of the lune and upwards.
    """
    return lune + 0.5 + np.arctan2(up, max(forward, 0.0)) / 3.2


@compiled
def _count_caps_at_lower_pole(directions, caps):
    """Return the number of triangles (c, 3) facing a lamp that contain the lower pole, or may contain it by rounding.

    ``caps`` holds the triangles' indices in ``directions`` (n, 2), the vertices as seen from the lamp: ahead and left.
    """
    count = 0
    for t in range(len(caps)):
        inside = True
        for k in range(3):
            a, b = directions[caps[t, k]], directions[caps[t, (k + 1) % 3]]
            forward, backward = a[0] * b[1], a[1] * b[0]
            inside &= forward - backward >= -1e-12 * (abs(forward) + abs(backward))
        count += inside
    return count


def _sort_by_light_distance(
    points: np.ndarray, triangles: np.ndarray, part_numbers: np.ndarray, orientations: np.ndarray, light: np.ndarray
) -> np.ndarray:
    """Return the casting triangles part by part, and within a part by distance from the light, the nearest first.

    The result holds indices of ``triangles`` (m, 3), whose vertices are ``points`` (n, 3). ``part_numbers`` and ``orientations``
    (m,) are those of the triangles.
    """
    casting = np.flatnonzero(orientations)
    middle = np.asarray(points, np.float64).reshape(-1, 3)[triangles[casting]].mean(axis=1)
    distance = np.linalg.norm(light[:3] - middle, axis=1) if light[3] else -(middle @ light[:3])
    part_numbers = part_numbers[casting]
    part_distance = np.bincount(part_numbers, distance) / np.maximum(np.bincount(part_numbers), 1)
    return casting[np.lexsort((distance, part_numbers, part_distance[part_numbers]))]


def _split_index(part_numbers: np.ndarray) -> int:
    """Return the index at which to halve sorted triangles: between two parts if there are several.

    ``part_numbers`` (n,) holds the number of each triangle's part; triangles of one part are adjacent.
    """
    starts = np.flatnonzero(np.diff(part_numbers)) + 1
    half = len(part_numbers) // 2
    return int(starts[np.argmin(np.abs(starts - half))]) if len(starts) else half
