"""Make the layers that show a drawn depth map: its frustum, the boxes that it is fitted to, and what the light sees.

All of them read the matrix with which the map was drawn, from the uniforms of its shaders.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.maps.drawing import read_depths
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import CASTER_LINE, MAP_LINE, RECEIVER_LINE, PassLog
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_meshes, caster_sheets
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.gl.device import Device
from skugga.terrain.level.level import CasterKind
from skugga.terrain.lights import LightPosition
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from moderngl import Framebuffer

MAX_VIEW_TEXELS = 1024
"""Largest side of a map in the layer ``light-view``. Of larger maps, blocks of texels show the one nearest to the light."""

BOX_CORNERS = np.array(list(product((0, 1), repeat=3)))
"""Corners (8, 3) of a box: 0 for its lower bound along an axis, 1 for its upper one."""

BOX_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (BOX_CORNERS[a] != BOX_CORNERS[b]).sum() == 1])
"""Edges (12, 2) of a box, as numbers of its corners."""

MIN_W_SHARE = 1e-4
"""Smallest w of an edge's end, as a share of the largest one of its box. An edge through infinity ends there."""


def keep_map_layers(
    log: PassLog,
    gl: Device,
    number: int,
    depth_map: DepthMap,
    target: Framebuffer,
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
) -> None:
    """Keep the requested layers of a drawn map: its lines in perspective views, and what the light sees.

    ``number`` is that of the map among those of its light. The other parameters are those of ``visibility_by_maps``.
    """
    log.keep_layer("light-view", light, light_view, gl, depth_map, target, scene.light_position(light, buffer.frame))
    if isinstance(buffer.view, PerspectiveView):
        log.keep_layer("light-frustum", light, frustum_lines, depth_map, number)
        log.keep_layer("light-bounds", light, bounds_lines, depth_map, number, buffer, scene, kinds, casters)


def clip_matrices(depth_map: DepthMap) -> list[np.ndarray]:
    """Return the matrices (4, 4) from the frame to the clip space of each of a map's faces, as its shaders use them."""
    uniforms = depth_map.uniforms
    if "clip_rows" in uniforms:
        return [np.array(uniforms["clip_rows"]).reshape(4, 4)]
    light_from_frame, offset = np.array(uniforms["light_from_frame"]).reshape(3, 3).T, np.array(uniforms["light_offset_m"])
    matrices = []
    for face in depth_map.face_rotations:
        axes = np.column_stack([face @ light_from_frame, face @ offset])
        matrix = np.zeros((4, 4))
        if uniforms["lamp"]:
            near, far = uniforms["near_far_m"]
            matrix[:2] = axes[:2] / uniforms["tangent"]
            matrix[2] = axes[2] * (far + near) / (far - near)
            matrix[2, 3] -= 2.0 * far * near / (far - near)
            matrix[3] = axes[2]
        else:
            matrix[:3] = 2.0 * axes / np.array(uniforms["window_m"])[:, None]
            matrix[:3, 3] -= 1.0
            matrix[3, 3] = 1.0
        matrices.append(matrix)
    return matrices


def box_lines(matrix: np.ndarray, low: np.ndarray, high: np.ndarray, number: int, role: float) -> np.ndarray:
    """Return the edges of a box in the space of a map as lines in the frame (n, 8), in the form of the layer ``light-frustum``.

    Parameters
    ----------
    matrix
        (4, 4): from the frame to the box's space.
    low, high
        (3,): the bounds of the box there.
    number, role
        The number of the map, and the role of the lines (``MAP_LINE`` and others).
    """
    corners = np.where(BOX_CORNERS, high, low)
    points = np.column_stack([corners, np.ones(8)]) @ np.linalg.inv(matrix).T
    min_w = MIN_W_SHARE * max(float(points[:, 3].max()), 0.0)
    lines = []
    for first, last in points[BOX_EDGES]:
        if max(first[3], last[3]) <= min_w:
            continue
        start, end = _before_infinity(first, last, min_w), _before_infinity(last, first, min_w)
        lines.append([*(start[:3] / start[3]), *(end[:3] / end[3]), number, role])
    return np.array(lines, np.float64).reshape(-1, 8)


def _before_infinity(point: np.ndarray, other: np.ndarray, min_w: float) -> np.ndarray:
    """Return a homogeneous point (4,), moved towards another one until its w is ``min_w``, unless it is larger already."""
    if point[3] >= min_w:
        return point
    return point + (other - point) * (min_w - point[3]) / (other[3] - point[3])


