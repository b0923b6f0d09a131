"""Select and scale the trees that a view draws. Small trees are decimated in a way that preserves the share of shaded ground.

Where trees are smaller than a few pixels, only a share k of them is drawn. They are spread evenly over the stand, a group of trees
(``skugga.terrain.trees.thinning``). The drawn trees are enlarged by 1 / sqrt(k) in all directions, so that they cover the same
area. The thinned stand intercepts as much light from any direction as the full stand, so the shaded shares of crowns and ground are
the same. Single shadows become coarser and longer. The picture, shadow maps and rays use the same trees.

In perspective k depends on a tree's distance from the eye, not on the direction of view. In a map k depends on the size of the
pixels and of the tree's crown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene_objects import SceneObjects
from skugga.terrain.trees.foliage import TREE_VARIANTS, leaf_outlines
from skugga.terrain.trees.trees import Trees

FULL_STAND_TREE_PX = 6.8
"""Height of a tree, in pixels, above which a perspective view decimates no trees."""

FULL_STAND_CROWN_PX = 1.5
"""Diameter of a crown, in pixels, above which a map decimates no trees."""

MIN_DRAWN_TREE_SHARE = 1.0 / 16.0
"""Lower bound of the share of trees that is drawn."""

QUAD_TRIANGLES = np.array([[4 * quad + a, 4 * quad + b, 4 * quad + c] for quad in range(3) for a, b, c in ((0, 1, 2), (0, 2, 3))])
"""Corner indices (6, 3) of a tree's triangles: two for each of its three quads, which have four corners each."""


