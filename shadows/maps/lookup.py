"""Look points up in a depth map: compare their depths with the map's, by a shader or on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.maps.drawing import MapSettings
from skugga.shadows.maps.map_point_lookup import GroundNodes, MapPoints, look_up_map_points
from skugga.shadows.maps.point_lookup import DepthComparison, LookupPoints, look_up_points, sun_map
from skugga.shadows.maps.slope_bias import move_by_slope_bias
from skugga.shadows.maps.sun_disc import BLOCK_TEXELS, DISC_TANGENT, MAX_HALF_DISC_TEXELS, MIN_DISC_TAPS, disc_samples_before_edges
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import PassRecord
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import set_uniforms, shader_source
from skugga.terrain.gbuffer.light_facing import FacingNormals, facing_normals
from skugga.terrain.gbuffer.map_columns import column_top_corners
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import Device
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.ground.surface import SurfaceWindow
from skugga.terrain.lights import LightPosition

if TYPE_CHECKING:
    from moderngl import Framebuffer, Program

LOOKUP_COLS, LOOKUP_ROWS = 2048, 384
"""Columns and rows of the textures in which points of a perspective view are looked up: 50 MB."""

MAX_GATHERED_SHARE = 0.5
"""Share of a map view's pixels with a surface below which only these pixels are gathered and looked up."""

CREASE_EPSILON = np.float32(1e-9)
"""Amount by which the negative crease of a lifted point differs from 0, so that a crease of 0 is marked as well."""

DEPTH_MAP_TEXTURE_UNIT = 5
"""Texture unit of the depth map."""

MIN_DEPTH_TEXTURE_UNIT = 6
"""Texture unit of the minimum depths of the depth map's blocks of texels."""

POINT_LOOKUP_LABEL, MAP_POINT_LOOKUP_LABEL = "shadows/maps/point_lookup", "shadows/maps/map_point_lookup"
"""Labels of the CPU loops over a perspective view's points, and over those of a map, in the record of passes."""


