"""The matrix of a trapezoidal shadow map, after Martin and Tan 2004, "Anti-aliasing and continuity with trapezoidal shadow maps".

The light sees the camera's frustum as a convex polygon. A trapezoid holds it (section 6 of the paper):

- The *centre line* runs through the images of the centres of the near and of the far plane. It is the view's axis as the light
  sees it.
- The *top line* and the *base line* are perpendicular to it. They touch the polygon at its near and at its far end, ``height``
  apart.
- The sides meet on the centre line, at the distance ``apex`` in front of the top line, and touch the polygon.

A homography maps the trapezoid to the square from -1 to 1: the base line to y = -1, the top line to y = 1. The *80 % rule* places
the sides' apex. The part of the frustum up to a focus, at the distance ``focus`` behind the top line, fills 80 % of the square: the
focus maps to y = -0.6.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.maps.camera import Camera, Light
from skugga.shadows.maps.post_perspective import (
    MIN_EXTENT_SHARE,
    NO_POINTS,
    UNIFORM_MAP_CONE_DEG,
    PostPerspective,
    candidate_maker,
    fit_to_bounds,
    horizon_distance,
    is_clear_of_horizon,
    off_axis_deg,
    project_points,
    texel_size_in_picture,
    uniform_matrix,
)

FOCUS_LINE = -0.6
"""The y of the focus in the map, from 1 at the top line to -1 at the base line: 80 % of the map lie before it."""

FOCUS_SHARE = 0.4
"""Distance of the focus behind the nearest receiver, as a share of the receivers' range of depths.

The paper leaves it to users. This is the best of those that were measured (``docs/reports/seeds.md``).
"""


def trapezoidal_maps(
    camera: Camera,
    light: Light,
    points: np.ndarray,
    inner_half_width: float,
    outer_receivers: np.ndarray = NO_POINTS,
    focus_share: float = FOCUS_SHARE,
) -> list[PostPerspective]:
    """Return the candidate maps for receivers (n, 3) in front of the eye: the trapezoidal map, if it is finer, and the uniform one.

    ``focus_share`` is the focus's place between the nearest receiver (0) and the farthest (1). The other parameters are those of
    ``skugga.shadows.maps.post_perspective.post_perspectives``.
    """
    required_points = np.concatenate([points, outer_receivers])
    make_candidate = candidate_maker(camera, light, points, outer_receivers, inner_half_width)
    uniform = uniform_matrix(light, points)

    def uniform_map(reason: str) -> PostPerspective:
        return make_candidate(uniform, None, np.inf, f"a uniform map: {reason}")

    angle_deg = off_axis_deg(camera, light, points.mean(axis=0))
    if angle_deg <= UNIFORM_MAP_CONE_DEG:
        limit = f"within the limit of {UNIFORM_MAP_CONE_DEG:g}"
        return [uniform_map(f"the light is {angle_deg:.1f} degrees off the view's axis, {limit}")]
    corners, axis_points = receiver_frustum(camera, required_points, focus_share)
    uniform_distances = horizon_distance(uniform, np.concatenate([corners, required_points]))
    if not is_clear_of_horizon(uniform_distances / uniform_distances.max()):
        return [uniform_map("a corner of the frustum does not lie in front of the lamp")]
    apex, matrix = trapezoid_matrix(project_points(uniform, corners)[:, :2], project_points(uniform, axis_points)[:, :2])
    if not np.isfinite(apex):
        return [uniform_map("a map without a warp gives the focus 80 % or more")]
    matrix = matrix @ uniform
    if not is_clear_of_horizon(horizon_distance(matrix, required_points) / horizon_distance(uniform, required_points)):
        return [uniform_map("the apex is too near to keep all receivers in front of the map's horizon")]
    projected = project_points(matrix, required_points)
    # The trapezoid's own axes are kept. The map is scaled to the receivers, as all maps here are.
    low, high = projected.min(axis=0), projected.max(axis=0)
    clip = fit_to_bounds(matrix, np.array([*low[:2], -1.0]), np.array([*high[:2], 1.0]), inner_half_width)
    warped = PostPerspective(clip, "parallel", apex, texel_size_in_picture(camera, light, clip, points))
    fallback = uniform_map("it has no larger texels than the trapezoidal map")
    return [warped, fallback] if warped.texel_size < fallback.texel_size else [fallback]


def receiver_frustum(camera: Camera, receivers: np.ndarray, focus_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (8, 3) of the camera's frustum that just holds receivers (n, 3), and three points (3, 3) on its axis.

    The frustum is symmetric about the view's axis. The points on the axis are the centres of the near and of the far plane, and
    the focus between them, at the share ``focus_share`` of their distance.
    """
    seen = camera.to_camera(receivers)
    near_m = float(seen[:, 2].min())
    far_m = max(float(seen[:, 2].max()), near_m * (1.0 + MIN_EXTENT_SHARE))
    tangents = np.maximum(np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0), MIN_EXTENT_SHARE)
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = np.concatenate([np.column_stack([depth_m * signs * tangents, np.full(4, depth_m)]) for depth_m in (near_m, far_m)])
    focus_m = near_m + focus_share * (far_m - near_m)
    axis_points = np.array([[0.0, 0.0, near_m], [0.0, 0.0, far_m], [0.0, 0.0, focus_m]])
    return tuple(points @ camera.camera_from_frame + camera.eye_m for points in (corners, axis_points))  # type: ignore[return-value]