@dataclass(frozen=True, eq=False)
class TreeInstances:
    """The drawn trees in a frame, one row each.

    Attributes
    ----------
    tree_number
        int64 (n,), the trees' indices in the arrays of ``Trees``.
    base_frame_m, base_height_m
        float64 (n, 3) and (n,), the feet of the trees in the frame, and their heights, metres.
    quad_sizes_m
        float32 (n, 4), metres. A tree is drawn as two upright quads and a horizontal one. The values are half the width of the
        upright quads, half the width of the horizontal quad, the tree's height, and the height of the horizontal quad.
    yaw_cos_sin
        float32 (n, 2), cosine and sine of the rotation about the stem.
    variant
        int32 (n,), index in ``TREE_VARIANTS``.
    curvature
        Tilt of the vertical, radians, per metre from the frame's origin: 1 / radius of the earth; 0 in a flat world.
    """

    tree_number: np.ndarray
    base_frame_m: np.ndarray
    base_height_m: np.ndarray
    quad_sizes_m: np.ndarray
    yaw_cos_sin: np.ndarray
    variant: np.ndarray
    curvature: float

    def __len__(self) -> int:
        return len(self.variant)

    def select(self, selection: np.ndarray) -> TreeInstances:
        """Return the trees that indices or a mask select."""
        return TreeInstances(
            self.tree_number[selection], self.base_frame_m[selection], self.base_height_m[selection], self.quad_sizes_m[selection],
            self.yaw_cos_sin[selection], self.variant[selection], self.curvature,
        )  # fmt: skip

    def in_box(self, rotation: np.ndarray, translation: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the indices of the trees whose bounding spheres intersect a box.

        ``low`` and ``high`` (3,) bound the box in the axes ``rotation @ point + translation``.
        """
        is_inside = np.empty(len(self), np.bool_)
        run_in_chunks(
            len(self), _mark_trees_in_box, self.base_frame_m, self.quad_sizes_m, rotation, translation, low, high, is_inside
        )
        return np.flatnonzero(is_inside)

    def in_frustum(self, eye: np.ndarray, rotation: np.ndarray, tangents: np.ndarray) -> np.ndarray:
        """Return the indices of the trees whose bounding spheres intersect a viewing pyramid.

        The apex is ``eye``. ``rotation`` (3, 3) maps to the camera's axes x, y and z, of which z is the pyramid's axis.
        ``tangents`` (2, 2) describe the pyramid's sides: row 0 holds the minimum and the maximum of x / z inside the pyramid, row 1
        those of y / z.
        """
        is_inside = np.empty(len(self), np.bool_)
        run_in_chunks(len(self), _mark_trees_in_frustum, self.base_frame_m, self.quad_sizes_m, eye, rotation, tangents, is_inside)
        return np.flatnonzero(is_inside)

    def front_to_back(self, indices: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return indices of trees, sorted front to back along a direction (3,).

        In this order a rasteriser does not shade pixels that nearer trees hide.
        """
        return indices[np.argsort(self.base_frame_m[indices] @ direction, kind="stable")]

    def corners(self) -> np.ndarray:
        """Return the corners (n, 3, 4, 3) float64 of the trees' quads in the frame: two upright quads, then the horizontal one."""
        return tree_corners(self.base_frame_m, self.quad_sizes_m, self.yaw_cos_sin, self.curvature)

    def outlines(self) -> np.ndarray:
        """Return the corners (n, 3, k, 3) of convex polygons in the frame. Each contains all leaves of one of the trees' quads."""
        corners, pictures = self.corners(), leaf_outlines()
        uv = pictures[2 * self.variant[:, None] + np.array([0, 0, 1])]
        right, up = (corners[:, :, end] - corners[:, :, 0] for end in (1, 3))
        return corners[:, :, :1] + uv[..., :1] * right[:, :, None] + uv[..., 1:] * up[:, :, None]


def _cache_key(objects: SceneObjects, *key_parts: object) -> tuple[object, ...]:
    """Return a cache key that ignores the meshes, so that moving meshes do not invalidate the trees."""
    return objects.elevation, objects.trees, *key_parts


@cached("scene", 512 * MIB, key=_cache_key)
def tree_instances_in_map(objects: SceneObjects, frame: LocalFrame, pixel_m: float) -> TreeInstances | None:
    """Return the trees that maps with pixels ``pixel_m`` metres wide draw; ``None`` without trees.

    They are the trees of the whole level, since trees outside of a map cast shadows into it.
    """
    trees = objects.trees
    return None if trees is None else _drawn_trees(objects, trees, frame, trees.crown_diameter_m / (pixel_m * FULL_STAND_CROWN_PX))


def map_draws_trees(trees: Trees, pixel_m: float) -> bool:
    """Return whether a map with pixels ``pixel_m`` metres wide draws at least one tree after decimation."""
    return bool((trees.thinning_rank < _drawn_share(trees.crown_diameter_m / (pixel_m * FULL_STAND_CROWN_PX))).any())


@cached("scene", 512 * MIB, key=_cache_key)
def tree_instances_in_perspective(
    objects: SceneObjects, frame: LocalFrame, eye_earth_m: tuple[float, float, float], focal_px: float
) -> TreeInstances | None:
    """Return the trees that views from an eye draw, in all directions; ``None`` without trees.

    Trees behind the eye may cast shadows into the view. ``focal_px`` is the focal length in pixels.
    """
    trees = objects.trees
    if trees is None:
        return None
    size = np.empty(len(trees.thinning_rank))
    run_in_chunks(len(size), _write_relative_sizes, trees.base_earth_m, np.array(eye_earth_m), trees.height_m * focal_px, size)
    return _drawn_trees(objects, trees, frame, size)


def _drawn_trees(objects: SceneObjects, trees: Trees, frame: LocalFrame, size: np.ndarray) -> TreeInstances:
    """Return the drawn trees. ``size`` (n,) is each tree's size over the size from which all trees are drawn."""
    share = _drawn_share(size)
    number = np.flatnonzero(trees.thinning_rank < share)
    share = share[number]
    base = _tree_bases(objects, frame)[number]
    half, height = trees.crown_diameter_m[number] / 2.0, trees.height_m[number]
    crown_quad_height = np.array([variant.crown_quad_height for variant in TREE_VARIANTS], np.float32)[trees.variant[number]]
    return TreeInstances(
        tree_number=number,
        base_frame_m=base,
        base_height_m=objects.tree_base_heights_m[number],
        quad_sizes_m=(np.stack([half, half, height, height * crown_quad_height], axis=1) / np.sqrt(share)[:, None]).astype(
            np.float32
        ),
        yaw_cos_sin=_yaws(trees)[number],
        variant=trees.variant[number].astype(np.int32),
        curvature=objects.world.curvature,
    )


@cached("scene", 64 * MIB)
def _yaws(trees: Trees) -> np.ndarray:
    """Return cosine and sine (n, 2) float32 of the rotation of all trees."""
    yaw_rad = np.radians(trees.yaw_deg.astype(np.float64))
    return np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1).astype(np.float32)


@cached("scene", 256 * MIB, key=_cache_key)
def _tree_bases(objects: SceneObjects, frame: LocalFrame) -> np.ndarray:
    """Return the feet (n, 3) of all trees in a frame, metres. They are cached, since views from several eyes share a frame."""
    assert objects.trees is not None
    return frame.points_from_earth(objects.trees.base_earth_m)


@compiled
def _write_relative_sizes(first, last, base, eye, height_px, out):
    """Write each tree's height in pixels, divided by ``FULL_STAND_TREE_PX``, to ``out`` (n,).

    ``base`` (n, 3) are the trees' feet. ``height_px`` (n,) are the trees' heights in pixels at a distance of 1 m from the eye.
    """
    for n in range(first, last):
        x, y, z = base[n, 0] - eye[0], base[n, 1] - eye[1], base[n, 2] - eye[2]
        out[n] = height_px[n] / (max(np.sqrt(x * x + y * y + z * z), 1.0) * FULL_STAND_TREE_PX)


