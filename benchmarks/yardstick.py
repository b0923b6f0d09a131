"""A minimal forward renderer of one vertex and one fragment shader, the reference for frame times.

It works like the renderer of a tutorial:

* The triangles of ground and meshes are uploaded once.
* So are the trees. A tree is an upright quad that turns to the eye, or to the sun in the depth map. It is alpha-tested with the
  engine's pictures of leaves.
* Lambert's cosine and ambient light from above shade surfaces. The background has one colour.
* With a shadow, all casters are drawn again into a depth map for every frame.
* Every picture is read back, since the frame would otherwise not reach the caller.

It omits exact shadows, antialiasing, detail of the ground, haze, the sky's gradient, and level of detail.
"""

from __future__ import annotations

from typing import NamedTuple

import moderngl
import numpy as np

from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_mesh
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.tree_instances import tree_instances_in_perspective
from skugga.terrain.gbuffer.view_geometry import solid_vertices
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene
from skugga.terrain.shading import albedo_of, daylight_in_frame
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

DEPTH_MAP_BITS = 16
"""Bits of a depth in the depth map."""
NEAR_M, FAR_M = 0.5, 20_000.0
"""Distances of the near and the far plane from the eye."""

DEPTH_MAP_EXTENT_M = 400.0
"""Side of the square that the depth map covers. The middle of the square lies half of this ahead of the eye."""

SLOPE_BIAS = 1.5
"""Factor of glPolygonOffset, in slopes of a triangle over a texel, for each tap along a side."""

SKY_COLOR = (0.62, 0.74, 0.88)
"""Uniform colour of the sky, sRGB."""

VERTEX_SHADER = """
#version 430
#ifdef TREES
in vec3 base;
in vec4 shape;   // half width, -, height, -
in float look;
uniform vec2 across;  // a unit vector along the quads
out vec3 leaf_at;
const vec2 CORNERS[6] = vec2[](vec2(-1, 0), vec2(1, 0), vec2(1, 1), vec2(-1, 0), vec2(1, 1), vec2(-1, 1));
#else
in vec3 position;
in vec3 normal;
in vec3 albedo;
out vec3 facing;
out vec3 tint;
#endif
uniform mat4 clip_from_frame;
uniform mat4 map_from_frame;
out vec3 map_at;

void main() {
#ifdef TREES
    vec2 corner = CORNERS[gl_VertexID];
    vec3 point = base + vec3(across * (corner.x * shape.x), corner.y * shape.z);
    leaf_at = vec3(0.5 + 0.5 * corner.x, 1.0 - corner.y, 2.0 * look);
#else
    vec3 point = position;
    facing = normal;
    tint = albedo;
#endif
    map_at = (map_from_frame * vec4(point, 1.0)).xyz;
    gl_Position = clip_from_frame * vec4(point, 1.0);
}
"""

FRAGMENT_SHADER = """
#version 430
#ifdef TREES
uniform sampler2DArray leaves;
uniform float threshold;
in vec3 leaf_at;
#else
in vec3 facing;
in vec3 tint;
#endif
uniform vec3 to_sun;
uniform vec3 sun;
uniform vec3 sky;
#if TAPS > 0
uniform sampler2D depth_map;
#endif
in vec3 map_at;
out vec4 color;

float lit() {
#if TAPS > 0
    ivec2 size = textureSize(depth_map, 0);
    ivec2 first = ivec2(floor((0.5 + 0.5 * map_at.xy) * vec2(size) - 0.5 * float(TAPS - 1)));
    if (any(lessThan(first, ivec2(0))) || any(greaterThan(first + TAPS, size))) return 1.0;
    float depth = 0.5 + 0.5 * map_at.z, sum = 0.0;
    for (int row = 0; row < TAPS; row++)
        for (int col = 0; col < TAPS; col++)
            sum += depth <= texelFetch(depth_map, first + ivec2(col, row), 0).r ? 1.0 : 0.0;
    return sum / float(TAPS * TAPS);
#else
    return 1.0;
#endif
}

void main() {
#ifdef TREES
    vec4 leaf = texture(leaves, leaf_at);
    if (leaf.a < threshold) discard;
    vec3 light = sun * (0.5 * lit()) + sky, own = leaf.rgb;
#else
    vec3 n = normalize(facing), own = tint;
    vec3 light = sun * (max(dot(n, to_sun), 0.0) * lit()) + sky * (0.5 + 0.5 * n.z);
#endif
    color = vec4(pow(min(own * light, vec3(1.0)), vec3(1.0 / 2.2)), 1.0);
}
"""

DEPTH_FRAGMENT_SHADER = """
#version 430
#ifdef TREES
uniform sampler2DArray leaves;
uniform float threshold;
in vec3 leaf_at;
void main() { if (texture(leaves, leaf_at).a < threshold) discard; }
#else
void main() {}
#endif
"""


class ProgramArrays(NamedTuple):
    """The vertex arrays of a program: the opaque surfaces, and the trees (``None`` without any)."""

    opaque: moderngl.VertexArray
    trees: moderngl.VertexArray | None


