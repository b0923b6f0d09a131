"""The hybrid's conservative maps: light-space windows round a buffer's points, and the classification of the points."""

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
from skugga.shadows.layer_collector import tiled_pictures
from skugga.shadows.maps.windows import CUBE, POSITION_ERROR
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

NEAR_SHARE = 1e-6
"""Near plane of a lamp, as a share of the nearest point's distance along the map's axis. Nearer casters are ignored."""

FINEST_ERRORS = 256.0
"""Minimum texel size, in float32 rounding errors of a caster's position: the margin of a texel is a share of its size."""


@dataclass(frozen=True, eq=False)
class _Window:
    """A face of a light's map, and the points in it.

    Attributes
    ----------
    pixels
        Flat indices (n,) of the points.
    u, v, depth
        Their texel coordinates and depths (n,).
    slack
        Bound of the rounding error of depths: a number or (n,).
    rotation, translation
        Transform (3, 3), (3,) from frame points to the light's axes.
    lamp
        Whether the light is a lamp, with perspective projection.
    near_m
        Near plane of a lamp, metres; 0 for the sun.
    first, texel
        Origin and texel size (2,) of the map in the light's axes: texels are ``(at - first) / texel``.
    size
        Columns and rows, texels.
    """

    pixels: np.ndarray
    u: np.ndarray
    v: np.ndarray
    depth: np.ndarray
    slack: np.ndarray | float
    rotation: np.ndarray
    translation: np.ndarray
    lamp: bool
    near_m: float
    first: np.ndarray
    texel: np.ndarray
    size: tuple[int, int]

    @property
    def key(self) -> Hashable:
        """Cache key of the map's content, apart from the casters."""
        arrays = (self.rotation, self.translation, self.first, self.texel)
        return self.lamp, self.near_m, self.size, tuple(float(v) for array in arrays for v in array.ravel())


_map_cache: Cache[ConservativeMap] = Cache("skugga.shadows.hybrid.maps", "light", 256 * MIB)


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
    """Classify the points in the mask ``receiver_mask``: LIT, SHADED or MASKED, uint8 (rows, cols); LIT elsewhere."""
    classes, casting = np.full(receiver_mask.shape, LIT, np.uint8), _on_casters(buffer, scene, light, kinds, receiver_mask)
    with log.run(passes[1]), log.run(passes[2]):
        windows = [*_windows(buffer, scene, light, map_size, receiver_mask)]
    for window in windows:
        with log.run(passes[1]) as record:
            drawn, was_kept = _map(window, volumes)
            record.kept += was_kept
            record.map_texels += drawn.nearest.size
            record.bytes = max(record.bytes, 3 * drawn.nearest.nbytes)
        with log.run(passes[2]):
            classes.ravel()[window.pixels] = classify_points(
                drawn, window.u, window.v, window.depth, window.slack, casting[window.pixels]
            )
    return classes


def _on_casters(
    buffer: GeometryBuffer, scene: Scene, light: str, kinds: tuple[CasterKind, ...], receiver_mask: np.ndarray
) -> np.ndarray:
    """Return the mask (n,) of a buffer's flattened points that certainly lie on casting triangles.

    These are points on front faces, as seen from the light, of meshes without simplified casters. Visible back faces have the
    normal of a front face, so the test uses the corners. Ground casts by its back faces, so it is excluded.
    """
    solids, out = scene.objects.solids, np.zeros(receiver_mask.size, bool)
    if solids is None or "meshes" not in kinds or solids.caster_triangles is not solids.triangles:
        return out
    pixels = np.flatnonzero(receiver_mask & (buffer.kind == MESHES))
    if len(pixels) and buffer.corners_frame_m is not None:
        a, b, c = buffer.corners_frame_m.reshape(-1, 3, 3)[pixels].astype(np.float64).transpose(1, 0, 2)
        source = np.array(scene.light_position(light, buffer.frame))
        out[pixels] = (np.cross(b - a, c - a) * (source[:3] - source[3] * a)).sum(axis=1) > 0.0
    return out


def map_pictures(
    buffer: GeometryBuffer, scene: Scene, light: str, volumes: list[Volumes], map_size: int, receiver_mask: np.ndarray
) -> np.ndarray:
    """Return the maps' nearest depths as pictures side by side: 0 is nearest to the light, 1 has no caster.

    The light's up direction is at the top.
    """
    arrays = []
    for window in _windows(buffer, scene, light, map_size, receiver_mask):
        nearest = _map(window, volumes)[0].nearest
        has_caster = np.isfinite(nearest)
        low, high = min(nearest[has_caster].min(initial=np.inf), window.depth.min()), window.depth.max()
        share = np.where(has_caster, (nearest - low) / max(high - low, 1e-30), 1.0).clip(0.0, 1.0).astype(np.float32)
        arrays.append(share if window.lamp else share[::-1])
    return tiled_pictures(arrays) if arrays else np.ones((1, 1), np.float32)


