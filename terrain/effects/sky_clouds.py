"""Clouds in the sky: pixels of a perspective view's sky show the layer whose shadows fall on the ground.

The ray of a pixel meets the layer at the place where a ray to the sun in that direction does (``layer_position``), and shows the
density of the clouds there. The cloud before the sun is thus the one whose shadow falls on the eye.

- Thin edges are white and dense middles are grey. The side towards the sun is brighter, by the slope of the noise.
- Three finer octaves fray the edges. They leave gaps free, and fade where a pixel is wider than they are.
- Far clouds fade into their mean over the sky, by haze and where a pixel covers more than a wavelength. That mean is the even sky
  of a view without the effect.
- Clouds fade in over the first degree of the sun's altitude, like direct sunlight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.cloud_layer import (
    CLOUD_EDGE_WIDTH,
    cloud_layer_of,
    cloud_noise,
    density_of_noise,
    fade_share,
    layer_position,
)
from skugga.terrain.effects.haze import green_extinction_per_m, visibility_m_of
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import geodetic
from skugga.terrain.ground.noise import noise_at
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.scene import Scene
from skugga.terrain.sky import OVERCAST_SKY_COLOR, sky_brightness, sky_pixel_colors, sunlight_color

MIN_RAY_SINE = 0.002
"""Lower bound of the sine of a ray's altitude. Clouds that low have faded into their mean."""

RELIEF_STEP_M, RELIEF_CONTRAST = 260.0, 1.1
"""Distance towards the sun over which the noise's slope lights a cloud, and the change of light per unit of noise."""

BASE_DEPTH = 0.75
"""Noise above a cloud's edge at which the cloud is as grey as it gets."""

LIT_CLOUD_COLOR, CLOUD_BASE_COLOR = (0.97, 0.97, 0.97), (0.46, 0.50, 0.56)
"""Linear colours of a thin, sunlit cloud, and of the base of a dense one, by day."""

DETAIL_WAVELENGTH_M, DETAIL_OCTAVES, DETAIL_GAIN, DETAIL_SEED, DETAIL_SHARE = 160.0, 3, 0.6, 171, 0.55
"""The octaves that fray edges: coarsest wavelength, number, gain, seed, and the change of opacity per unit of their sum."""

LINING_COSINE = 0.94
"""Cosine of the angle to the sun within which thin clouds are brighter."""


class CloudLight(NamedTuple):
    """The light of clouds in a view.

    Attributes
    ----------
    lit_color, base_color, mean_color
        (3,), linear colours of a sunlit cloud, of a dense cloud's base, and of the mean cloud.
    strength
        Share of the clouds that is visible, 0 to 1: less than 1 during the first degree of the sun's altitude.
    extinction_per_m
        Extinction of haze.
    pixel_tangent
        Width of a pixel at distance 1.
    """

    lit_color: np.ndarray
    base_color: np.ndarray
    mean_color: np.ndarray
    strength: float
    extinction_per_m: float
    pixel_tangent: float


