"""Draw the scene in the post-perspective space of a perspective shadow map, as the layer ``post-perspective`` shows it.

The space is a cube: what the view shows lies within -1 to 1 in all three axes. It is seen from the side of its near plane, from
above and from the left. Of the scene, what lies in the cube is drawn.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.line_drawing import Line, line_opacity
from skugga.shadows.maps.light_layers import BOX_CORNERS, BOX_EDGES
from skugga.terrain.casters.casting import caster_meshes
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import set_uniforms, shader_source
from skugga.terrain.gbuffer.tree_instances import QUAD_TRIANGLES
from skugga.terrain.gl.device import Device
from skugga.terrain.scene import Scene
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

PICTURE_SIZE = 896, 1120
"""Rows and columns of the picture of a map's space."""

YAW_DEG, PITCH_DEG = 32.0, 24.0
"""Direction in which the cube is seen: turned to the right from its forward axis, and down."""

SHOWN_HALF_HEIGHT = 1.75
"""Half the height of the picture, where half the cube's side is 1."""

CUBE_EDGE = 1.001
"""Half the side of the cube to which the scene is cut; more than 1, since the outermost points lie on its faces."""

RAY_PLACES = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.6,) for z in (-0.6, 0.6)])
"""Points (n, 3) in the cube from which rays to the light are drawn."""

RAY_LENGTH = 0.7
"""Length of the drawn rays."""

LINE_TOLERANCE = 0.01
"""Distance by which a line may lie behind the scene, and still is visible."""


def post_perspective_view(gl: Device, space_from_frame: np.ndarray, buffer: GeometryBuffer, scene: Scene, light: str) -> np.ndarray:
    """Return the picture of a map's space, float32 (rows, cols, 5), as the layer ``post-perspective`` holds it.

    ``space_from_frame`` (4, 4) is the matrix from the buffer's frame to the space.
    """
    rows, cols = PICTURE_SIZE
    picture = picture_matrix()
    depths = _drawn_depths(gl, space_from_frame, picture, buffer, scene)
    col, row = np.meshgrid(2.0 * (np.arange(cols) + 0.5) / cols - 1.0, 1.0 - 2.0 * (np.arange(rows) + 0.5) / rows)
    clip = np.stack([col, row, 2.0 * depths - 1.0, np.ones_like(col)], axis=-1)
    points = clip @ np.linalg.inv(picture @ space_from_frame).T
    out = np.empty((rows, cols, 5), np.float32)
    out[..., :3] = np.where((depths < 1.0)[..., None], points[..., :3] / points[..., 3:], np.nan)
    tolerance = LINE_TOLERANCE * float(np.linalg.norm(picture[2, :3]))
    surface = np.where(depths < 1.0, 1.0 - 2.0 * depths - tolerance, -np.inf)
    corners = 2.0 * BOX_CORNERS - 1.0
    out[..., 3] = line_opacity([_line(picture, *corners[edge]) for edge in BOX_EDGES], surface)
    light_in_space = space_from_frame @ np.array(scene.light_position(light, buffer.frame))
    out[..., 4] = line_opacity([_line(picture, *ray) for ray in rays_to_light(light_in_space)], surface)
    return out


def picture_matrix() -> np.ndarray:
    """Return the matrix (4, 4) from a map's space (right, down, forward) to the clip space of its picture."""
    yaw, pitch = np.radians(YAW_DEG), np.radians(PITCH_DEG)
    turn = np.array([[np.cos(yaw), 0.0, -np.sin(yaw)], [0.0, 1.0, 0.0], [np.sin(yaw), 0.0, np.cos(yaw)]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(pitch), -np.sin(pitch)], [0.0, np.sin(pitch), np.cos(pitch)]])
    rows, cols = PICTURE_SIZE
    scale = np.diag([rows / cols / SHOWN_HALF_HEIGHT, -1.0 / SHOWN_HALF_HEIGHT, 0.5])
    matrix = np.eye(4)
    matrix[:3, :3] = scale @ tilt @ turn
    return matrix


def rays_to_light(light_in_space: np.ndarray) -> np.ndarray:
    """Return rays (n, 2, 3) in a map's space: from places in the cube, as points there move on their way to a light (4,).

    Their lines meet in the light: a point before the camera, or a sink behind it, towards which light runs.
    """
    towards = light_in_space[:3] - light_in_space[3] * RAY_PLACES
    towards = RAY_LENGTH * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return np.stack([RAY_PLACES, RAY_PLACES + towards], axis=1)


def _line(picture: np.ndarray, start: np.ndarray, end: np.ndarray) -> Line:
    """Return a line between two points (3,) of a map's space in its picture, whose matrix is ``picture`` (4, 4)."""
    rows, cols = PICTURE_SIZE
    ends = np.stack([start, end]) @ picture[:3, :3].T
    pixels = (ends[:, :2] * [1.0, -1.0] + 1.0) / 2.0 * [cols, rows] - 0.5
    return Line(pixels[0], pixels[1], -float(ends[0, 2]), -float(ends[1, 2]))


def _drawn_depths(
    gl: Device, space_from_frame: np.ndarray, picture: np.ndarray, buffer: GeometryBuffer, scene: Scene
) -> np.ndarray:
    """Return the depths of the scene in the picture of a map's space, (rows, cols) in [0, 1], 1 where there is nothing."""
    rows, cols = PICTURE_SIZE
    target = gl.depth_target(cols, rows, 24)
    uniforms = {
        "space_rows": tuple(space_from_frame.ravel()), "picture_rows": tuple(picture.ravel()), "edge": CUBE_EDGE,
    }  # fmt: skip
    solid = gl.program(
        shader_source("shadows/maps/space.vert", "shadows/maps/depth.vert"),
        shader_source("shadows/maps/space.frag", "shadows/maps/space_solid.frag"),
    )
    set_uniforms(solid, uniforms)
    with gl.depth_pass(target):
        gl.ctx.viewport = (0, 0, cols, rows)
        for vertices, triangles in caster_meshes(scene, buffer, ("relief", "meshes")):
            gl.draw_triangles(solid, vertices, triangles)
        trees = buffer.tree_instances
        if trees is not None and len(trees):
            leaves = gl.program(
                shader_source("shadows/maps/space.vert", "terrain/gbuffer/tree", "shadows/maps/depth_tree.vert"),
                shader_source("shadows/maps/space.frag", "shadows/maps/space_tree.frag"),
            )
            set_uniforms(leaves, {**uniforms, "foliage": 0, "threshold": ALPHA_THRESHOLD, "curvature": trees.curvature})
            gl.srgb_texture_array(foliage().mip_levels).use(0)
            variant = np.concatenate([trees.yaw_cos_sin, trees.variant[:, None]], axis=1)
            gl.draw_instances(
                leaves, QUAD_TRIANGLES, [("base", trees.base_frame_m), ("shape", trees.quad_sizes_m), ("look", variant)]
            )
    return gl.read(target, -1, size=(cols, rows))[::-1]
