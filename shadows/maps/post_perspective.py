"""Compute the matrix of a perspective shadow map, from a frame through a camera's projection to the light's clip space.

It follows Stamminger and Drettakis 2002, "Perspective shadow maps", with the cases of Kozlov 2004, "Perspective shadow maps: care
and feeding" (GPU Gems, chapter 14). ``docs/perspective-shadow-maps.md`` derives the light's perspective, one formula for its three
kinds. It also shows why no caster is lost, and how the slide-back is chosen. The computation is in float64, without OpenGL.

- The *virtual camera* is the one through which the map is projected. It stands behind the real one by the *slide-back*.
- The *horizon* of a map is the plane on which the homogeneous coordinate w of its matrix is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from skugga.shadows.maps.camera import Camera, Light
from skugga.terrain.compiled import compiled

PostPerspectiveLightKind = Literal["point", "sink", "parallel"]
"""Kind of a light after the camera's projection: in front of the camera, behind it, or neither."""

UNIFORM_MAP_CONE_DEG = 3.0
"""Angle between a light and the view's axis, in either direction, up to which the light gets a uniform map."""

HORIZON_MARGIN = 1e-3
"""Lower bound of a receiver's distance from a map's horizon, as a share of the farthest receiver's distance.

It leaves float32 enough precision.
"""

SLIDE_BACK_DOUBLINGS = 6
"""Number of doublings of the far plane's distance for the longest slide-back, and least number of halvings for the shortest."""

MIN_EXTENT_SHARE = 1e-3
"""Lower bound of the depth and of the half width, as shares of the distance, of a virtual camera.

It keeps the projection regular if the receivers are a wall or a single pixel.
"""

MAP_ROTATIONS = np.radians(np.arange(0.0, 90.0, 5.0))
"""Rotations of the map about its centre that are tried. The receivers fill the chosen one best."""

NO_POINTS = np.zeros((0, 3))
"""An empty array of points (0, 3)."""

OUTLINE_DIRECTIONS = 64
"""Number of directions whose farthest receivers form the outline, for the choice of the map's rotation."""


@dataclass(frozen=True, eq=False)
class PostPerspective:
    """The matrix of a map whose depth range is not yet fitted.

    Attributes
    ----------
    clip_from_frame
        (4, 4): the matrix. It maps the sampled receivers into the inner part of -1 to 1 in x and y.
    kind
        The kind of the light after the camera's projection; ``None`` for a uniform map.
    slide_back_m
        The slide-back (distance from the real camera back to the virtual one), metres; infinity for a uniform map. Of a light-space
        perspective map, the distance of the warp's centre from the nearest receiver.
    texel_size
        Size in the picture of half the map's width: the root mean square over the sampled receivers, in tangents of angles.
    uniform_map_reason
        The reason for a uniform map; empty otherwise.
    space_from_frame
        Matrix (4, 4) from the frame to the space after the perspective, in which the receivers lie within -1 to 1 in all axes
        (right, down and forward); ``None`` for a uniform map.
    """

    clip_from_frame: np.ndarray
    kind: PostPerspectiveLightKind | None
    slide_back_m: float
    texel_size: float
    uniform_map_reason: str = ""
    space_from_frame: np.ndarray | None = None


def camera_matrix(camera: Camera, tangent: float, near_m: float, far_m: float, slide_back_m: float) -> np.ndarray:
    """Return the projection (4, 4) of the virtual camera, which stands ``slide_back_m`` behind the real one.

    ``tangent`` is that of half the angle of view. ``near_m`` and ``far_m`` are the distances of the near and the far plane from the
    real camera. Raises ``ValueError`` unless 0 < near < far for the virtual camera.
    """
    near, far = near_m + slide_back_m, far_m + slide_back_m
    if not 0.0 < near < far:
        raise ValueError(f"near {near}, far {far}: 0 < near < far must hold")
    projection = np.array([
        [1.0 / tangent, 0.0, 0.0, 0.0], [0.0, 1.0 / tangent, 0.0, 0.0],
        [0.0, 0.0, (far + near) / (far - near), -2.0 * far * near / (far - near)], [0.0, 0.0, 1.0, 0.0],
    ])  # fmt: skip
    view = np.eye(4)
    view[:3, :3] = camera.camera_from_frame
    view[:3, 3] = np.array([0.0, 0.0, slide_back_m]) - camera.camera_from_frame @ camera.eye_m
    return projection @ view


def light_kind_in_clip_space(light: np.ndarray) -> PostPerspectiveLightKind:
    """Return the kind of a light (4,) in a camera's clip space.

    A light that differs from ``parallel`` by no more than rounding counts as ``parallel``.
    """
    if abs(light[3]) <= 1e-12 * np.linalg.norm(light[:3]):
        return "parallel"
    return "point" if light[3] > 0.0 else "sink"


