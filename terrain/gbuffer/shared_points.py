"""Which normal a light goes by at a point of the ground, and from where it is looked for.

**Shared points** of a map's ground lie on its nodes, between two of them, or on the diagonals of its quads: several facets meet
there. Such a point has no normal of its own. Whether light reaches it is up to all of its facets: it is turned away from a light
only if all of them are, for else it can be seen from there. So a light goes by the facet that faces it most; what has no direction,
by the mean of all. Neither prefers a side.

**Between the raster's nodes** a facet is a chord of smooth ground, and shading takes it for that. So does shadow: the ground is
turned away from a light where its smooth normal is. From where the light is looked for then:
``skugga.terrain.gbuffer.smooth_ground``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, in_shares, internal
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.lift import up_at
from skugga.terrain.gbuffer.map_points import ON_EDGE, crease_at, facet_corners, facets_at
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.lights import LightPosition

STEEPEST = 1.0 / 32.0
"""Least upward part of a facet's unit normal by which a ray's start is lifted: walls may be steeper, but start no ray higher."""

GRAZING = 2.0**-20
"""A light that meets a surface at no more than this sine (0.2 seconds of arc) counts as below it: unit normals in float32 cannot
say which side it is on, and what it would give is a millionth of its light.
"""

LEAST_LIFT_M = 1e-3
"""Least lift that takes a point off its facet for float32. Where the smooth ground lies no higher, as in a hollow, a facet that is
turned away shades it.
"""

PARALLEL = 1e-6
"""Tangent of the angle below which light comes along a side of a facet, seen from above."""


class FacingNormals(NamedTuple):
    """Of each point of a buffer (rows, cols), for one light.

    Attributes
    ----------
    normal_frame
        float32 (rows, cols, 3), the unit normal of the facet that faces the light most; the smooth one where that does not face
        the light, and where the point is lifted.
    crease
        float32 (rows, cols), as a ``GeometryBuffer`` has it, from that normal.
    lift_frame
        float32 (rows, cols, 3): what takes a point off its facets, all of them, by one metre or a little more. From a point of one
        facet that is the buffer's normal, and ``None`` where all points are such. From a shared point the normal of one facet may
        lead under another: it goes up. Where light comes along the rim of the ground it goes inwards, too: a ray along the rim
        meets it.
    blocked
        bool (rows, cols): whether a shared point's way to the light goes at once below one of its own facets, which faces away.
    lifted
        bool (rows, cols): where the smooth normal faces the light, no facet does, and the smooth ground lies above.
    """

    normal_frame: np.ndarray
    crease: np.ndarray
    lift_frame: np.ndarray | None
    blocked: np.ndarray
    lifted: np.ndarray


def _from_afar(buffer: GeometryBuffer, light: LightPosition) -> bool:
    """Whether a light comes from one direction to triangles of a perspective view: then it is all one where on them points lie, or
    have been put, and which of them are looked at.
    """
    return buffer.surface is None and light.w == 0.0


def _made_from(buffer: GeometryBuffer, light: LightPosition) -> tuple[object, ...]:
    if not _from_afar(buffer, light):
        return buffer, light
    return buffer.normal_frame, buffer.shading_normal_frame, buffer.crease, buffer.kind, buffer.lift_m, light


@cached("light", 512 * MIB, key=_made_from, most=8)
def facing_normals(buffer: GeometryBuffer, light: LightPosition) -> FacingNormals:
    """Which normals a light goes by; off the surface they mean nothing. The last ones are kept."""
    nowhere = np.zeros(buffer.there.shape, bool)
    facing = FacingNormals(buffer.normal_frame.copy(), buffer.crease.copy(), None, nowhere, nowhere.copy())
    view, surface, ground = buffer.view, buffer.surface, buffer.kind == RELIEF
    if not _from_afar(buffer, light):
        ground &= buffer.there
    if surface is not None and isinstance(view, MapView):
        facing = facing._replace(lift_frame=buffer.normal_frame.copy())
        row = view.row0 - surface.row0 + np.arange(view.rows) * view.row_step
        col = view.col0 - surface.col0 + np.arange(view.cols) * view.col_step
        sheet, points = surface.sheet, buffer.position_frame_m
        nodes, centre = sheet.position_frame_m, surface.centre_frame_m
        _turn_to(nodes, sheet.normals_frame, sheet.falls, centre, row, col, ground, points, light, facing)
    if buffer.lift_m is not None:
        in_shares(
            len(ground), _go_by_smooth, ground, buffer.shading_normal_frame, buffer.lift_m, buffer.position_frame_m, light, facing
        )  # fmt: skip
    return facing


@compiled
def _turn_to(nodes, faces, falls, centre, row, col, ground, position, light, facing):
    """Put in what holds for the facet that faces a light most, where several share a point of the ground."""
    normal, crease, lift, blocked, _ = facing
    found, axes = np.empty((8, 3), np.int64), np.empty((3, 3))
    for i in range(row.size):
        for j in range(col.size):
            if not ground[i, j]:
                continue
            count = facets_at(faces, falls, row[i], col[j], found)
            p = position[i, j]
            x, y, z = light.x - light.w * p[0], light.y - light.w * p[1], light.z - light.w * p[2]
            _axes_at(p, centre, axes)
            up = axes[2]
            east, north = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z, axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
            flattest = _along(normal[i, j], up)
            if count > 1:
                most, best = -np.inf, 0
                for k in range(count):
                    n = faces[found[k, 0], found[k, 1], found[k, 2]]
                    towards = n[0] * x + n[1] * y + n[2] * z
                    if towards < 0.0 and _leads_over(nodes, falls, found[k], p, axes, east, north):
                        blocked[i, j] = True
                    if towards > most:
                        most, best = towards, k
                    flattest = min(flattest, _along(n, up)) if k > 0 else _along(n, up)
                for k in range(3):
                    normal[i, j, k] = faces[found[best, 0], found[best, 1], found[best, 2], k]
                    lift[i, j, k] = up[k] / max(flattest, STEEPEST)
                crease[i, j] = crease_at(faces, falls, row[i], col[j], normal[i, j])
            if _on_rim(falls, found, count, row[i], col[j]) and _along_a_side(nodes, falls, found, count, p, axes, east, north):
                east, north = _inwards(nodes, falls, found, count, p, axes)
                for k in range(3):
                    lift[i, j, k] = east * axes[0, k] + north * axes[1, k] + 2.0 * up[k] / max(flattest, STEEPEST)


@compiled
def _go_by_smooth(first, last, ground, smooth, lift, position, light, facing):
    """Put in what holds for the smooth ground: its normal where it does not face a light, or it alone does from above the facet."""
    normal, crease, _, blocked, lifted = facing
    for i in range(first, last):
        for j in range(ground.shape[1]):
            if not ground[i, j] or np.isnan(lift[i, j]):
                continue
            p, n, s = position[i, j], normal[i, j], smooth[i, j]
            x, y, z = light.x - light.w * p[0], light.y - light.w * p[1], light.z - light.w * p[2]
            least = GRAZING * np.sqrt(x * x + y * y + z * z)
            smooth_faces = s[0] * x + s[1] * y + s[2] * z > least
            facet_faces = n[0] * x + n[1] * y + n[2] * z > least
            lifted[i, j] = smooth_faces and not facet_faces and lift[i, j] > LEAST_LIFT_M
            if lifted[i, j] or not smooth_faces:
                apart = (n[0] - s[0]) ** 2 + (n[1] - s[1]) ** 2 + (n[2] - s[2]) ** 2
                crease[i, j] += np.sqrt(apart)
                blocked[i, j] = False
                for k in range(3):
                    normal[i, j, k] = s[k]


@internal
def _along(vector, axis):
    return vector[0] * axis[0] + vector[1] * axis[1] + vector[2] * axis[2]


@internal
def _axes_at(point, centre, out):
    """Two horizontal axes and the one up at a point, the rows of (3, 3); the frame's own in a flat world."""
    up = out[2]
    up_at(point, centre, up)
    first = 0 if abs(up[0]) < 0.7 else 1
    for k in range(3):
        out[0, k] = (1.0 if k == first else 0.0) - up[first] * up[k]
    length = np.sqrt(_along(out[0], out[0]))
    for k in range(3):
        out[0, k] /= length
    for k in range(3):
        out[1, k] = up[(k + 1) % 3] * out[0, (k + 2) % 3] - up[(k + 2) % 3] * out[0, (k + 1) % 3]


