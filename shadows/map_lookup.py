"""Looking points up in a depth map."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from moderngl import Framebuffer, Program, Texture

from shadows.map_windows import DepthMap
from shadows.passes import PassRecord
from shadows.plan import LampMapSettings, ShadowMapSettings
from shadows.sun_disc import BLOCK_TEXELS, DISC_TANGENT, DISC_TAPS, WIDEST_TEXELS, samples_before_edges
from terrain.geometry import GeometryBuffer
from terrain.gl import Device
from terrain.grid import MapView
from terrain.visible import set_uniforms, shader

LOOK_COLS, LOOK_ROWS = 2048, 384
"""Points of a perspective view that are looked up side by side, and one below the other: 50 MB of textures."""

MAP_UNIT = 4
"""Texture unit of the depth map."""

LEAST_UNIT = 5
"""Texture unit of the least depths of its blocks."""


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
    arrays = [buffer.position_frame_m, np.concatenate([buffer.normal_frame, buffer.crease[..., None]], axis=-1)]
    view, window, corners = buffer.view, buffer.surface, buffer.corners_frame_m
    with _look_up_program(gl, drawn, target, settings) as program:
        if isinstance(view, MapView) and window is not None:
            rows, cols = buffer.there.shape
            first = (view.col0 - window.col0, view.row0 - window.row0)
            nodes = {"node_frame_m": 2, "first_node": first, "node_step": (view.col_step, view.row_step), "on_nodes": True}
            set_uniforms(program, nodes)
            arrays.append(window.position_frame_m)
            if corners is not None:
                arrays.append(corners.reshape(rows, cols * 3, 3))
            set_uniforms(program, {"has_corners": corners is not None, "corner_frame_m": len(arrays) - 1})
            _set_taps(program, settings, settings.filter)
            visibility[:] = _drawn_pixels(gl, program, arrays, target, drawn, record)
            return
        assert corners is not None and drawn.pixels is not None
        set_uniforms(program, {"on_nodes": False, "has_corners": True, "corner_frame_m": 2})
        flat = [array.reshape(visibility.size, -1) for array in (*arrays, corners)]
        own = visibility.size if buffer.samples_from is None else buffer.samples_from * visibility.shape[1]
        split = int(np.searchsorted(drawn.pixels, own))
        sample_filter = "sun" if settings.filter == "sun" else 1  # samples are averaged as it is
        for part, filter in ((drawn.pixels[:split], settings.filter), (drawn.pixels[split:], sample_filter)):
            _set_taps(program, settings, filter)
            for start in range(0, len(part), LOOK_COLS * LOOK_ROWS):
                chosen = part[start : start + LOOK_COLS * LOOK_ROWS]
                rows = -(-len(chosen) // LOOK_COLS)
                some = [_rows_of(values, chosen, rows) for values in flat]
                some[-1] = some[-1].reshape(rows, LOOK_COLS * 3, 3)
                visibility.ravel()[chosen] = _drawn_pixels(gl, program, some, target, drawn, record).ravel()[: len(chosen)]


@contextmanager
def _look_up_program(
    gl: Device, drawn: DepthMap, target: Framebuffer, settings: ShadowMapSettings | LampMapSettings
) -> Iterator[Program]:
    """The program that looks a map up, all set but for the points and the taps."""
    name = "sun_disc" if settings.filter == "sun" else "shadow_map"
    program = gl.program(shader("shadows/pixels.vert"), shader("shadows/receiver", f"shadows/{name}.frag"))
    set_uniforms(program, {
        **drawn.uniforms, "map_size": drawn.size, "faces": len(drawn.faces), "bias_scale": settings.bias_scale,
        "by_triangles": settings.bias == "receiver_plane", "by_offset": settings.bias != "polygon_offset",
        "position_frame_m": 0, "normal_frame": 1, "depth_map": MAP_UNIT,
    })  # fmt: skip
    if "face_from_lamp" in program:
        turns = [*drawn.faces, *([np.eye(3)] * (6 - len(drawn.faces)))]
        program["face_from_lamp"] = [tuple(face.T.ravel()) for face in turns]
    if settings.filter != "sun":
        yield program
        return
    widest_m = tuple(WIDEST_TEXELS * side for side in drawn.uniforms["texel_m"])
    disc = {"least_depth": LEAST_UNIT, "block_texels": BLOCK_TEXELS, "disc_tangent": DISC_TANGENT, "widest_m": widest_m}
    set_uniforms(program, disc)
    for name, bits in zip(("left_of", "below"), samples_before_edges(), strict=True):
        program[name].write(bits.tobytes())
    least = _least_depths(gl, drawn, target)
    least.use(LEAST_UNIT)
    try:
        yield program
    finally:
        least.release()


def _set_taps(program: Program, settings: ShadowMapSettings | LampMapSettings, filter: int | str) -> None:
    """Taps a side. Beside known triangles there are fewer: a point moved far clear of its own misses what touches it."""
    taps = DISC_TAPS if filter == "sun" else int(filter)
    set_uniforms(program, {"taps": taps, "taps_beside": min(taps, 2) if settings.bias == "receiver_plane" else taps})


def _least_depths(gl: Device, drawn: DepthMap, target: Framebuffer) -> Texture:
    """The least depth of each block of a map's texels; to be released."""
    program = gl.program(shader("shadows/pixels.vert"), shader("shadows/least_depth.frag"))
    set_uniforms(program, {"depth_map": MAP_UNIT, "block_texels": BLOCK_TEXELS})
    target.depth_attachment.use(MAP_UNIT)
    width, height = drawn.size
    blocks = gl.float_target(width // BLOCK_TEXELS, height // BLOCK_TEXELS)
    gl.draw_pixels(program, blocks)
    return gl.texture(gl.read(blocks))


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
