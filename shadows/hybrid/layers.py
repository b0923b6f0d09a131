"""Make the layers that show a hybrid's conservative maps, from the windows and depths that classified the points."""

from __future__ import annotations

import numpy as np

from skugga.shadows.hybrid.conservative_map import ConservativeMap
from skugga.shadows.hybrid.maps import MapWindow, cached_map, map_windows
from skugga.shadows.layer_collector import tiled_pictures
from skugga.shadows.maps.light_layers import box_lines
from skugga.shadows.passes import CASTER_LINE, MAP_LINE, RECEIVER_LINE, PassLog
from skugga.shadows.volumes.volumes import Volumes
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene


def keep_conservative_layers(
    log: PassLog,
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    volumes: list[Volumes],
    map_size: int,
    receiver_mask: np.ndarray,
) -> None:
    """Keep the requested layers of the conservative maps. The parameters are those of ``maps_as_picture``, and the passes' log."""
    log.keep_layer("shadow-map", light, maps_as_picture, buffer, scene, light, volumes, map_size, receiver_mask)
    if not log.requested_layers & {"light-view", "light-frustum", "light-bounds"}:
        return
    for number, window in enumerate(map_windows(buffer, scene, light, map_size, receiver_mask)):
        conservative = cached_map(window, volumes)[0]
        log.keep_layer("light-view", light, _light_view, window, conservative)
        if isinstance(buffer.view, PerspectiveView):
            log.keep_layer("light-frustum", light, _frustum_lines, window, conservative, number)
            log.keep_layer("light-bounds", light, _bounds_lines, window, conservative, number)


def _window_matrix(window: MapWindow) -> np.ndarray:
    """Return the matrix (4, 4) from the frame to the light's axes, in which a window's points and depths are given."""
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([window.rotation, window.translation])
    if window.is_lamp:  # right and up as tangents, and -1 / depth
        matrix[3] = matrix[2]
        matrix[2] = [0.0, 0.0, 0.0, -1.0]
    return matrix


def _depth_bounds(window: MapWindow, conservative: ConservativeMap) -> tuple[float, float]:
    """Return the depths, in the window's own unit, of the nearest caster or point and of the farthest point."""
    nearest = conservative.nearest_depth
    low = min(float(nearest[np.isfinite(nearest)].min(initial=np.inf)), float(window.depth.min()))
    return low, max(float(window.depth.max()), low + 1e-9)


def _frustum_lines(window: MapWindow, conservative: ConservativeMap, number: int) -> np.ndarray:
    """Return the edges of the space that a window covers, from its nearest caster on, as lines (n, 8)."""
    near, far = _depth_bounds(window, conservative)
    low, high = window.map_origin, window.map_origin + np.array(window.size) * window.texel_size
    return box_lines(_window_matrix(window), np.array([*low, near]), np.array([*high, far]), number, MAP_LINE)


def _bounds_lines(window: MapWindow, conservative: ConservativeMap, number: int) -> np.ndarray:
    """Return the boxes of a window's points, and of the texels that hold casters, as lines (n, 8)."""
    matrix, origin, texel = _window_matrix(window), window.map_origin, window.texel_size
    low = np.array([*(origin + np.array([window.u.min(), window.v.min()]) * texel), window.depth.min()])
    high = np.array([*(origin + np.array([window.u.max(), window.v.max()]) * texel), window.depth.max()])
    lines = box_lines(matrix, low, high, number, RECEIVER_LINE)
    held = np.isfinite(conservative.nearest_depth)
    if not held.any():
        return lines
    row, col = np.nonzero(held)
    depths = conservative.nearest_depth[held]
    low = np.array([*(origin + np.array([col.min(), row.min()]) * texel), depths.min()])
    high = np.array([*(origin + np.array([col.max() + 1, row.max() + 1]) * texel), max(depths.max(), depths.min() + 1e-9)])
    return np.concatenate([lines, box_lines(matrix, low, high, number, CASTER_LINE)])


def _light_view(window: MapWindow, conservative: ConservativeMap) -> np.ndarray:
    """Return the nearest depths of a window's map in metres, as the layer ``light-view`` holds them, float32 (rows, cols)."""
    nearest = conservative.nearest_depth
    rows, cols = nearest.shape
    col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    held = np.isfinite(nearest)
    if not window.is_lamp:
        return np.where(held, nearest - window.translation[2], np.nan).astype(np.float32)[::-1]
    x, y = window.map_origin[0] + col * window.texel_size[0], window.map_origin[1] + row * window.texel_size[1]
    axial_m = -1.0 / np.where(held, nearest, -1.0)
    return np.where(held, axial_m * np.sqrt(1.0 + x * x + y * y), np.nan).astype(np.float32)


def maps_as_picture(
    buffer: GeometryBuffer, scene: Scene, light: str, volumes: list[Volumes], map_size: int, receiver_mask: np.ndarray
) -> np.ndarray:
    """Return the maps' nearest depths as one picture, the maps side by side: 0 is nearest to the light, 1 has no caster.

    The light's up direction is at the top. ``map_size`` is the number of texels along a side of each map.
    """
    arrays = []
    for window in map_windows(buffer, scene, light, map_size, receiver_mask):
        nearest = cached_map(window, volumes)[0].nearest_depth
        has_caster = np.isfinite(nearest)
        low, high = min(nearest[has_caster].min(initial=np.inf), window.depth.min()), window.depth.max()
        share = np.where(has_caster, (nearest - low) / max(high - low, 1e-30), 1.0).clip(0.0, 1.0).astype(np.float32)
        arrays.append(share if window.is_lamp else share[::-1])
    return tiled_pictures(arrays) if arrays else np.ones((1, 1), np.float32)