def _drawn_share(size: np.ndarray) -> np.ndarray:
    """Return the share (n,) of trees that is drawn, from ``MIN_DRAWN_TREE_SHARE`` to 1.

    ``size`` (n,) is each tree's size over the size from which all trees are drawn.
    """
    return np.clip(size.astype(np.float64) ** 2, MIN_DRAWN_TREE_SHARE, 1.0)


@internal
def tree_corner(base, quad_sizes, yaw_cos_sin, curvature, quad, corner):
    """Return the corner ``corner`` (x, y, z) of the quad ``quad`` of a tree, in the frame.

    Quads 0 and 1 are upright, and quad 2 is horizontal. Corners are 0 to 3; the texture coordinate u is 0 at corners 0 and 3, else
    1. The other parameters are the tree's rows of the arrays of ``TreeInstances``.
    """
    cosine, sine = np.float64(yaw_cos_sin[0]), np.float64(yaw_cos_sin[1])
    x, y = base[0] * curvature, base[1] * curvature
    scale = 1.0 / np.sqrt(1.0 + x * x + y * y)
    side = -1.0 if corner == 0 or corner == 3 else 1.0
    high = 1.0 if corner >= 2 else 0.0
    if quad == 0:
        local_x, local_y, up = side * quad_sizes[0], 0.0, high * quad_sizes[2]
    elif quad == 1:
        local_x, local_y, up = 0.0, side * quad_sizes[0], high * quad_sizes[2]
    else:
        local_x, local_y, up = side * quad_sizes[1], (2.0 * high - 1.0) * quad_sizes[1], np.float64(quad_sizes[3])
    up *= scale
    return (
        base[0] + local_x * cosine - local_y * sine + up * x,
        base[1] + local_x * sine + local_y * cosine + up * y,
        base[2] + up,
    )


@internal
def tree_radius(quad_sizes):
    """Return the radius of the bounding sphere of a tree's quads, whose centre is half-way up the stem."""
    half_width = max(quad_sizes[0], 1.4143 * quad_sizes[1])
    return np.sqrt(half_width * half_width + 0.25 * quad_sizes[2] * quad_sizes[2])


@compiled
def _mark_trees_in_box(first, last, base, quad_sizes, rotation, translation, low, high, is_inside):
    """Write to ``is_inside`` (n,) which trees from ``first`` to ``last`` (exclusive) have a bounding sphere that intersects a box.

    ``low`` and ``high`` (3,) bound the box in the axes ``rotation @ point + translation``.
    """
    for n in range(first, last):
        radius = tree_radius(quad_sizes[n])
        inside = True
        for k in range(3):
            v = (
                rotation[k, 0] * base[n, 0] + rotation[k, 1] * base[n, 1] + rotation[k, 2] * (base[n, 2] + 0.5 * quad_sizes[n, 2])
                + translation[k]
            )  # fmt: skip
            inside = inside and v + radius >= low[k] and v - radius <= high[k]
        is_inside[n] = inside


@compiled
def _mark_trees_in_frustum(first, last, base, quad_sizes, eye, rotation, tangents, is_inside):
    """Write to ``is_inside`` (n,) which trees from ``first`` to ``last`` (exclusive) may intersect a viewing pyramid.

    The other parameters are those of ``TreeInstances.in_frustum``.
    """
    in_camera = np.empty(3)
    for n in range(first, last):
        radius = tree_radius(quad_sizes[n])
        for k in range(3):
            in_camera[k] = (
                rotation[k, 0] * (base[n, 0] - eye[0]) + rotation[k, 1] * (base[n, 1] - eye[1])
                + rotation[k, 2] * (base[n, 2] + 0.5 * quad_sizes[n, 2] - eye[2])
            )  # fmt: skip
        intersects = in_camera[2] > -radius
        for axis in range(2):
            low, high = tangents[axis, 0], tangents[axis, 1]
            intersects = intersects and in_camera[axis] - low * in_camera[2] > -radius * np.sqrt(1.0 + low * low)
            intersects = intersects and high * in_camera[2] - in_camera[axis] > -radius * np.sqrt(1.0 + high * high)
        is_inside[n] = intersects


@compiled
def tree_corners(base, quad_sizes, yaw_cos_sin, curvature):
    """Return the corners (n, 3, 4, 3) float64 of the quads of n trees: two upright quads, then the horizontal one.

    The parameters are arrays of ``TreeInstances``.
    """
    out = np.empty((len(base), 3, 4, 3))
    for n in range(len(base)):
        for quad in range(3):
            for corner in range(4):
                x, y, z = tree_corner(base[n], quad_sizes[n], yaw_cos_sin[n], curvature, quad, corner)
                out[n, quad, corner, 0], out[n, quad, corner, 1], out[n, quad, corner, 2] = x, y, z
    return out
