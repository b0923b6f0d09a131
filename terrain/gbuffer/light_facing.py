"""Choose the normal that a light uses at each point of the ground, and the offset of the shadow ray's start from the point.

A facet is a triangle of the ground.

**Shared points** of a map's ground lie on its nodes, on the sides of its quads, or on their diagonals. Several facets meet there,
and the point has no normal of its own. It faces away from a light only if all of these facets do; otherwise the light reaches it
over one of them. So a light uses the normal of the facet that faces it most. Quantities without a direction use the mean normal of
the facets. Neither choice prefers a side.

**Between the raster's nodes** a facet is a chord of smooth ground. Shading uses the smooth normal there, and so do shadows: ground
faces away from a light where its smooth normal does. ``skugga.terrain.gbuffer.smooth_ground`` moves the starts of shadow rays to
the smooth ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.lift import write_up
from skugga.terrain.gbuffer.map_points import FACET_EDGE_TOLERANCE_NODES, crease_at, facet_corners, facets_at
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.lights import LightPosition

MIN_NORMAL_UP = 1.0 / 32.0
"""Lower bound of the upward component of a facet's unit normal, in the lift of a ray's start. It limits the lift at steep walls."""

MIN_LIGHT_SINE = 2.0**-20
"""Sine of the light's angle above a surface up to which the light counts as below it: 0.2 seconds of arc.

At smaller angles float32 normals cannot tell on which side of the surface the light is. It would contribute a millionth of its
light.
"""

MIN_LIFT_M = 1e-3
"""Minimum height of the smooth ground above a facet, metres, to which a point is lifted. A smaller lift is lost in float32.

