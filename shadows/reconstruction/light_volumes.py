"""Draw a light's depth maps, and rebuild the volume behind what each of them shows in the frame of a view."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skugga.shadows.maps.windows import DepthMap, depth_step_count
from skugga.shadows.reconstruction.polygons import MAX_SQUARE_TEXELS, volume_polygons
from skugga.shadows.reconstruction.surface import DepthScale, rebuild_surface
from skugga.shadows.volumes.volumes import Volumes

LINKED_SLOPE = 3.0
"""Tangent in light space up to which neighbouring texels always belong to one surface, for a high sun and lamps."""

GROUND_SLOPE_FACTOR = 1.25
"""Factor by which that tangent exceeds the one of level ground under a low sun."""

MAX_LINKED_SLOPE = 20.0
"""Upper bound of that tangent under a low sun: level ground at 3.6 degrees."""


def linked_slope(sun_altitude_deg: float | None) -> float:
    """Return the tangent up to which texels are always linked, given the sun's altitude; ``None`` for a lamp."""
    if sun_altitude_deg is None:
        return LINKED_SLOPE
    tangent = np.tan(np.radians(max(sun_altitude_deg, 0.1)))
    return float(np.clip(GROUND_SLOPE_FACTOR / tangent, LINKED_SLOPE, MAX_LINKED_SLOPE))


def depth_scale(depth_map: DepthMap, max_slope: float) -> DepthScale:
    """Return how a map's depths relate to its texels and to metres."""
    uniforms, step = depth_map.uniforms, 1.0 / depth_step_count(depth_map.depth_bits)
    if not uniforms["lamp"]:
        depth_m = uniforms["window_m"][2]
        across, along = (side / depth_m for side in uniforms["texel_m"])
        return DepthScale((across, along), uniforms["error_m"] / depth_m, step, (1.0, 0.0), max_slope)
    near, far = uniforms["near_far_m"]
    per_reciprocal = near * far / (far - near)  # a depth grows by this times w squared in a metre
    side = 2.0 * uniforms["tangent"] / depth_map.face_size[0] * per_reciprocal
    return DepthScale((side, side), uniforms["error_m"] * per_reciprocal, step, (1.0 / near, -1.0 / per_reciprocal), max_slope)


def to_frame(depth_map: DepthMap, face: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return vertices (n, 3) of a face's map in the frame, metres (n, 3), the light's direction or place, and the handedness.

    The direction (3,) is away from the sun; a lamp has a place. The last value is whether the frame's axes have the handedness of
    columns, rows and depths.
    """
    uniforms = depth_map.uniforms
    rotation = face @ np.array(uniforms["light_from_frame"]).reshape(3, 3).T
    offset = face @ np.array(uniforms["light_offset_m"])
    if uniforms["lamp"]:
        near, far = uniforms["near_far_m"]
        distance = 1.0 / (1.0 / near - vertices[:, 2] * (far - near) / (near * far))
        sides = (2.0 * vertices[:, :2] / np.array(depth_map.face_size) - 1.0) * uniforms["tangent"] * distance[:, None]
        in_light = np.column_stack([sides, distance])
        origin = -rotation.T @ offset
    else:
        in_light = np.column_stack([vertices[:, :2] * uniforms["texel_m"], vertices[:, 2] * uniforms["window_m"][2]])
        origin = rotation[2]
    return (in_light - offset) @ rotation, origin, bool(np.linalg.det(rotation) > 0.0)


def face_depths(depth_map: DepthMap, texels: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the rotation (3, 3) of each face of a map, and its part (rows, cols) of all ``texels``."""
    width, height = depth_map.face_size
    for number, face in enumerate(depth_map.face_rotations):
        col, row = number % 3 * width, number // 3 * height
        yield face, np.ascontiguousarray(texels[row : row + height, col : col + width])


def rebuild_volume(
    depth_map: DepthMap, face: np.ndarray, depths: np.ndarray, max_slope: float, max_square: int = MAX_SQUARE_TEXELS
) -> Volumes | None:
    """Return the volume behind the surface that a face of a map shows; ``None`` if it shows nothing.

    ``depths`` (rows, cols) are the face's. ``max_slope`` is that of ``DepthScale``, and ``max_square`` that of
    ``volume_polygons``.
    """
    is_lamp, scale = bool(depth_map.uniforms["lamp"]), depth_scale(depth_map, max_slope)
    surface = rebuild_surface(depths, scale)
    if not len(surface.vertices):
        return None
    in_map, far_rays, faces = volume_polygons(surface, scale, is_lamp, max_square)
    points, light, keeps_handedness = to_frame(depth_map, face, in_map)
    if keeps_handedness:  # counter-clockwise as seen from behind the surface
        faces = np.ascontiguousarray(faces[:, ::-1])
    far = np.column_stack([points[far_rays] - light, np.zeros(len(far_rays))]) if is_lamp else np.append(light, 0.0)[None]
    near = np.column_stack([points, np.ones(len(points))])
    return Volumes(
        np.concatenate([near, far]).astype(np.float32),
        faces,
        np.zeros(len(faces), np.int32),
        points.min(axis=0)[None],
        points.max(axis=0)[None],
        np.zeros((0, 2), np.int32),
        0,
        0,
        draws_all_faces=True,
    )