def _map(window: _Window, volumes: list[Volumes]) -> tuple[ConservativeMap, bool]:
    """Return the map of a window, and whether it comes from the cache."""
    conservative = _map_cache.get(window.key, *volumes)
    if not isinstance(conservative, Missing):
        return conservative, True
    corners = [_transform_to_texels(window, part.vertices[part.caps], clipped_triangles) for part in volumes]
    edges = [_transform_to_texels(window, part.vertices[part.edges], clipped_edges) for part in volumes]
    none = np.zeros((0, 3, 3)), np.zeros((0, 2, 3))
    conservative = conservative_map(window.size, np.concatenate([none[0], *corners]), np.concatenate([none[1], *edges]))
    _map_cache.put(window.key, *volumes, value=conservative)
    return conservative, False


def _transform_to_texels(window: _Window, points: np.ndarray, clipped: Callable[[np.ndarray, float], np.ndarray]) -> np.ndarray:
    """Transform triangles or edges (n, k, 4) of volumes to texels and depth (m, k, 3), clipped at a lamp's near plane."""
    in_light = points[..., :3].astype(np.float64) @ window.rotation.T + window.translation
    if window.lamp:
        in_light = _projected(clipped(in_light, window.near_m))
    return np.concatenate([(in_light[..., :2] - window.first) / window.texel, in_light[..., 2:]], axis=-1)


def _projected(points: np.ndarray) -> np.ndarray:
    """Project points (..., 3) in front of a lamp to tangents and a depth that is linear in them."""
    return np.concatenate([points[..., :2] / points[..., 2:], -1.0 / points[..., 2:]], axis=-1)


def _windows(buffer: GeometryBuffer, scene: Scene, light: str, map_size: int, receiver_mask: np.ndarray) -> Iterator[_Window]:
    """Yield the faces of a light's map that contain any points."""
    pixels, points = np.flatnonzero(receiver_mask), buffer.position_frame_m.reshape(-1, 3)
    if light == SUN:
        assert scene.light is not None
        rotation, translation = scene.light.from_frame(buffer.frame)
        faces = [(rotation, translation, pixels)]
    else:
        lamp = scene.lamps[light]
        place, _, turn = lamp.in_frame(buffer.frame)
        if lamp.kind == "spot":
            faces = [(turn, -turn @ place, pixels)]
        else:
            turns = [face @ turn for face in CUBE]
            nearest = np.stack([(points[pixels] - place) @ face_rotation[2] for face_rotation in turns]).argmax(axis=0)
            faces = [
                (face_rotation, -face_rotation @ place, pixels[nearest == number]) for number, face_rotation in enumerate(turns)
            ]
    for rotation, translation, chosen in faces:
        if not len(chosen):
            continue
        u, v, depth, low, high, largest_m = _in_light(points, chosen, rotation, translation, light != SUN)
        error_m = POSITION_ERROR * max(largest_m, 1.0)
        near_m, slack, error = 0.0, np.float64(4.0 * error_m), np.full(2, error_m)
        if light != SUN:
            min_distance_m = -1.0 / low[2]
            near_m, slack = NEAR_SHARE * min_distance_m, 4.0 * error_m * depth**2
            error = error_m / min_distance_m * (1.0 + np.maximum(np.abs(low[:2]), np.abs(high[:2])))
        low, high = low[:2], high[:2]
        texel = np.maximum((high - low) / max(map_size - 2 * HYBRID_BORDER_TEXELS - 1, 1), FINEST_ERRORS * error)
        first = low - HYBRID_BORDER_TEXELS * texel
        width, height = (int(n) for n in np.ceil((high - first) / texel) + HYBRID_BORDER_TEXELS)
        _to_texels(u, first[0], texel[0])
        _to_texels(v, first[1], texel[1])
        yield _Window(
            chosen, u, v, depth, slack, rotation, translation, light != SUN, near_m, first, texel, (width, height),
        )  # fmt: skip


@compiled
def _in_light(points, pixels, rotation, translation, lamp):
    """Transform points (m, 3) of given indices to a light's axes, with projection for a lamp.

    Returns x, y and depth (n,), their lower and upper bounds (3,), and the largest absolute coordinate of the points in the frame.
    """
    n = len(pixels)
    x, y, depth = np.empty(n), np.empty(n), np.empty(n)
    low, high, largest = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    at = np.empty(3)
    for k in range(n):
        p = points[pixels[k]]
        for axis in range(3):
            largest = max(largest, abs(p[axis]))
            at[axis] = rotation[axis, 0] * p[0] + rotation[axis, 1] * p[1] + rotation[axis, 2] * p[2] + translation[axis]
        if lamp:
            at[0], at[1], at[2] = at[0] / at[2], at[1] / at[2], -1.0 / at[2]
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], at[axis]), max(high[axis], at[axis])
        x[k], y[k], depth[k] = at
    return x, y, depth, low, high, largest


@compiled
def _to_texels(at, first, texel):
    for k in range(len(at)):
        at[k] = (at[k] - first) / texel