def light_matrix(light: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return the light's perspective (4, 4) in the space in which ``light`` is given: a camera's clip space, or a frame.

    It maps a light (4,) of any kind to (0, 0, -1, 0), and the point ``middle`` (3,) to (0, 0, 0, 1).

    Kozlov's matrix for a sink has its near plane at -e and its far plane at +e, so that depth is e/z and runs through infinity. For
    a point it has two positive planes. In both, depth is a sum of w and a positive multiple of the z here. Along a ray the two
    differ by a shift and a scale, which the fit to the receivers removes. So e need not be chosen.
    """
    to_light = light[:3] - light[3] * middle
    squared_length = to_light @ to_light
    right, up = perpendicular_axes(to_light / np.sqrt(squared_length)).T
    return np.array([
        [*right, -right @ middle],
        [*up, -up @ middle],
        [*(-to_light / squared_length), to_light @ middle / squared_length],
        [*(-light[3] * to_light / squared_length), to_light @ light[:3] / squared_length],
    ])  # fmt: skip


def uniform_matrix(light: Light, points: np.ndarray) -> np.ndarray:
    """Return the light's perspective (4, 4) in the frame, without a camera: the matrix of a uniform map.

    Its texels have one size across the sun's rays, or across a lamp's axis. For the sun, the matrix is centred on the bounds of
    ``points`` (n, 3); a lamp's does not depend on them.
    """
    return light_matrix(
        light.homogeneous_position, light.lit_point_m if light.homogeneous_position[3] else centre_of_bounds(points)
    )


def post_perspectives(
    camera: Camera,
    light: Light,
    points: np.ndarray,
    inner_half_width: float,
    outer_receivers: np.ndarray = NO_POINTS,
    slides_back: bool = True,
) -> list[PostPerspective]:
    """Return the candidate maps for receivers (n, 3) in front of the eye, the best one first.

    The last one is the uniform map. Candidates with larger texels than the uniform map are left out. The maps are chosen by
    ``points``, and also hold the points ``outer_receivers`` (m, 3). If another receiver lies beyond the horizon of a map, the
    caller takes the next candidate. ``inner_half_width`` is the part of the map's half width that receivers may fill. Unless
    ``slides_back``, the only candidate is the map of a virtual camera at the real one, if it has all receivers before its horizon.
    """
    uniform = uniform_matrix(light, points)
    required_points = np.concatenate([points, outer_receivers])
    camera_points, uniform_distance = camera.to_camera(points), horizon_distance(uniform, required_points)

    make_candidate = candidate_maker(camera, light, points, outer_receivers, inner_half_width)
    angle_deg = off_axis_deg(camera, light, centre_of_bounds(points))
    if angle_deg <= UNIFORM_MAP_CONE_DEG and not slides_back:
        return []
    if angle_deg <= UNIFORM_MAP_CONE_DEG:
        reason = f"the light is {angle_deg:.1f} degrees off the view's axis, within the limit of {UNIFORM_MAP_CONE_DEG:g}"
        return [make_candidate(uniform, None, np.inf, f"a uniform map: {reason}")]
    near, far = float(camera_points[:, 2].min()), float(camera_points[:, 2].max())
    far = max(far, near * (1.0 + MIN_EXTENT_SHARE))  # a wall that faces the camera
    widest, candidates = np.abs(camera_points[:, :2]).max(axis=1), []
    halvings = max(
        SLIDE_BACK_DOUBLINGS, int(np.ceil(np.log2(far / near))) + 1
    )  # a slide-back below half the nearest distance has no effect
    slides_m = far * 2.0 ** np.arange(-halvings, SLIDE_BACK_DOUBLINGS + 1) if slides_back else ()
    for slide_m in (0.0, *slides_m):
        view = camera_matrix(
            camera, max(float((widest / (camera_points[:, 2] + slide_m)).max()), MIN_EXTENT_SHARE), near, far, slide_m
        )
        clip_light = view @ light.homogeneous_position
        matrix = light_matrix(clip_light, centre_of_bounds(project_points(view, points))) @ view
        if is_clear_of_horizon(horizon_distance(matrix, required_points) / uniform_distance):
            candidate = make_candidate(matrix, light_kind_in_clip_space(clip_light), float(slide_m), "")
            candidates.append(replace(candidate, space_from_frame=view))
    if not slides_back:
        return candidates
    reason = (
        "a uniform map has smaller texels than the perspective map at every slide-back distance"
        if candidates
        else "no slide-back keeps all receivers in front of the map's horizon"
    )
    uniform_map = make_candidate(uniform, None, np.inf, f"a uniform map: {reason}")
    return [
        *sorted(
            (candidate for candidate in candidates if candidate.texel_size < uniform_map.texel_size),
            key=lambda candidate: candidate.texel_size,
        ),
        uniform_map,
    ]


def candidate_maker(
    camera: Camera, light: Light, points: np.ndarray, outer_receivers: np.ndarray, inner_half_width: float
) -> Callable[[np.ndarray, PostPerspectiveLightKind | None, float, str], PostPerspective]:
    """Return a function that makes a candidate map of a matrix (4, 4): it is rotated and scaled to the receivers.

    The function's further arguments are ``kind``, ``slide_back_m`` and ``uniform_map_reason`` of ``PostPerspective``. The sizes of
    texels are those at ``points`` (n, 3). The other parameters are those of ``post_perspectives``.
    """
    image = project_points(uniform_matrix(light, points), points)[:, :2]
    outline = np.concatenate([points[_outline_indices(image)], outer_receivers])
    ray_axes, picture_derivatives = _ray_axes_and_picture_derivatives(camera, light, points)

    def make_candidate(
        matrix: np.ndarray, kind: PostPerspectiveLightKind | None, slide_back_m: float, uniform_map_reason: str
    ) -> PostPerspective:
        matrix = _fit_rotation(matrix, outline, inner_half_width)
        return PostPerspective(
            matrix, kind, slide_back_m, _rms_texel_size(matrix, points, ray_axes, picture_derivatives), uniform_map_reason
        )

    return make_candidate


def texel_size_in_picture(camera: Camera, light: Light, matrix: np.ndarray, points: np.ndarray) -> float:
    """Return the size in the picture of half a map's width, the root mean square over points (n, 3).

    ``matrix`` (4, 4) is that of the map. Sizes in the picture are tangents of angles from the view's axis.
    """
    return float(_rms_texel_size(matrix, points, *_ray_axes_and_picture_derivatives(camera, light, points)))


def _ray_axes_and_picture_derivatives(camera: Camera, light: Light, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions across a light's rays at points (n, 3), and the picture's derivatives along them.

    The directions are unit vectors (n, 3, 2). The derivatives (n, 2, 2) are those of the picture's coordinates, per metre.
    """
    directions = light.homogeneous_position[:3] - light.homogeneous_position[3] * points
    directions = np.broadcast_to(directions / np.linalg.norm(directions, axis=-1, keepdims=True), points.shape)
    ray_axes = perpendicular_axes(directions)
    return ray_axes, _picture_derivatives(camera, camera.to_camera(points), ray_axes)


def fit_to_bounds(
    matrix: np.ndarray, low: np.ndarray, high: np.ndarray, inner_half_width: float, front_share: float = 0.0
) -> np.ndarray:
    """Return a map's matrix, scaled so that the bounds of x and y map to -``inner_half_width`` and ``inner_half_width``.

    ``low`` and ``high`` (3,) are the bounds of x, y and z. Those of z map to -1 and 1, with the share ``front_share`` of that range
    in front of them.
    """
    span = np.maximum(high - low, 1e-9 * (1.0 + np.abs(high)))
    low, high = low - np.array([0.0, 0.0, front_share / (1.0 - front_share) * span[2]]), low + span
    scale = np.array([2.0 * inner_half_width, 2.0 * inner_half_width, 2.0]) / (high - low)
    out = matrix.copy()
    out[:3] = scale[:, None] * (matrix[:3] - 0.5 * (low + high)[:, None] * matrix[3])
    return out


def project_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) transformed by a matrix (4, 4) and divided by their w."""
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    return homogeneous[:, :3] / homogeneous[:, 3:]


def horizon_distance(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the w (n,) of points (n, 3) in a map: their distance in front of the map's horizon (w = 0), in the map's own unit.

    ``matrix`` (4, 4) maps homogeneous points to the map.
    """
    return points @ matrix[3, :3] + matrix[3, 3]


