"""Compute the float64 point, the normals and the albedo of each pixel from the number of its triangle.

* In perspective the point is the intersection of the pixel's ray with the triangle's plane (T. Moeller and B. Trumbore 1997).
* In a map it is the triangle's point vertically below the pixel's centre.

Barycentric coordinates are clamped to the triangle. Otherwise points could lie outside, since rasterisers snap corners to 1/256 of
a pixel.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.lift import is_smooth, lift_distance
from skugga.terrain.gbuffer.resolve_types import (
    GroundInPerspective,
    PixelCamera,
    ResolvedPoints,
    SolidsInPerspective,
    TreesInPerspective,
)
from skugga.terrain.gbuffer.tree_instances import tree_corner

CROWN_CENTRE_SHARE, CROWN_HALF_HEIGHT_SHARE = 0.55, 0.47
"""Height of a crown's middle, and half the crown's height, as shares of the tree's height."""

CROWN_NORMAL_UP_BIAS = 0.25
"""Value that is added to the upward component of a crown's unit normals, since leaves lean upwards."""

TREE_BRIGHTNESS_VARIATION, TREE_HUE_VARIATION = 0.1, 0.1
"""Largest deviation of a tree's albedo from that of its picture: in brightness, and of red and blue relative to green.

Neighbouring trees of one species differ by as much (the crowns of a stand in aerial photographs; the painted leaves of one crown
differ by 18 % and 4 %, ``skugga.terrain.trees.foliage_paint``).
"""

NO_SURFACE, RELIEF, MESHES, FOREST = 0, 1, 2, 3
"""The kinds of surface that a pixel shows."""


def resolve_perspective(
    triangle_number: np.ndarray,
    camera: PixelCamera,
    ground: GroundInPerspective,
    solids: SolidsInPerspective,
    trees: TreesInPerspective,
    sqrt_albedo: np.ndarray,
) -> ResolvedPoints:
    """Return the points that a camera's pixels show.

    ``triangle_number`` (rows, cols) is the number of the triangle in each pixel, from 1: of the ground, then of the meshes, then of
    the trees; 0 without one. ``sqrt_albedo`` (rows, cols, 4) holds the square roots of the albedo of visible leaves, times 255.
    """
    size = triangle_number.shape
    points = ResolvedPoints(
        np.empty(size, np.bool_), np.empty((*size, 3)), np.empty(size, np.float32),
        np.empty((*size, 3), np.float32), np.empty((*size, 3), np.float32), np.empty(size, np.float32),
        np.empty(size, np.uint8), np.empty((*size, 3), np.float32), np.empty((*size, 9), np.float32),
        np.empty((*size, 2) if len(ground.imagery_cells) else (0, 0, 2), np.float32), np.empty(size, np.float32),
    )  # fmt: skip
    run_in_chunks(size[0], _resolve, triangle_number, camera, ground, solids, trees, sqrt_albedo, points)
    return points


