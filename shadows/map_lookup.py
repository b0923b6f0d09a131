"""Looking points up in a depth map."""

from __future__ import annotations

import numpy as np
from moderngl import Framebuffer, Program

from shadows.map_windows import DepthMap
from shadows.passes import PassRecord
from shadows.plan import LampMapSettings, ShadowMapSettings
from terrain.geometry import GeometryBuffer
from terrain.gl import Device
from terrain.grid import MapView
from terrain.visible import set_uniforms, shader

LOOK_COLS, LOOK_ROWS = 2048, 384
"""Points of a perspective view that are looked up side by side, and one below the other: 50 MB of textures."""

MAP_UNIT = 4
"""Texture unit of the depth map."""


def look_up(
    gl: Device,
    drawn: DepthMap,
    target: Framebuffer,
    buffer: GeometryBuffer,
    settings: ShadowMapSettings | LampMapSettings,
    visibility: np.ndarray,
    record: PassRecord,
) -> None:
    """Fill in the visibility (rows, cols) of the points that are a map's."""
    program = gl.program(shader("shadows/pixels.vert"), shader("shadows/shadow_map.frag"))
    set_uniforms(program, {
        **drawn.uniforms, "map_size": drawn.size, "faces": len(drawn.faces), "taps": settings.filter,
        "bias_scale": settings.bias_scale, "position_frame_m": 0, "normal_frame": 1, "depth_map": MAP_UNIT,
    })  # fmt: skip
    if "face_from_lamp" in program:
        turns = [*drawn.faces, *([np.eye(3)] * (6 - len(drawn.faces)))]
        program["face_from_lamp"] = [tuple(face.T.ravel()) for face in turns]
    arrays = [buffer.position_frame_m, np.concatenate([buffer.normal_frame, buffer.crease[..., None]], axis=-1)]
    view, window, corners = buffer.view, buffer.surface, buffer.corners_frame_m
    if isinstance(view, MapView) and window is not None:
        rows, cols = buffer.there.shape
        first = (view.col0 - window.col0, view.row0 - window.row0)
        nodes = {"node_frame_m": 2, "first_node": first, "node_step": (view.col_step, view.row_step), "on_nodes": True}
        set_uniforms(program, nodes)
        arrays.append(window.position_frame_m)
        if corners is not None:
            arrays.append(corners.reshape(rows, cols * 3, 3))
        set_uniforms(program, {"has_corners": corners is not None, "corner_frame_m": len(arrays) - 1})
        visibility[:] = _drawn_pixels(gl, program, arrays, target, drawn, record)
        return
    assert corners is not None and drawn.pixels is not None
    set_uniforms(program, {"on_nodes": False, "has_corners": True, "corner_frame_m": 2})
    flat = [array.reshape(visibility.size, -1) for array in (*arrays, corners)]
    own = visibility.size if buffer.samples_from is None else buffer.samples_from * visibility.shape[1]
    split = int(np.searchsorted(drawn.pixels, own))
    for part, taps in ((drawn.pixels[:split], settings.filter), (drawn.pixels[split:], 1)):  # samples are averaged as it is
        for start in range(0, len(part), LOOK_COLS * LOOK_ROWS):
            chosen = part[start : start + LOOK_COLS * LOOK_ROWS]
            rows = -(-len(chosen) // LOOK_COLS)
            some = [_rows_of(values, chosen, rows) for values in flat]
            some[-1] = some[-1].reshape(rows, LOOK_COLS * 3, 3)
            set_uniforms(program, {"taps": taps})
            visibility.ravel()[chosen] = _drawn_pixels(gl, program, some, target, drawn, record).ravel()[: len(chosen)]


def _drawn_pixels(
    gl: Device, program: Program, arrays: list[np.ndarray], target: Framebuffer, drawn: DepthMap, record: PassRecord
) -> np.ndarray:
    """Run the look-up for points (rows, cols, 3), facings, and what else there is of them."""
    rows, cols = arrays[0].shape[:2]
    textures = [gl.texture(array) for array in arrays]
    for unit, texture in enumerate(textures):
        texture.use(unit)
    target.depth_attachment.use(MAP_UNIT)
    visible = gl.float_target(cols, rows)
    gl.draw_pixels(program, visible)
    found = gl.read(visible)
    record.draws += 1
    held = sum(texture.width * texture.height * texture.components * 4 for texture in textures)
    record.bytes = max(record.bytes, drawn.nbytes + held + found.nbytes)
    for texture in textures:
        texture.release()
    return found


def _rows_of(values: np.ndarray, chosen: np.ndarray, rows: int) -> np.ndarray:
    """Some of values (n, k) as float32 (rows, LOOK_COLS, k), filled up with zeros."""
    out = np.zeros((rows * LOOK_COLS, values.shape[1]), np.float32)
    out[: len(chosen)] = values[chosen]
    return out.reshape(rows, LOOK_COLS, -1)
