"""Make the hybrid's conservative maps: light-space windows round a buffer's points, and the classification of the points."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

import numpy as np

from skugga.shadows.hybrid.conservative_map import (
    LIT,
    ConservativeMap,
    classify_points,
    clipped_edges,
    clipped_triangles,
    conservative_map,
)
from skugga.shadows.maps.windows import CUBE_FACES, POSITION_ERROR
from skugga.shadows.passes import PassLog
from skugga.shadows.volumes.volumes import Volumes
from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.scene import Scene

HYBRID_BORDER_TEXELS = 1
"""Border of texels round the points, so that no point lies at the edge of the map."""

NEAR_PLANE_DISTANCE_SHARE = 1e-6
"""Near plane of a lamp, as a share of the nearest point's distance along the map's axis. Nearer casters are ignored."""

MIN_TEXEL_ROUNDING_ERRORS = 256.0
"""Minimum texel size, in float32 rounding errors of a caster's position: the margin of a texel is a share of its size."""


@dataclass(frozen=True, eq=False)
class MapWindow:
    """A face of a light's map, and the points in it.

    Attributes
    ----------
    pixels
        Flat indices (n,) of the points.
    u, v, depth
        Their texel coordinates and depths (n,).
    depth_rounding
        Bound of the rounding error of depths: a number or (n,).
    rotation, translation
        Transform (3, 3), (3,) from frame points to the light's axes.
    is_lamp
        Whether the light is a lamp, with perspective projection.
    near_m
        Near plane of a lamp, metres; 0 for the sun.
    map_origin, texel_size
        Origin and texel size (2,) of the map in the light's axes. A point p there has the texel coordinates
        (p - ``map_origin``) / ``texel_size``.
    size
        Columns and rows, texels.
    """

    pixels: np.ndarray
    u: np.ndarray
    v: np.ndarray
    depth: np.ndarray
    depth_rounding: np.ndarray | float
    rotation: np.ndarray
    translation: np.ndarray
    is_lamp: bool
    near_m: float
    map_origin: np.ndarray
    texel_size: np.ndarray
    size: tuple[int, int]

    @property
    def cache_key(self) -> Hashable:
        """Cache key of the map's content, apart from the casters."""
        arrays = (self.rotation, self.translation, self.map_origin, self.texel_size)
        return self.is_lamp, self.near_m, self.size, tuple(float(v) for array in arrays for v in array.ravel())


_map_cache: Cache[ConservativeMap] = Cache("skugga.shadows.hybrid.maps", "light", 256 * MIB)
"""Cache of conservative maps, by window and casters."""


def classify_pixels(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    volumes: list[Volumes],
    map_size: int,
    receiver_mask: np.ndarray,
    passes: list[str],
    log: PassLog,
) -> np.ndarray:
    """Return the class of each point in ``receiver_mask``: LIT, SHADED or MASKED, uint8 (rows, cols); LIT elsewhere.

    ``volumes`` are the shadow volumes of all casters. ``map_size`` is the number of texels along a side of each map. ``passes`` are
    the names of the algorithm's passes for the light and the kinds.
    """
    classes, on_caster = np.full(receiver_mask.shape, LIT, np.uint8), _caster_mask(buffer, scene, light, kinds, receiver_mask)
    with log.record_pass(passes[1]), log.record_pass(passes[2]):
        windows = [*map_windows(buffer, scene, light, map_size, receiver_mask)]
    for window in windows:
        with log.record_pass(passes[1]) as record:
            window_map, was_cached = cached_map(window, volumes)
            record.kept += was_cached
            record.map_texels += window_map.nearest_depth.size
            record.bytes = max(record.bytes, 3 * window_map.nearest_depth.nbytes)
        with log.record_pass(passes[2]):
            classes.ravel()[window.pixels] = classify_points(
                window_map, window.u, window.v, window.depth, window.depth_rounding, on_caster[window.pixels]
            )
    return classes


def _caster_mask(
    buffer: GeometryBuffer, scene: Scene, light: str, kinds: tuple[CasterKind, ...], receiver_mask: np.ndarray
) -> np.ndarray:
    """Return which of a buffer's points certainly lie on casting triangles, bool (n,) for the flattened points.

    These are points on front faces, as seen from the light, of meshes without simplified casters. The buffer gives visible back
    faces the normal of a front face, so the test uses the triangles' corners. Ground casts by its back faces, so it is excluded.
    """
    solids, result = scene.objects.solids, np.zeros(receiver_mask.size, bool)
    if solids is None or "meshes" not in kinds or solids.caster_triangles is not solids.triangles:
        return result
    pixels = np.flatnonzero(receiver_mask & (buffer.surface_kind == MESHES))
    if len(pixels) and buffer.corners_frame_m is not None:
        a, b, c = buffer.corners_frame_m.reshape(-1, 3, 3)[pixels].astype(np.float64).transpose(1, 0, 2)
        source = np.array(scene.light_position(light, buffer.frame))
        result[pixels] = (np.cross(b - a, c - a) * (source[:3] - source[3] * a)).sum(axis=1) > 0.0
    return result


def cached_map(window: MapWindow, volumes: list[Volumes]) -> tuple[ConservativeMap, bool]:
    """Return the conservative map of a window, and whether it comes from the cache. ``volumes`` hold the casters."""
    conservative = _map_cache.get(window.cache_key, *volumes)
    if not isinstance(conservative, Missing):
        return conservative, True
    corners = [_transform_to_texels(window, part.vertices[part.caps], clipped_triangles) for part in volumes]
    edges = [_transform_to_texels(window, part.vertices[part.silhouette_edges], clipped_edges) for part in volumes]
    empty = np.zeros((0, 3, 3)), np.zeros((0, 2, 3))
    conservative = conservative_map(window.size, np.concatenate([empty[0], *corners]), np.concatenate([empty[1], *edges]))
    _map_cache.put(window.cache_key, *volumes, value=conservative)
    return conservative, False