def trapezoid_matrix(corners: np.ndarray, axis_points: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the apex's distance from the top line, and the matrix (4, 4) that maps the trapezoid to the square from -1 to 1.

    Parameters
    ----------
    corners
        (8, 2), the frustum's corners as the light sees them.
    axis_points
        (3, 2), the centres of its near and far plane and the focus, as the light sees them.

    Returns
    -------
    tuple
        The distance, infinite without a warp, and the matrix. It maps homogeneous points of the light's space, and keeps the order
        of depths along rays.
    """
    start, end, focus = axis_points
    along = (end - start) / np.linalg.norm(end - start)
    across = np.array([-along[1], along[0]])
    depths, offsets = (corners - start) @ along, (corners - start) @ across
    top, base = float(depths.min()), float(depths.max())
    apex = apex_distance(base - top, float((focus - start) @ along) - top)
    if not np.isfinite(apex):
        return apex, np.eye(4)
    slopes = offsets / (depths - top + apex)
    low, high, height = float(slopes.min()), float(slopes.max()), base - top
    # Rows over the plane's (x, y, 1): the distance behind the apex, and the offset from the centre line.
    behind_apex = np.array([*along, apex - top - start @ along])
    offset = np.array([*across, -start @ across])
    scale = (height + apex) / height
    x = (2.0 * offset - (low + high) * behind_apex) / (high - low)
    y = (1.0 - 2.0 * scale) * behind_apex + 2.0 * apex * scale * np.array([0.0, 0.0, 1.0])
    rows = [[row[0], row[1], 0.0, row[2]] for row in (x, y, behind_apex)]
    return apex, np.array([rows[0], rows[1], [0.0, 0.0, 1.0, 0.0], rows[2]])


def apex_distance(height: float, focus: float, focus_line: float = FOCUS_LINE) -> float:
    """Return the distance of the sides' apex from the top line, by the paper's rule; infinity where no warp is needed.

    ``height`` is the distance of the base line from the top line, ``focus`` that of the focus, and ``focus_line`` the y of the
    focus in the map. An affine map takes the focus to ``focus_line`` at ``focus`` = ``height`` (1 - ``focus_line``) / 2. Beyond
    that, a warp would take room away from the focus.
    """
    denominator = height - 2.0 * focus - height * focus_line
    return height * focus * (1.0 + focus_line) / denominator if denominator > 0.0 else np.inf
