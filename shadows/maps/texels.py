"""Compute texel sizes of depth maps: in pixels, predicted from a descriptor, and in metres, at the points of a picture.

A perspective map is a perspective shadow map (Stamminger and Drettakis 2002, "Perspective shadow maps").
"""

from __future__ import annotations

from math import radians, sqrt, tan

import numpy as np

from skugga.shadows.maps.settings import LampMapSettings, PerspectiveMapSettings, ShadowMapSettings
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.scene import Scene


def shadow_map_texel_px(
    descriptor: Descriptor, light: str, settings: ShadowMapSettings | LampMapSettings, band: CastBand, texels_per_pixel: float
) -> float:
    """Return the side of a texel of the sun's map or a lamp's, in pixels, in a band of distances from the eye.

    It is the geometric mean of both sides, perpendicular to the light. ``texels_per_pixel`` is not used.
    """
    if isinstance(settings, LampMapSettings):
        return _uniform_map_extent_px(descriptor, light, band) / settings.map_size
    ends = (cascade.far_m for cascade in settings.cascades[:-1])
    number = sum(1 for end in ends if end is not None and band.near_m >= end * (1.0 - 1e-9))
    right, up = settings.cascades[number].texel_m
    return sqrt(right * up) / band.pixel_m


def perspective_map_texel_px(
    descriptor: Descriptor, light: str, settings: PerspectiveMapSettings, band: CastBand, texels_per_pixel: float
) -> float:
    """Return the side of a perspective map's texel, in pixels, in a band of distances from the eye.

    It is perpendicular to the light. ``texels_per_pixel`` is the number of the map's texels per pixel's side.
    """
    map_px = texels_per_pixel * sqrt(descriptor.rows * descriptor.cols)
    return min(map_px, _uniform_map_extent_px(descriptor, light, band)) / settings.map_size


def _uniform_map_extent_px(descriptor: Descriptor, light: str, band: CastBand) -> float:
    """Return the extent of one uniform map of the light along a side, in pixels of a band."""
    lamp = next((lamp for lamp in descriptor.lamps if lamp.name == light), None)
    if light == SUN or lamp is None:
        right, up, _ = descriptor.receivers_light_m or (band.pixel_m, band.pixel_m, 0.0)
        return sqrt(right * up) / band.pixel_m
    tangent = 1.0 if lamp.kind == "omni" else tan(radians(lamp.cutoff_deg))
    return 2.0 * tangent * (band.light_m or lamp.reference_m) / band.pixel_m


def shadow_map_texel_m(
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    settings: ShadowMapSettings | LampMapSettings,
    buffer: GeometryBuffer,
) -> float | np.ndarray:
    """Return a texel's larger side on level ground, metres, at a buffer's points (rows, cols), or one number for all.

    It is 0 without a sun.
    """
    if isinstance(settings, LampMapSettings):
        lamp = scene.lamps[light]
        to_lamp = lamp.in_frame(buffer.frame).position_frame_m - buffer.position_frame_m
        length_m = np.linalg.norm(to_lamp, axis=-1)
        tangent = 1.0 if lamp.kind == "omni" else np.tan(np.radians(lamp.cutoff_deg))
        return 2.0 * tangent * length_m / settings.map_size * length_m / np.maximum(np.abs(to_lamp[..., 2]), 0.01 * length_m)
    if scene.sun is None:
        return 0.0
    sine = np.sin(np.radians(max(scene.sun.altitude_deg, 0.5)))
    sides = [max(cascade.texel_m[0], cascade.texel_m[1] / sine) for cascade in settings.cascades]
    ends_m = [cascade.far_m for cascade in settings.cascades[:-1] if cascade.far_m is not None]
    return np.array(sides)[np.searchsorted(ends_m, _eye_distance_m(buffer))]


def _eye_distance_m(buffer: GeometryBuffer) -> np.ndarray:
    """Return the distance of a perspective view's points (rows, cols) from the eye, metres; 0 in a map."""
    if not isinstance(buffer.view, PerspectiveView):
        return np.asarray(0.0)
    eye, _ = buffer.view.in_frame(buffer.frame)
    return np.linalg.norm(buffer.position_frame_m - eye, axis=-1)


def texel_on_level_ground_m(map_from_frame: np.ndarray, position_frame_m: np.ndarray) -> np.ndarray:
    """Return a texel's larger side on level ground at points, metres.

    ``position_frame_m`` (..., 3) are the points, and ``map_from_frame`` (4, 4) is a projective map from the frame to texels. The
    least singular value of its derivative is the number of texels per metre in the direction where texels are largest (J. Blinn,
    Consider the Lowly 2 x 2 Matrix, 1996).
    """
    x, y, _, w = np.moveaxis(position_frame_m @ map_from_frame[:, :3].T + map_from_frame[:, 3], -1, 0)
    (ux, uy), (vx, vy), _, (wx, wy) = map_from_frame[:, :2]
    a, b, c, d = (
        (slope - coordinate / w * w_slope) / w
        for slope, coordinate, w_slope in ((ux, x, wx), (uy, x, wy), (vx, y, wx), (vy, y, wy))
    )
    min_singular_value = np.abs(np.hypot(a + d, b - c) - np.hypot(a - d, b + c)) / 2.0
    return 1.0 / np.maximum(min_singular_value, 1e-30)
