"""Compute the matrix of a light-space perspective shadow map, which warps the light's own space.

The method is that of Wimmer, Scherzer and Purgathofer 2004, "Light space perspective shadow maps". The light's own perspective
comes first (``uniform_matrix``). In that space all rays are parallel. The warp is a perspective along the view's axis as the light
sees it, so rays stay parallel, and no caster changes its side. Its centre lies ``n`` metres before the nearest receiver. Where
receivers lie from z_n to z_f along the view's axis, at the angle gamma to the rays, n = (z_n + sqrt(z_n z_f)) / sin(gamma) balances
the errors of the nearest and the farthest (section 4 of the paper). A light near the view's axis has no such direction: n grows
without bound, and the map becomes uniform.
"""

from __future__ import annotations

from dataclasses import replace

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
    uniform_matrix,
)


def light_space_perspectives(
    camera: Camera, light: Light, points: np.ndarray, inner_half_width: float, outer_receivers: np.ndarray = NO_POINTS
) -> list[PostPerspective]:
    """Return the candidate maps for receivers (n, 3) in front of the eye: the warped map, if it is finer, and the uniform one.

    The parameters are those of ``post_perspectives``.
    """
    uniform, required_points = uniform_matrix(light, points), np.concatenate([points, outer_receivers])
    make_candidate = candidate_maker(camera, light, points, outer_receivers, inner_half_width)
    angle_deg = off_axis_deg(camera, light, points.mean(axis=0))
    if angle_deg <= UNIFORM_MAP_CONE_DEG:
        reason = f"the light is {angle_deg:.1f} degrees off the view's axis, within the limit of {UNIFORM_MAP_CONE_DEG:g}"
        return [make_candidate(uniform, None, np.inf, f"a uniform map: {reason}")]
    matrix, centre_m = warped_matrix(camera, light, points, required_points)
    if not is_clear_of_horizon(horizon_distance(matrix, required_points) / horizon_distance(uniform, required_points)):
        reason = "the warp's centre is too near to keep all receivers in front of the map's horizon"
        return [make_candidate(uniform, None, np.inf, f"a uniform map: {reason}")]
    warped = replace(make_candidate(matrix, "parallel", centre_m, ""), space_from_frame=_warped_space(matrix, required_points))
    reason = "it has no larger texels than the light-space perspective map"
    uniform_map = make_candidate(uniform, None, np.inf, f"a uniform map: {reason}")
    return [warped, uniform_map] if warped.texel_size < uniform_map.texel_size else [uniform_map]


def _warped_space(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) from the frame to the warped space, scaled so that points (n, 3) lie within -1 to 1 in all axes.

    The axes of ``matrix`` (4, 4) are right, forward and away from the light; those of the result are right, away from the light
    (down) and forward.
    """
    projected = project_points(matrix, points)
    return fit_to_bounds(matrix, projected.min(axis=0), projected.max(axis=0), 1.0)[[0, 2, 1, 3]]


def warped_matrix(camera: Camera, light: Light, points: np.ndarray, required_points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the warped matrix (4, 4), whose ranges are not fitted yet, and the distance ``n`` of the warp's centre in metres.

    Parameters
    ----------
    camera, light
        The view and the light, which does not lie in the view's axis.
    points
        (n, 3), the receivers that decide the warp, metres in the frame.
    required_points
        (m, 3), the receivers in front of which the centre has to lie.
    """
    # The mean of receivers lies before a lamp, as they do. The centre of their bounds may lie behind it.
    uniform, middle = uniform_matrix(light, points), points.mean(axis=0)
    # The view's axis in the light's space, at that point, per metre.
    w = float(middle @ uniform[3, :3] + uniform[3, 3])
    projected = project_points(uniform, middle[None])[0]
    per_m = (uniform[:2, :3] - projected[:2, None] * uniform[3, :3]) / w
    axis = per_m @ camera.forward_axis
    sine = np.sin(np.radians(off_axis_deg(camera, light, middle)))
    units_per_m = float(np.linalg.norm(axis)) / sine
    along = axis / np.linalg.norm(axis)
    depth_m = camera.to_camera(points)[:, 2]
    near_m, far_m = float(depth_m.min()), float(max(depth_m.max(), depth_m.min() * (1.0 + MIN_EXTENT_SHARE)))
    centre_m = (near_m + np.sqrt(near_m * far_m)) / sine
    nearest = float((project_points(uniform, required_points)[:, :2] @ along).min())
    warp = np.array([
        [-along[1], along[0], 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.0],
        [along[0], along[1], 0.0, centre_m * units_per_m - nearest],
    ])  # fmt: skip
    return warp @ uniform, centre_m