class Yardstick:
    """A scene on the device, seen from the eye of a view or from near it.

    ``map_size`` is the side of the depth map in texels (0: no shadows). A shadow look-up compares ``taps`` x ``taps`` texels.
    """

    def __init__(self, scene: Scene, view: PerspectiveView, map_size: int = 0, taps: int = 1) -> None:
        gl = device()
        self._map_size, self._taps = map_size, taps
        self._frame = view.frame(scene.world)
        self._target = gl.ctx.framebuffer(
            [gl.ctx.texture((view.cols, view.rows), 4)], gl.ctx.depth_renderbuffer((view.cols, view.rows))
        )
        ground = ground_mesh(scene, view)
        vertices, indices = _opaque_mesh(scene, view, ground, self._frame)
        self._vertices, self._indices = gl.ctx.buffer(vertices), gl.ctx.buffer(indices)
        self.triangles = len(indices)
        self._instances: moderngl.Buffer | None = None
        tree_instances = tree_instances_in_perspective(scene.objects, self._frame, tuple(view.eye_earth_m), view.focal_px)
        self.trees = 0 if tree_instances is None else len(tree_instances)
        bounds = [vertices[:, :3].min(axis=0), vertices[:, :3].max(axis=0)]
        if tree_instances is not None and self.trees:
            self._instances = gl.ctx.buffer(
                np.concatenate(
                    [tree_instances.base_frame_m, tree_instances.quad_sizes_m, tree_instances.variant[:, None]], axis=1
                ).astype(np.float32)
            )
            self._leaves = gl.srgb_texture_array(foliage().mip_levels)
            bounds[1] = bounds[1] + [0.0, 0.0, float(tree_instances.quad_sizes_m[:, 2].max())]
        self._bounds = np.array(bounds)
        self._color_arrays = self._vertex_arrays(FRAGMENT_SHADER.replace("TAPS", str(taps if map_size else 0)))
        self._depth_arrays = self._vertex_arrays(DEPTH_FRAGMENT_SHADER) if map_size else None

    def draw(self, scene: Scene, view: PerspectiveView) -> np.ndarray:
        """Draw a view near the first view's eye under the scene's sun, and return its picture, uint8 (rows, cols, 4)."""
        gl = device()
        eye, camera_from_frame = view.in_frame(self._frame)
        light = daylight_in_frame(scene, self._frame)
        to_sun = np.asarray(light.to_sun_frame, np.float64)
        map_from_frame = self._depth_map_matrix(eye, camera_from_frame, to_sun)
        if self._depth_arrays is not None:
            target = gl.depth_target(self._map_size, self._map_size, DEPTH_MAP_BITS)
            with gl.depth_pass(target, (SLOPE_BIAS * self._taps, 4.0)):
                self._render(self._depth_arrays, map_from_frame, map_from_frame, to_sun[:2], {})
            target.depth_attachment.use(1)
        self._target.use()
        self._target.clear(*SKY_COLOR, 1.0, depth=1.0)
        gl.ctx.enable_only(moderngl.DEPTH_TEST)
        uniforms = {"to_sun": tuple(to_sun), "sun": tuple(light.sun_irradiance), "sky": tuple(light.sky_irradiance), "depth_map": 1}
        self._render(
            self._color_arrays, _clip_matrix(view, eye, camera_from_frame), map_from_frame, camera_from_frame[2, :2], uniforms
        )
        gl.ctx.enable_only(moderngl.NOTHING)
        return gl.read(self._target, 0, "f1", 4)

    def _vertex_arrays(self, fragment: str) -> ProgramArrays:
        """Compile the programs with a fragment shader for surfaces and for trees, and return their vertex arrays."""
        gl, arrays = device(), []
        for kind in ("OPAQUE", "TREES"):
            define = f"#version 430\n#define {kind}"
            vertex, fragment_source = (text.strip().replace("#version 430", define) for text in (VERTEX_SHADER, fragment))
            program = gl.program(vertex, fragment_source)
            names = ("position", "normal", "albedo") if kind == "OPAQUE" else ("base", "shape", "look")
            layout = "3f 3f 3f" if kind == "OPAQUE" else "3f 4f 1f/i"
            buffer = self._vertices if kind == "OPAQUE" else self._instances
            if buffer is None:
                continue
            used_names, layout = _used_attributes(program, names, layout)
            index = self._indices if kind == "OPAQUE" else None
            arrays.append(gl.ctx.vertex_array(program, [(buffer, layout, *used_names)], index_buffer=index))
        return ProgramArrays(arrays[0], arrays[1] if len(arrays) > 1 else None)

    def _render(
        self, arrays: ProgramArrays, clip_from_frame: np.ndarray, map_from_frame: np.ndarray, towards: np.ndarray, uniforms: dict
    ) -> None:
        """Draw surfaces and trees into the current framebuffer.

        Matrices are (4, 4): from the scene's frame to the target's clip space and to that of the depth map. Quads of trees stand
        upright and face ``towards`` (2,), east and north. ``uniforms`` are further values of the programs' variables.
        """
        gl = device()
        leaf_axis = np.array([-towards[1], towards[0]]) / max(float(np.hypot(*towards)), 1e-9)
        matrices = {"clip_from_frame": tuple(clip_from_frame.T.ravel()), "map_from_frame": tuple(map_from_frame.T.ravel())}
        tree_uniforms = {"across": tuple(leaf_axis), "leaves": 0, "threshold": ALPHA_THRESHOLD}
        for array in arrays:
            if array is not None:
                for name, value in {**uniforms, **matrices, **tree_uniforms}.items():
                    if name in array.program:
                        array.program[name] = value
        gl.render(arrays.opaque)
        if arrays.trees is not None:
            self._leaves.use(0)
            gl.render(arrays.trees, vertices=6, instances=self.trees)

    def _depth_map_matrix(self, eye: np.ndarray, camera_from_frame: np.ndarray, to_sun: np.ndarray) -> np.ndarray:
        """Return the matrix (4, 4) from the scene's frame to the clip space of the depth map.

        ``eye`` (3,) is in metres, ``camera_from_frame`` (3, 3) has the camera's axes as rows, and ``to_sun`` (3,) is a unit vector.
        """
        right = np.cross([0.0, 0.0, 1.0], to_sun)
        right = right / max(float(np.linalg.norm(right)), 1e-9)
        axes = np.stack([right, np.cross(to_sun, right), -to_sun])
        forward = np.array([*camera_from_frame[2, :2], 0.0])
        middle = axes @ (eye + forward * (0.5 * DEPTH_MAP_EXTENT_M / max(float(np.linalg.norm(forward)), 1e-9)))
        corners = np.stack(np.meshgrid(*self._bounds.T, indexing="ij"), axis=-1).reshape(-1, 3) @ axes.T
        near, far = corners[:, 2].min(), corners[:, 2].max()
        half = 0.5 * DEPTH_MAP_EXTENT_M
        scale = np.array([1.0 / half, 1.0 / half, 2.0 / (far - near)])
        out = np.eye(4)
        out[:3, :3] = axes * scale[:, None]
        out[:3, 3] = -np.array([middle[0], middle[1], 0.5 * (near + far)]) * scale
        return out