def is_clear_of_horizon(distances: np.ndarray) -> bool:
    """Return whether points lie clearly in front of a map's horizon (w = 0).

    ``distances`` (n,) are the points' w in the map, divided by their w in the uniform map. All must be finite and at least
    ``HORIZON_MARGIN`` times the largest.
    """
    return bool(np.isfinite(distances).all() and distances.min() >= HORIZON_MARGIN * distances.max() > 0.0)


def centre_of_bounds(points: np.ndarray) -> np.ndarray:
    """Return the centre (3,) of the bounds of points (n, 3)."""
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def off_axis_deg(camera: Camera, light: Light, point_m: np.ndarray) -> float:
    """Return the angle, in degrees, between the view's axis and the direction from a point ``point_m`` (3,) to a light.

    The axis counts in either direction, so the angle is at most 90.
    """
    to_light = light.homogeneous_position[:3] - light.homogeneous_position[3] * point_m
    sine = np.linalg.norm(np.cross(camera.forward_axis, to_light))
    return float(np.degrees(np.arctan2(sine, abs(camera.forward_axis @ to_light))))


def _outline_indices(image_points: np.ndarray) -> np.ndarray:
    """Return the indices of the points that are farthest in some direction, of ``OUTLINE_DIRECTIONS`` in all.

    ``image_points`` (n, 2) are the points in a picture. A homography maps the outline of points to the outline of their images.
    """
    angle = np.arange(OUTLINE_DIRECTIONS) * 2.0 * np.pi / OUTLINE_DIRECTIONS
    return np.unique(np.argmax((image_points - image_points.mean(axis=0)) @ np.stack([np.cos(angle), np.sin(angle)]), axis=0))