@compiled
def _resolve(first, last, triangle_number, camera, ground_nodes, solids, trees, sqrt_albedo, points):
    """Fill rows ``first`` to ``last`` (exclusive) of ``points``, a ``ResolvedPoints``.

    ``ground_nodes`` is a ``GroundInPerspective``. The other parameters are those of ``resolve_perspective``.
    """
    tangents, finer_tangents, finer_row, finer_col, picture_rows, eye, frame_from_camera = camera
    ground_position, ground_height, ground_normal, ground_triangles, ground_crease, ground_cells = ground_nodes
    solid_position, solid_height, (solid_triangles, solid_albedo, solid_normals, solid_crease) = solids
    tree_base, tree_height, tree_shape, tree_yaw, curvature, tree_number = trees
    valid, point, surface_height, normal, shading_normal, crease, kind, albedo, corners, cells, lift = points
    cols = triangle_number.shape[1]
    ground_count, solid_count = len(ground_triangles), len(solid_triangles)
    p, face = np.empty((3, 3)), np.empty(3, np.float32)
    ray, to_eye = np.empty(3), np.empty(3)
    last_triangle, has_smooth_normals = (
        np.int64(-1),
        False,
    )  # the triangle that p, face and has_smooth_normals belong to: neighbouring pixels mostly show the same one
    for i in range(first, last):
        for j in range(cols):
            t = np.int64(triangle_number[i, j]) - 1
            valid[i, j], kind[i, j], crease[i, j], lift[i, j] = t >= 0, NO_SURFACE, 0.0, 0.0
            for k in range(3):
                albedo[i, j, k] = np.nan
            if len(ground_cells):
                for k in range(2):
                    cells[i, j, k] = np.nan
            if t < 0:
                surface_height[i, j] = np.nan
                for k in range(3):
                    point[i, j, k] = normal[i, j, k] = shading_normal[i, j, k] = np.nan
                for k in range(9):
                    corners[i, j, k] = 0.0
                continue
            if i < picture_rows:
                x, y = tangents[0] + j * tangents[2], tangents[1] + i * tangents[2]
            else:
                x = finer_tangents[0] + finer_col[i - picture_rows, j] * finer_tangents[2]
                y = finer_tangents[1] + finer_row[i - picture_rows, j] * finer_tangents[2]
            for k in range(3):
                ray[k] = frame_from_camera[k, 0] * x + frame_from_camera[k, 1] * y + frame_from_camera[k, 2]
            if t != last_triangle:
                last_triangle = t
                if t < ground_count:
                    for c in range(3):
                        for k in range(3):
                            p[c, k] = ground_position[ground_triangles[t, c], k]
                elif t < ground_count + solid_count:
                    for c in range(3):
                        for k in range(3):
                            p[c, k] = solid_position[solid_triangles[t - ground_count, c], k]
                else:
                    tree, part = (t - ground_count - solid_count) // 6, (t - ground_count - solid_count) % 6
                    _write_tree_triangle(p, tree_base[tree], tree_shape[tree], tree_yaw[tree], curvature, part)
                _face_normal(p, face)
                has_smooth_normals = False
                if t < ground_count:
                    a, b, c = ground_triangles[t, 0], ground_triangles[t, 1], ground_triangles[t, 2]
                    has_smooth_normals = is_smooth(face, ground_normal[a]) and is_smooth(face, ground_normal[b])
                    has_smooth_normals = has_smooth_normals and is_smooth(face, ground_normal[c])
            kind[i, j] = RELIEF if t < ground_count else MESHES if t < ground_count + solid_count else FOREST
            u, v = _barycentric_on_ray(p, eye, ray)
            for k in range(3):
                point[i, j, k] = p[0, k] + u * (p[1, k] - p[0, k]) + v * (p[2, k] - p[0, k])
                normal[i, j, k] = face[k]
                for c in range(3):
                    corners[i, j, 3 * c + k] = p[c, k]
            if t < ground_count:
                a, b, c = ground_triangles[t, 0], ground_triangles[t, 1], ground_triangles[t, 2]
                surface_height[i, j] = (1.0 - u - v) * ground_height[a] + u * ground_height[b] + v * ground_height[c]
                for k in range(3):
                    shading_normal[i, j, k] = (
                        (1.0 - u - v) * ground_normal[a, k] + u * ground_normal[b, k] + v * ground_normal[c, k]
                    )
                crease[i, j] = ground_crease[t]
                length = np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
                for k in range(3):
                    to_eye[k] = -ray[k] / length
                lift[i, j] = np.nan
                seen_from_above = face[0] * to_eye[0] + face[1] * to_eye[1] + face[2] * to_eye[2] > 0.0
                if seen_from_above and has_smooth_normals:
                    lift[i, j] = (
                        (1.0 - u - v) * lift_distance(p[0], ground_normal[a], point[i, j], to_eye)
                        + u * lift_distance(p[1], ground_normal[b], point[i, j], to_eye)
                        + v * lift_distance(p[2], ground_normal[c], point[i, j], to_eye)
                    )
                if len(ground_cells):
                    for k in range(2):
                        cells[i, j, k] = (1.0 - u - v) * ground_cells[a, k] + u * ground_cells[b, k] + v * ground_cells[c, k]
            elif t < ground_count + solid_count:
                s = t - ground_count
                a, b, c = solid_triangles[s, 0], solid_triangles[s, 1], solid_triangles[s, 2]
                surface_height[i, j] = (1.0 - u - v) * solid_height[a] + u * solid_height[b] + v * solid_height[c]
                n = solid_normals[s]
                for k in range(3):
                    shading_normal[i, j, k] = (1.0 - u - v) * n[0, k] + u * n[1, k] + v * n[2, k]
                    albedo[i, j, k] = solid_albedo[s, k]
                crease[i, j] = solid_crease[s]
                if normal[i, j, 0] * ray[0] + normal[i, j, 1] * ray[1] + normal[i, j, 2] * ray[2] > 0.0:
                    for k in range(3):  # the back side of an open mesh
                        normal[i, j, k] = -normal[i, j, k]
                        shading_normal[i, j, k] = -shading_normal[i, j, k]
            else:
                tree = (t - ground_count - solid_count) // 6
                _write_leaf_shading(
                    point[i, j], ray, tree_base[tree], tree_shape[tree], sqrt_albedo[i, j], shading_normal[i, j], albedo[i, j]
                )
                red_factor, green_factor, blue_factor = tree_tint(tree_number[tree])
                albedo[i, j, 0] *= red_factor
                albedo[i, j, 1] *= green_factor
                albedo[i, j, 2] *= blue_factor
                surface_height[i, j] = tree_height[tree] + point[i, j, 2] - tree_base[tree, 2]
            _normalise(shading_normal[i, j])