def _transform_to_texels(window: MapWindow, points: np.ndarray, clip: Callable[[np.ndarray, float], np.ndarray]) -> np.ndarray:
    """Transform triangles or edges of volumes to texels and depth (m, k, 3), clipped at a lamp's near plane.

    ``points`` (n, k, 4) are their k corners, homogeneous points of the frame. ``clip`` is ``clipped_triangles`` or
    ``clipped_edges``.
    """
    light_points = points[..., :3].astype(np.float64) @ window.rotation.T + window.translation
    if window.is_lamp:
        light_points = _project_to_tangents(clip(light_points, window.near_m))
    return np.concatenate([(light_points[..., :2] - window.map_origin) / window.texel_size, light_points[..., 2:]], axis=-1)


def _project_to_tangents(points: np.ndarray) -> np.ndarray:
    """Project points (..., 3) in front of a lamp to tangents and a depth that is linear in them."""
    return np.concatenate([points[..., :2] / points[..., 2:], -1.0 / points[..., 2:]], axis=-1)


def map_windows(buffer: GeometryBuffer, scene: Scene, light: str, map_size: int, receiver_mask: np.ndarray) -> Iterator[MapWindow]:
    """Yield the faces of a light's map that contain any points.

    ``map_size`` is the number of texels along a side of each face.
    """
    pixels, points = np.flatnonzero(receiver_mask), buffer.position_frame_m.reshape(-1, 3)
    if light == SUN:
        assert scene.light_space is not None
        rotation, translation = scene.light_space.transform_from_frame(buffer.frame)
        faces = [(rotation, translation, pixels)]
    else:
        lamp = scene.lamps[light]
        lamp_position, _, lamp_rotation = lamp.in_frame(buffer.frame)
        if lamp.kind == "spot":
            faces = [(lamp_rotation, -lamp_rotation @ lamp_position, pixels)]
        else:
            face_rotations = [face @ lamp_rotation for face in CUBE_FACES]
            nearest = np.stack([(points[pixels] - lamp_position) @ face_rotation[2] for face_rotation in face_rotations]).argmax(
                axis=0
            )
            faces = [
                (face_rotation, -face_rotation @ lamp_position, pixels[nearest == number])
                for number, face_rotation in enumerate(face_rotations)
            ]
    for rotation, translation, face_pixels in faces:
        if not len(face_pixels):
            continue
        u, v, depth, low, high, largest_m = _transform_to_light(points, face_pixels, rotation, translation, light != SUN)
        error_m = POSITION_ERROR * max(largest_m, 1.0)
        near_m, slack, error = 0.0, np.float64(4.0 * error_m), np.full(2, error_m)
        if light != SUN:
            min_distance_m = -1.0 / low[2]
            near_m, slack = NEAR_PLANE_DISTANCE_SHARE * min_distance_m, 4.0 * error_m * depth**2
            error = error_m / min_distance_m * (1.0 + np.maximum(np.abs(low[:2]), np.abs(high[:2])))
        low, high = low[:2], high[:2]
        texel = np.maximum((high - low) / max(map_size - 2 * HYBRID_BORDER_TEXELS - 1, 1), MIN_TEXEL_ROUNDING_ERRORS * error)
        map_origin = low - HYBRID_BORDER_TEXELS * texel
        width, height = (int(n) for n in np.ceil((high - map_origin) / texel) + HYBRID_BORDER_TEXELS)
        _to_texels(u, map_origin[0], texel[0])
        _to_texels(v, map_origin[1], texel[1])
        yield MapWindow(
            face_pixels, u, v, depth, slack, rotation, translation, light != SUN, near_m, map_origin, texel, (width, height),
        )  # fmt: skip


@compiled
def _transform_to_light(points, pixels, rotation, translation, is_lamp):
    """Transform the points (m, 3) with the indices ``pixels`` (n,) to a light's axes, with projection for a lamp.

    ``rotation`` (3, 3) and ``translation`` (3,) are those of ``MapWindow``. Returns x, y and depth (n,), their lower and upper
    bounds (3,), and the largest absolute coordinate of the points in the frame. ``is_lamp`` is false for the sun, whose map is
    orthographic.
    """
    n = len(pixels)
    x, y, depth = np.empty(n), np.empty(n), np.empty(n)
    low, high, largest = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    light_point = np.empty(3)
    for k in range(n):
        p = points[pixels[k]]
        for axis in range(3):
            largest = max(largest, abs(p[axis]))
            light_point[axis] = rotation[axis, 0] * p[0] + rotation[axis, 1] * p[1] + rotation[axis, 2] * p[2] + translation[axis]
        if is_lamp:
            light_point[0], light_point[1], light_point[2] = (
                light_point[0] / light_point[2],
                light_point[1] / light_point[2],
                -1.0 / light_point[2],
            )
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], light_point[axis]), max(high[axis], light_point[axis])
        x[k], y[k], depth[k] = light_point
    return x, y, depth, low, high, largest


@compiled
def _to_texels(coordinates, map_origin, texel_size):
    """Convert coordinates (n,) along one axis of a map to texels, in place.

    ``map_origin`` and ``texel_size`` are those of ``MapWindow`` along this axis.
    """
    for k in range(len(coordinates)):
        coordinates[k] = (coordinates[k] - map_origin) / texel_size
