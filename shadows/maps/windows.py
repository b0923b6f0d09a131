"""Make the depth maps of a light: their windows in light space, their sizes and their contents."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.settings import Cascade, LampMapSettings, ShadowMapSettings
from skugga.shadows.maps.sun_disc import border_texels
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.light_space import light_bounds
from skugga.terrain.gl.device import device
from skugga.terrain.lights import Lamp
from skugga.terrain.scene import Scene

MAP_BORDER_TEXELS = 12
"""Texels around the receivers: the bias moves look-ups by up to 8, taps by up to 2."""

MAP_SIZE_STEP = 64
"""Map sizes are multiples of this, so that the blocks of a level share textures."""

POSITION_ERROR = 4.0 * float(np.finfo(np.float32).eps)
"""Upper bound of the float32 error of positions, as a share of the coordinates' extent: 8 units in the last place."""

MIN_NEAR_PLANE_SHARE = 1e-4
"""Lower bound of the distance of a lamp's nearest receiver, as a share of the farthest one's."""

CUBE_FACES = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
], np.float64)  # fmt: skip
"""Rotations from an omni light's axes to those of its six maps: forward, right, left, back, down, up.

The names are in the light's axes; its forward axis points straight down to the ground.
"""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth map to draw.

    Attributes
    ----------
    uniforms
        Uniforms of the shaders, by name.
    face_size
        Texels (across, down) of a face.
    face_rotations
        Rotations (3, 3) of the faces.
    depth_bits
        Bits of depth: 16, 24 or 32.
    trees
        The casting trees; ``None`` without any.
    point_indices
        Flat indices (n,) of the points that the map serves in a perspective view; ``None`` in a map view.
    tree_bounds
        Bounds of the trees that matter: rotation, translation, low and high, as ``skugga.terrain.casters.casting.occluding_trees``
        takes them. ``None``: all trees matter.
    shader_parts
        Names of two shader parts: the light's clip space, and the comparison of points with the map.
    relevant_trees
        Indices of the trees to draw, in the order of drawing; ``None``: all.
    eye_distances_m
        Distances from the eye of a perspective view between which the map serves points: more than the first, at most the second.
    receiver_boxes
        The boxes of the receivers that the map is fitted to, one for each face: a matrix (4, 4) from the frame to the box's space,
        and the bounds (3,) there.
    space_from_frame
        Matrix (4, 4) from the frame to the post-perspective space of a perspective map, whose view lies within -1 to 1 in all axes
        (right, down and forward); ``None`` for a uniform map.
    """

    uniforms: dict[str, Any]
    face_size: tuple[int, int]
    face_rotations: tuple[np.ndarray, ...]
    depth_bits: int
    trees: TreeInstances | None
    point_indices: np.ndarray | None
    tree_bounds: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None
    shader_parts: tuple[str, str] = ("shadows/maps/light", "shadows/maps/receiver")
    relevant_trees: np.ndarray | None = None
    eye_distances_m: tuple[float, float] = (-1.0, np.inf)
    receiver_boxes: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()
    space_from_frame: np.ndarray | None = None

    @property
    def texture_size(self) -> tuple[int, int]:
        """Texels (across, down) of all faces together; six lie in two rows of three."""
        face_cols, face_rows = (3, 2) if len(self.face_rotations) == 6 else (1, 1)
        return self.face_size[0] * face_cols, self.face_size[1] * face_rows

    @property
    def is_uniform(self) -> bool:
        """Whether the texels have one size in the light's own space, rather than in the picture's."""
        return self.shader_parts == DepthMap.shader_parts

    @property
    def texel_count(self) -> int:
        """Number of texels of all faces."""
        return self.face_size[0] * self.face_size[1] * len(self.face_rotations)

    @property
    def nbytes(self) -> int:
        """Size of the texels in bytes."""
        return self.texel_count * (2 if self.depth_bits == 16 else 4)


def sun_maps(
    buffer: GeometryBuffer, scene: Scene, settings: ShadowMapSettings, trees: TreeInstances | None, nearest_caster_m: float = np.inf
) -> list[DepthMap]:
    """Return the maps of the cascades that have receivers.

    Depths start at ``nearest_caster_m`` (the nearest caster) if that is in front of the receivers. Surfaces that face away from the
    sun need no map. The stable windows of a map view, however, cover all of its ground under any sun.
    """
    view = buffer.view
    stable = isinstance(view, MapView) and settings.fit == "stable"
    receivers = buffer.valid if stable else buffer.valid & ~attached_shadow_mask(buffer, scene)
    if len(settings.cascades) == 1 or isinstance(view, MapView):
        if not receivers.any():
            return []
        return [_sun_map(buffer, receivers, scene, settings.cascades[0], settings, trees, nearest_caster_m)]
    eye, _ = view.in_frame(buffer.frame)
    distance_m = eye_distances(buffer.position_frame_m, eye)
    maps, near_m = [], -1.0
    for cascade in settings.cascades:
        far_m = np.inf if cascade.far_m is None else cascade.far_m
        cascade_receivers = receivers & (distance_m > near_m) & (distance_m <= far_m)
        if cascade_receivers.any():
            depth_map = _sun_map(buffer, cascade_receivers, scene, cascade, settings, trees, nearest_caster_m)
            maps.append(replace(depth_map, eye_distances_m=(near_m, far_m)))
        near_m = far_m
    return maps


def _sun_map(
    buffer: GeometryBuffer,
    receiver_mask: np.ndarray,
    scene: Scene,
    cascade: Cascade,
    settings: ShadowMapSettings,
    trees: TreeInstances | None,
    nearest_caster_m: float,
) -> DepthMap:
    """Return the map of a cascade for the receivers in the mask ``receiver_mask`` (rows, cols).

    ``trees`` are the casting trees; ``None`` without any. ``nearest_caster_m`` is the light-space depth of the nearest caster.
    """
    assert scene.light_space is not None
    rotation, translation = scene.light_space.transform_from_frame(buffer.frame)
    low, high = light_bounds(buffer.position_frame_m, receiver_mask, rotation, translation)
    light_matrix = np.eye(4)
    light_matrix[:3] = np.column_stack([rotation, translation])
    receiver_box = light_matrix, low.copy(), high.copy()
    error_m = POSITION_ERROR * (_max_coordinate_m(buffer, receiver_mask) + float(np.abs(high - low).max()))
    stable, texel = settings.fit == "stable", np.array(cascade.texel_m)
    if not stable:  # never coarser, nor finer than the float32 error of positions
        fitted_texel_m = (high - low)[:2] / max(settings.map_size - 2 * MAP_BORDER_TEXELS - 1, 1)
        texel = np.minimum(texel, np.maximum(fitted_texel_m, 4.0 * error_m))
    border = np.full(2, MAP_BORDER_TEXELS)
    if settings.filter == "sun":
        low[2] = min(low[2], nearest_caster_m)
        border += border_texels(float(high[2] - low[2]), texel)
    first, size = _map_window(low, high, texel, border, stable)
    for axis in (0, 1):  # a block wider than planned gets coarser texels instead of a map too large for the device
        while size[axis] > min(device().max_size, 2 * settings.map_size + 4 * border[axis] + MAP_SIZE_STEP):
            texel[axis] *= 2.0
            first, size = _map_window(low, high, texel, border, stable)
    if settings.bias == "receiver_plane" and buffer.corners_frame_m is not None:
        tap_reach_m = texel * (3 if settings.filter == "sun" else settings.filter) / 2.0
        low[2] -= _depth_margin_m(
            buffer.normal_frame, buffer.corners_frame_m, buffer.position_frame_m, _on_triangles(buffer, receiver_mask), rotation,
            tap_reach_m,
        )  # fmt: skip
    steps = depth_step_count(settings.depth_bits)
    front_margin_m = 4.0 * (error_m + cascade.depth_step_m) + MAP_BORDER_TEXELS * float(
        texel.max()
    )  # keeps receivers clear of depth 0
    near, step_m = (_stable_depths if stable else _tight_depths)(low[2] - front_margin_m, high[2], cascade.depth_step_m, steps)
    offset_m, window_m = translation - np.array([*(first * texel), near]), np.array([*(size * texel), steps * step_m])
    uniforms = {
        "lamp": False,
        "light_from_frame": tuple(rotation.T.ravel()),  # GLSL matrices are column-major
        "light_offset_m": tuple(offset_m),
        "window_m": tuple(window_m),
        "texel_m": tuple(texel),
        "first_texel": (int(first[0]), int(first[1])),
        "error_m": error_m,
        "depth_step": 1.0 / steps,
    }
    pixels = None if isinstance(buffer.view, MapView) else np.flatnonzero(receiver_mask)
    tree_bounds = rotation, offset_m, np.zeros(3), window_m
    return DepthMap(
        uniforms, (int(size[0]), int(size[1])), (np.eye(3),), settings.depth_bits, trees, pixels, tree_bounds,
        receiver_boxes=(receiver_box,),
    )  # fmt: skip


def lamp_map(buffer: GeometryBuffer, lamp: Lamp, settings: LampMapSettings, trees: TreeInstances | None) -> DepthMap | None:
    """Return the map of a lamp; ``None`` where it shines on nothing. ``trees`` are the casting trees; ``None`` without any."""
    position, _, rotation = lamp.in_frame(buffer.frame)
    size = settings.map_size
    faces = tuple(CUBE_FACES) if lamp.kind == "omni" else (np.eye(3),)
    half = 1.0 if lamp.kind == "omni" else float(np.tan(np.radians(lamp.cutoff_deg)))
    tangent = half * size / (size - 2 * MAP_BORDER_TEXELS)
    face_from_frame = np.stack([face @ rotation for face in faces])
    nearest_m, farthest_m = _depth_range_m(buffer.position_frame_m, buffer.valid, position, face_from_frame, tangent)
    if not farthest_m > 0.0:
        return None
    near, far = max(0.98 * nearest_m, MIN_NEAR_PLANE_SHARE * farthest_m), 1.02 * farthest_m
    uniforms = {
        "lamp": True,
        "light_from_frame": tuple(rotation.T.ravel()),
        "light_offset_m": tuple(-rotation @ position),
        "tangent": tangent,
        "near_far_m": (near, far),
        "error_m": POSITION_ERROR * (_max_coordinate_m(buffer, buffer.valid) + float(np.abs(position).max())),
        "depth_step": 1.0 / depth_step_count(settings.depth_bits),
    }
    pixels = None if isinstance(buffer.view, MapView) else np.flatnonzero(buffer.valid)
    receiver_boxes = tuple(
        (_lamp_matrix(face, position, half, nearest_m, farthest_m), np.full(3, -1.0), np.ones(3)) for face in face_from_frame
    )
    return DepthMap(uniforms, (size, size), faces, settings.depth_bits, trees, pixels, receiver_boxes=receiver_boxes)


def _lamp_matrix(rotation: np.ndarray, position: np.ndarray, tangent: float, near_m: float, far_m: float) -> np.ndarray:
    """Return the perspective (4, 4) of a lamp's face, which takes its space between two depths to -1 to 1.

    ``rotation`` (3, 3) leads from the frame to the face's right, up and forward axes. ``position`` (3,) is that of the lamp,
    ``tangent`` half the face's width at distance 1, ``near_m`` and ``far_m`` are the depths.
    """
    axes = np.column_stack([rotation, -rotation @ position])
    far_m = max(far_m, near_m * (1.0 + 1e-6))
    depth = axes[2] * (far_m + near_m) / (far_m - near_m) - np.array([0.0, 0.0, 0.0, 2.0 * far_m * near_m / (far_m - near_m)])
    return np.stack([axes[0] / tangent, axes[1] / tangent, depth, axes[2]])


@compiled
def _depth_range_m(points, mask, position, faces, tangent):
    """Return the smallest and largest depth, metres, of the points (rows, cols, 3) in ``mask``, in a lamp's faces (n, 3, 3).

    ``position`` (3,) is that of the lamp, ``faces`` are the rotations from the frame to the faces' right, up and forward axes. Each
    face reaches as far as ``tangent`` times the depth from its axis. The result is infinity and 0 where no face contains a point.
    """
    nearest, farthest = np.inf, 0.0
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            if not mask[i, j]:
                continue
            x, y, z = points[i, j, 0] - position[0], points[i, j, 1] - position[1], points[i, j, 2] - position[2]
            for k in range(faces.shape[0]):
                face = faces[k]
                depth = face[2, 0] * x + face[2, 1] * y + face[2, 2] * z
                right = face[0, 0] * x + face[0, 1] * y + face[0, 2] * z
                up = face[1, 0] * x + face[1, 1] * y + face[1, 2] * z
                if depth > 0.0 and max(abs(right), abs(up)) <= tangent * depth:
                    nearest, farthest = min(nearest, depth), max(farthest, depth)
    return nearest, farthest


def eye_distances(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Return the distances (rows, cols) float32 of points (rows, cols, 3) from an eye; NaN at invalid points."""
    out = np.empty(points.shape[:2], np.float32)
    run_in_chunks(len(points), _write_eye_distances, points, eye, out)
    return out