@internal
def _in_plan(node, p, axes):
    """Where a node lies as seen from above, from a point on."""
    x, y, z = node[0] - p[0], node[1] - p[1], node[2] - p[2]
    return axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z, axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z


@internal
def _leads_over(nodes, falls, facet, p, axes, east, north):
    """Whether a way from a point on a facet's side or corner leads, seen from above, over the facet: no share that the point has
    none of (its barycentric coordinates) falls on the way.
    """
    r, c, half = facet
    corners = facet_corners(falls[r, c], half)
    for k in range(3):
        a = _in_plan(nodes[r + corners[k][0], c + corners[k][1]], p, axes)
        b = _in_plan(nodes[r + corners[(k + 1) % 3][0], c + corners[(k + 1) % 3][1]], p, axes)
        d = _in_plan(nodes[r + corners[(k + 2) % 3][0], c + corners[(k + 2) % 3][1]], p, axes)
        side_x, side_y = d[0] - b[0], d[1] - b[1]
        whole = side_x * (a[1] - b[1]) - side_y * (a[0] - b[0])
        share = (side_y * b[0] - side_x * b[1]) / whole
        turn = (side_x * north - side_y * east) * np.sign(whole)
        if share <= 1e-5 and turn < -PARALLEL * np.sqrt((side_x * side_x + side_y * side_y) * (east * east + north * north)):
            return False
    return True


