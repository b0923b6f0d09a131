"""The matrix of a perspective shadow map: from a frame to the light's clip space, by way of a camera's. Float64, no OpenGL.

After Stamminger and Drettakis 2002, "Perspective shadow maps", with the cases of Kozlov 2004, "Perspective shadow maps: care and
feeding" (GPU Gems, chapter 14). ``docs/perspective-shadow-maps.md`` derives the light's perspective, one formula for its three
kinds; why no caster is lost; and which slide-back is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skugga.terrain.compiled import compiled

PostPerspectiveLightKind = Literal["point", "sink", "parallel"]
"""What a light is after the camera's projection: in front of it, behind, or neither."""

CONE_DEG = 3.0
"""Within this angle of the view's axis, or of its continuation behind, a light gets a uniform map."""

HORIZON_MARGIN = 1e-3
"""How close a receiver may come to the horizon, as a share of the farthest one's distance from it: so much of float32 is left."""

DOUBLINGS = 6
"""How often the far plane's distance is doubled for the longest slide-back, and at least halved for the shortest."""

LEAST_EXTENT = 1e-3
"""Least depth and half width, as shares of the distance, of what a virtual camera sees: of a wall, a single pixel."""

MAP_ROTATIONS = np.radians(np.arange(0.0, 90.0, 5.0))
"""Turns of the map about its middle that are tried: the one that the receivers fill best is taken."""

NO_POINTS = np.zeros((0, 3))
"""No points."""

OUTLINE = 64
"""Directions in which the farthest receivers count as their outline, for the map's turn."""


@dataclass(frozen=True, eq=False)
class Camera:
    """An eye (3,) and the rotation (3, 3) from the frame to right, down and forward."""

    eye_m: np.ndarray
    camera_from_frame: np.ndarray

    @property
    def axis(self) -> np.ndarray:
        return self.camera_from_frame[2]

    def seen(self, points_m: np.ndarray) -> np.ndarray:
        """Points (..., 3) right, down and forward of the eye."""
        return (points_m - self.eye_m) @ self.camera_from_frame.T


@dataclass(frozen=True, eq=False)
class Light:
    """A light's homogeneous point (4,), and a point (3,) that it surely shines at: ahead of a spot, anywhere under the sun."""

    homogeneous: np.ndarray
    ahead_m: np.ndarray


@dataclass(frozen=True, eq=False)
class PostPerspective:
    """A map's matrix (4, 4), with the sampled receivers within the inner part of -1 to 1 in x and y, its depth not yet fitted.

    ``kind`` is that of the light, ``slide_m`` the slide-back; a uniform map has ``None`` and infinity, and a ``note`` that says
    why. ``texel`` is the root mean square of what half the map's width covers in the picture, in tangents.
    """

    clip_from_frame: np.ndarray
    kind: PostPerspectiveLightKind | None
    slide_m: float
    texel: float
    note: str = ""


def camera_matrix(camera: Camera, tangent: float, near_m: float, far_m: float, slide_m: float) -> np.ndarray:
    """The virtual camera's projection (4, 4): it stands ``slide_m`` behind the real one, from which its planes are counted.

    Raises ``ValueError`` unless the planes lie before the virtual camera, one behind the other.
    """
    near, far = near_m + slide_m, far_m + slide_m
    if not 0.0 < near < far:
        raise ValueError(f"near {near}, far {far}: needed is 0 < near < far")
    projection = np.array([
        [1.0 / tangent, 0.0, 0.0, 0.0], [0.0, 1.0 / tangent, 0.0, 0.0],
        [0.0, 0.0, (far + near) / (far - near), -2.0 * far * near / (far - near)], [0.0, 0.0, 1.0, 0.0],
    ])  # fmt: skip
    view = np.eye(4)
    view[:3, :3] = camera.camera_from_frame
    view[:3, 3] = np.array([0.0, 0.0, slide_m]) - camera.camera_from_frame @ camera.eye_m
    return projection @ view


def kind_of(light: np.ndarray) -> PostPerspectiveLightKind:
    """The kind of a light (4,) in a camera's clip space; in between are those that rounding does not tell apart."""
    if abs(light[3]) <= 1e-12 * np.linalg.norm(light[:3]):
        return "parallel"
    return "point" if light[3] > 0.0 else "sink"