@compiled
def _write_eye_distances(first, last, points, eye, out):
    """Write the distances of points (rows, cols, 3) from an eye (3,) to ``out``, for the rows from ``first`` to ``last``."""
    for i in range(first, last):
        for j in range(points.shape[1]):
            p = points[i, j]
            out[i, j] = np.sqrt((p[0] - eye[0]) ** 2 + (p[1] - eye[1]) ** 2 + (p[2] - eye[2]) ** 2)


def _depth_margin_m(
    normal: np.ndarray, corners: np.ndarray, position: np.ndarray, mask: np.ndarray, rotation: np.ndarray, tap_reach_m: np.ndarray
) -> float:
    """Return the largest depth, metres, by which a map may store a point's own triangle in front of the point.

    The maximum is over the points (rows, cols) in ``mask``. The map samples the triangle at texel centres up to ``tap_reach_m``
    (2,) right and up of the point. It clamps depths in front of its first depth. A triangle that starts there could not be
    distinguished from its casters. ``position`` and ``normal`` (rows, cols, 3) and the triangles' ``corners`` (rows, cols, 9) are
    those of the buffer. ``rotation`` (3, 3) leads from the frame to the light's axes: right, up and depth.
    """
    row_margins_m = np.empty(len(mask))
    run_in_chunks(len(mask), _write_depth_margins, normal, corners, position, mask, rotation, tap_reach_m, row_margins_m)
    return float(row_margins_m.max(initial=0.0))


