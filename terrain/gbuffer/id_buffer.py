"""Rasterise the number of the nearest triangle in each pixel. ``skugga.terrain.gbuffer.resolve`` computes the points on them.

Triangles are numbered from 1. In perspective the ground's come first; a map's ground is not rasterised. Then come those of the
meshes, and six for each tree. The alpha test of leaves reads mipmaps that preserve the covered area.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.ground_mesh import GroundMesh
from skugga.terrain.gbuffer.tree_instances import QUAD_TRIANGLES, TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.gl.device import Device, device
from skugga.terrain.gl.programs import join_shader_parts
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

if TYPE_CHECKING:
    import moderngl

NEAR_PLANE_M = 0.005
"""Distance of the near plane from the eye, metres. Nearer surfaces are clipped."""


@dataclass(frozen=True, eq=False)
class IdBuffer:
    """The visible triangle in each pixel of a view.

    Attributes
    ----------
    triangle_number
        uint32 (rows, cols), the triangle's number, from 1; 0 in empty pixels.
    sqrt_albedo
        uint8 (rows, cols, 4), the square root of the linear albedo where a tree is visible, times 255. Empty without trees.
    depth
        float32 (rows, cols), ``NEAR_PLANE_M`` over the distance along the view's axis. Empty in a map, and if only selected pixels
        were drawn.
    """

    triangle_number: np.ndarray
    sqrt_albedo: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class ObjectPixels:
    """The pixels of a map that show meshes or trees, and the visible triangle in each of them.

    Attributes
    ----------
    pixel
        int32 (n,), flat indices of the pixels.
    triangle_number
        uint32 (n,), the triangle's number, from 1.
    sqrt_albedo
        uint8 (n, 4), as in ``IdBuffer``.
    """

    pixel: np.ndarray
    triangle_number: np.ndarray
    sqrt_albedo: np.ndarray

    def select(self, pixel_mask: np.ndarray) -> ObjectPixels:
        """Return those of the pixels that a mask (rows, cols) selects."""
        selected = pixel_mask.ravel()[self.pixel]
        return ObjectPixels(self.pixel[selected], self.triangle_number[selected], self.sqrt_albedo[selected])


def object_pixels(id_buffer: IdBuffer) -> ObjectPixels:
    """Return the pixels of a map's ID buffer that show meshes or trees."""
    number = id_buffer.triangle_number.ravel()
    pixel = np.flatnonzero(number).astype(np.int32)
    sqrt_albedo = id_buffer.sqrt_albedo.reshape(-1, 4)[pixel] if id_buffer.sqrt_albedo.size else np.zeros((len(pixel), 4), np.uint8)
    return ObjectPixels(pixel, number[pixel], sqrt_albedo)


@cached("process", 8 * MIB)
def shader_source(*parts: str) -> str:
    """Return the concatenated GLSL text of shader parts, each the name of a file.

    For example, ``terrain/gbuffer/tree`` is the file ``shaders/tree.glsl`` in the package ``skugga.terrain.gbuffer``.
    """
    texts = {}
    for part in parts:
        folder, _, name = part.rpartition("/")
        texts[part] = files(f"skugga.{folder.replace('/', '.')}").joinpath("shaders", f"{name}.glsl").read_text(encoding="utf-8")
    return join_shader_parts(texts)


def rasterise_perspective(
    view: PerspectiveView,
    frame: LocalFrame,
    ground: GroundMesh,
    solids: tuple[np.ndarray, np.ndarray] | None,
    instances: TreeInstances | None,
    pixel_mask: np.ndarray | None = None,
) -> IdBuffer:
    """Rasterise the ground, meshes and trees for a camera.

    ``solids`` are the meshes' vertices (n, 3) in the frame and triangles (m, 3). ``pixel_mask`` (rows, cols) selects pixels; the
    others stay empty.
    """
    gl = device()
    eye, camera_from_frame = view.in_frame(frame)
    size = np.array([view.cols, view.rows])
    first = np.array([view.col0, view.row0])
    uniforms = {
        "camera_from_frame": tuple(camera_from_frame.T.ravel()),
        "eye_frame_m": tuple(eye),
        "window": (*(2.0 * view.focal_px / (view.step_px * size)), *((1.0 - 2.0 * first / view.step_px) / size - 1.0)),
        "near_m": NEAR_PLANE_M,
    }
    target = gl.visibility_buffer_target(view.cols, view.rows)
    tangent_bounds = np.array([[first[k] - view.step_px, first[k] + size[k] * view.step_px] for k in (0, 1)]) / view.focal_px
    visible_ground = _triangles_in_frustum(ground.position_frame_m, ground.triangles, eye, camera_from_frame, tangent_bounds)
    with gl.visibility_buffer_pass(target):
        if pixel_mask is not None:  # depth 1 is the near plane: the depth test rejects all other pixels early
            gl.write_depths(target, np.subtract(np.float32(1.0), pixel_mask, dtype=np.float32))
        program = _program(gl, "visible.vert", "visible.frag", uniforms)
        gl.draw_triangles(program, ground.position_frame_m, ground.triangles[visible_ground], 0)
        triangle_count = len(ground.triangles)
        if solids is not None:
            triangle_count += gl.draw_triangles(program, *solids, triangle_count)
        if instances is not None:
            visible_trees = instances.in_frustum(eye, camera_from_frame, tangent_bounds)
            visible_trees = instances.front_to_back(visible_trees, camera_from_frame[2])
            tree_uniforms = {"in_map": False, "level_bias": float(np.log2(view.pixel_share))}
            _draw_trees(gl, instances, visible_trees, instances.base_frame_m, {**uniforms, **tree_uniforms}, triangle_count)
    return _read_id_buffer(
        gl,
        target,
        instances,
        triangle_count,
        None if instances is None else visible_trees,
        visible_ground,
        reads_depth=pixel_mask is None,
    )