@compiled
def resolve_map(pixel, triangle_number, sqrt_albedo, solids, trees, points):
    """Replace the ground's points in ``points`` by those of meshes and trees where these are higher, in place.

    ``pixel``, ``triangle_number`` and ``sqrt_albedo`` are the arrays of ``ObjectPixels``. Triangles are those of ``solids``, then
    those of ``trees``.
    """
    solid_position, solid_px, (solid_triangles, solid_albedo, solid_normals, solid_crease) = solids
    tree_base, tree_px, tree_shape, tree_yaw, curvature, px_from_m = trees
    valid, point, surface_height, normal, shading_normal, crease, kind, albedo, corners, _, _ = points
    cols = valid.shape[1]
    solid_count = len(solid_triangles)
    p, q = np.empty((3, 3)), np.empty((3, 3))
    down = np.array([0.0, 0.0, -1.0])
    for n in range(len(pixel)):
        i, j, t = np.int64(pixel[n]) // cols, np.int64(pixel[n]) % cols, np.int64(triangle_number[n]) - 1
        tree = (t - solid_count) // 6
        if t < solid_count:
            for c in range(3):
                for k in range(3):
                    p[c, k] = solid_position[solid_triangles[t, c], k]
                    q[c, k] = solid_px[solid_triangles[t, c], k]
        else:
            _write_tree_triangle(p, tree_base[tree], tree_shape[tree], tree_yaw[tree], curvature, (t - solid_count) % 6)
            for c in range(3):
                east, north = p[c, 0] - tree_base[tree, 0], p[c, 1] - tree_base[tree, 1]
                q[c, 0] = tree_px[tree, 0] + px_from_m[0, 0] * east + px_from_m[0, 1] * north
                q[c, 1] = tree_px[tree, 1] + px_from_m[1, 0] * east + px_from_m[1, 1] * north
                q[c, 2] = tree_px[tree, 2] + p[c, 2] - tree_base[tree, 2]
        u, v = _barycentric_in_plan(q, j + 0.5, i + 0.5)
        height = q[0, 2] + u * (q[1, 2] - q[0, 2]) + v * (q[2, 2] - q[0, 2])
        if valid[i, j] and surface_height[i, j] >= height:
            continue
        valid[i, j] = True
        surface_height[i, j] = height
        for k in range(3):
            point[i, j, k] = p[0, k] + u * (p[1, k] - p[0, k]) + v * (p[2, k] - p[0, k])
            for c in range(3):
                corners[i, j, 3 * c + k] = p[c, k]
        _face_normal(p, normal[i, j])
        crease[i, j] = 0.0
        if t < solid_count:
            kind[i, j] = MESHES
            crease[i, j] = solid_crease[t]
            corner_normals = solid_normals[t]
            for k in range(3):
                shading_normal[i, j, k] = (1.0 - u - v) * corner_normals[0, k] + u * corner_normals[1, k] + v * corner_normals[2, k]
                albedo[i, j, k] = solid_albedo[t, k]
            if normal[i, j, 2] < 0.0:
                for k in range(3):
                    normal[i, j, k] = -normal[i, j, k]
                    shading_normal[i, j, k] = -shading_normal[i, j, k]
        else:
            kind[i, j] = FOREST
            _write_leaf_shading(
                point[i, j], down, tree_base[tree], tree_shape[tree], sqrt_albedo[n], shading_normal[i, j], albedo[i, j]
            )
        _normalise(shading_normal[i, j])


@internal
def _write_tree_triangle(p, base, quad_sizes, yaw_cos_sin, curvature, triangle_in_tree):
    """Write the corners (3, 3) of one of a tree's six triangles to ``p``.

    ``triangle_in_tree`` is the triangle's index, from 0. ``base``, ``quad_sizes`` and ``yaw_cos_sin`` are the tree's rows of the
    arrays of ``TreeInstances``.
    """
    quad, second = triangle_in_tree // 2, triangle_in_tree % 2
    for c in range(3):
        corner = c if second == 0 or c == 0 else c + 1
        x, y, z = tree_corner(base, quad_sizes, yaw_cos_sin, curvature, quad, corner)
        p[c, 0], p[c, 1], p[c, 2] = x, y, z


@internal
def _barycentric_on_ray(p, eye, ray):
    """Return the barycentric weights of a triangle's second and third corner where a ray meets its plane.

    They are clamped to the triangle.
    """
    e1x, e1y, e1z = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    e2x, e2y, e2z = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    hx, hy, hz = ray[1] * e2z - ray[2] * e2y, ray[2] * e2x - ray[0] * e2z, ray[0] * e2y - ray[1] * e2x
    det = e1x * hx + e1y * hy + e1z * hz
    if det == 0.0:
        return 1.0 / 3.0, 1.0 / 3.0
    sx, sy, sz = eye[0] - p[0, 0], eye[1] - p[0, 1], eye[2] - p[0, 2]
    u = (sx * hx + sy * hy + sz * hz) / det
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    return _clamp_barycentric(u, (ray[0] * qx + ray[1] * qy + ray[2] * qz) / det)


