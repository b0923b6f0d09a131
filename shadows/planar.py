"""`planar`: the casters projected from a light onto a level ground, and drawn there once per pixel through the stencil.

**Projection.** With h a point's height above the plane, L the light in homogeneous coordinates (a direction for the sun, a
place for a lamp) and H its height, the point p = (x, y, z, 1) falls on

    p' = H p - h L

(J. Blinn, Me and My (Fake) Shadow, IEEE Computer Graphics and Applications 8(1), 1988). p' is linear in p, so that triangles
stay triangles and alpha-tested texture stays where it was. What lies below the plane (h < 0) would fall in the wrong place; a
clip distance cuts it off. What stands above a lamp gets w < 0: in a map that is outside of the clip volume, in a camera either
that or above the horizon, where no ground is. Coordinates count from the point of the plane below the eye, or in the middle
of a map, so that float32 is fine enough.

**Stencil.** The ground's pixels become 1, everything else is 0. A projected caster makes a 1 a 2, in the very pixels of the
view: the shadow ends where the ground does, and a pixel that is covered twice is as dark as one that is covered once.

The ground alone receives: points on meshes and trees keep visibility 1 here, and only what is turned away from the light is
dark there. Level ground itself shades nothing.

**Samples** of a perspective view's pixels (``terrain.antialias``) are pixels of a finer view of the same camera, and are drawn
as such.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from moderngl import Framebuffer

from shadows.attached import lamp_in_frame
from shadows.passes import PassLog, PassRecord
from terrain.antialias import SIDE
from terrain.camera import PerspectiveView
from terrain.casting import caster_meshes, caster_trees
from terrain.foliage import THRESHOLD, foliage
from terrain.geometry import GeometryBuffer
from terrain.gl import Device, device
from terrain.grid import MapView
from terrain.level import SUN, CasterKind
from terrain.reach import Casters
from terrain.resolve import RELIEF
from terrain.scene import Scene
from terrain.stand import Stand
from terrain.visible import NEAR_M, set_uniforms, shader
from terrain.world import LocalFrame, World

PASSES = ("receivers", "projected casters")

NO_GROUND, LIT, SHADED = 0, 1, 2
"""What the stencil holds."""


@dataclass(frozen=True, eq=False)
class Projected:
    """What is to be projected: the light (4,) homogeneous, vertices and triangles of meshes, trees. Coordinates are metres
    along the axes of a frame, from a point of the plane: ``origin_frame_m``.
    """

    origin_frame_m: np.ndarray
    light_m: np.ndarray
    meshes: list[tuple[np.ndarray, np.ndarray]]
    trees: Stand | None


def fill(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: None,
    log: PassLog,
) -> np.ndarray:
    """Visibility of a light (rows, cols), float32, 0 or 1, for the points of a buffer whose ground is level.

    It is 1 on everything but the ground. Raises ``GraphicsError``.
    """
    passes = log.named(light, kinds, PASSES)
    projected = _projected(buffer, scene, light, kinds)
    view, ground = buffer.view, buffer.there & (buffer.kind == RELIEF)
    stencil = np.zeros(ground.shape, np.uint8)
    stencil[: view.rows] = _stencil(scene.world, buffer.frame, view, ground[: view.rows], projected, passes, log)
    below = np.nonzero(ground[view.rows :])
    if isinstance(view, PerspectiveView) and len(below[0]):
        finer = view.finer(SIDE)
        pixels = _pixels_of(finer, buffer.frame, buffer.position_frame_m[view.rows :][below])
        receivers = np.zeros((finer.rows, finer.cols), bool)
        receivers[pixels] = True
        stencil[view.rows :][below] = _stencil(scene.world, buffer.frame, finer, receivers, projected, passes, log)[pixels]
    log.keep("stencil", light, stencil.copy)
    return np.where(stencil == SHADED, np.float32(0.0), np.float32(1.0))


def onto_plane(light_m: np.ndarray) -> np.ndarray:
    """The projection (4, 4) of homogeneous points onto z = 0, away from a homogeneous light (4,) above it: p' / H of the above."""
    return np.eye(4) - np.outer(light_m / light_m[2], [0.0, 0.0, 1.0, 0.0])