Where the smooth ground is lower, as in a hollow, a facet that faces away from the light shades its points.
"""

MAX_PARALLEL_TANGENT = 1e-6
"""Tangent of the angle, as seen from above, below which light counts as parallel to a side of a facet."""


class FacingNormals(NamedTuple):
    """Normals and ray starts at the points of a buffer (rows, cols), for one light.

    Attributes
    ----------
    normal_frame
        float32 (rows, cols, 3), the unit normal of the facet that faces the light most. It is the smooth normal instead where the
        smooth normal faces away from the light, and where the point is lifted.
    crease
        float32 (rows, cols), ``crease`` of a ``GeometryBuffer``, measured from ``normal_frame``.
    lift_frame
        float32 (rows, cols, 3), the vector that lifts a point off all of its facets by at least one metre. For a point on one facet
        it is the facet's normal. For a shared point it points up, since the normal of one facet may lead below another facet. On
        the rim of the ground, if light is parallel to a side of a facet, it also points inwards, so that a ray along the rim hits
        the rim. ``None`` if it is the buffer's normal everywhere, and unless it was requested.
    is_blocked
        bool (rows, cols), whether one of a shared point's own facets blocks the light: the facet faces away from the light, and the
        ray from the point to the light starts below it.
    is_lifted
        bool (rows, cols), whether a point is to be moved to the smooth ground. There the smooth normal faces the light, no facet
        does, and the smooth ground lies above the facet.
    """

    normal_frame: np.ndarray
    crease: np.ndarray
    lift_frame: np.ndarray | None
    is_blocked: np.ndarray
    is_lifted: np.ndarray


def _is_position_independent(buffer: GeometryBuffer, light: LightPosition) -> bool:
    """Return whether the normals for a light do not depend on the points' positions within their triangles.

    This holds for a directional light, where the buffer has no nodes of a map's smooth ground.
    """
    return buffer.surface is None and light.w == 0.0


def _cache_key(buffer: GeometryBuffer, light: LightPosition, with_lifts: bool = False) -> tuple[object, ...]:
    """Return the cache key of ``facing_normals``. Buffers that differ only in their points share it if these do not matter.

    In a map they matter to a directional light only where no point is moved to the smooth ground: the ray from a moved point is
    not tested against the facets below it. So a buffer and its moved copy (``move_to_smooth_ground``) share their normals.
    """
    arrays = buffer.normal_frame, buffer.shading_normal_frame, buffer.crease, buffer.surface_kind, buffer.lift_m
    if _is_position_independent(buffer, light):
        return *arrays, light
    if light.w == 0.0 and not with_lifts:
        return *arrays, buffer.valid, buffer.surface, buffer.view, light
    return buffer, light, with_lifts


@cached("light", 512 * MIB, key=_cache_key, max_entries=8)
def facing_normals(buffer: GeometryBuffer, light: LightPosition, with_lifts: bool = False) -> FacingNormals:
    """Return the normals that a light uses at a buffer's points. Values in pixels without a surface are undefined.

    ``with_lifts`` is whether to compute ``lift_frame``, too, which only rays from the points need.
    """
    nowhere = np.zeros(buffer.valid.shape, bool)
    facing = FacingNormals(buffer.normal_frame.copy(), buffer.crease.copy(), None, nowhere, nowhere.copy())
    view, surface, ground = buffer.view, buffer.surface, buffer.surface_kind == RELIEF
    if not _is_position_independent(buffer, light):
        ground &= buffer.valid
    if surface is not None and isinstance(view, MapView):
        lift = buffer.normal_frame.copy() if with_lifts else None
        facing = facing._replace(lift_frame=lift)
        row = view.row0 - surface.row0 + np.arange(view.rows) * view.row_step
        col = view.col0 - surface.col0 + np.arange(view.cols) * view.col_step
        sheet, points = surface.with_rim.sheet, buffer.position_frame_m
        nodes, centre = sheet.position_frame_m, surface.up_origin_frame_m
        run_in_chunks(
            len(ground), _write_facing_facets, nodes, sheet.normals_frame, sheet.is_cut_nw_se, centre, row, col, ground, points,
            light, facing.normal_frame, facing.crease, facing.is_blocked, lift,
        )  # fmt: skip
    if buffer.lift_m is not None:
        run_in_chunks(
            len(ground), _write_smooth_normals, ground, buffer.shading_normal_frame, buffer.lift_m, buffer.position_frame_m,
            light, facing.normal_frame, facing.crease, facing.is_blocked, facing.is_lifted,
        )  # fmt: skip
    return facing


@compiled
def _write_facing_facets(
    first, last, nodes, faces, is_cut_nw_se, up_origin, row, col, ground, position, light, normal, crease, blocked, lift
):
    """Write the fields of ``FacingNormals`` at points of a map's ground that several facets share.

    ``normal`` (rows, cols, 3), ``crease`` and ``blocked`` are the fields ``normal_frame``, ``crease`` and ``is_blocked``. The first
    two are those of the facet that faces the light most. ``lift`` is the field ``lift_frame``, which is also written at points on
    the rim of the ground; ``None`` unless it is requested. ``nodes`` (m, n, 3), ``faces`` (m - 1, n - 1, 2, 3) and ``is_cut_nw_se``
    are positions, normals of facets and diagonals of the sheet. ``row`` (rows,) and ``col`` (cols,) are the pixels' fractional rows
    and columns on it. ``ground`` (rows, cols) is the mask of pixels that show ground, and ``position`` (rows, cols, 3) their
    points. Rows run from ``first`` to ``last`` (exclusive).
    """
    facets, axes = np.empty((8, 3), np.int64), np.empty((3, 3))
    for i in range(first, last):
        for j in range(col.size):
            if not ground[i, j]:
                continue
            count = facets_at(faces, is_cut_nw_se, row[i], col[j], facets)
            if count <= 1 and lift is None:
                continue
            p = position[i, j]
            x, y, z = light.x - light.w * p[0], light.y - light.w * p[1], light.z - light.w * p[2]
            max_facing, best, faces_away = -np.inf, 0, False
            if count > 1:
                for k in range(count):
                    n = faces[facets[k, 0], facets[k, 1], facets[k, 2]]
                    towards = n[0] * x + n[1] * y + n[2] * z
                    faces_away = faces_away or towards < 0.0
                    if towards > max_facing:
                        max_facing, best = towards, k
                if faces_away:
                    _write_local_axes(p, up_origin, axes)
                    east, north = _plan_components(axes, x, y, z)
                    for k in range(count):
                        n = faces[facets[k, 0], facets[k, 1], facets[k, 2]]
                        if n[0] * x + n[1] * y + n[2] * z < 0.0 and _enters_facet(
                            nodes, is_cut_nw_se, facets[k], p, axes, east, north
                        ):
                            blocked[i, j] = True
            if lift is not None:
                _write_lift(nodes, faces, is_cut_nw_se, up_origin, facets, count, row[i], col[j], p, (x, y, z), normal[i, j], axes,
                            lift[i, j])  # fmt: skip
            if count > 1:
                for k in range(3):
                    normal[i, j, k] = faces[facets[best, 0], facets[best, 1], facets[best, 2], k]
                crease[i, j] = crease_at(faces, is_cut_nw_se, row[i], col[j], normal[i, j])


@internal
def _plan_components(axes, x, y, z):
    """Return the components of a vector along the first two of three ``axes`` (3, 3)."""
    return axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z, axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z


@internal
def _write_lift(nodes, faces, is_cut_nw_se, up_origin, facets, count, row, col, p, to_light, mean_normal, axes, lift):
    """Write the lift (3,) of a point: that of ``FacingNormals``.

    ``facets`` holds the ``count`` facets at the point ``p`` (3,) (``facets_at``), at the fractional ``row`` and ``col``.
    ``to_light`` is the direction to the light, a tuple, and ``mean_normal`` (3,) the buffer's normal. ``axes`` (3, 3) is scratch
    memory. The other parameters are those of ``_write_facing_facets``.
    """
    _write_local_axes(p, up_origin, axes)
    up = axes[2]
    flattest = _dot(mean_normal, up)
    if count > 1:
        for k in range(count):
            n = faces[facets[k, 0], facets[k, 1], facets[k, 2]]
            flattest = min(flattest, _dot(n, up)) if k > 0 else _dot(n, up)
        for k in range(3):
            lift[k] = up[k] / max(flattest, MIN_NORMAL_UP)
    east, north = _plan_components(axes, to_light[0], to_light[1], to_light[2])
    if _is_on_rim(is_cut_nw_se, facets, count, row, col) and _is_parallel_to_side(
        nodes, is_cut_nw_se, facets, count, p, axes, east, north
    ):
        east, north = _inward_direction(nodes, is_cut_nw_se, facets, count, p, axes)
        for k in range(3):
            lift[k] = east * axes[0, k] + north * axes[1, k] + 2.0 * up[k] / max(flattest, MIN_NORMAL_UP)


@compiled
def _write_smooth_normals(
    first, last, ground, smooth_normals, lift, position, light, normal, crease, blocked, lifted
):  # fmt: skip
    """Write the smooth normals to fields of ``FacingNormals`` where they decide about the light instead of the facets.

    They do in two cases: where the smooth normal faces away from the light, and where it faces the light, no facet does and the
    smooth ground lies above the facet. ``ground`` (rows, cols) is the mask of pixels that show ground; ``smooth_normals``, ``lift``
    and ``position`` are ``shading_normal_frame``, ``lift_m`` and ``position_frame_m`` of their buffer. Rows run from ``first`` to
    ``last`` (exclusive). ``normal``, ``crease``, ``blocked`` and ``lifted`` are ``normal_frame``, ``crease``, ``is_blocked`` and
    ``is_lifted``.
    """
    for i in range(first, last):
        for j in range(ground.shape[1]):
            if not ground[i, j] or np.isnan(lift[i, j]):
                continue
            p, n, s = position[i, j], normal[i, j], smooth_normals[i, j]
            x, y, z = light.x - light.w * p[0], light.y - light.w * p[1], light.z - light.w * p[2]
            min_facing = MIN_LIGHT_SINE * np.sqrt(x * x + y * y + z * z)
            smooth_faces = s[0] * x + s[1] * y + s[2] * z > min_facing
            facet_faces = n[0] * x + n[1] * y + n[2] * z > min_facing
            lifted[i, j] = smooth_faces and not facet_faces and lift[i, j] > MIN_LIFT_M
            if lifted[i, j] or not smooth_faces:
                squared_distance = (n[0] - s[0]) ** 2 + (n[1] - s[1]) ** 2 + (n[2] - s[2]) ** 2
                crease[i, j] += np.sqrt(squared_distance)
                blocked[i, j] = False
                for k in range(3):
                    normal[i, j, k] = s[k]


@internal
def _dot(vector, axis):
    """Return the dot product of two vectors (3,)."""
    return vector[0] * axis[0] + vector[1] * axis[1] + vector[2] * axis[2]


@internal
def _write_local_axes(point, up_origin, out):
    """Write three orthogonal unit axes at a point as rows (3, 3): two horizontal ones, then up.

    Up points away from ``up_origin``. In a flat world the axes are the frame's.
    """
    up = out[2]
    write_up(point, up_origin, up)
    first = 0 if abs(up[0]) < 0.7 else 1
    for k in range(3):
        out[0, k] = (1.0 if k == first else 0.0) - up[first] * up[k]
    length = np.sqrt(_dot(out[0], out[0]))
    for k in range(3):
        out[0, k] /= length
    for k in range(3):
        out[1, k] = up[(k + 1) % 3] * out[0, (k + 2) % 3] - up[(k + 2) % 3] * out[0, (k + 1) % 3]


@internal
def _plan_offset(node, p, axes):
    """Return the horizontal offset (x, y) of a node from the point ``p``, along the first two ``axes``."""
    x, y, z = node[0] - p[0], node[1] - p[1], node[2] - p[2]
    return axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z, axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z


@internal
def _enters_facet(nodes, is_cut_nw_se, facet, p, axes, east, north):
    """Return whether a ray from a point on a facet's side or corner runs over the facet, as seen from above.

    It does if no barycentric coordinate of the point that is 0 decreases along the ray. ``facet`` (3,) is a row of ``facets_at``,
    and ``nodes`` (m, n, 3) are the sheet's positions. ``east`` and ``north`` are the ray's components along the first two ``axes``.
    """
    r, c, half = facet
    corners = facet_corners(is_cut_nw_se[r, c], half)
    for k in range(3):
        a = _plan_offset(nodes[r + corners[k][0], c + corners[k][1]], p, axes)
        b = _plan_offset(nodes[r + corners[(k + 1) % 3][0], c + corners[(k + 1) % 3][1]], p, axes)
        d = _plan_offset(nodes[r + corners[(k + 2) % 3][0], c + corners[(k + 2) % 3][1]], p, axes)
        side_x, side_y = d[0] - b[0], d[1] - b[1]
        area = side_x * (a[1] - b[1]) - side_y * (a[0] - b[0])
        share = (side_y * b[0] - side_x * b[1]) / area
        inward_speed = (side_x * north - side_y * east) * np.sign(area)
        if share <= 1e-5 and inward_speed < -MAX_PARALLEL_TANGENT * np.sqrt(
            (side_x * side_x + side_y * side_y) * (east * east + north * north)
        ):
            return False
    return True


@internal
def _is_on_rim(is_cut_nw_se, facets, count, row, col):
    """Return whether a position on a node or between two nodes lies on the rim of the ground.

    On the rim a quad beside the position is missing, or the position lies on a quad's diagonal and half of the quad is missing.
    ``facets`` holds the ``count`` facets at the position (``facets_at``), at the fractional ``row`` and ``col``.
    """
    quads = 0
    for k in range(count):
        r, c = facets[k, 0], facets[k, 1]
        if k > 0 and r == facets[k - 1, 0] and c == facets[k - 1, 1]:
            continue
        quads += 1
        is_paired = k + 1 < count and r == facets[k + 1, 0] and c == facets[k + 1, 1]
        diagonal_distance = (col - c) - (row - r) if is_cut_nw_se[r, c] else 1.0 - (row - r) - (col - c)
        if not is_paired and abs(diagonal_distance) <= FACET_EDGE_TOLERANCE_NODES:
            return True
    expected_quads = (2 if abs(row - np.rint(row)) <= FACET_EDGE_TOLERANCE_NODES else 1) * (
        2 if abs(col - np.rint(col)) <= FACET_EDGE_TOLERANCE_NODES else 1
    )
    return quads < expected_quads


@internal
def _is_parallel_to_side(nodes, is_cut_nw_se, facets, count, p, axes, east, north):
    """Return whether a ray from a point runs, as seen from above, towards a corner of one of the point's facets.

    From a point on a side of a facet such a ray is parallel to that side. ``facets`` holds the ``count`` facets at the point ``p``
    (3,). ``nodes`` (m, n, 3) are the sheet's positions. ``east`` and ``north`` are the ray's components along the first two
    ``axes``.
    """
    for k in range(count):
        r, c, half = facets[k]
        for down, right in facet_corners(is_cut_nw_se[r, c], half):
            x, y = _plan_offset(nodes[r + down, c + right], p, axes)
            forward = x * east + y * north
            if forward > 0.0 and abs(x * north - y * east) <= MAX_PARALLEL_TANGENT * forward:
                return True
    return False


@internal
def _inward_direction(nodes, is_cut_nw_se, facets, count, p, axes):
    """Return the components (east, north) of the horizontal unit vector from a point to the middle of its facets.

    The parameters are those of ``_is_parallel_to_side``.
    """
    east, north = 0.0, 0.0
    for k in range(count):
        r, c, half = facets[k]
        for down, right in facet_corners(is_cut_nw_se[r, c], half):
            x, y = _plan_offset(nodes[r + down, c + right], p, axes)
            east, north = east + x, north + y
    length = np.sqrt(east * east + north * north)
    return east / length, north / length