@internal
def _on_rim(falls, found, count, row, col):
    """Whether quads are missing round a place on a node or between two, or the other half of a quad on whose diagonal it lies."""
    quads = 0
    for k in range(count):
        r, c = found[k, 0], found[k, 1]
        if k > 0 and r == found[k - 1, 0] and c == found[k - 1, 1]:
            continue
        quads += 1
        is_paired = k + 1 < count and r == found[k + 1, 0] and c == found[k + 1, 1]
        aside = (col - c) - (row - r) if falls[r, c] else 1.0 - (row - r) - (col - c)
        if not is_paired and abs(aside) <= ON_EDGE:
            return True
    beside = (2 if abs(row - np.rint(row)) <= ON_EDGE else 1) * (2 if abs(col - np.rint(col)) <= ON_EDGE else 1)
    return quads < beside


@internal
def _along_a_side(nodes, falls, found, count, p, axes, east, north):
    """Whether a way from a point runs, seen from above, along a side of one of its facets."""
    for k in range(count):
        r, c, half = found[k]
        for down, right in facet_corners(falls[r, c], half):
            x, y = _in_plan(nodes[r + down, c + right], p, axes)
            ahead = x * east + y * north
            if ahead > 0.0 and abs(x * north - y * east) <= PARALLEL * ahead:
                return True
    return False


@internal
def _inwards(nodes, falls, found, count, p, axes):
    """The horizontal direction, of unit length, from a point to the middle of its facets."""
    east, north = 0.0, 0.0
    for k in range(count):
        r, c, half = found[k]
        for down, right in facet_corners(falls[r, c], half):
            x, y = _in_plan(nodes[r + down, c + right], p, axes)
            east, north = east + x, north + y
    length = np.sqrt(east * east + north * north)
    return east / length, north / length
