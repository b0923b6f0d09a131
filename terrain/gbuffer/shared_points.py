"""Which normal a light goes by at a point of the ground, and from where it is looked for.

**Shared points** of a map's ground lie on its nodes, between two of them, or on the diagonals of its quads: several facets meet
there. Such a point has no normal of its own. Whether light reaches it is up to all of its facets: it is turned away from a light
only if all of them are, for else it can be seen from there. So a light goes by the facet that faces it most; what has no direction,
by the mean of all. Neither prefers a side.

**Between the raster's nodes** a facet is a chord of smooth ground, and shading takes it for that. So does shadow: the ground is
turned away from a light where its smooth normal is. From where the light is looked for then: ``terrain.gbuffer.smooth_ground``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.cache import MIB, cached
from terrain.compiled import compiled
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gbuffer.map_points import ON_EDGE, crease_at, facet_corners, facets_at
from terrain.gbuffer.resolve import RELIEF
from terrain.geo.grid import MapView
from terrain.lights import LightPosition

STEEPEST = 1.0 / 32.0
"""Least upward part of a facet's unit normal by which a ray's start is lifted: walls may be steeper, but start no ray higher."""

GRAZING = 2.0**-20
"""A light that meets a surface at no more than this sine (0.2 seconds of arc) counts as below it: unit normals in float32 cannot
say which side it is on, and what it would give is a millionth of its light.
"""

PARALLEL = 1e-6
"""Tangent of the angle below which light comes along a side of a facet, seen from above."""


class FacingNormals(NamedTuple):
    """Of each point of a buffer (rows, cols), for one light.

    Attributes
    ----------
    normal_frame
        float32 (rows, cols, 3), the unit normal of the facet that faces the light most; the smooth one where only that faces the
        light, and where it does not.
    crease
        float32 (rows, cols), as a ``GeometryBuffer`` has it, from that normal.
    lift_frame
        float32 (rows, cols, 3): what takes a point off its facets, all of them, by one metre or a little more. From a point of one
        facet that is the normal. From a shared point the normal of one facet may lead under another: it goes up. Where light comes
        along the rim of the ground it goes inwards, too: a ray along the rim meets it.
    blocked
        bool (rows, cols): whether a shared point's way to the light goes at once below one of its own facets, which faces away.
    lifted
        bool (rows, cols): where the smooth normal faces the light and no facet does.
    """

    normal_frame: np.ndarray
    crease: np.ndarray
    lift_frame: np.ndarray
    blocked: np.ndarray
    lifted: np.ndarray


@cached("light", 512 * MIB)
def facing_normals(buffer: GeometryBuffer, light: LightPosition) -> FacingNormals:
    """Which normals a light goes by. The last ones are kept."""
    normal, nowhere = buffer.normal_frame.copy(), np.zeros(buffer.there.shape, bool)
    facing = FacingNormals(normal, buffer.crease.copy(), normal.copy(), nowhere, nowhere.copy())
    view, surface, ground = buffer.view, buffer.surface, buffer.there & (buffer.kind == RELIEF)
    if surface is not None and isinstance(view, MapView):
        row = view.row0 - surface.row0 + np.arange(view.rows) * view.row_step
        col = view.col0 - surface.col0 + np.arange(view.cols) * view.col_step
        sheet, points = surface.sheet, buffer.position_frame_m
        _turn_to(sheet.position_frame_m, sheet.normals_frame, sheet.falls, row, col, ground, points, light, facing)
    if buffer.lift_m is not None:
        _go_by_smooth(ground & ~np.isnan(buffer.lift_m), buffer.shading_normal_frame, buffer.position_frame_m, light, facing)
    return facing


@compiled
def _turn_to(nodes, faces, falls, row, col, ground, position, light, facing):
    """Put in what holds for the facet that faces a light most, where several share a point of the ground."""
    normal, crease, lift, blocked, _ = facing
    found = np.empty((8, 3), np.int64)
    for i in range(row.size):
        for j in range(col.size):
            if not ground[i, j]:
                continue
            count = facets_at(faces, falls, row[i], col[j], found)
            p = position[i, j]
            x, y, z = light.x - light.w * p[0], light.y - light.w * p[1], light.z - light.w * p[2]
            flattest = normal[i, j, 2]
            if count > 1:
                most, best = -np.inf, 0
                for k in range(count):
                    n = faces[found[k, 0], found[k, 1], found[k, 2]]
                    towards = n[0] * x + n[1] * y + n[2] * z
                    if towards < 0.0 and _leads_over(nodes, falls, found[k], p, x, y):
                        blocked[i, j] = True
                    if towards > most:
                        most, best = towards, k
                    flattest = min(flattest, n[2]) if k > 0 else n[2]
                for k in range(3):
                    normal[i, j, k] = faces[found[best, 0], found[best, 1], found[best, 2], k]
                    lift[i, j, k] = 0.0
                crease[i, j] = crease_at(faces, falls, row[i], col[j], normal[i, j])
                lift[i, j, 2] = 1.0 / max(flattest, STEEPEST)
            if _on_rim(found, count, row[i], col[j]) and _along_a_side(nodes, falls, found, count, p, x, y):
                east, north = _inwards(nodes, falls, found, count, p)
                lift[i, j, 0], lift[i, j, 1], lift[i, j, 2] = east, north, 2.0 / max(flattest, STEEPEST)


@compiled
def _go_by_smooth(where, smooth, position, light, facing):
    """Put in what holds for the smooth ground: its normal where it does not face a light, or no facet does."""
    normal, crease, lift, blocked, lifted = facing
    for i in range(where.shape[0]):
        for j in range(where.shape[1]):
            if not where[i, j]:
                continue
            p, n, s = position[i, j], normal[i, j], smooth[i, j]
            x, y, z = light.x - light.w * p[0], light.y - light.w * p[1], light.z - light.w * p[2]
            least = GRAZING * np.sqrt(x * x + y * y + z * z)
            facet_faces = n[0] * x + n[1] * y + n[2] * z > least
            lifted[i, j] = s[0] * x + s[1] * y + s[2] * z > least and not facet_faces
            if not facet_faces or not s[0] * x + s[1] * y + s[2] * z > least:
                apart = (n[0] - s[0]) ** 2 + (n[1] - s[1]) ** 2 + (n[2] - s[2]) ** 2
                crease[i, j] += np.sqrt(apart)
                blocked[i, j] = False
                for k in range(3):
                    normal[i, j, k] = lift[i, j, k] = s[k]


@compiled
def _leads_over(nodes, falls, facet, p, x, y):
    """Whether a way (x, y) from a point on a facet's side or corner leads, seen from above, over the facet: no share that the
    point has none of (its barycentric coordinates) falls on the way.
    """
    r, c, half = facet
    corners = facet_corners(falls[r, c], half)
    for k in range(3):
        a = nodes[r + corners[k][0], c + corners[k][1]]
        b = nodes[r + corners[(k + 1) % 3][0], c + corners[(k + 1) % 3][1]]
        d = nodes[r + corners[(k + 2) % 3][0], c + corners[(k + 2) % 3][1]]
        side_x, side_y = d[0] - b[0], d[1] - b[1]
        whole = side_x * (a[1] - b[1]) - side_y * (a[0] - b[0])
        share = (side_x * (p[1] - b[1]) - side_y * (p[0] - b[0])) / whole
        turn = (side_x * y - side_y * x) * np.sign(whole)
        if share <= 1e-5 and turn < -PARALLEL * np.sqrt((side_x * side_x + side_y * side_y) * (x * x + y * y)):
            return False
    return True


@compiled
def _on_rim(found, count, row, col):
    """Whether quads are missing round a place on a node or between two."""
    quads = 1
    for k in range(1, count):
        if found[k, 0] != found[k - 1, 0] or found[k, 1] != found[k - 1, 1]:
            quads += 1
    beside = (2 if abs(row - np.rint(row)) <= ON_EDGE else 1) * (2 if abs(col - np.rint(col)) <= ON_EDGE else 1)
    return quads < beside


@compiled
def _along_a_side(nodes, falls, found, count, p, x, y):
    """Whether a way (x, y) from a point runs, seen from above, along a side of one of its facets."""
    for k in range(count):
        r, c, half = found[k]
        for down, right in facet_corners(falls[r, c], half):
            east, north = nodes[r + down, c + right, 0] - p[0], nodes[r + down, c + right, 1] - p[1]
            ahead = east * x + north * y
            if ahead > 0.0 and abs(east * y - north * x) <= PARALLEL * ahead:
                return True
    return False


@compiled
def _inwards(nodes, falls, found, count, p):
    """The horizontal direction, of unit length, from a point to the middle of its facets."""
    east, north = 0.0, 0.0
    for k in range(count):
        r, c, half = found[k]
        for down, right in facet_corners(falls[r, c], half):
            east += nodes[r + down, c + right, 0] - p[0]
            north += nodes[r + down, c + right, 1] - p[1]
    length = np.sqrt(east * east + north * north)
    return east / length, north / length
