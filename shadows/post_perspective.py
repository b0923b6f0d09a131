"""The matrix of a perspective shadow map: from a frame to the light's clip space, by way of a camera's. Float64, no OpenGL.

After Stamminger and Drettakis 2002, "Perspective shadow maps", with the cases of Kozlov 2004, "Perspective shadow maps: care and
feeding" (GPU Gems, chapter 14).

**Camera.** A virtual camera looks as the real one does from b metres behind it (the slide-back). V takes what it sees between its
near and far plane to a cube, in which what is near is large. The planes lie round the receivers: what the camera sees and the
light may reach.

**Light.** V takes the light along: the homogeneous point S = (direction to the sun, 0) or (position, 1) to S' = V S. The fourth
coordinate w' of S' is the distance ahead of the virtual camera, hence three kinds: a ``point`` (w' > 0: the light is in front),
a ``sink`` (w' < 0: it is behind, and rays run towards S' instead of away from it), ``parallel`` light (w' = 0). With C a point
amid the receivers in the cube (fourth coordinate 1) and D = S'_xyz - w' C, these four functions of a homogeneous point X of the
cube are smooth in S', and are one formula for the three kinds (a, b, D at right angles; a, b of length 1):

    x = a.X_xyz - (a.C) X_w                 y = b.X_xyz - (b.C) X_w
    w = (D.S'_xyz X_w - w' D.X_xyz) / D^2   z = (D.C X_w - D.X_xyz) / D^2

They are the light's perspective: x, y and w are 0 at S', and w is 1 at C. At S' itself z is -1.

**No caster is lost.** So the whole map P takes the light to (0, 0, -1, 0). Whatever lies between a point X and the sun, X + t S,
goes to P X + (0, 0, -t, 0): it has the u, v and w of X, and a depth z/w that falls evenly with t, without bound. What lies at a
share k of the way to a lamp goes to (1 - k) P X + k (0, 0, -1, 0): the same u and v, w of the same sign, and a depth that falls by
k / ((1 - k) w). Where w > 0 at a receiver, then, all that can shade it is drawn before it in its very texel, be it behind the eye,
beside the view or past the plane that V takes to infinity; what lies before the map's depth 0 is clamped to it. Nothing needs to
slide back for the casters' sake: b is chosen for the receivers alone.

Kozlov's matrix for a sink has its near plane at -e and its far plane at +e, so that depth is e/z and runs through infinity; for
a point in front it has two positive ones. Depth is a sum of w and a positive multiple of the z above in both: the two differ
along a ray by a shift and a stretch, which the fit to the receivers undoes. So e need not be chosen.

**Slide-back.** In the light's own image (along the sun; from the lamp) P is a homography, whose horizon w = 0 depends on b: far
behind the receivers for a large b, where it hardly distorts; no receiver may lie on it or beyond. Of some slide-backs the one is
taken whose texels are smallest where they are seen: smallest in the power mean of the pixels that a texel covers on the receivers'
own surfaces, over a sample of the receivers. A large slide-back is as good as a uniform map, so the mean never exceeds that of one
by much.

**Singular directions.** Where the light, as seen from amid the receivers, stands in the view's axis or in its continuation, V
distorts along the rays alone, and the map is uniform whatever b. Within ``CONE_DEG`` of the axis the uniform map is taken at once,
and the same where no slide-back keeps the receivers off the horizon; ``note`` says which.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

LightKind = Literal["point", "sink", "parallel"]
"""What a light is after the camera's projection: in front of it, behind, or neither."""

CONE_DEG = 3.0
"""Within this angle of the view's axis, or of its continuation behind, a light gets a uniform map."""

LEAST_SHARE = 1e-3
"""How close a receiver may come to the horizon, as a share of the farthest one's distance from it: so much of float32 is left."""

SLIDES = (0.0, *(2.0 ** np.arange(-6.0, 6.5, 0.5)))
"""Slide-backs that are tried, in units of the far plane's distance."""

PARALLEL = 1e-12
"""Up to this share of its length a light's fourth coordinate counts as 0, when its kind is named."""

TURNS = np.radians(np.arange(0.0, 90.0, 5.0))
"""Turns of the map about its middle that are tried."""

POWER = 2.0
"""Of the mean of what a texel covers."""


