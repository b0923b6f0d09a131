"""Bound the ranges of a perspective shadow map: how small they may be, and at which depth the map may begin."""

from __future__ import annotations

import numpy as np

from skugga.shadows.maps.post_perspective import horizon_distance, project_points


def min_map_ranges(matrix: np.ndarray, points: np.ndarray, error_m: np.ndarray, map_size: int) -> np.ndarray:
    """Return lower bounds (2,) of a map's x and y ranges, at which a texel is four times the error of positions.

    ``error_m`` (n,) are the errors of the positions ``points`` (n, 3). The bounds apply to a single receiver, or to a few at one
    place, where finer texels would resolve rounding only. ``matrix`` (4, 4) maps points of the frame to the map, which has
    ``map_size`` texels along a side.
    """
    w = horizon_distance(matrix, points)[:, None]
    projected_xy = project_points(matrix, points)[:, :2]
    per_m = np.linalg.norm(matrix[None, :2, :3] - projected_xy[..., None] * matrix[3, :3], axis=-1) / w
    return 4.0 * map_size * (error_m[:, None] * per_m).max(axis=0)


def latest_start_depths(
    matrix: np.ndarray, points: np.ndarray, corners: np.ndarray, error_m: np.ndarray, tap_reach_texels: float
) -> np.ndarray:
    """Return the largest depth (n,) at which a map may begin, for each of the points (n, 3) on triangles (n, 3, 3).

    Depths are the z of ``matrix``, which maps to texels in x and y. A map clamps casters in front of its first depth to that depth.
    Such a caster shades a point under two conditions. The point is deeper by all that the comparison subtracts. The point's
    triangle begins no earlier than the map at the texels up to ``tap_reach_texels`` beside the point. The result allows for twice
    the amount that the shader subtracts, except for the shader's share of the whole depth range. ``corners`` (n, 3, 3) are those of
    the triangles, and ``error_m`` (n,) the errors of the positions.
    """
    w = horizon_distance(matrix, points)[:, None]
    in_map = project_points(matrix, points)
    per_m = np.linalg.norm(matrix[None, :3, :3] - in_map[..., None] * matrix[3, :3], axis=-1) / w
    sides = corners - points[:, None]
    w_offsets = sides @ matrix[3, :3]
    x, y, z = np.moveaxis(sides @ matrix[:3, :3].T - in_map[:, None] * w_offsets[..., None], -1, 0)
    corner_w = w + w_offsets
    share, right, up = np.cross(x, y), np.cross(y, corner_w), np.cross(corner_w, x)
    area = (share * corner_w).sum(axis=1)
    area = np.where(area == 0.0, np.inf, area)
    slope = np.abs(np.stack([(z * right).sum(axis=1), (z * up).sum(axis=1)], axis=1) / area[:, None])
    corner_depths = np.where(
        (corner_w > 0.0).all(axis=1, keepdims=True), z / np.where(corner_w > 0.0, corner_w, 1.0), [[-np.inf, np.inf, 0.0]]
    )
    grid = 1.0 / 128.0 + error_m[:, None] * per_m[:, :2]
    slack = np.minimum((slope * grid).sum(axis=1), np.ptp(corner_depths, axis=1)) + error_m * per_m[:, 2]
    depth_ratio = 1.0 + 3.0 * w[:, 0] * (np.abs(right.sum(axis=1)) + np.abs(up.sum(axis=1))) / np.abs(area)
    return (
        in_map[:, 2] - 2.0 * slack * depth_ratio**2 - np.minimum(tap_reach_texels * slope.sum(axis=1), -corner_depths.min(axis=1))
    )