@compiled
def _write_depth_margins(first, last, normal, corners, position, mask, rotation, tap_reach_m, out):
    """Write the largest depth margin of each row's points to ``out`` (rows,), metres, for the rows in [``first``, ``last``).

    The other parameters are those of ``_depth_margin_m``.
    """
    for i in range(first, last):
        margin_m = 0.0
        for j in range(mask.shape[1]):
            if not mask[i, j]:
                continue
            n, c, p = normal[i, j], corners[i, j], position[i, j]
            slope_rise, corner_rise = 0.0, 0.0
            for k in range(2):
                slope_rise += tap_reach_m[k] * abs(rotation[k, 0] * n[0] + rotation[k, 1] * n[1] + rotation[k, 2] * n[2])
            facing = abs(rotation[2, 0] * n[0] + rotation[2, 1] * n[1] + rotation[2, 2] * n[2])
            if slope_rise <= margin_m * facing:
                continue
            for k in range(0, 9, 3):
                x, y, z = p[0] - c[k], p[1] - c[k + 1], p[2] - c[k + 2]
                corner_rise = max(corner_rise, rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z)
            margin_m = max(margin_m, min(slope_rise / facing if facing > 0.0 else corner_rise, corner_rise))
        out[i] = margin_m


def _max_coordinate_m(buffer: GeometryBuffer, mask: np.ndarray) -> float:
    """Return the largest coordinate of the points in ``mask`` and of their triangles, whose corners may be outside of the view."""
    extent_m = float(np.abs(light_bounds(buffer.position_frame_m, mask, np.eye(3), np.zeros(3))).max())
    if buffer.corners_frame_m is None:
        return extent_m
    farthest = np.empty(len(mask), np.float32)
    run_in_chunks(len(mask), _write_max_corner_coordinates, buffer.corners_frame_m, _on_triangles(buffer, mask), farthest)
    return max(extent_m, float(farthest.max(initial=0.0)))


