"""`perspective_shadow_map`: a depth map in the post-perspective space of the camera."""

from __future__ import annotations

import numpy as np

from shadows.attached import attached
from shadows.map_drawing import draw_map
from shadows.map_lookup import look_up
from shadows.map_windows import BORDER_TEXELS, POSITION_ERROR, DepthMap, steps_of
from shadows.passes import PassLog
from shadows.plan import PerspectiveMapSettings
from shadows.post_perspective import Camera, Light, PostPerspective, Receivers, fitted, ranked
from shadows.shadow_map import depths
from terrain.camera import PerspectiveView
from terrain.casting import caster_trees
from terrain.compiled import compiled
from terrain.geometry import GeometryBuffer
from terrain.gl import device
from terrain.level import SUN, CasterKind
from terrain.light_space import light_bounds
from terrain.reach import Casters
from terrain.scene import Scene
from terrain.stand import Stand

PASSES = ("depth map", "visibility")

SAMPLE = 1500
"""Receivers that a map's matrix is chosen by; all of them are fitted to."""


def fill(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: PerspectiveMapSettings,
    log: PassLog,
) -> np.ndarray:
    """Visibility of a light (rows, cols), float32 in [0, 1], for a buffer's points past some kinds of casters.

    Where there is no surface, or one that is turned away from the light, the value means nothing. Raises ``GraphicsError``.
    """
    depth_pass, visibility_pass = log.named(light, kinds, PASSES)
    visibility = np.ones(buffer.there.shape, np.float32)
    with log.run(depth_pass) as record:
        receivers = buffer.there & ~attached(buffer, scene, light)
        if receivers.any():
            drawn, record.note = perspective_map(buffer, receivers, scene, light, settings, caster_trees(buffer, kinds))
            gl = device()
            target = draw_map(gl, drawn, buffer, scene, kinds, casters, settings, record)
            log.keep("shadow-map", light, depths, gl, drawn, target)
    with log.run(visibility_pass) as record:
        if receivers.any():
            look_up(gl, drawn, target, buffer, settings, visibility, record)
    return visibility


def perspective_map(
    buffer: GeometryBuffer, receivers: np.ndarray, scene: Scene, light: str, settings: PerspectiveMapSettings, trees: Stand | None
) -> tuple[DepthMap, str]:
    """The map of a light for a perspective view's receivers (rows, cols), at least one, and what there is to say of it."""
    chosen = np.flatnonzero(receivers)
    some = chosen[:: max(len(chosen) // SAMPLE, 1)]
    camera, source = camera_of(buffer), light_of(buffer, scene, light)
    size = settings.map_size
    inner = 1.0 - 2.0 * BORDER_TEXELS / size
    sample = Receivers(buffer.position_frame_m.reshape(-1, 3)[some], buffer.normal_frame.reshape(-1, 3)[some].astype(np.float64))
    for found in ranked(camera, source, sample, inner):
        low, high, clear = bounds(found, buffer, receivers)
        if clear:
            break
    clip = fitted(found.clip_from_frame, low, high, inner, 0.05)
    texels = np.array([[size / 2, 0, 0, size / 2], [0, size / 2, 0, size / 2], [0, 0, 0.5, 0.5], [0, 0, 0, 1.0]])
    extent_m = max(float(np.abs(sample.points_m).max()), float(np.abs(high).max()) * 0.0)
    uniforms = {
        "lamp": False,
        "clip_rows": tuple(clip.ravel()),
        "map_rows": tuple((texels @ clip).ravel()),
        "error_m": POSITION_ERROR * 2.0 * extent_m,
        "depth_step": 1.0 / steps_of(settings.depth_bits),
    }
    shaders = "shadows/perspective_light", "shadows/perspective_receiver"
    return DepthMap(uniforms, (size, size), (np.eye(3),), settings.depth_bits, trees, chosen, None, shaders), found.note


def camera_of(buffer: GeometryBuffer) -> Camera:
    """The camera of a perspective view in the buffer's frame."""
    assert isinstance(buffer.view, PerspectiveView)
    return Camera(*buffer.view.in_frame(buffer.frame))


def light_of(buffer: GeometryBuffer, scene: Scene, light: str) -> Light:
    """The sun or a lamp as a homogeneous point in the buffer's frame."""
    if light == SUN:
        assert scene.sun is not None
        return Light(np.array([*(buffer.frame.frame_from_earth @ scene.sun.to_sun_earth), 0.0]), np.zeros(3))
    lamp = scene.lamps[light]
    position = buffer.frame.frame_from_earth @ (lamp.position_earth_m - buffer.frame.origin_earth_m)
    axis = buffer.frame.frame_from_earth @ lamp.earth_from_lamp[:, 2]
    return Light(np.array([*position, 1.0]), position + lamp.reference_m * axis)


def bounds(found: PostPerspective, buffer: GeometryBuffer, receivers: np.ndarray):
    out = _bounds(found.clip_from_frame, buffer.position_frame_m, receivers)
    return out[0, :3], out[1, :3], out[0, 3] > 0


@compiled
def _bounds(matrix, position, here):  # type: ignore[no-untyped-def]
    out = np.empty((2, 4))
    out[0] = np.inf
    out[1] = -np.inf
    for i in range(position.shape[0]):
        for j in range(position.shape[1]):
            if here[i, j]:
                p = position[i, j]
                w = matrix[3, 0] * p[0] + matrix[3, 1] * p[1] + matrix[3, 2] * p[2] + matrix[3, 3]
                for k in range(3):
                    v = (matrix[k, 0] * p[0] + matrix[k, 1] * p[1] + matrix[k, 2] * p[2] + matrix[k, 3]) / w
                    out[0, k], out[1, k] = min(out[0, k], v), max(out[1, k], v)
                out[0, 3], out[1, 3] = min(out[0, 3], w), max(out[1, 3], w)
    return out