def clip_from_plane(world: World, frame: LocalFrame, view: MapView | PerspectiveView, origin_frame_m: np.ndarray) -> np.ndarray:
    """Clip coordinates (4, 4) of homogeneous points of the plane, metres from an origin on it; row 0 of a view is at y = -1.

    A camera's are those of ``terrain/shaders/visible.vert.glsl``. The map of a flat world is affine.
    """
    size = np.array([view.cols, view.rows])
    if isinstance(view, MapView):
        points = origin_frame_m + np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        x, y, _ = world.map_position(view.grid.crs, points @ frame.frame_from_earth + frame.origin_earth_m)
        col, row = (x - view.grid.x0) / view.grid.step, (view.grid.y0 - y) / view.grid.step
        pixel = np.array([(col - view.col0) / view.col_step, (row - view.row0) / view.row_step]) + 0.5
        at = 2.0 * pixel / size[:, None] - 1.0
        clip = np.zeros((4, 4))
        clip[:2] = np.column_stack([at[:, 1] - at[:, 0], at[:, 2] - at[:, 0], np.zeros(2), at[:, 0]])
        clip[3, 3] = 1.0
        return clip
    eye, camera_from_frame = view.in_frame(frame)
    right, down, forward = np.column_stack([camera_from_frame, camera_from_frame @ (origin_frame_m - eye)])
    scale = 2.0 * view.focal_px / (view.step * size)
    shift = (1.0 - 2.0 * np.array([view.col0, view.row0]) / view.step) / size - 1.0
    return np.array([scale[0] * right + shift[0] * forward, scale[1] * down + shift[1] * forward, [0.0, 0.0, 0.0, NEAR_M], forward])


def _projected(buffer: GeometryBuffer, scene: Scene, light: str, kinds: tuple[CasterKind, ...]) -> Projected:
    """What casts, counted from the point of the plane below the eye or in the middle of a map."""
    view, frame = buffer.view, buffer.frame
    if isinstance(view, MapView):
        middle, _ = scene.world.ground(view.grid.crs, *(np.float64(v) for v in view.centre))
    else:
        middle = view.eye_earth_m
    origin = frame.frame_from_earth @ (middle - frame.origin_earth_m)
    origin[2] = scene.height_range_m[0]
    if light == SUN:
        assert scene.sun is not None
        at = np.append(frame.frame_from_earth @ scene.sun.to_sun_earth, 0.0)
    else:
        at = np.append(lamp_in_frame(buffer, scene.lamps[light])[0] - origin, 1.0)
    meshes = caster_meshes(scene, buffer, ("meshes",)) if "meshes" in kinds else []  # level ground shades nothing
    return Projected(origin, at, [(vertices - origin, triangles) for vertices, triangles in meshes], caster_trees(buffer, kinds))


def _pixels_of(view: PerspectiveView, frame: LocalFrame, position_frame_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (n,) of the pixels of a view in which points (n, 3) are seen."""
    eye, camera_from_frame = view.in_frame(frame)
    right, down, forward = camera_from_frame @ (position_frame_m - eye).T
    row, col = (
        np.rint((along / forward * view.focal_px - first) / view.step).astype(np.int64)
        for along, first in ((down, view.row0), (right, view.col0))
    )
    return row.clip(0, view.rows - 1), col.clip(0, view.cols - 1)


def _stencil(
    world: World,
    frame: LocalFrame,
    view: MapView | PerspectiveView,
    receivers: np.ndarray,
    projected: Projected,
    passes: list[str],
    log: PassLog,
) -> np.ndarray:
    """The stencil (rows, cols) uint8 of a view that shows the ground at ``receivers``."""
    gl = device()
    target = gl.stencil_target(view.cols, view.rows)
    with log.run(passes[0]) as record:
        program = gl.program(shader("shadows/pixels.vert"), shader("shadows/planar_receivers.frag"))
        texture = gl.texture(receivers)
        texture.use(0)
        program["receivers"] = 0
        with gl.stencil_pass(target, NO_GROUND):
            gl.draw_pixels(program, target)
        texture.release()
        record.draws += 1
        record.bytes = max(record.bytes, 9 * receivers.size)
    with log.run(passes[1]) as record:
        if projected.light_m[2] > 0.0:  # from below, no light reaches the ground
            clip_from_caster = clip_from_plane(world, frame, view, projected.origin_frame_m) @ onto_plane(projected.light_m)
            _draw_casters(gl, target, clip_from_caster, projected, record)
        return gl.read_stencil(target)


def _draw_casters(gl: Device, target: Framebuffer, clip_from_caster: np.ndarray, projected: Projected, record: PassRecord) -> None:
    uniforms = {"clip_from_caster": tuple(clip_from_caster.T.ravel())}
    with gl.stencil_pass(target, LIT, clip_distances=1):
        if projected.meshes:
            program = gl.program(shader("shadows/planar", "shadows/planar_mesh.vert"), shader("shadows/depth.frag"))
            set_uniforms(program, uniforms)
            for vertices, triangles in projected.meshes:
                record.triangles += gl.draw_triangles(program, vertices, triangles)
                record.draws += 1
        if projected.trees is not None:
            vertex = shader("shadows/planar", "terrain/tree", "shadows/planar_tree.vert")
            program = gl.program(vertex, shader("shadows/planar_tree.frag"))
            set_uniforms(program, {**uniforms, "foliage": 0, "threshold": THRESHOLD, "curvature": 0.0})
            stand = projected.trees
            gl.layers(foliage().levels).use(0)
            base, look = stand.base_frame_m - projected.origin_frame_m, np.concatenate([stand.turn, stand.look[:, None]], axis=1)
            record.triangles += gl.draw_instances(program, 18, [("base", base), ("shape", stand.shape), ("look", look)])
            record.draws += 1