def _on_triangles(buffer: GeometryBuffer, mask: np.ndarray) -> np.ndarray:
    """Return which of the points in ``mask`` (rows, cols) lie on their triangles: those that were not moved to smooth ground."""
    return mask if buffer.is_lifted is None or isinstance(buffer.view, MapView) else mask & ~buffer.is_lifted


@compiled
def _write_max_corner_coordinates(first, last, corners, mask, out):
    """Write the largest absolute coordinate of the corners (rows, cols, 9) of each row's pixels in ``mask`` to ``out`` (rows,).

    The rows are those in [``first``, ``last``).
    """
    for i in range(first, last):
        largest = np.float32(0.0)
        for j in range(mask.shape[1]):
            if mask[i, j]:
                for k in range(9):
                    largest = max(largest, abs(corners[i, j, k]))
        out[i] = largest


def depth_step_count(depth_bits: int) -> int:
    """Return the number of steps from depth 0 to depth 1, for 16, 24 or 32 bits of depth.

    32-bit floats count as 24 bits, since these are their steps near 1.
    """
    return 2**16 - 1 if depth_bits == 16 else 2**24 - 1


def _map_window(
    low: np.ndarray, high: np.ndarray, texel_m: np.ndarray, border_texels_xy: np.ndarray, is_stable: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first texel (2,) and the size (2,), in texels, of a map over light-space bounds and a border.

    ``low`` and ``high`` (2 or more,) are the bounds of the receivers, metres right and up. ``texel_m`` (2,) are the sides of a
    texel, and ``border_texels_xy`` (2,) is the border at either side. If ``is_stable``, the map lies on a lattice of texels through
    the origin of light space.
    """
    first = (np.floor(low[:2] / texel_m) if is_stable else low[:2] / texel_m) - border_texels_xy
    size = np.floor(high[:2] / texel_m - first).astype(np.int64) + 1 + border_texels_xy
    return first, -(-size // MAP_SIZE_STEP) * MAP_SIZE_STEP


def _stable_depths(low_m: float, high_m: float, step_m: float, step_count: int) -> tuple[float, float]:
    """Return the position of depth 0 and the depth step, in metres of light space, on a lattice of steps.

    The depths reach from at most ``low_m`` over ``step_count`` steps of ``step_m`` metres. The step is doubled until they reach
    ``high_m``, if the plan expected a smaller range.
    """
    while True:
        near = float(np.floor(low_m / (step_m * 256))) * 256 * step_m
        if near + step_count * step_m >= high_m:
            return near, step_m
        step_m *= 2.0


def _tight_depths(low_m: float, high_m: float, step_m: float, step_count: int) -> tuple[float, float]:
    """Return the position of depth 0 and the depth step, in metres of light space, that just cover the bounds.

    ``low_m`` and ``high_m`` are the bounds, and ``step_count`` is the number of steps. ``step_m`` is not used.
    """
    return low_m, (high_m - low_m) / step_count * (1.0 + 1e-6)