@dataclass(frozen=True, eq=False)
class Receivers:
    """Some of the points (n, 3) that a camera sees and a light may reach, and their surfaces' unit normals (n, 3)."""

    points_m: np.ndarray
    normals: np.ndarray


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
    """A map's matrix (4, 4), which takes the sampled receivers to within ``inner`` of the map's middle in x and y; the kind of
    the light (``None``: the map is uniform, and ``note`` says why), and the slide-back.
    """

    clip_from_frame: np.ndarray
    kind: LightKind | None
    slide_m: float
    note: str = ""


def camera_matrix(camera: Camera, tangent: float, near_m: float, far_m: float, slide_m: float) -> np.ndarray:
    """The virtual camera's projection (4, 4): ``near_m`` to ``far_m`` from the real eye to -1 to 1, the camera ``slide_m`` behind it.

    Raises ``ValueError`` unless the planes lie before the virtual camera, one behind the other.
    """
    near, far = near_m + slide_m, far_m + slide_m
    if not 0.0 < near < far:
        raise ValueError(f"near {near} and far {far} are no planes before a camera")
    projection = np.array([
        [1.0 / tangent, 0.0, 0.0, 0.0], [0.0, 1.0 / tangent, 0.0, 0.0],
        [0.0, 0.0, (far + near) / (far - near), -2.0 * far * near / (far - near)], [0.0, 0.0, 1.0, 0.0],
    ])  # fmt: skip
    view = np.eye(4)
    view[:3, :3] = camera.camera_from_frame
    view[:3, 3] = np.array([0.0, 0.0, slide_m]) - camera.camera_from_frame @ camera.eye_m
    return projection @ view


def kind_of(light: np.ndarray) -> LightKind:
    """The kind of a light (4,) in a camera's clip space."""
    if abs(light[3]) <= PARALLEL * np.linalg.norm(light[:3]):
        return "parallel"
    return "point" if light[3] > 0.0 else "sink"