def sky_colors_with_clouds(scene: Scene, view: PerspectiveView, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """Return the linear display colour (n, 3) of the sky with clouds in the pixels ``rows`` and ``cols`` (n,) of a view.

    An eye above the layer sees the even sky of ``sky_pixel_colors``.
    """
    cover = scene.loaded.level.weather.cloud_cover
    eye_height_m = float(view.eye_earth_m[2] if scene.world.is_flat else geodetic(view.eye_earth_m, scene.world.ellipsoid)[2])
    if scene.sun is None or not 0.0 < cover < 1.0 or not scene.sun_is_up:
        return sky_pixel_colors(scene, view, rows, cols)
    layer = cloud_layer_of(scene)
    if eye_height_m >= layer.height_m:
        return sky_pixel_colors(scene, view, rows, cols)
    colors = sky_pixel_colors(scene, view, rows, cols, cloud_cover=0.0)
    anchor_from_earth = scene.world.earth_from_anchor.T
    eye = anchor_from_earth @ (view.eye_earth_m - scene.world.anchor_earth_m)
    up = eye - layer.up_origin_anchor_m
    pixels = np.array([view.col0, view.row0, view.step_px, view.focal_px])
    run_in_chunks(
        rows.size, _draw_clouds, rows, cols, pixels, anchor_from_earth @ view.earth_from_camera, eye, up / np.linalg.norm(up),
        eye_height_m, layer, _light_of(scene, view), colors,
    )  # fmt: skip
    return colors


def _light_of(scene: Scene, view: PerspectiveView) -> CloudLight:
    """Return the light of a scene's clouds. The scene has a sun above the horizon."""
    assert scene.sun is not None
    altitude_deg, brightness = scene.sun.altitude_deg, sky_brightness(scene)
    tint = sunlight_color(altitude_deg)
    tint = tint / tint.max()
    return CloudLight(
        np.array(LIT_CLOUD_COLOR) * np.sqrt(tint) * brightness,
        np.array(CLOUD_BASE_COLOR) * tint**0.25 * brightness,
        np.array(OVERCAST_SKY_COLOR) * brightness,
        float(np.clip(altitude_deg, 0.0, 1.0)), green_extinction_per_m(visibility_m_of(scene, view)), view.pixel_tangent,
    )  # fmt: skip


@compiled
def cloud_opacity(x_m, y_m, density, pixel_m):
    """Return the opacity of a cloud at a place of the layer, in [0, 1]: 0 in gaps, 1 inside clouds, frayed in between.

    ``density`` is the cloud's density there, and ``pixel_m`` the width of a pixel, metres.
    """
    if density <= 0.0 or density >= 1.0:
        return density
    x, y, total, amplitude, wave_m = x_m / DETAIL_WAVELENGTH_M, y_m / DETAIL_WAVELENGTH_M, 0.0, 1.0, DETAIL_WAVELENGTH_M
    for k in range(DETAIL_OCTAVES):
        visible_share = min(max(2.0 - 4.0 * pixel_m / wave_m, 0.0), 1.0)
        if visible_share <= 0.0:
            break
        total += visible_share * amplitude * noise_at(x, y, DETAIL_SEED + k)
        x, y = 2.0 * (0.8 * x - 0.6 * y) + 7.9, 2.0 * (0.6 * x + 0.8 * y) - 3.7
        amplitude, wave_m = amplitude * DETAIL_GAIN, wave_m / 2.0
    # The parabola is 0 in gaps and inside clouds, so that the detail has no edge of its own.
    return min(max(density + DETAIL_SHARE * total * 4.0 * density * (1.0 - density), 0.0), 1.0)


@compiled
def _draw_clouds(first, last, rows, cols, pixels, anchor_from_camera, eye, up, eye_height_m, layer, light, colors):
    """Blend clouds over the colours (n, 3) of the sky's pixels from ``first`` to ``last`` (exclusive), in place.

    ``pixels`` (4,) holds the view's ``col0``, ``row0``, ``step_px`` and ``focal_px``. ``eye`` and ``up`` (3,) are in the anchor's
    axes, ``layer`` is a ``CloudLayer`` and ``light`` a ``CloudLight``.
    """
    cover, threshold, _, layer_m, to_sun, centre, drift = layer
    lit, base, mean, strength, extinction, tangent = light
    ray = np.empty(3)
    edge = threshold - CLOUD_EDGE_WIDTH / 2.0
    for n in range(first, last):
        cx, cy = (pixels[0] + cols[n] * pixels[2]) / pixels[3], (pixels[1] + rows[n] * pixels[2]) / pixels[3]
        length = np.sqrt(1.0 + cx * cx + cy * cy)
        for k in range(3):
            ray[k] = (anchor_from_camera[k, 0] * cx + anchor_from_camera[k, 1] * cy + anchor_from_camera[k, 2]) / length
        sine = max(ray[0] * up[0] + ray[1] * up[1] + ray[2] * up[2], MIN_RAY_SINE)
        distance_m = (layer_m - eye_height_m) / sine
        # Along the ray, a pixel covers more of the layer than across.
        pixel_m = tangent * distance_m / sine
        clear = np.exp(-extinction * distance_m) * (1.0 - fade_share(pixel_m))
        opacity, shade, lining = 0.0, 0.0, 0.0
        if clear > 0.004:
            x, y = layer_position(eye[0], eye[1], eye[2], eye_height_m, layer_m, ray, centre, drift, MIN_RAY_SINE)
            noise = cloud_noise(x, y, edge, np.inf)
            opacity = cloud_opacity(x, y, density_of_noise(noise, threshold), pixel_m)
            if opacity > 0.0:
                sunward = cloud_noise(x + RELIEF_STEP_M * to_sun[0], y + RELIEF_STEP_M * to_sun[1], -np.inf, np.inf)
                shade = smoothstep_value((noise - edge) / BASE_DEPTH) - RELIEF_CONTRAST * (noise - sunward)
                facing = (ray[0] * to_sun[0] + ray[1] * to_sun[1] + ray[2] * to_sun[2] - LINING_COSINE) / (1.0 - LINING_COSINE)
                lining = smoothstep_value(facing) * (1.0 - opacity)
                shade = min(max(shade - lining, 0.0), 1.0)
        for k in range(3):
            sky = colors[n, k]
            cloudy = sky + (lit[k] + (base[k] - lit[k]) * shade - sky) * opacity
            even = sky + (mean[k] - sky) * cover
            colors[n, k] = even + (cloudy - even) * clear * strength