def frustum_lines(depth_map: DepthMap, number: int) -> np.ndarray:
    """Return the edges of the space that a map covers, of each face, as lines (n, 8) of the layer ``light-frustum``."""
    return np.concatenate([
        box_lines(matrix, np.full(3, -1.0), np.ones(3), number, MAP_LINE) for matrix in clip_matrices(depth_map)
    ])  # fmt: skip


def bounds_lines(
    depth_map: DepthMap, number: int, buffer: GeometryBuffer, scene: Scene, kinds: tuple[CasterKind, ...], casters: Casters
) -> np.ndarray:
    """Return the box of the receivers that a map is fitted to, and that of the casters in it, as lines (n, 8) of ``light-bounds``.

    The casters' box reaches as far towards the light as they do. Beside the map and behind it, it ends with the map.
    """
    lines = [box_lines(*box, number, RECEIVER_LINE) for box in depth_map.receiver_boxes]
    for matrix in clip_matrices(depth_map):
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for corners in _caster_corners(depth_map, buffer, scene, kinds, casters):
            caster_low, caster_high = _bounds_in_clip_space(matrix, corners)
            low, high = np.minimum(low, caster_low), np.maximum(high, caster_high)
        if (low <= high).all():
            lines.append(box_lines(matrix, np.maximum(low, [-1.0, -1.0, -np.inf]), np.minimum(high, 1.0), number, CASTER_LINE))
    return np.concatenate([np.zeros((0, 8)), *lines])


def _caster_corners(
    depth_map: DepthMap, buffer: GeometryBuffer, scene: Scene, kinds: tuple[CasterKind, ...], casters: Casters
) -> Iterator[np.ndarray]:
    """Yield the corners (n, k, 3) of drawn casters in the frame: triangles, nodes of the ground, and stems of trees."""
    for sheet in caster_sheets(scene, buffer, casters, kinds):
        yield sheet.position_frame_m.reshape(-1, 1, 3)
    for vertices, triangles in caster_meshes(scene, buffer, kinds):
        yield vertices[triangles]
    if depth_map.trees is not None and len(depth_map.trees):
        trees = depth_map.trees
        yield trees.base_frame_m[:, None] + trees.quad_sizes_m[:, 2, None, None] * np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _bounds_in_clip_space(matrix: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (3,) of those bodies in a map's clip space whose bounds reach into the map.

    ``corners`` (n, k, 3) are those of n bodies, and ``matrix`` (4, 4) leads from the frame to the clip space.
    """
    points = corners @ matrix[:, :3].T + matrix[:, 3]
    points = points[(points[..., 3] > 0.0).all(axis=1)]  # without those that have no data, which are NaN
    in_map = points[..., :3] / points[..., 3:]
    low, high = in_map.min(axis=1), in_map.max(axis=1)
    inside = (high[:, :2] >= -1.0).all(axis=1) & (low <= 1.0).all(axis=1)
    return low[inside].min(axis=0, initial=np.inf), high[inside].max(axis=0, initial=-np.inf)


def light_view(gl: Device, depth_map: DepthMap, target: Framebuffer, light_in_frame: LightPosition) -> np.ndarray:
    """Return what a light sees in a drawn map, float32 (rows, cols), in metres; NaN where nothing casts.

    A lamp's values are distances from it. The sun's are distances along its rays from the plane through the frame's origin.
    """
    depths = read_depths(gl, depth_map, target)
    width, height = depth_map.face_size
    step = -(-max(width, height) // MAX_VIEW_TEXELS)
    rows, cols = -(-height // step), -(-width // step)
    is_lamp, light = light_in_frame.w != 0.0, np.array(light_in_frame)
    across = 2.0 * step * (np.arange(cols) + 0.5) / width - 1.0
    down = 2.0 * step * (np.arange(rows) + 0.5) / height - 1.0
    x, y = np.meshgrid(across, down if depth_map.uniforms["lamp"] else -down)
    matrices = clip_matrices(depth_map)
    tile_cols = 3 if len(matrices) > 1 else 1
    out = np.empty((rows * (-(-len(matrices) // tile_cols)), cols * tile_cols), np.float32)
    for number, matrix in enumerate(matrices):
        top, left = number // tile_cols, number % tile_cols
        face = np.ones((rows * step, cols * step), np.float32)
        face[:height, :width] = depths[top * height : (top + 1) * height, left * width : (left + 1) * width]
        nearest = face.reshape(rows, step, cols, step).min(axis=(1, 3))
        points = np.stack([x, y, 2.0 * nearest - 1.0, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix).T
        points = points[..., :3] / points[..., 3:]
        metres = np.linalg.norm(points - light[:3], axis=-1) if is_lamp else -points @ light[:3]
        out[top * rows : (top + 1) * rows, left * cols : (left + 1) * cols] = np.where(nearest < 1.0, metres, np.nan)
    return out