def light_matrix(light: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The light's perspective (4, 4) in a camera's cube, or in plain space: it takes the light (4,) to (0, 0, -1, 0), whatever its
    kind, and a point (3,), ``middle``, to (0, 0, 0, 1).
    """
    away = light[:3] - light[3] * middle
    square = away @ away
    first = np.eye(3)[np.argmin(np.abs(away))]
    right = np.cross(first, away)
    right /= np.linalg.norm(right)
    up = np.cross(away, right) / np.sqrt(square)
    return np.array([
        [*right, -right @ middle],
        [*up, -up @ middle],
        [*(-away / square), away @ middle / square],
        [*(-light[3] * away / square), away @ light[:3] / square],
    ])  # fmt: skip


def post_perspective(camera: Camera, light: Light, receivers: Receivers, inner: float) -> PostPerspective:
    """The matrix of the map for some receivers; ``inner`` is the part of its half width that they may fill.

    The map's depth is left as the light's perspective makes it: ``fitted`` sets it. Ranked by what is written above.
    """
    return ranked(camera, light, receivers, inner)[0]


def ranked(camera: Camera, light: Light, receivers: Receivers, inner: float) -> list[PostPerspective]:
    """The maps for some receivers, the best one first, the uniform one last: whoever finds that a receiver that is not in the sample
    lies beyond the horizon takes the next one.
    """
    points = receivers.points_m
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    uniform = light_matrix(light.homogeneous, light.ahead_m if light.homogeneous[3] else middle)
    even = _filling(uniform, points, inner)
    to_light = light.homogeneous[:3] - light.homogeneous[3] * middle
    along = abs(float(camera.axis @ to_light)) / float(np.linalg.norm(to_light))
    if along >= np.cos(np.radians(CONE_DEG)):
        aside = np.degrees(np.arccos(min(along, 1.0)))
        why = f"the light stands {aside:.1f} degrees off the view's axis, within {CONE_DEG:g}: a uniform map"
        return [PostPerspective(even, None, np.inf, why)]
    seen = camera.seen(points)
    near, far = float(seen[:, 2].min()), float(seen[:, 2].max())
    far = max(far, near * (1.0 + 1e-3))
    tangent = float((np.abs(seen[:, :2]).max(axis=1) / seen[:, 2]).max())
    base, footprint, found = _w(uniform, points), _Footprint(camera, receivers), []
    for slide_m in far * np.array(SLIDES):
        view = camera_matrix(camera, tangent, near, far, slide_m)
        seen_light = view @ light.homogeneous
        for centre in _middles(view, light, points):
            matrix = light_matrix(seen_light, centre) @ view
            if _is_clear(_w(matrix, points) / base):
                matrix = _filling(matrix, points, inner)
                found.append((footprint.mean(matrix), PostPerspective(matrix, kind_of(seen_light), float(slide_m))))
    found.sort(key=lambda each: each[0])
    why = "no slide-back keeps all that is seen off the horizon of the map: a uniform map"
    return [*(each for _, each in found), PostPerspective(even, None, np.inf, why)]


def fitted(matrix: np.ndarray, low: np.ndarray, high: np.ndarray, inner: float, before: float) -> np.ndarray:
    """A map's matrix with the receivers' bounds (3,) at +-``inner`` in x and y, and at -1 + ``before`` and 1 in z.

    ``before`` is in units of the receivers' depth, and leaves room for their offset.
    """
    span = np.maximum(high - low, 1e-9 * (1.0 + np.abs(high)))
    low, high = low - np.array([0.0, 0.0, before * span[2]]), low + span
    scale = np.array([2.0 * inner, 2.0 * inner, 2.0]) / (high - low)
    out = matrix.copy()
    out[:3] = scale[:, None] * (matrix[:3] - 0.5 * (low + high)[:, None] * matrix[3])
    return out


def projected(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) through a matrix (4, 4), divided by their w."""
    through = points @ matrix[:, :3].T + matrix[:, 3]
    return through[:, :3] / through[:, 3:]


def texels_per_m(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How x, y and z (rows) of points (n, 3) change with a step in the frame (columns): (n, 3, 3)."""
    through = points @ matrix[:, :3].T + matrix[:, 3]
    w = through[:, 3, None, None]
    return (matrix[:3, :3] - through[:, :3, None] / w * matrix[3, :3]) / w


def _w(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[3, :3] + matrix[3, 3]


def _is_clear(away: np.ndarray) -> bool:
    """Whether all distances from the horizon (n,) are well above 0."""
    return bool(np.isfinite(away).all() and away.min() >= LEAST_SHARE * away.max() > 0.0)


def _middles(view: np.ndarray, light: Light, points: np.ndarray) -> list[np.ndarray]:
    """Points (3,) of the camera's cube that the light may look at."""
    cube = projected(view, points)
    middles = [0.5 * (cube.min(axis=0) + cube.max(axis=0))]
    return middles


def _filling(matrix: np.ndarray, points: np.ndarray, inner: float) -> np.ndarray:
    """A matrix that turns the map about its axis so that points (n, 3) fill +-``inner`` of it best."""
    seen = projected(matrix, points)[:, :2]
    axes = np.stack([np.cos(TURNS), np.sin(TURNS), -np.sin(TURNS), np.cos(TURNS)], axis=1).reshape(-1, 2, 2)
    turned = axes @ seen.T
    low, high = turned.min(axis=2), turned.max(axis=2)
    best = int(np.argmin((high - low).prod(axis=1)))
    out = matrix.copy()
    out[:2] = axes[best] @ matrix[:2]
    ends = np.array([[*low[best], 0.0], [*high[best], 1.0]])
    out[:2] = fitted(out, *ends, inner, 0.0)[:2]
    return out


class _Footprint:
    """How many pixels of a camera a map's texel covers on the surfaces of receivers."""

    def __init__(self, camera: Camera, receivers: Receivers) -> None:
        n = receivers.normals
        first = np.eye(3)[np.abs(n).argmin(axis=1)]
        right = np.cross(first, n)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        self.points_m = receivers.points_m
        self.along = np.stack([right, np.cross(n, right)], axis=2)
        """Two directions (n, 3, 2) along the surfaces."""
        seen = camera.seen(receivers.points_m)
        picture = (camera.camera_from_frame[:2] - seen[:, :2, None] / seen[:, 2:, None] * camera.axis) / seen[:, 2:, None]
        self.picture = picture @ self.along

    def mean(self, matrix: np.ndarray) -> float:
        """The power mean of a texel's size in the picture, in a unit of its own."""
        texel = texels_per_m(matrix, self.points_m)[:, :2] @ self.along
        area = np.abs(np.linalg.det(texel))
        turned = np.stack([texel[:, 1, 1], -texel[:, 0, 1], -texel[:, 1, 0], texel[:, 0, 0]], axis=1).reshape(-1, 2, 2)
        size = np.linalg.norm(self.picture @ turned, axis=(1, 2)) / np.maximum(area, 1e-300)
        return (
            float(np.quantile(size, 0.9))
            if POWER == 0
            else float(np.exp(np.mean(np.log(size))))
            if POWER < 0
            else float(np.mean(size**POWER) ** (1.0 / POWER))
        )