def _opaque_mesh(scene: Scene, view: PerspectiveView, ground: GroundMesh, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of the ground and the meshes.

    Vertices are float32 (n, 9): point, normal and albedo. Triangles are int32 (m, 3).
    """
    shape = (1, len(ground.height_m))
    flat = np.zeros(shape, np.float32)
    points = ground.position_frame_m.reshape(*shape, 3)
    normals = ground.normal_frame.reshape(*shape, 3)
    buffer = GeometryBuffer(
        view, frame, np.isfinite(points[..., 2]), points, ground.height_m.reshape(shape), normals, normals, flat,
        np.full(shape, RELIEF, np.uint8),
    )  # fmt: skip
    parts = [np.concatenate([points[0], normals[0], albedo_of(buffer, scene)[0]], axis=1)]
    indices = [ground.triangles]
    solids, corners = scene.objects.solids, solid_vertices(scene.objects, frame)
    if solids is not None and corners is not None:
        at = corners[solids.triangles].reshape(-1, 3)
        facing = frame.directions_from_earth(solids.corner_normals_earth).reshape(-1, 3)
        parts.append(np.concatenate([at, facing, np.repeat(solids.albedo, 3, axis=0)], axis=1))
        indices.append(shape[1] + np.arange(len(at)).reshape(-1, 3))
    return np.concatenate(parts).astype(np.float32), np.concatenate(indices).astype(np.int32)


def _used_attributes(program: moderngl.Program, names: tuple[str, ...], layout: str) -> tuple[list[str], str]:
    """Return the names of the attributes that a program uses, and a buffer layout that skips all others.

    ``names`` are all attributes of the buffer. ``layout`` is their layout as moderngl writes it, such as "3f 4f 1f/i".
    """
    per_instance = layout.endswith("/i")
    words, used_names = [], []
    for name, word in zip(names, layout.removesuffix("/i").split(), strict=True):
        if name in program:
            used_names.append(name)
            words.append(word)
        else:
            words.append(f"{4 * int(word[0])}x")
    return used_names, " ".join(words) + ("/i" if per_instance else "")


def _clip_matrix(view: PerspectiveView, eye: np.ndarray, camera_from_frame: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) from the scene's frame to clip space, with row 0 of the picture first.

    ``eye`` (3,) is in metres, and ``camera_from_frame`` (3, 3) has the camera's axes as rows.
    """
    size = np.array([view.cols, view.rows])
    first = np.array([view.col0, view.row0])
    scale, shift = 2.0 * view.focal_px / (view.step_px * size), (1.0 - 2.0 * first / view.step_px) / size - 1.0
    projection = np.zeros((4, 4))
    projection[0, 0], projection[0, 2] = scale[0], shift[0]
    projection[1, 1], projection[1, 2] = scale[1], shift[1]
    projection[2, 2], projection[2, 3] = (FAR_M + NEAR_M) / (FAR_M - NEAR_M), -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    projection[3, 2] = 1.0
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = camera_from_frame, -camera_from_frame @ eye
    return projection @ camera