def _fit_rotation(matrix: np.ndarray, outline: np.ndarray, inner_half_width: float) -> np.ndarray:
    """Return a map's matrix (4, 4), rotated and scaled so that an outline of points (n, 3) fills the map's inner part best.

    The map rotates about its centre, by one of ``MAP_ROTATIONS``. ``inner_half_width`` is the part of its half width that the
    outline may fill.
    """
    axes = np.stack([np.cos(MAP_ROTATIONS), np.sin(MAP_ROTATIONS), -np.sin(MAP_ROTATIONS), np.cos(MAP_ROTATIONS)], axis=1).reshape(
        -1, 2, 2
    )
    rotated = axes @ project_points(matrix, outline)[:, :2].T
    low, high = rotated.min(axis=2), rotated.max(axis=2)
    best = int(np.argmin((high - low).prod(axis=1)))
    out = matrix.copy()
    out[:2] = axes[best] @ matrix[:2]
    out[:2] = fit_to_bounds(out, np.array([*low[best], -1.0]), np.array([*high[best], 1.0]), inner_half_width)[:2]
    return out


def perpendicular_axes(normals: np.ndarray) -> np.ndarray:
    """Return two unit vectors (..., 3, 2) perpendicular to each other and to unit vectors (..., 3).

    After Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = np.moveaxis(normals, -1, 0)
    side = np.copysign(1.0, z)
    a = -1.0 / (side + z)
    first = np.stack([1.0 + side * x * x * a, side * x * y * a, -side * x], axis=-1)
    return np.stack([first, np.stack([x * y * a, side + y * y * a, -y], axis=-1)], axis=-1)


def _picture_derivatives(camera: Camera, camera_points: np.ndarray, ray_axes: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 2, 2) of the picture's coordinates (tangents) along two directions at points, per metre.

    ``camera_points`` (n, 3) are the points in camera coordinates, and ``ray_axes`` (n, 3, 2) the two directions in the frame.
    """
    depth = camera_points[:, 2, None, None]
    return (camera.camera_from_frame[:2] - camera_points[:, :2, None] / depth * camera.forward_axis) / depth @ ray_axes


@compiled
def _rms_texel_size(matrix, points, ray_axes, picture_derivatives):
    """Return the size in the picture of half a map's width, the root mean square over points (n, 3) and two directions.

    It is in tangents of angles. ``matrix`` (4, 4) is that of the map. ``ray_axes`` and ``picture_derivatives`` are the results of
    ``_ray_axes_and_picture_derivatives``.
    """
    total = 0.0
    for n in range(len(points)):
        p = points[n]
        clip_point = np.empty(4)
        for k in range(4):
            clip_point[k] = matrix[k, 0] * p[0] + matrix[k, 1] * p[1] + matrix[k, 2] * p[2] + matrix[k, 3]
        a = np.zeros((2, 2))
        for k in range(2):
            for m in range(3):
                step = (matrix[k, m] - clip_point[k] / clip_point[3] * matrix[3, m]) / clip_point[3]
                a[k, 0] += step * ray_axes[n, m, 0]
                a[k, 1] += step * ray_axes[n, m, 1]
        square = 0.0
        for k in range(2):
            square += (picture_derivatives[n, k, 0] * a[1, 1] - picture_derivatives[n, k, 1] * a[1, 0]) ** 2
            square += (picture_derivatives[n, k, 1] * a[0, 0] - picture_derivatives[n, k, 0] * a[0, 1]) ** 2
        total += square / max((a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) ** 2, 1e-300)
    return np.sqrt(total / len(points))