def light_matrix(light: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The light's perspective (4, 4) in a camera's cube, or in plain space: it takes the light (4,) to (0, 0, -1, 0), whatever its
    kind, and a point (3,), ``middle``, to (0, 0, 0, 1).
    """
    away = light[:3] - light[3] * middle
    square = away @ away
    right, up = across(away / np.sqrt(square)).T
    return np.array([
        [*right, -right @ middle],
        [*up, -up @ middle],
        [*(-away / square), away @ middle / square],
        [*(-light[3] * away / square), away @ light[:3] / square],
    ])  # fmt: skip


def uniform_matrix(light: Light, points: np.ndarray) -> np.ndarray:
    """The light's perspective (4, 4) in plain space: even texels across the sun's rays, or across a lamp's axis."""
    return light_matrix(light.homogeneous, light.ahead_m if light.homogeneous[3] else _amid(points))


def post_perspectives(
    camera: Camera, light: Light, points: np.ndarray, inner: float, rim: np.ndarray = NO_POINTS
) -> list[PostPerspective]:
    """The maps for receivers (n, 3) of which all are before the eye, the best one first, the uniform one last: with it end those
    that are better than none.

    They are chosen by ``points``, and hold those on the ``rim`` (m, 3), too. Whoever finds that another receiver lies beyond the
    horizon takes the next map. ``inner`` is the part of the map's half width that receivers may fill.
    """
    uniform = uniform_matrix(light, points)
    outline = np.concatenate([points[_outline(projected(uniform, points)[:, :2])], rim])
    held = np.concatenate([points, rim])
    seen, ahead = camera.seen(points), horizon_m(uniform, held)
    aside, pixels = _in_picture(camera, light, points)

    def made(matrix: np.ndarray, kind: PostPerspectiveLightKind | None, slide_m: float, note: str = "") -> PostPerspective:
        matrix = _filled(matrix, outline, inner)
        return PostPerspective(matrix, kind, slide_m, _texel(matrix, points, aside, pixels), note)

    off_deg = _off_axis_deg(camera, light, _amid(points))
    if off_deg <= CONE_DEG:
        why = f"the light stands {off_deg:.1f} degrees off the view's axis, within {CONE_DEG:g}"
        return [made(uniform, None, np.inf, f"a uniform map: {why}")]
    near, far = float(seen[:, 2].min()), float(seen[:, 2].max())
    far = max(far, near * (1.0 + LEAST_EXTENT))  # a wall that is looked at straight on
    widest, candidates = np.abs(seen[:, :2]).max(axis=1), []
    halvings = max(DOUBLINGS, int(np.ceil(np.log2(far / near))) + 1)  # shorter than half the nearest's distance is as good as none
    for slide_m in (0.0, *(far * 2.0 ** np.arange(-halvings, DOUBLINGS + 1))):
        view = camera_matrix(camera, max(float((widest / (seen[:, 2] + slide_m)).max()), LEAST_EXTENT), near, far, slide_m)
        seen_light = view @ light.homogeneous
        matrix = light_matrix(seen_light, _amid(projected(view, points))) @ view
        if is_clear(horizon_m(matrix, held) / ahead):
            candidates.append(made(matrix, kind_of(seen_light), float(slide_m)))
    why = "every slide-back has larger texels" if candidates else "no slide-back keeps all that is seen off the map's horizon"
    last = made(uniform, None, np.inf, f"a uniform map: {why}")
    return [
        *sorted((candidate for candidate in candidates if candidate.texel < last.texel), key=lambda candidate: candidate.texel),
        last,
    ]


def texel_in_picture(camera: Camera, light: Light, matrix: np.ndarray, points: np.ndarray) -> float:
    """The root mean square of what half the width of a map covers in the picture at points (n, 3), in tangents."""
    return float(_texel(matrix, points, *_in_picture(camera, light, points)))


def _in_picture(camera: Camera, light: Light, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two directions across a light's rays (n, 3, 2) at points (n, 3), and how the picture's coordinates change along them."""
    directions = light.homogeneous[:3] - light.homogeneous[3] * points
    directions = np.broadcast_to(directions / np.linalg.norm(directions, axis=-1, keepdims=True), points.shape)
    aside = across(directions)
    return aside, _pixels(camera, camera.seen(points), aside)


def fit_to_bounds(matrix: np.ndarray, low: np.ndarray, high: np.ndarray, inner: float, before: float = 0.0) -> np.ndarray:
    """A map's matrix with what it takes to bounds (3,) between -``inner`` and ``inner`` in x and y.

    In z it is taken to between -1 and 1, but for a share ``before`` of that before it.
    """
    span = np.maximum(high - low, 1e-9 * (1.0 + np.abs(high)))
    low, high = low - np.array([0.0, 0.0, before / (1.0 - before) * span[2]]), low + span
    scale = np.array([2.0 * inner, 2.0 * inner, 2.0]) / (high - low)
    out = matrix.copy()
    out[:3] = scale[:, None] * (matrix[:3] - 0.5 * (low + high)[:, None] * matrix[3])
    return out


def projected(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) through a matrix (4, 4), divided by their w."""
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    return homogeneous[:, :3] / homogeneous[:, 3:]


def horizon_m(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far points (n, 3) lie before a map's horizon, in a unit of its own: their w."""
    return points @ matrix[3, :3] + matrix[3, 3]


def is_clear(away: np.ndarray) -> bool:
    """Whether all distances from a horizon (n,), as shares of those in the uniform map, are well above 0."""
    return bool(np.isfinite(away).all() and away.min() >= HORIZON_MARGIN * away.max() > 0.0)


def _amid(points: np.ndarray) -> np.ndarray:
    """The middle (3,) of the bounds of points (n, 3)."""
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def _off_axis_deg(camera: Camera, light: Light, from_m: np.ndarray) -> float:
    """The angle between the view's axis, either way, and the way from a point (3,) to a light."""
    to_light = light.homogeneous[:3] - light.homogeneous[3] * from_m
    aside = np.linalg.norm(np.cross(camera.axis, to_light))
    return float(np.degrees(np.arctan2(aside, abs(camera.axis @ to_light))))


def _outline(image: np.ndarray) -> np.ndarray:
    """Those of some points (n, 2) that lie farthest in some direction: their outline stays that in any homography."""
    angle = np.arange(OUTLINE) * 2.0 * np.pi / OUTLINE
    return np.unique(np.argmax((image - image.mean(axis=0)) @ np.stack([np.cos(angle), np.sin(angle)]), axis=0))


def _filled(matrix: np.ndarray, outline: np.ndarray, inner: float) -> np.ndarray:
    """A matrix with the map turned about its axis and stretched so that an outline (n, 3) fills its inner part best."""
    axes = np.stack([np.cos(MAP_ROTATIONS), np.sin(MAP_ROTATIONS), -np.sin(MAP_ROTATIONS), np.cos(MAP_ROTATIONS)], axis=1).reshape(
        -1, 2, 2
    )
    turned = axes @ projected(matrix, outline)[:, :2].T
    low, high = turned.min(axis=2), turned.max(axis=2)
    best = int(np.argmin((high - low).prod(axis=1)))
    out = matrix.copy()
    out[:2] = axes[best] @ matrix[:2]
    out[:2] = fit_to_bounds(out, np.array([*low[best], -1.0]), np.array([*high[best], 1.0]), inner)[:2]
    return out


def across(normals: np.ndarray) -> np.ndarray:
    """Two unit vectors at right angles (..., 3, 2) across unit vectors (..., 3).

    After Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = np.moveaxis(normals, -1, 0)
    side = np.copysign(1.0, z)
    a = -1.0 / (side + z)
    first = np.stack([1.0 + side * x * x * a, side * x * y * a, -side * x], axis=-1)
    return np.stack([first, np.stack([x * y * a, side + y * y * a, -y], axis=-1)], axis=-1)


def _pixels(camera: Camera, seen: np.ndarray, aside: np.ndarray) -> np.ndarray:
    """How the picture's coordinates (tangents) change along two directions (n, 3, 2) at points as the camera sees them (n, 3)."""
    ahead = seen[:, 2, None, None]
    return (camera.camera_from_frame[:2] - seen[:, :2, None] / ahead * camera.axis) / ahead @ aside


@compiled
def _texel(matrix, points, aside, pixels):
    """The root mean square size in the picture, in tangents, of what half the width of a map covers along two directions."""
    total = 0.0
    for n in range(len(points)):
        p = points[n]
        through = np.empty(4)
        for k in range(4):
            through[k] = matrix[k, 0] * p[0] + matrix[k, 1] * p[1] + matrix[k, 2] * p[2] + matrix[k, 3]
        a = np.zeros((2, 2))
        for k in range(2):
            for m in range(3):
                step = (matrix[k, m] - through[k] / through[3] * matrix[3, m]) / through[3]
                a[k, 0] += step * aside[n, m, 0]
                a[k, 1] += step * aside[n, m, 1]
        square = 0.0
        for k in range(2):
            square += (pixels[n, k, 0] * a[1, 1] - pixels[n, k, 1] * a[1, 0]) ** 2
            square += (pixels[n, k, 1] * a[0, 0] - pixels[n, k, 0] * a[0, 1]) ** 2
        total += square / max((a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) ** 2, 1e-300)
    return np.sqrt(total / len(points))