@internal
def _barycentric_in_plan(q, x, y):
    """Return the barycentric weights of a triangle's second and third corner at the plan position (``x``, ``y``).

    The first two columns of ``q`` (3, 3) are the corners' plan positions. The weights are clamped to the triangle, and 1/3 for a
    triangle without area in plan.
    """
    ax, ay, bx, by = q[1, 0] - q[0, 0], q[1, 1] - q[0, 1], q[2, 0] - q[0, 0], q[2, 1] - q[0, 1]
    det = ax * by - ay * bx
    if det == 0.0:
        return 1.0 / 3.0, 1.0 / 3.0
    x, y = x - q[0, 0], y - q[0, 1]
    return _clamp_barycentric((x * by - y * bx) / det, (ax * y - ay * x) / det)


@internal
def _clamp_barycentric(u, v):
    """Return the weights ``u`` and ``v`` of a triangle's second and third corner, changed to those of a point of the triangle."""
    u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
    if u + v > 1.0:
        total = u + v
        u, v = u / total, v / total
    return u, v


@internal
def _face_normal(p, out):
    """Write the unit normal (3,) of the triangle with the corners ``p`` (3, 3). It is (0, 0, 1) for a triangle without area."""
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        out[0], out[1], out[2] = x / length, y / length, z / length
    else:
        out[0], out[1], out[2] = 0.0, 0.0, 1.0


@compiled
def _write_leaf_shading(point, ray, base, quad_sizes, sqrt_albedo, shading_normal, albedo):
    """Write the shading normal (3,) and the albedo (3,) of a visible leaf.

    A tree is drawn as crossed quads. The normal is instead that of an ellipsoid with the size of the crown, at the place where the
    ray to the point meets it or passes nearest to it. So it does not depend on the quad, and the quads are not visible. It is
    tilted upwards by ``CROWN_NORMAL_UP_BIAS``, as leaves are. ``base`` and ``quad_sizes`` are the tree's rows of the arrays of
    ``TreeInstances``. ``sqrt_albedo`` (4,) is the pixel's (``IdBuffer``).
    """
    half_width, half_height = max(np.float64(quad_sizes[0]), 1e-3), max(CROWN_HALF_HEIGHT_SHARE * quad_sizes[2], 1e-3)
    qx, qy, qz = (
        (point[0] - base[0]) / half_width,
        (point[1] - base[1]) / half_width,
        (point[2] - base[2] - CROWN_CENTRE_SHARE * quad_sizes[2]) / half_height,
    )
    dx, dy, dz = ray[0] / half_width, ray[1] / half_width, ray[2] / half_height
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / length, dy / length, dz / length
    projection = qx * dx + qy * dy + qz * dz
    qx, qy, qz = qx - projection * dx, qy - projection * dy, qz - projection * dz
    depth_inside = np.sqrt(max(1.0 - (qx * qx + qy * qy + qz * qz), 0.0))
    x, y, z = (qx - depth_inside * dx) / half_width, (qy - depth_inside * dy) / half_width, (qz - depth_inside * dz) / half_height
    length = np.sqrt(x * x + y * y + z * z)
    shading_normal[0], shading_normal[1], shading_normal[2] = x / length, y / length, z / length + CROWN_NORMAL_UP_BIAS
    for k in range(3):
        albedo[k] = (sqrt_albedo[k] / 255.0) ** 2


@compiled
def tree_tint(tree_number):
    """Return the factors of a tree's red, green and blue albedo, by a hash of its number in the level.

    No two neighbours look alike, and a tree keeps its colour from frame to frame. The hash is the finaliser of SplitMix64
    (G. Steele, D. Lea and C. Flood 2014, "Fast splittable pseudorandom number generators").
    """
    bits = (np.uint64(tree_number) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    brightness = 1.0 + TREE_BRIGHTNESS_VARIATION * (2.0 * np.float64(bits >> np.uint64(32)) / 2.0**32 - 1.0)
    warmth = TREE_HUE_VARIATION * (2.0 * np.float64(bits & np.uint64(0xFFFFFFFF)) / 2.0**32 - 1.0)
    return brightness * (1.0 + warmth), brightness, brightness * (1.0 - warmth)


@internal
def _normalise(v):
    """Scale the vector ``v`` (3,) to unit length, in place. The zero vector does not change."""
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if length > 0.0:
        for k in range(3):
            v[k] /= length