def look_up(
    gl: Device,
    depth_map: DepthMap,
    target: Framebuffer,
    buffer: GeometryBuffer,
    light_in_frame: LightPosition,
    settings: MapSettings,
    visibility: np.ndarray,
    record: PassRecord,
) -> None:
    """Write the visibility of the points that a depth map serves to ``visibility`` (rows, cols) float32.

    ``target`` is the framebuffer of the drawn map. ``light_in_frame`` is the position of the map's light in the buffer's frame.
    Other points of the buffer keep their visibility.
    """
    view, window, corners = buffer.view, buffer.surface, buffer.corners_frame_m
    with _bind_min_depths(gl, depth_map, target, settings):
        if isinstance(view, MapView) and buffer.columns is not None:
            top_crease = np.where(buffer.surface_kind == RELIEF, np.float32(-1.0), buffer.crease)
            normal_and_crease = np.concatenate([buffer.normal_frame, top_crease[..., None]], axis=-1)
            arrays = [
                _looked_up_positions(depth_map, buffer.position_frame_m, buffer.normal_frame, light_in_frame, settings),
                normal_and_crease,
                column_top_corners(buffer).reshape(len(normal_and_crease), -1, 3),
            ]
            program = _lookup_program(gl, depth_map, settings, settings.filter, {"on_nodes": False, "has_corners": True})
            set_uniforms(program, {"corner_frame_m": 2})
            visibility[:] = _run_lookup(gl, program, arrays, target, depth_map, record)
            return
        facets = facing_normals(buffer, light_in_frame)
        position = _looked_up_positions(depth_map, buffer.position_frame_m, facets.normal_frame, light_in_frame, settings)
        if isinstance(view, MapView) and window is not None and _has_loop(depth_map, settings):
            depths = _read_map(gl, depth_map, target, record)
            comparison = _depth_comparison(settings, int(settings.filter))
            look_up_map_points(
                sun_map(depth_map, depths),
                comparison,
                _map_points(buffer, position, facets),
                _ground_nodes(window, view),
                visibility,
            )
            visibility[facets.is_blocked] = 0.0  # a map may miss occluders nearer than a texel
            record.add_loop(MAP_POINT_LOOKUP_LABEL, int(settings.filter))
            return
        if isinstance(view, MapView) and window is not None:
            rows, cols = buffer.valid.shape
            # a lifted point lies on none of the triangles around its node; a negative crease marks it
            crease = (
                facets.crease
                if buffer.is_lifted is None
                else np.where(buffer.is_lifted, -facets.crease - CREASE_EPSILON, facets.crease)
            )
            normal_and_crease = np.concatenate([facets.normal_frame, crease[..., None]], axis=-1)
            chosen = np.flatnonzero(buffer.valid)
            triangle_flags = {
                "on_nodes": True,
                "has_corners": corners is not None,
                "placed": chosen.size < MAX_GATHERED_SHARE * buffer.valid.size,
            }
            program = _lookup_program(gl, depth_map, settings, settings.filter, triangle_flags)
            first = (view.col0 - window.col0, view.row0 - window.row0)
            nodes = {"node_frame_m": 2, "first_node": first, "node_step": (view.col_step, view.row_step)}
            set_uniforms(program, {**nodes, "corner_frame_m": 3, "place": 3 if corners is None else 4})
            arrays = [
                position,
                normal_and_crease,
                *(() if corners is None else (corners.reshape(rows, cols * 3, 3),)),
            ]
            visibility[:] = 1.0
            if triangle_flags["placed"]:
                pixel_xy = np.stack(np.nonzero(buffer.valid)[::-1], axis=-1).astype(np.float32)
                gathered = [_reshape_to_rows(array.reshape(rows * cols, -1)[chosen]) for array in arrays] + [
                    _reshape_to_rows(pixel_xy)
                ]
                arrays = [gathered[0], gathered[1], *(array.reshape(len(array), -1, 3) for array in gathered[2:-1]), gathered[-1]]
            arrays.insert(2, _nodes_with_cuts(window.with_rim.sheet))
            lit = _run_lookup(gl, program, arrays, target, depth_map, record)
            visibility.ravel()[chosen] = lit.ravel()[: chosen.size] if triangle_flags["placed"] else lit.ravel()[chosen]
            visibility[facets.is_blocked] = 0.0  # a map may miss occluders nearer than a texel
            return
        assert corners is not None and depth_map.point_indices is not None
        pixel_count = visibility.size if buffer.first_sample_row is None else buffer.first_sample_row * visibility.shape[1]
        split = int(np.searchsorted(depth_map.point_indices, pixel_count))
        sample_filter = "sun" if settings.filter == "sun" else 1  # samples are averaged anyway
        parts = (depth_map.point_indices[:split], settings.filter), (depth_map.point_indices[split:], sample_filter)
        flat_arrays: list[np.ndarray] = [
            a.reshape(visibility.size, -1) for a in (position, facets.normal_frame, facets.crease, corners)
        ]
        flat_arrays.append(_kinds_of_triangles(buffer).reshape(-1))
        if _has_loop(depth_map, settings):
            depths = _read_map(gl, depth_map, target, record)
            points = LookupPoints(flat_arrays[0], flat_arrays[1], flat_arrays[2][:, 0], *flat_arrays[3:])
            for part, filter in parts:
                look_up_points(
                    sun_map(depth_map, depths), _depth_comparison(settings, int(filter)), points, part, visibility.reshape(-1)
                )
                record.add_loop(POINT_LOOKUP_LABEL, int(filter))
            return
        for part, filter in parts:
            for start in range(0, len(part), LOOKUP_COLS * LOOKUP_ROWS):
                chosen = part[start : start + LOOKUP_COLS * LOOKUP_ROWS]
                program = _lookup_program(gl, depth_map, settings, filter, {"on_nodes": False, "has_corners": True})
                set_uniforms(program, {"corner_frame_m": 2})
                rows = -(-len(chosen) // LOOKUP_COLS)
                gathered = [np.zeros((rows * LOOKUP_COLS, width), np.float32) for width in (3, 4, 9)]
                _gather_points(chosen, *flat_arrays, *gathered)
                arrays = [array.reshape(rows, -1, width) for array, width in zip(gathered, (3, 4, 3), strict=True)]
                visibility.ravel()[chosen] = _run_lookup(gl, program, arrays, target, depth_map, record).ravel()[: len(chosen)]


def _kinds_of_triangles(buffer: GeometryBuffer) -> np.ndarray:
    """Return the kinds of surface (rows, cols) of a perspective view, with ``FOREST`` for lifted points.

    Those lie on no known triangle, like points of trees.
    """
    if buffer.is_lifted is None:
        return buffer.surface_kind
    return np.where(buffer.is_lifted, np.uint8(FOREST), buffer.surface_kind)


def _has_loop(depth_map: DepthMap, settings: MapSettings) -> bool:
    """Return whether loops on the CPU can look points up in a map: in the sun's, without the sun's disc."""
    return settings.filter != "sun" and not depth_map.uniforms["lamp"] and depth_map.is_uniform


def _read_map(gl: Device, depth_map: DepthMap, target: Framebuffer, record: PassRecord) -> np.ndarray:
    """Return the depths of a drawn map of the sun: uint16 or float32 (rows, cols), valid until the next read."""
    depths = gl.read(target, -1, "u2" if depth_map.depth_bits == 16 else "f4", size=depth_map.face_size, reuse_memory=True)
    record.bytes = max(record.bytes, depth_map.nbytes + depths.nbytes)
    return depths


def _looked_up_positions(
    depth_map: DepthMap, position: np.ndarray, normal: np.ndarray, light_in_frame: LightPosition, settings: MapSettings
) -> np.ndarray:
    """Return the points (rows, cols, 3) that are looked up: the buffer's own, but for the bias ``slope_clamped``."""
    if settings.bias != "slope_clamped":
        return position
    return move_by_slope_bias(depth_map, position, normal, light_in_frame, settings.bias_scale)


def _map_points(buffer: GeometryBuffer, position: np.ndarray, facets: FacingNormals) -> MapPoints:
    """Return a map's points with the normals that face the light, in the form that the loop reads.

    ``position`` (rows, cols, 3) are the points that are looked up.
    """
    size, corners = buffer.valid.size, buffer.corners_frame_m
    return MapPoints(
        buffer.valid.reshape(size), position.reshape(size, 3), facets.normal_frame.reshape(size, 3),
        facets.crease.reshape(size), np.zeros((0, 9), np.float32) if corners is None else corners.reshape(size, 9),
        np.zeros(0, np.bool_) if buffer.is_lifted is None else buffer.is_lifted.reshape(size),
    )  # fmt: skip


def _ground_nodes(window: SurfaceWindow, view: MapView) -> GroundNodes:
    """Return the nodes of a map's ground, in the form that the loop reads."""
    sheet = window.with_rim.sheet
    places = view.row0 - window.row0, view.col0 - window.col0, view.row_step, view.col_step
    return GroundNodes(sheet.position_frame_m, sheet.is_cut_nw_se, *(np.float32(value) for value in places))


def _depth_comparison(settings: MapSettings, taps: int) -> DepthComparison:
    """Return how the loop on the CPU compares depths by some settings, with ``taps`` along a side for points on known triangles."""
    uses_triangles = settings.bias == "receiver_plane"
    # Points without a known triangle get fewer taps: a large offset would miss casters that touch the surface.
    taps_without_triangle = min(taps, 2) if uses_triangles else taps
    return DepthComparison(
        uses_triangles,
        settings.bias in ("receiver_plane", "normal_offset"),
        np.float32(settings.bias_scale),
        taps,
        taps_without_triangle,
    )


def _lookup_program(
    gl: Device, depth_map: DepthMap, settings: MapSettings, filter: int | str, triangle_flags: dict[str, bool]
) -> Program:
    """Return the shader program that samples a map, with all uniforms set but those of the points.

    ``filter`` is the number of taps along a side, or ``sun``. ``triangle_flags`` are constants of the shader: from where it reads
    the triangles round a point, if they are known.
    """
    from moderngl import Uniform

    is_disc, taps = filter == "sun", MIN_DISC_TAPS if filter == "sun" else int(filter)
    comparison = _depth_comparison(settings, taps)
    constants = triangle_flags | {
        "lamp": depth_map.uniforms["lamp"], "faces": len(depth_map.face_rotations), "uses_triangles": comparison.uses_triangles,
        "uses_offset": comparison.uses_offset,
        "taps": taps, "lit_by_taps": not is_disc, "taps_without_triangle": comparison.taps_without_triangle,
    }  # fmt: skip
    fragment = shader_source(depth_map.shader_parts[1], "shadows/maps/sun_disc.frag" if is_disc else "shadows/maps/shadow_map.frag")
    program = gl.program(shader_source("shadows/pixels.vert"), fragment, constants)
    set_uniforms(program, {
        **depth_map.uniforms, "map_size": depth_map.face_size, "bias_scale": settings.bias_scale,
        "position_frame_m": 0, "normal_frame": 1, "depth_map": DEPTH_MAP_TEXTURE_UNIT,
    })  # fmt: skip
    if "face_from_lamp" in program:
        program["face_from_lamp"] = [tuple(face.T.ravel()) for face in depth_map.face_rotations]
    if is_disc:
        widest_m = tuple(MAX_HALF_DISC_TEXELS * side for side in depth_map.uniforms["texel_m"])
        set_uniforms(program, {
            "least_depth": MIN_DEPTH_TEXTURE_UNIT, "block_texels": BLOCK_TEXELS, "disc_tangent": DISC_TANGENT, "widest_m": widest_m,
        })  # fmt: skip
        for name, bits in zip(("left_of", "below"), disc_samples_before_edges(), strict=True):
            uniform = program[name]
            assert isinstance(uniform, Uniform)
            uniform.write(bits.tobytes())
    return program


def _bind_depths(target: Framebuffer) -> None:
    """Bind a depth map to its texture unit."""
    from moderngl import Texture

    depths = target.depth_attachment
    assert isinstance(depths, Texture)
    depths.use(DEPTH_MAP_TEXTURE_UNIT)


@contextmanager
def _bind_min_depths(gl: Device, depth_map: DepthMap, target: Framebuffer, settings: MapSettings) -> Iterator[None]:
    """Bind the minimum depth of each block of a map's texels to its texture unit, where the sun's disc needs it."""
    if settings.filter != "sun":
        yield
        return
    program = gl.program(shader_source("shadows/pixels.vert"), shader_source("shadows/maps/least_depth.frag"))
    set_uniforms(program, {"depth_map": DEPTH_MAP_TEXTURE_UNIT, "block_texels": BLOCK_TEXELS})
    _bind_depths(target)
    width, height = depth_map.face_size
    blocks = gl.float_target(width // BLOCK_TEXELS, height // BLOCK_TEXELS)
    gl.draw_pixels(program, blocks)
    min_depth_texture = gl.texture(gl.read(blocks))
    min_depth_texture.use(MIN_DEPTH_TEXTURE_UNIT)
    try:
        yield
    finally:
        min_depth_texture.release()


def _run_lookup(
    gl: Device, program: Program, arrays: list[np.ndarray], target: Framebuffer, depth_map: DepthMap, record: PassRecord
) -> np.ndarray:
    """Run a look-up program on points, and return their visibility (rows, cols).

    ``arrays`` become the textures 0, 1, and so on: positions (rows, cols, 3), normals with creases (rows, cols, 4), and further
    arrays of the program.
    """
    rows, cols = arrays[0].shape[:2]
    textures = [gl.texture(array) for array in arrays]
    for unit, texture in enumerate(textures):
        texture.use(unit)
    _bind_depths(target)
    lookup_target = gl.float_target(cols, rows)
    gl.draw_pixels(program, lookup_target)
    lit = gl.read(lookup_target)
    texture_bytes = sum(texture.width * texture.height * texture.components * 4 for texture in textures)
    record.bytes = max(record.bytes, depth_map.nbytes + texture_bytes + lit.nbytes)
    for texture in textures:
        texture.release()
    return lit


def _reshape_to_rows(values: np.ndarray) -> np.ndarray:
    """Return values (n, k) row by row as (rows, ``LOOKUP_COLS``, k), the last row padded with NaN."""
    rows = max(-(-len(values) // LOOKUP_COLS), 1)
    out = np.full((rows * LOOKUP_COLS, values.shape[1]), np.nan, np.float32)
    out[: len(values)] = values
    return out.reshape(rows, LOOKUP_COLS, -1)


def _nodes_with_cuts(sheet: Sheet) -> np.ndarray:
    """Return a sheet's nodes (rows, cols, 4) float32, each with the diagonal that cuts the quad south-east of it.

    The fourth number is 1 where the diagonal runs from north-west to south-east, and 0 otherwise.
    """
    out = np.zeros((*sheet.position_frame_m.shape[:2], 4), np.float32)
    out[..., :3] = sheet.position_frame_m
    out[:-1, :-1, 3] = sheet.is_cut_nw_se
    return out


@compiled
def _gather_points(point_indices, position, normal, crease, corners, surface_kind, points, normals_and_creases, triangles):
    """Copy the points of a buffer with the flat indices ``point_indices`` (n,) to float32 arrays for textures.

    ``position``, ``normal``, ``crease``, ``corners`` and ``surface_kind`` are those of the buffer, one row for each of its points.
    The outputs are ``points`` (n, 3), ``normals_and_creases`` (n, 4) and the corners of the points' ``triangles`` (n, 9). The three
    corners of a tree's triangle are the point itself. Shaders take this as an unknown triangle.
    """
    for n in range(len(point_indices)):
        i = point_indices[n]
        for k in range(3):
            points[n, k] = position[i, k]
            normals_and_creases[n, k] = normal[i, k]
        normals_and_creases[n, 3] = crease[i, 0]
        for k in range(9):
            triangles[n, k] = position[i, k % 3] if surface_kind[i] == FOREST else corners[i, k]
