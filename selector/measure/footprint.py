"""How large a shadow map's texels are where they are looked up: what errors are held against."""

from __future__ import annotations

import numpy as np

from shadows.attached import attached
from shadows.maps.perspective_shadow_map import perspective_map
from shadows.plan import LampMapSettings, PerspectiveMapSettings, ShadowMapSettings, Step
from terrain.cache import MIB, kept
from terrain.casters.casting import caster_trees
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.geo.camera import PerspectiveView
from terrain.scene import Scene


def texel_footprint_px(scene: Scene, step: Step | None, buffer: GeometryBuffer, pixel_m: float) -> np.ndarray:
    """A texel's larger side on level ground in pixels (rows, cols); 0 for an algorithm without texels, and off the surface."""
    settings = None if step is None else step.settings
    texel_m: float | np.ndarray = 0.0
    away_m, size_m = _from_eye(buffer) if isinstance(buffer.view, PerspectiveView) else (0.0, pixel_m)
    if isinstance(settings, ShadowMapSettings) and scene.sun is not None:
        sine = np.sin(np.radians(max(scene.sun.altitude_deg, 0.5)))
        sides = [max(cascade.texel_m[0], cascade.texel_m[1] / sine) for cascade in settings.cascades]
        ends_m = [cascade.far_m for cascade in settings.cascades[:-1] if cascade.far_m is not None]
        texel_m = np.array(sides)[np.searchsorted(ends_m, np.asarray(away_m))]
    elif isinstance(settings, LampMapSettings) and step is not None:
        lamp = scene.lamps[step.light]
        way = lamp.in_frame(buffer.frame).position_frame_m - buffer.position_frame_m
        length_m = np.linalg.norm(way, axis=-1)
        tangent = 1.0 if lamp.kind == "omni" else np.tan(np.radians(lamp.cutoff_deg))
        texel_m = 2.0 * tangent * length_m / settings.map_size * length_m / np.maximum(np.abs(way[..., 2]), 0.01 * length_m)
    elif isinstance(settings, PerspectiveMapSettings) and step is not None:
        receivers = buffer.there & ~attached(buffer, scene, step.light)
        if receivers.any():
            drawn, _ = perspective_map(buffer, receivers, scene, step.light, settings, caster_trees(buffer, step.kinds))
            texel_m = texel_on_level_ground_m(np.reshape(drawn.uniforms["map_rows"], (4, 4)), buffer.position_frame_m)
    return np.broadcast_to(np.nan_to_num(texel_m / size_m), buffer.there.shape)


@kept("scene", 512 * MIB)
def _from_eye(buffer: GeometryBuffer) -> tuple[np.ndarray, np.ndarray]:
    """How far a perspective view's points are from the eye, and the side of a pixel at their depths: (rows, cols) metres each."""
    view = buffer.view
    assert isinstance(view, PerspectiveView)
    eye, camera_from_frame = view.in_frame(buffer.frame)
    way_m = buffer.position_frame_m - eye
    return np.linalg.norm(way_m, axis=-1), way_m @ camera_from_frame[2] * view.pixel


def texel_on_level_ground_m(map_from_frame: np.ndarray, position_frame_m: np.ndarray) -> np.ndarray:
    """A texel's larger side on level ground at points (..., 3), metres, where a projective map (4, 4) takes a frame to texels.

    A metre is as many texels as the least singular value of the map's derivative says, in the direction where texels are largest
    (J. Blinn, Consider the Lowly 2 x 2 Matrix, 1996).
    """
    x, y, _, w = np.moveaxis(position_frame_m @ map_from_frame[:, :3].T + map_from_frame[:, 3], -1, 0)
    (ux, uy), (vx, vy), _, (wx, wy) = map_from_frame[:, :2]
    a, b, c, d = ((k - at / w * along) / w for k, at, along in ((ux, x, wx), (uy, x, wy), (vx, y, wx), (vy, y, wy)))
    least = np.abs(np.hypot(a + d, b - c) - np.hypot(a - d, b + c)) / 2.0
    return 1.0 / np.maximum(least, 1e-30)
