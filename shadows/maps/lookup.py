"""Look points up in a depth map."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.maps.drawing import MapSettings
from skugga.shadows.maps.point_lookup import DepthComparison, LitPoints, look_points_up, sun_map
from skugga.shadows.maps.sun_disc import BLOCK_TEXELS, DISC_TANGENT, MIN_DISC_TAPS, WIDEST_TEXELS, samples_before_edges
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import PassRecord
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import set_uniforms, shader
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.gbuffer.map_columns import column_top_corners
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import Device
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.lights import LightPosition

if TYPE_CHECKING:
    from moderngl import Framebuffer, Program

LOOK_COLS, LOOK_ROWS = 2048, 384
"""Columns and rows of the textures in which points of a perspective view are looked up: 50 MB."""

MAX_GATHERED_SHARE = 0.5
"""Threshold of the valid share of a map's pixels below which only valid pixels are gathered and looked up."""

TINY = np.float32(1e-9)

MAP_UNIT = 5
"""Texture unit of the depth map."""

MIN_DEPTH_UNIT = 6
"""Texture unit of the minimum depths of its blocks."""

POINT_LOOKUP = "shadows/maps/point_lookup"
"""Label in the record of the loop over a perspective view's points."""


def look_up(
    gl: Device,
    depth_map: DepthMap,
    target: Framebuffer,
    buffer: GeometryBuffer,
    light_frame: LightPosition,
    settings: MapSettings,
    visibility: np.ndarray,
    record: PassRecord,
) -> None:
    """Fill the visibility (rows, cols) of a map's points. ``light_frame`` is the position of the light whose map it is."""
    view, window, corners = buffer.view, buffer.surface, buffer.corners_frame_m
    with _bound_min_depths(gl, depth_map, target, settings):
        if isinstance(view, MapView) and buffer.columns is not None:
            on_tops = np.where(buffer.kind == RELIEF, np.float32(-1.0), buffer.crease)
            facing = np.concatenate([buffer.normal_frame, on_tops[..., None]], axis=-1)
            arrays = [buffer.position_frame_m, facing, column_top_corners(buffer).reshape(len(facing), -1, 3)]
            program = _program(gl, depth_map, settings, settings.filter, {"on_nodes": False, "has_corners": True})
            set_uniforms(program, {"corner_frame_m": 2})
            visibility[:] = _run_lookup(gl, program, arrays, target, depth_map, record)
            return
        facets = facing_normals(buffer, light_frame)
        if isinstance(view, MapView) and window is not None:
            rows, cols = buffer.valid.shape
            # a lifted point lies on none of the triangles around its node; a negative crease marks it
            crease = facets.crease if buffer.lifted is None else np.where(buffer.lifted, -facets.crease - TINY, facets.crease)
            facing = np.concatenate([facets.normal_frame, crease[..., None]], axis=-1)
            chosen = np.flatnonzero(buffer.valid)
            triangle_flags = {
                "on_nodes": True,
                "has_corners": corners is not None,
                "placed": chosen.size < MAX_GATHERED_SHARE * buffer.valid.size,
            }
            program = _program(gl, depth_map, settings, settings.filter, triangle_flags)
            first = (view.col0 - window.col0, view.row0 - window.row0)
            nodes = {"node_frame_m": 2, "first_node": first, "node_step": (view.col_step, view.row_step)}
            set_uniforms(program, {**nodes, "corner_frame_m": 3, "place": 3 if corners is None else 4})
            arrays = [buffer.position_frame_m, facing, *(() if corners is None else (corners.reshape(rows, cols * 3, 3),))]
            visibility[:] = 1.0
            if triangle_flags["placed"]:
                place = np.stack(np.nonzero(buffer.valid)[::-1], axis=-1).astype(np.float32)
                gathered = [_in_rows(array.reshape(rows * cols, -1)[chosen]) for array in arrays] + [_in_rows(place)]
                arrays = [gathered[0], gathered[1], *(array.reshape(len(array), -1, 3) for array in gathered[2:-1]), gathered[-1]]
            arrays.insert(2, _nodes(window.casting.sheet))
            lit = _run_lookup(gl, program, arrays, target, depth_map, record)
            visibility.ravel()[chosen] = lit.ravel()[: chosen.size] if triangle_flags["placed"] else lit.ravel()[chosen]
            visibility[facets.blocked] = 0.0  # a map may miss occluders nearer than a texel
            return
        assert corners is not None and depth_map.pixels is not None
        pixel_count = visibility.size if buffer.samples_from is None else buffer.samples_from * visibility.shape[1]
        split = int(np.searchsorted(depth_map.pixels, pixel_count))
        sample_filter = "sun" if settings.filter == "sun" else 1  # samples are averaged anyway
        parts = (depth_map.pixels[:split], settings.filter), (depth_map.pixels[split:], sample_filter)
        flat = [a.reshape(visibility.size, -1) for a in (buffer.position_frame_m, facets.normal_frame, facets.crease, corners)]
        if settings.filter != "sun" and not depth_map.uniforms["lamp"] and depth_map.is_uniform:
            depths = gl.read(target, -1, "u2" if depth_map.depth_bits == 16 else "f4", size=depth_map.size, reuse_memory=True)
            record.bytes = max(record.bytes, depth_map.nbytes + depths.nbytes)
            points = LitPoints(flat[0], flat[1], flat[2][:, 0], flat[3])
            for part, filter in parts:
                look_points_up(sun_map(depth_map, depths), _comparison(settings, int(filter)), points, part, visibility.reshape(-1))
                record.add_loop(POINT_LOOKUP, int(filter))
            return
        for part, filter in parts:
            for start in range(0, len(part), LOOK_COLS * LOOK_ROWS):
                chosen = part[start : start + LOOK_COLS * LOOK_ROWS]
                program = _program(gl, depth_map, settings, filter, {"on_nodes": False, "has_corners": True})
                set_uniforms(program, {"corner_frame_m": 2})
                rows = -(-len(chosen) // LOOK_COLS)
                gathered = [np.zeros((rows * LOOK_COLS, width), np.float32) for width in (3, 4, 9)]
                _gather(chosen, *flat, *gathered)
                arrays = [array.reshape(rows, -1, width) for array, width in zip(gathered, (3, 4, 3), strict=True)]
                visibility.ravel()[chosen] = _run_lookup(gl, program, arrays, target, depth_map, record).ravel()[: len(chosen)]


def _comparison(settings: MapSettings, taps: int) -> DepthComparison:
    by_triangles = settings.bias == "receiver_plane"
    # Points without a known triangle get fewer taps: a large offset would miss casters that touch the surface.
    beside = min(taps, 2) if by_triangles else taps
    return DepthComparison(by_triangles, settings.bias != "polygon_offset", np.float32(settings.bias_scale), taps, beside)


def _program(gl: Device, depth_map: DepthMap, settings: MapSettings, filter: int | str, triangle_flags: dict[str, bool]) -> Program:
    """Return the program that samples a map, with all uniforms but those of the points.

    ``triangle_flags`` says which triangles are known.
    """
    from moderngl import Uniform

    disc, taps = filter == "sun", MIN_DISC_TAPS if filter == "sun" else int(filter)
    by = _comparison(settings, taps)
    constants = triangle_flags | {
        "lamp": depth_map.uniforms["lamp"], "faces": len(depth_map.faces), "by_triangles": by.by_triangles,
        "by_offset": by.by_offset,
        "taps": taps, "lit_by_taps": not disc, "taps_beside": by.taps_beside,
    }  # fmt: skip
    fragment = shader(depth_map.shaders[1], "shadows/maps/sun_disc.frag" if disc else "shadows/maps/shadow_map.frag")
    program = gl.program(shader("shadows/pixels.vert"), fragment, constants)
    set_uniforms(program, {
        **depth_map.uniforms, "map_size": depth_map.size, "bias_scale": settings.bias_scale,
        "position_frame_m": 0, "normal_frame": 1, "depth_map": MAP_UNIT,
    })  # fmt: skip
    if "face_from_lamp" in program:
        program["face_from_lamp"] = [tuple(face.T.ravel()) for face in depth_map.faces]
    if disc:
        widest_m = tuple(WIDEST_TEXELS * side for side in depth_map.uniforms["texel_m"])
        set_uniforms(program, {
            "least_depth": MIN_DEPTH_UNIT, "block_texels": BLOCK_TEXELS, "disc_tangent": DISC_TANGENT, "widest_m": widest_m,
        })  # fmt: skip
        for name, bits in zip(("left_of", "below"), samples_before_edges(), strict=True):
            uniform = program[name]
            assert isinstance(uniform, Uniform)
            uniform.write(bits.tobytes())
    return program


def _use_depths(target: Framebuffer) -> None:
    """Bind a depth map to its texture unit."""
    from moderngl import Texture

    depths = target.depth_attachment
    assert isinstance(depths, Texture)
    depths.use(MAP_UNIT)


@contextmanager
def _bound_min_depths(gl: Device, depth_map: DepthMap, target: Framebuffer, settings: MapSettings) -> Iterator[None]:
    """Bind the minimum depth of each block of a map's texels to its texture unit, where the sun's disc needs it."""
    if settings.filter != "sun":
        yield
        return
    program = gl.program(shader("shadows/pixels.vert"), shader("shadows/maps/least_depth.frag"))
    set_uniforms(program, {"depth_map": MAP_UNIT, "block_texels": BLOCK_TEXELS})
    _use_depths(target)
    width, height = depth_map.size
    blocks = gl.float_target(width // BLOCK_TEXELS, height // BLOCK_TEXELS)
    gl.draw_pixels(program, blocks)
    least = gl.texture(gl.read(blocks))
    least.use(MIN_DEPTH_UNIT)
    try:
        yield
    finally:
        least.release()


def _run_lookup(
    gl: Device, program: Program, arrays: list[np.ndarray], target: Framebuffer, depth_map: DepthMap, record: PassRecord
) -> np.ndarray:
    """Run the look-up for points (rows, cols, 3), normals with creases, and further arrays; return visibility (rows, cols)."""
    rows, cols = arrays[0].shape[:2]
    textures = [gl.texture(array) for array in arrays]
    for unit, texture in enumerate(textures):
        texture.use(unit)
    _use_depths(target)
    visible = gl.float_target(cols, rows)
    gl.draw_pixels(program, visible)
    lit = gl.read(visible)
    held = sum(texture.width * texture.height * texture.components * 4 for texture in textures)
    record.bytes = max(record.bytes, depth_map.nbytes + held + lit.nbytes)
    for texture in textures:
        texture.release()
    return lit


def _in_rows(values: np.ndarray) -> np.ndarray:
    """Return values (n, k) row by row as (rows, ``LOOK_COLS``, k), the last row padded with NaN."""
    rows = max(-(-len(values) // LOOK_COLS), 1)
    out = np.full((rows * LOOK_COLS, values.shape[1]), np.nan, np.float32)
    out[: len(values)] = values
    return out.reshape(rows, LOOK_COLS, -1)


def _nodes(sheet: Sheet) -> np.ndarray:
    """Return a sheet's nodes (rows, cols, 4) float32 with the cut of the quad south-east of each.

    The cut is 1 where it runs to the south-east.
    """
    out = np.zeros((*sheet.position_frame_m.shape[:2], 4), np.float32)
    out[..., :3] = sheet.position_frame_m
    out[:-1, :-1, 3] = sheet.falls
    return out


@compiled
def _gather(chosen, position, normal, crease, corners, points, facings, triangles):
    """Gather some of a buffer's points (n, k) as float32: positions, normals with creases, and triangles."""
    for n in range(len(chosen)):
        i = chosen[n]
        for k in range(3):
            points[n, k] = position[i, k]
            facings[n, k] = normal[i, k]
        facings[n, 3] = crease[i, 0]
        for k in range(9):
            triangles[n, k] = corners[i, k]