def rasterise_map(
    view: MapView,
    solids_px: tuple[np.ndarray, np.ndarray] | None,
    instances: TreeInstances | None,
    bases_px: np.ndarray | None,
    px_from_m: np.ndarray,
    heights_m: tuple[float, float],
) -> IdBuffer:
    """Rasterise the meshes and trees on a map's ground.

    Positions are columns and rows in pixels from the corner of the first pixel, and heights in metres.

    Parameters
    ----------
    view
        The map view.
    solids_px
        Positions (n, 3) of the meshes' vertices, and triangles (m, 3); ``None`` without meshes.
    instances
        The trees; ``None`` without trees.
    bases_px
        Positions (k, 3) of the trees' feet.
    px_from_m
        (2, 2), the map's pixels per metre along the frame's first two axes.
    heights_m
        A lower and an upper bound of all heights, metres.
    """
    gl = device()
    low, high = heights_m
    scale = np.array([1.0, 1.0, 1.0 / (high - low)])
    shift = np.array([0.0, 0.0, low])
    target = gl.visibility_buffer_target(view.cols, view.rows)
    triangle_count, tree_indices = 0, None
    with gl.visibility_buffer_pass(target):
        uniforms = {"size_px": (float(view.cols), float(view.rows))}
        if solids_px is not None:
            program = _program(gl, "visible_map.vert", "visible.frag", uniforms)
            triangle_count += gl.draw_triangles(program, (solids_px[0] - shift) * scale, solids_px[1], 0)
        if instances is not None and bases_px is not None:
            reach = np.linalg.norm(px_from_m, 2) * instances.quad_sizes_m[:, :2].max(axis=1) * 1.5
            inside = [(bases_px[:, k] > -reach) & (bases_px[:, k] < size + reach) for k, size in enumerate((view.cols, view.rows))]
            tree_indices = np.flatnonzero(inside[0] & inside[1])
            tree_uniforms = {"in_map": True, "px_from_m": tuple(px_from_m.T.ravel()), "height_m": float(high - low)}
            tree_uniforms |= {"level_bias": float(np.log2(view.pixel_share))}
            _draw_trees(gl, instances, tree_indices, (bases_px - shift) * scale, {**uniforms, **tree_uniforms}, triangle_count)
    return _read_id_buffer(gl, target, instances, triangle_count, tree_indices, np.zeros(0, np.int64), reads_depth=False)


def _draw_trees(
    gl: Device, instances: TreeInstances, tree_indices: np.ndarray, base: np.ndarray, uniforms: dict[str, Any], first: int
) -> None:
    """Draw the quads of the trees ``tree_indices`` (k,) of ``instances``, with alpha test.

    ``base`` (n, 3) holds the feet of all trees in the coordinates of the vertex shader. ``first`` is the number of triangles before
    those of the trees.
    """
    program = gl.program(
        shader_source("terrain/gbuffer/tree", "terrain/gbuffer/visible_tree.vert"),
        shader_source("terrain/gbuffer/visible_tree.frag"),
    )
    texture = gl.srgb_texture_array(foliage().mip_levels)
    texture.use(0)
    tree_uniforms = {"foliage": 0, "threshold": ALPHA_THRESHOLD, "curvature": instances.curvature, "first": first}
    set_uniforms(program, {**uniforms, **tree_uniforms})
    variant = np.concatenate([instances.yaw_cos_sin, instances.variant[:, None]], axis=1)
    attributes = [("base", base[tree_indices]), ("shape", instances.quad_sizes_m[tree_indices]), ("look", variant[tree_indices])]
    gl.draw_instances(program, QUAD_TRIANGLES, attributes)


