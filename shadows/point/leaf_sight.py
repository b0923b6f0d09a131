"""The occlusion of the sky around a point by trees, which are drawn as textured quads with opaque and transparent texels.

A direction is an azimuth. Its vertical plane cuts a quad in a straight segment. A ray in this plane meets the segment in one point,
where the alpha test of the texture decides between leaf and gap. The horizon is the highest leaf. The search follows the segment
from its upper end down, in steps of a quarter of a texel, or of ``TANGENT_STEP`` where that is larger.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.shadows.point.directions import Directions, direction_range
from skugga.shadows.point.solid_sight import MIN_DISTANCE_M, Sighting, azimuth_deg_of
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_corner
from skugga.terrain.interpolation_loops import blend_corners, cell_interval
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, TEXTURE_PX, foliage

TANGENT_STEP = 1e-4
"""Step of the tangent of the elevation angle (0.006 degrees) in the search for distant leaves."""


class VisibleTrees(NamedTuple):
    """Trees (n,) that rise above the horizontal plane through the eye, for compiled loops.

    Attributes
    ----------
    base, shape, yaw_cos_sin, variant, curvature
        As in ``TreeInstances``.
    enu_from_frame
        (3, 3): rotation from the frame to east, north and up.
    eye_frame_m
        (3,) metres: the eye in the frame.
    min_azimuth_deg, max_azimuth_deg
        (n,) degrees: azimuths between which each tree lies.
    max_tangent
        (n,): upper bound of the tangent of each tree's elevation angle.
    alpha
        (layers, rows, cols): alpha channel of the trees' textures.
    """

    base: np.ndarray
    shape: np.ndarray
    yaw_cos_sin: np.ndarray
    variant: np.ndarray
    curvature: float
    enu_from_frame: np.ndarray
    eye_frame_m: np.ndarray
    min_azimuth_deg: np.ndarray
    max_azimuth_deg: np.ndarray
    max_tangent: np.ndarray
    alpha: np.ndarray


def visible_trees(instances: TreeInstances, enu_from_frame: np.ndarray, eye_frame_m: np.ndarray) -> VisibleTrees:
    """Return the trees that rise above the horizontal plane through an eye. Lower trees cannot hide a sun that is up.

    ``enu_from_frame`` (3, 3) rotates vectors of the frame to east, north and up. ``eye_frame_m`` (3,) is the eye in the frame.
    """
    enu_from_frame = np.ascontiguousarray(enu_from_frame)
    number, low, high, steepest = _trees_above_eye(instances.base_frame_m, instances.quad_sizes_m, enu_from_frame, eye_frame_m)
    return VisibleTrees(
        instances.base_frame_m[number], instances.quad_sizes_m[number], instances.yaw_cos_sin[number], instances.variant[number],
        instances.curvature, enu_from_frame, eye_frame_m, low, high, steepest, foliage().mip_levels[0][..., 3],
    )  # fmt: skip


@compiled
def _trees_above_eye(base, shape, enu_rotation, origin):
    """Return the indices of the trees that rise above the horizontal plane through the eye, and three bounds of each.

    ``base`` and ``shape`` are ``base_frame_m`` and ``quad_sizes_m`` of ``TreeInstances``. ``enu_rotation`` (3, 3) leads from the
    frame to east, north and up, and ``origin`` (3,) is the eye in the frame. The bounds are the lowest and the highest azimuth in
    degrees, and an upper bound of the tangent of the elevation angle.
    """
    number = np.empty(len(base), np.int64)
    bounds = np.empty((3, len(base)))
    count = 0
    foot = np.empty(3)
    for m in range(len(base)):
        _frame_to_enu(enu_rotation, origin, base[m, 0], base[m, 1], base[m, 2], foot)
        top = foot[2] + shape[m, 2]
        if top <= 0.0:
            continue
        half = max(shape[m, 0], 1.4143 * shape[m, 1]) + 0.01 * shape[m, 2]
        distance = np.hypot(foot[0], foot[1])
        low, high, steepest = 0.0, 360.0, np.inf
        if distance > half:
            spread = np.degrees(np.arcsin(half / distance))
            low = (azimuth_deg_of(foot) - spread) % 360.0
            high, steepest = low + 2.0 * spread, top / (distance - half)
        number[count], bounds[0, count], bounds[1, count], bounds[2, count] = m, low, high, steepest
        count += 1
    return number[:count], bounds[0, :count].copy(), bounds[1, :count].copy(), bounds[2, :count].copy()


def highest_leaves(trees: VisibleTrees, directions: Directions, sighting: Sighting) -> None:
    """Replace entries of ``sighting`` by the highest leaves in their directions, where these have larger elevation angles."""
    _update_with_trees(trees, directions, sighting.tangent, True, sighting)


def nearest_leaves(trees: VisibleTrees, directions: Directions, tangent: np.ndarray, sighting: Sighting) -> None:
    """Replace entries of ``sighting`` by leaves that rays meet, where these are nearer.

    ``tangent`` (n,) is the tangent of each ray's elevation angle, in the order of ``directions``.
    """
    _update_with_trees(trees, directions, tangent, False, sighting)


@compiled
def _update_with_trees(trees, directions, tangent, seeks_highest, sighting):
    """Update the entries of ``sighting`` with all trees.

    ``seeks_highest`` is true for ``highest_leaves`` and false for ``nearest_leaves``; the other parameters are those of these
    functions. For the highest leaves, ``tangent`` is ``sighting.tangent``.
    """
    count = len(directions.azimuth_deg)
    if count == 0:
        return
    enu_rotation, origin = trees.enu_from_frame, trees.eye_frame_m
    corner, quad = np.empty((4, 3)), np.empty((3, 3, 3))
    for m in range(len(trees.base)):
        begin, end = direction_range(directions, trees.min_azimuth_deg[m], trees.max_azimuth_deg[m])
        has_quads = False
        for k in range(begin, end):
            n = k % count
            if trees.max_tangent[m] <= tangent[n]:  # in a search for the highest leaves, ``tangent`` is the largest so far
                continue
            if not has_quads:
                for q in range(3):
                    for e in range(4):
                        x, y, z = tree_corner(trees.base[m], trees.shape[m], trees.yaw_cos_sin[m], trees.curvature, q, e)
                        _frame_to_enu(enu_rotation, origin, x, y, z, corner[e])
                    for d in range(3):
                        quad[q, 0, d] = corner[0, d]
                        quad[q, 1, d] = corner[1, d] - corner[0, d]
                        quad[q, 2, d] = corner[3, d] - corner[0, d]
                has_quads = True
            for q in range(3):
                layer = 2 * trees.variant[m] + (1 if q == 2 else 0)
                _update_with_quad(
                    quad[q], trees.alpha[layer], directions.sine[n], directions.cosine[n], tangent[n], seeks_highest, sighting, n, m
                )


@internal
def _frame_to_enu(enu_rotation, origin, x, y, z, out):
    """Convert a point ``x``, ``y``, ``z`` of the frame to metres east, north and up from the eye, and write it to ``out`` (3,).

    ``enu_rotation`` (3, 3) leads from the frame to east, north and up, and ``origin`` (3,) is the eye in the frame.
    """
    x, y, z = x - origin[0], y - origin[1], z - origin[2]
    for d in range(3):
        out[d] = enu_rotation[d, 0] * x + enu_rotation[d, 1] * y + enu_rotation[d, 2] * z


@internal
def _update_with_quad(quad, alpha, sine, cosine, tangent, seeks_highest, sighting, n, m):
    """Update the entry ``n`` of ``sighting`` with the leaves of one quad of the tree with index ``m``.

    ``quad`` (3, 3) holds the quad's first corner, its side to the right and its side up, in metres east, north and up from the eye.
    ``alpha`` (h, w) is its texture's alpha channel. ``sine`` and ``cosine`` are those of the direction's azimuth. If
    ``seeks_highest``, the highest leaf counts, otherwise the leaf on the ray whose elevation angle has the tangent ``tangent``.
    """
    first, right, up = quad[0], quad[1], quad[2]
    offset = first[0] * cosine - first[1] * sine
    by_right, by_up = right[0] * cosine - right[1] * sine, up[0] * cosine - up[1] * sine
    crossings = 0
    u0 = v0 = u1 = v1 = 0.0
    for side in range(4):  # the line beside + u by_right + v by_up = 0 in the unit square
        if side < 2:
            u, v = float(side), 0.0
            if by_up == 0.0:
                continue
            v = -(offset + u * by_right) / by_up
        else:
            u, v = 0.0, float(side - 2)
            if by_right == 0.0:
                continue
            u = -(offset + v * by_up) / by_right
        if not (-1e-9 <= u <= 1.0 + 1e-9 and -1e-9 <= v <= 1.0 + 1e-9):
            continue
        if crossings == 0:
            u0, v0 = u, v
            crossings = 1
        elif abs(u - u0) + abs(v - v0) > abs(u1 - u0) + abs(v1 - v0) or crossings == 1:
            u1, v1 = u, v
            crossings = 2
    if crossings < 2:
        return
    base = first[0] * sine + first[1] * cosine
    by_u, by_v = right[0] * sine + right[1] * cosine, up[0] * sine + up[1] * cosine
    s0, s1 = base + u0 * by_u + v0 * by_v, base + u1 * by_u + v1 * by_v
    z0, z1 = first[2] + u0 * right[2] + v0 * up[2], first[2] + u1 * right[2] + v1 * up[2]
    if s0 <= MIN_DISTANCE_M and s1 <= MIN_DISTANCE_M:
        return
    if seeks_highest:
        _highest_leaf(alpha, u0, v0, s0, z0, u1, v1, s1, z1, sighting, n, m)
        return
    over, under = z0 - tangent * s0, z1 - tangent * s1
    if (over > 0.0) == (under > 0.0):
        return
    share = over / (over - under)
    s = s0 + share * (s1 - s0)
    if MIN_DISTANCE_M < s < sighting.distance_m[n] and _is_leaf(alpha, u0 + share * (u1 - u0), v0 + share * (v1 - v0)):
        sighting.tangent[n], sighting.distance_m[n], sighting.object_index[n] = tangent, s, m


@internal
def _highest_leaf(alpha, u0, v0, s0, z0, u1, v1, s1, z1, sighting, n, m):
    """Search a segment of a quad from its upper end down for a leaf, and store it as the entry ``n`` of ``sighting``.

    Each end of the segment, 0 and 1, has texture coordinates u and v, a distance s and a height z from the eye, metres. ``alpha``
    (h, w) is the texture's alpha channel, and ``m`` the index of the tree. The search ends at the elevation angle that the entry
    has already.
    """
    if s0 < MIN_DISTANCE_M or s1 < MIN_DISTANCE_M:  # clip at the vertical through the eye
        share = (MIN_DISTANCE_M - s0) / (s1 - s0)
        u, v, z = u0 + share * (u1 - u0), v0 + share * (v1 - v0), z0 + share * (z1 - z0)
        if s0 < s1:
            u0, v0, s0, z0 = u, v, MIN_DISTANCE_M, z
        else:
            u1, v1, s1, z1 = u, v, MIN_DISTANCE_M, z
    if z0 * s1 < z1 * s0:
        u0, v0, s0, z0, u1, v1, s1, z1 = u1, v1, s1, z1, u0, v0, s0, z0
    if z0 <= sighting.tangent[n] * s0:
        return
    texels = 4.0 * max(abs(u1 - u0), abs(v1 - v0)) * TEXTURE_PX
    steps = int(min(texels, abs(z0 / s0 - z1 / s1) / TANGENT_STEP)) + 1
    for k in range(steps + 1):
        share = k / steps
        s, z = s0 + share * (s1 - s0), z0 + share * (z1 - z0)
        if z <= sighting.tangent[n] * s:
            return
        if _is_leaf(alpha, u0 + share * (u1 - u0), v0 + share * (v1 - v0)):
            sighting.tangent[n], sighting.distance_m[n], sighting.object_index[n] = z / s, s, m
            return


@internal
def _is_leaf(alpha, u, v):
    """Return whether the bilinear alpha (h, w) of a texture is opaque at texture coordinates u and v.

    The result equals that of ``skugga.terrain.casters.rays.sample_alpha``.
    """
    height, width = alpha.shape
    x = min(max(u * width - 0.5, 0.0), width - 1.0)
    y = min(max((1.0 - v) * height - 0.5, 0.0), height - 1.0)
    y0, y1, y_share = cell_interval(y, height)
    x0, x1, x_share = cell_interval(x, width)
    return blend_corners(alpha[y0, x0], alpha[y0, x1], alpha[y1, x0], alpha[y1, x1], y_share, x_share) >= 255.0 * ALPHA_THRESHOLD
