"""Drawing a depth map: everything that casts, as a light sees it."""

from __future__ import annotations

import numpy as np
from moderngl import Framebuffer

from shadows.map_windows import DepthMap
from shadows.passes import PassRecord
from terrain.casting import caster_meshes, caster_sheets
from terrain.foliage import THRESHOLD, foliage
from terrain.geometry import GeometryBuffer
from terrain.gl import Device
from terrain.level import CasterKind
from terrain.reach import Casters
from terrain.scene import Scene
from terrain.surface import sheet_triangles
from terrain.visible import set_uniforms, shader


def draw_map(
    gl: Device,
    drawn: DepthMap,
    buffer: GeometryBuffer,
    scene: Scene,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    record: PassRecord,
) -> Framebuffer:
    """Draw a map; returns its depth-only framebuffer, whose content lasts until the next map of its size is drawn."""
    width, height = drawn.size
    across, down = (3, 2) if len(drawn.faces) == 6 else (1, 1)
    target = gl.depth_target(width * across, height * down, drawn.depth_bits)
    solid = gl.program(shader("shadows/light", "shadows/depth.vert"), shader("shadows/depth.frag"))
    set_uniforms(solid, drawn.uniforms)
    meshes = caster_meshes(scene, buffer, kinds)
    if drawn.near_trees is not None:
        vertex = shader("shadows/light", "terrain/tree", "shadows/depth_tree.vert")
        leaves = gl.program(vertex, shader("shadows/depth_tree.frag"))
        set_uniforms(leaves, {**drawn.uniforms, "foliage": 0, "threshold": THRESHOLD, "curvature": drawn.near_trees.curvature})
    largest = 0
    with gl.depth_pass(target):
        for number, face in enumerate(drawn.faces):
            gl.ctx.viewport = (number % 3 * width, number // 3 * height, width, height)
            if len(drawn.faces) > 1:
                turned = _turned(drawn.uniforms, face)
                set_uniforms(solid, turned)
                if drawn.near_trees is not None:
                    set_uniforms(leaves, turned)
            for sheet in caster_sheets(scene, buffer, casters, kinds):
                record.triangles += gl.draw_sheet(solid, sheet)
                record.draws += 1
                largest = max(largest, sheet[..., 0].size * 12 + sheet_triangles(*sheet.shape[:2]).nbytes)
            for vertices, triangles in meshes:
                record.triangles += gl.draw_triangles(solid, vertices, triangles)
                record.draws += 1
                largest = max(largest, len(vertices) * 12 + triangles.nbytes)
            if drawn.near_trees is not None:
                stand = drawn.near_trees
                gl.layers(foliage().levels).use(0)
                look = np.concatenate([stand.turn, stand.look[:, None]], axis=1)
                instances = [("base", stand.base_frame_m), ("shape", stand.shape), ("look", look)]
                record.triangles += gl.draw_instances(leaves, 18, instances)
                record.draws += 1
                largest = max(largest, len(stand) * 40)
    record.map_texels += drawn.texels
    record.bytes = max(record.bytes, drawn.nbytes + largest)
    gl.check("depth map")
    return target


def _turned(uniforms: dict, face: np.ndarray) -> dict:
    """A lamp's rotation and offset, turned to one of its faces."""
    rotation = face @ np.array(uniforms["light_from_frame"]).reshape(3, 3).T
    return {"light_from_frame": tuple(rotation.T.ravel()), "light_offset_m": tuple(face @ np.array(uniforms["light_offset_m"]))}