def _program(gl: Device, vertex: str, fragment: str, uniforms: dict[str, Any]) -> moderngl.Program:
    """Return a shader program with its uniforms set.

    ``vertex`` and ``fragment`` name its shader files in this package, without the suffix ``.glsl``.
    """
    program = gl.program(shader_source(f"terrain/gbuffer/{vertex}"), shader_source(f"terrain/gbuffer/{fragment}"))
    set_uniforms(program, uniforms)
    return program


def set_uniforms(program: moderngl.Program, values: dict[str, Any]) -> None:
    """Set the uniforms that a program uses, and ignore the others."""
    for name, value in values.items():
        if name in program:
            program[name] = value


def _read_id_buffer(
    gl: Device,
    target: moderngl.Framebuffer,
    instances: TreeInstances | None,
    triangle_count: int,
    tree_indices: np.ndarray | None,
    visible_ground: np.ndarray,
    reads_depth: bool,
) -> IdBuffer:
    """Return the ID buffer that was drawn to ``target``.

    ``triangle_count`` is the number of triangles before those of the trees, and ``visible_ground`` (m,) holds the indices of the
    ground's drawn triangles. ``tree_indices`` (k,) holds the indices of the drawn trees in ``instances``; ``None`` if no tree was
    drawn.
    """
    number = gl.read(target, 0, "u4")
    depth = gl.read(target, -1) if reads_depth else np.zeros((0, 0), np.float32)
    run_in_chunks(
        len(number),
        _renumber,
        number,
        visible_ground,
        triangle_count,
        np.zeros(0, np.int64) if tree_indices is None else tree_indices,
    )
    if tree_indices is None or not len(tree_indices):
        no_albedo = np.zeros((*number.shape, 4), np.uint8) if instances is not None else np.zeros((0, 0, 4), np.uint8)
        return IdBuffer(number, no_albedo, depth)
    return IdBuffer(number, gl.read(target, 1, "f1", 4), depth)


@compiled
def _renumber(first, last, number, visible_ground, triangle_count, visible_trees):
    """Replace the numbers that count drawn triangles only by numbers that count all triangles, in place.

    ``visible_ground`` holds the indices of the ground's drawn triangles, ``visible_trees`` those of the drawn trees.
    ``triangle_count`` is the number of triangles before those of the trees.
    """
    for i in range(first, last):
        for j in range(number.shape[1]):
            drawn_index = np.int64(number[i, j]) - 1
            tree_index = drawn_index - triangle_count
            if tree_index >= 0:
                number[i, j] = np.uint32(visible_trees[tree_index // 6] * 6 + tree_index % 6 + triangle_count + 1)
            elif 0 <= drawn_index < len(visible_ground):
                number[i, j] = np.uint32(visible_ground[drawn_index] + 1)


@compiled
def _triangles_in_frustum(position, triangles, eye, rotation, tangents):
    """Return the indices of the triangles that may intersect a viewing pyramid.

    A triangle is left out if all of its corners lie outside one plane of the pyramid. The apex is ``eye``. ``rotation`` (3, 3) maps
    to the camera's axes x, y and z, of which z is the pyramid's axis. ``tangents`` (2, 2) describe the pyramid's sides: row 0 holds
    the minimum and the maximum of x / z inside the pyramid, row 1 those of y / z.
    """
    outside = np.zeros(len(position), np.uint8)
    in_camera = np.empty(3)
    for n in range(len(position)):
        for k in range(3):
            in_camera[k] = (
                rotation[k, 0] * (position[n, 0] - eye[0]) + rotation[k, 1] * (position[n, 1] - eye[1])
                + rotation[k, 2] * (position[n, 2] - eye[2])
            )  # fmt: skip
        code = 1 if in_camera[2] < 0.0 else 0
        for axis in range(2):
            code |= (2 << 2 * axis) * (in_camera[axis] < tangents[axis, 0] * in_camera[2]) + (4 << 2 * axis) * (
                in_camera[axis] > tangents[axis, 1] * in_camera[2]
            )
        outside[n] = code
    out = np.empty(len(triangles), np.int64)
    count = 0
    for n in range(len(triangles)):
        if outside[triangles[n, 0]] & outside[triangles[n, 1]] & outside[triangles[n, 2]] == 0:
            out[count] = n
            count += 1
    return out[:count].copy()
