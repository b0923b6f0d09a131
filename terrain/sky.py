"""The colours of the sky behind a perspective view. Haze and water use them as the light of infinitely deep air.

By day the colour changes from the horizon's to the zenith's with the sine of the altitude. The light of a low sun takes a long path
through the air, which adds colours:

- Sunlight has the colour of white light after the optical air mass of that path (F. Kasten and A. T. Young 1989, "Revised optical
  air mass tables and approximation formula", Applied Optics 28(22)). Rayleigh scattering removes blue first. Depths are those of a
  clear atmosphere (E. Bruneton and F. Neyret 2008, "Precomputed atmospheric scattering") with a little aerosol.
- Sunlight colours the horizon, most below the sun and a little opposite to it. Multiple scattering makes it paler, so only a share
  of the optical depth counts.
- Towards the zenith red fades first, since thinner air scatters less: orange, yellow, a pale green, blue.
- Round the sun, air and dust scatter forwards in a wide and a narrow lobe (L. G. Henyey and J. L. Greenstein 1941).
- The sun's disc is so bright that it saturates: white when it is high, yellow when it is low. A narrow glow leads over to the
  lobes. Its limb is the mean over each pixel. Fog dims both, and an overcast sky hides them. Water mirrors the sky without them,
  since it has a glint of its own.

**Dithering.** Without it a sky's 8-bit steps, some pixels wide, would show as bands. Each pixel is moved by up to half a step
before encoding, by interleaved gradient noise (J. Jimenez 2014, "Next generation post processing in Call of Duty: Advanced
Warfare"). The noise depends only on the pixel's position on the camera's image plane. Pictures are reproducible, and so are parts
of pictures.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.interpolation import smoothstep
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.scene import Scene
from skugga.terrain.shading_loops import twilight_sky_share

ZENITH_COLOR, HORIZON_COLOR = (0.20, 0.36, 0.66), (0.72, 0.82, 0.92)
"""Linear colours of the day's sky behind a perspective view."""

OVERCAST_SKY_COLOR = (0.60, 0.64, 0.68)
"""Linear colour of an overcast sky."""

OPTICAL_DEPTH_OF_AIR = (0.105, 0.180, 0.325)
"""Optical depth of the air overhead for red, green and blue light: Rayleigh scattering, ozone and 0.05 of aerosol."""

SINGLE_SCATTERING_SHARE = 0.45
"""Share of ``OPTICAL_DEPTH_OF_AIR`` that colours the horizon. Multiple scattering compensates the rest."""

MAX_AIR_MASS = 22.0
"""Maximum optical air mass of a path, as of a sun at 1.5 degrees. A longer path is lit from above, too."""

LOW_SUN_ALTITUDES_DEG = (2.0, 16.0)
"""Altitudes of the sun at which the horizon has all of the sunlight's colour, and none of it."""

OPPOSITE_HORIZON_COLOR_SHARE = 0.22
"""Share of the sunlight's colour in the horizon opposite to the sun."""

HIGH_SUN_FADE_RATES, LOW_SUN_FADE_RATES = (4.0, 4.0, 4.0), (7.5, 5.2, 4.2)
"""Rates per sine of the altitude at which the horizon's colour fades into the zenith's: under a high sun, and under a low one."""

ZENITH_DARKENING = 0.25
"""Share by which a low sun darkens the zenith."""

AUREOLE_LOBES = ((0.72, 0.40), (0.965, 0.55))
"""Asymmetry of each lobe of light round the sun, and the share of the sun's colour in its middle."""

SUN_DISC_EXPOSURE = 20.0
"""Exposure of the sun's disc: its colour is 1 - exp(-exposure * light)."""

SUN_GLOW_SHARE, SUN_GLOW_WIDTH_DEG, SUN_GLOW_RADIUS_DEG = 0.55, 0.7, 6.0
"""Share of the disc's colour in the glow at the disc's middle, its half width, and its radius."""

SUN_DISC_SAMPLES = 8
"""Samples per side of a pixel on the limb of the sun's disc."""

VISIBILITY_CONTRAST = 0.02
"""Contrast of a black object with the horizon at the distance that defines the visibility."""

CLEAR_AIR_VISIBILITY_M = 100_000.0
"""Default visibility: clear weather, without the dust of a dry summer."""

AEROSOL_SCALE_HEIGHT_M = 1200.0
"""Scale height of the aerosol that dims the sun's disc (E. Bruneton and F. Neyret 2008)."""

MAX_TWILIGHT_DEPRESSION_DEG = 9.0
"""Depression of the sun below the horizon down to which it colours the horizon."""

SUN_RADIUS_RAD, SUN_GLOW_WIDTH_RAD, SUN_GLOW_RADIUS_RAD = (
    float(np.radians(angle_deg)) for angle_deg in (SUN_RADIUS_DEG, SUN_GLOW_WIDTH_DEG, SUN_GLOW_RADIUS_DEG)
)
COS_SUN_RADIUS, COS_SUN_GLOW_RADIUS = float(np.cos(SUN_RADIUS_RAD)), float(np.cos(SUN_GLOW_RADIUS_RAD))

BATCH_PIXELS = 1024
"""Pixels per batch."""

HORIZON_AZIMUTH_COUNT = 129
"""Samples of the horizon's colour, from the sun's azimuth to the opposite one; densest near the sun."""


class Sky(NamedTuple):
    """A sky's parameters. Colours are linear RGB (3,).

    Attributes
    ----------
    horizon_below_sun_color, opposite_horizon_color
        The horizon's colour below the sun, and opposite to it.
    zenith_color
        The zenith's colour.
    aureole_color
        The colour of the light round the sun.
    aureole_share
        Share of ``aureole_color``, 0 to 1.
    horizon_fade_rates
        (3,), rates per sine of the altitude at which the horizon's colour fades into the zenith's.
    sun_altitude_sine_cosine
        (2,), sine and cosine of the sun's altitude.
    """

    horizon_below_sun_color: np.ndarray
    opposite_horizon_color: np.ndarray
    zenith_color: np.ndarray
    aureole_color: np.ndarray
    aureole_share: float
    horizon_fade_rates: np.ndarray
    sun_altitude_sine_cosine: np.ndarray


class SunDisc(NamedTuple):
    """The sun's disc and its glow in a view.

    Attributes
    ----------
    to_sun_camera
        (3,), unit vector to the middle of the disc, in the camera's axes.
    color
        (3,), linear colour of the disc.
    disc_share
        Share of ``color`` in the disc, 0 to 1. The disc is missing at 0.
    glow_share
        Share of ``color`` in the glow at the middle of the disc, 0 to 1.
    pixel_side
        Side of a pixel, in units of the view's ``row0`` and ``col0``.
    """

    to_sun_camera: np.ndarray
    color: np.ndarray
    disc_share: float
    glow_share: float
    pixel_side: float


def sky_brightness(scene: Scene) -> float:
    """Return the brightness of a scene's sky relative to the day's. It is low at night and without a sun."""
    sine = np.sin(np.radians(-90.0 if scene.sun is None else scene.sun.altitude_deg))
    return 0.02 + 0.98 * float(twilight_sky_share(sine))


def sky_of(scene: Scene, cloud_cover: float | None = None) -> Sky:
    """Return the sky of a scene, by the sun's altitude and the clouds. It is dark at night and without a sun.

    ``cloud_cover`` replaces that of the weather.
    """
    altitude_deg = -90.0 if scene.sun is None else scene.sun.altitude_deg
    sine = np.sin(np.radians(altitude_deg))
    brightness = sky_brightness(scene)
    cover = scene.loaded.level.weather.cloud_cover if cloud_cover is None else cloud_cover
    twilight = float(smoothstep(1.0 + min(altitude_deg, 0.0) / MAX_TWILIGHT_DEPRESSION_DEG))
    low_sun_share = (
        float(smoothstep((LOW_SUN_ALTITUDES_DEG[1] - altitude_deg) / (LOW_SUN_ALTITUDES_DEG[1] - LOW_SUN_ALTITUDES_DEG[0])))
        * twilight
    )
    grey, horizon = np.array(OVERCAST_SKY_COLOR), np.array(HORIZON_COLOR)
    reddened = sunlight_color(altitude_deg)
    lit = reddened / reddened.max()

    def horizon_color(share: float) -> np.ndarray:
        return ((1.0 - cover) * (horizon + (lit - horizon) * low_sun_share * share) + cover * grey) * brightness

    zenith = ((1.0 - cover) * np.array(ZENITH_COLOR) * (1.0 - ZENITH_DARKENING * low_sun_share) + cover * grey) * brightness
    aureole = (1.0 - cover) * twilight
    fade = np.array(HIGH_SUN_FADE_RATES) + (np.array(LOW_SUN_FADE_RATES) - np.array(HIGH_SUN_FADE_RATES)) * low_sun_share
    sun = np.array([sine, np.sqrt(max(1.0 - sine * sine, 0.0))])
    return Sky(
        horizon_color(1.0), horizon_color(OPPOSITE_HORIZON_COLOR_SHARE), zenith, np.sqrt(lit) * brightness, aureole, fade, sun
    )


def horizon_colors(scene: Scene) -> np.ndarray:
    """Return linear display colours (n, 3) of the horizon, from below the sun to the opposite side.

    Azimuths are those of ``HORIZON_AZIMUTH_COUNT``. Colours in between may be interpolated.
    """
    out = np.empty((3, HORIZON_AZIMUTH_COUNT))
    azimuths = np.pi * np.linspace(0.0, 1.0, HORIZON_AZIMUTH_COUNT) ** 2
    sky_colors(sky_of(scene), np.zeros(HORIZON_AZIMUTH_COUNT), np.cos(azimuths), out)
    return out.T


def horizontal_sun_direction(to_sun: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the horizontal unit direction (3,) towards the sun's azimuth; 0 if the sun is at the zenith or missing."""
    horizontal = to_sun - (to_sun @ up) * up
    length = float(np.linalg.norm(horizontal))
    return horizontal / length if length > 1e-9 else np.zeros(3)


def sky_pixel_colors(
    scene: Scene, view: PerspectiveView, rows: np.ndarray, cols: np.ndarray, cloud_cover: float | None = None
) -> np.ndarray:
    """Return the linear display colour (n, 3) of the sky in the pixels ``rows`` and ``cols`` (n,) of a view.

    Colours are dithered by up to half an 8-bit step. ``cloud_cover`` replaces that of the weather: with 0 it is the sky in gaps
    between clouds.
    """
    cover = scene.loaded.level.weather.cloud_cover if cloud_cover is None else cloud_cover
    up = np.array([0.0, 0.0, 1.0]) if scene.world.is_flat else view.eye_earth_m / np.linalg.norm(view.eye_earth_m)
    horizontal_to_sun = np.zeros(3) if scene.sun is None else horizontal_sun_direction(scene.sun.to_sun_earth, up)
    pixels = np.array([view.col0, view.row0, view.step_px])
    axes = view.earth_from_camera.T
    out = np.empty((rows.size, 3), np.float32)
    run_in_chunks(
        rows.size, _write_sky_pixels, rows, cols, pixels, view.focal_px, axes @ up, axes @ horizontal_to_sun,
        sky_of(scene, cover), sun_disc_of(scene, view, up, cover), out,
    )  # fmt: skip
    return out


def sun_disc_of(scene: Scene, view: PerspectiveView, up: np.ndarray, cloud_cover: float) -> SunDisc:
    """Return the sun's disc in a view. ``up`` (3,) is the unit vector away from the earth at the eye.

    Its glow fades as the disc sets.
    """
    pixel_side = view.pixel_share * view.step_px
    if scene.sun is None:
        return SunDisc(np.zeros(3), np.zeros(3), 0.0, 0.0, pixel_side)
    to_sun, weather = scene.sun.to_sun_earth, scene.loaded.level.weather
    altitude_deg = float(np.degrees(np.arcsin(np.clip(to_sun @ up, -1.0, 1.0))))
    visible_share = float(smoothstep(0.5 + 0.5 * altitude_deg / SUN_RADIUS_DEG))
    extinction_per_m = -np.log(VISIBILITY_CONTRAST) * (
        1.0 / min(weather.visibility or CLEAR_AIR_VISIBILITY_M, CLEAR_AIR_VISIBILITY_M) - 1.0 / CLEAR_AIR_VISIBILITY_M
    )
    transmittance = float(np.exp(-extinction_per_m * AEROSOL_SCALE_HEIGHT_M * min(_air_mass(altitude_deg), MAX_AIR_MASS)))
    # The share of the densest cloud's light that comes through falls in the same way as the sky gets overcast.
    unclouded_share = 1.0 - cloud_cover**4
    color = 1.0 - np.exp(-SUN_DISC_EXPOSURE * sunlight_color(altitude_deg))
    disc_share = unclouded_share * (1.0 - float(np.exp(-SUN_DISC_EXPOSURE * transmittance))) if visible_share > 0.0 else 0.0
    glow_share = SUN_GLOW_SHARE * visible_share * (1.0 - cloud_cover) * transmittance
    return SunDisc(view.earth_from_camera.T @ to_sun, color, disc_share, glow_share, pixel_side)


@compiled
def sky_color(sky, altitude_sine, azimuth_cosine, out):
    """Compute the sky's linear colour in a direction into ``out`` (3,). ``sky`` is a ``Sky``.

    ``altitude_sine`` is the sine of its altitude, ``azimuth_cosine`` the cosine of the azimuth between it and the sun.
    """
    below_sun, opposite, zenith, glow, aureole, fade, sun = sky
    altitude_sine = max(altitude_sine, 0.0)
    facing = 0.5 + 0.5 * azimuth_cosine
    facing *= facing
    light = 0.0
    if aureole > 0.0:
        cos_sun_angle = altitude_sine * sun[0] + np.sqrt(max(1.0 - altitude_sine * altitude_sine, 0.0)) * sun[1] * azimuth_cosine
        for asymmetry, peak in AUREOLE_LOBES:
            lobe = (1.0 - asymmetry) * (1.0 - asymmetry) / (1.0 + asymmetry * asymmetry - 2.0 * asymmetry * cos_sun_angle)
            light += peak * lobe * np.sqrt(lobe)
        light *= aureole
    for k in range(3):
        horizon_color = opposite[k] + (below_sun[k] - opposite[k]) * facing
        share = 1.0 - np.exp(-fade[k] * altitude_sine) if altitude_sine > 0.0 else 0.0
        color = (1.0 - share) * horizon_color + share * zenith[k]
        out[k] = color + (glow[k] - color) * light


@compiled
def sky_colors(sky, altitude_sine, azimuth_cosine, out):
    """Compute ``sky_color`` of many directions into ``out`` (3, n), in loops that compile to vector instructions.

    ``altitude_sine`` and ``azimuth_cosine`` (n,) are those of ``sky_color``, and ``sky`` is a ``Sky``.
    """
    below_sun, opposite, zenith, glow, aureole, fade, sun = sky
    light, share = np.zeros(altitude_sine.size), np.empty(altitude_sine.size)
    if aureole > 0.0:
        for asymmetry, peak in AUREOLE_LOBES:
            for n in range(altitude_sine.size):
                clamped_sine = max(altitude_sine[n], 0.0)
                cos_sun_angle = (
                    clamped_sine * sun[0] + np.sqrt(max(1.0 - clamped_sine * clamped_sine, 0.0)) * sun[1] * azimuth_cosine[n]
                )
                lobe = (1.0 - asymmetry) * (1.0 - asymmetry) / (1.0 + asymmetry * asymmetry - 2.0 * asymmetry * cos_sun_angle)
                light[n] += peak * lobe * np.sqrt(lobe)
        light *= aureole
    for k in range(3):
        transmittances(fade[k], altitude_sine, share)
        for n in range(altitude_sine.size):
            facing = 0.5 + 0.5 * azimuth_cosine[n]
            facing *= facing
            horizon_color = opposite[k] + (below_sun[k] - opposite[k]) * facing
            color = share[n] * horizon_color + (1.0 - share[n]) * zenith[k]
            out[k, n] = color + (glow[k] - color) * light[n]


@compiled
def transmittances(extinction, path_length, out):
    """Compute the transmittance (n,) of air along paths of a length (n,), exp(-extinction * path_length); 1 for a negative length.

    It is evaluated as exp(-extinction * path_length / 1024)**1024, with a power series for exp, because calls of a library's
    function would take most of the time. The absolute error is below 1e-12.
    """
    for n in range(out.size):
        x = max(-extinction * max(path_length[n], 0.0), -80.0) / 1024.0
        power = 1.0 + x * (1.0 + x * (1.0 / 2.0 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0 + x / 720.0)))))
        for _ in range(10):
            power *= power
        out[n] = power


@compiled
def gradient_noise(x, y):
    """Return interleaved gradient noise in [-0.5, 0.5) at the position of a pixel (J. Jimenez 2014)."""
    inner = 0.06711056 * x + 0.00583715 * y
    outer = 52.9829189 * (inner - np.floor(inner))
    return outer - np.floor(outer) - 0.5


@internal
def _disc_coverage(px, py, pixel_side, focal, to_sun, up):
    """Return the share of a pixel that the sun's disc above the horizon covers, by samples of the pixel at (``px``, ``py``)."""
    covered = 0
    for i in range(SUN_DISC_SAMPLES):
        for j in range(SUN_DISC_SAMPLES):
            x = (px + ((j + 0.5) / SUN_DISC_SAMPLES - 0.5) * pixel_side) / focal
            y = (py + ((i + 0.5) / SUN_DISC_SAMPLES - 0.5) * pixel_side) / focal
            if x * up[0] + y * up[1] + up[2] <= 0.0:
                continue
            cosine = (x * to_sun[0] + y * to_sun[1] + to_sun[2]) / np.sqrt(1.0 + x * x + y * y)
            if cosine >= COS_SUN_RADIUS:
                covered += 1
    return covered / (SUN_DISC_SAMPLES * SUN_DISC_SAMPLES)


@compiled
def _add_sun_disc(px, py, focal, up, disc, color):
    """Blend the sun's disc and its glow over the colours (3, n) of the pixels at ``px`` and ``py`` (n,), in place.

    ``disc`` is a ``SunDisc``, and ``up`` (3,) the unit vector up in the camera's axes.
    """
    to_sun, disc_color, disc_share, glow_share, pixel_side = disc
    for n in range(px.size):
        x, y = px[n] / focal, py[n] / focal
        cosine = (x * to_sun[0] + y * to_sun[1] + to_sun[2]) / np.sqrt(1.0 + x * x + y * y)
        if cosine < COS_SUN_GLOW_RADIUS:
            continue
        angle = np.arccos(min(cosine, 1.0))
        width = angle / SUN_GLOW_WIDTH_RAD
        share = glow_share * (1.0 - smoothstep_value(angle / SUN_GLOW_RADIUS_RAD)) / (1.0 + width * width)
        # A pixel is at most as wide as in the middle of the picture.
        if angle < SUN_RADIUS_RAD + pixel_side / focal:
            share += (max(disc_share, share) - share) * _disc_coverage(px[n], py[n], pixel_side, focal, to_sun, up)
        for k in range(3):
            color[k, n] += (max(disc_color[k], color[k, n]) - color[k, n]) * share


@compiled
def _write_sky_pixels(first, last, rows, cols, pixels, focal, up, horizontal_to_sun, sky, disc, out):
    """Write the dithered colours of the pixels from ``first`` to ``last`` (exclusive) to ``out`` (n, 3), by ``sky_colors``.

    ``rows`` and ``cols`` (n,) are the pixels. ``pixels`` (3,) holds the view's ``col0``, ``row0`` and ``step_px``, and ``focal``
    its focal length in pixels. ``up`` and ``horizontal_to_sun`` (3,) are unit vectors in the camera's axes.
    ``disc`` is a ``SunDisc``.
    """
    px, py, sine, azimuth_cosine = np.empty(BATCH_PIXELS), np.empty(BATCH_PIXELS), np.empty(BATCH_PIXELS), np.empty(BATCH_PIXELS)
    color = np.empty((3, BATCH_PIXELS))
    for begin in range(first, last, BATCH_PIXELS):
        count = min(BATCH_PIXELS, last - begin)
        for n in range(count):
            px[n], py[n] = pixels[0] + cols[begin + n] * pixels[2], pixels[1] + rows[begin + n] * pixels[2]
        for n in range(count):
            x, y = px[n] / focal, py[n] / focal
            length = np.sqrt(1.0 + x * x + y * y)
            sine[n] = (x * up[0] + y * up[1] + up[2]) / length
            cos_altitude = np.sqrt(max(1.0 - sine[n] * sine[n], 1e-12))
            azimuth_cosine[n] = min(
                max((x * horizontal_to_sun[0] + y * horizontal_to_sun[1] + horizontal_to_sun[2]) / (length * cos_altitude), -1.0),
                1.0,
            )
        sky_colors(sky, sine[:count], azimuth_cosine[:count], color[:, :count])
        if disc.disc_share > 0.0:
            _add_sun_disc(px[:count], py[:count], focal, up, disc, color[:, :count])
        for k in range(3):
            for n in range(count):
                # sRGB is about the root of linear light, so that a step of 1/255 is twice that root over 255.
                value = color[k, n]
                dithered = value + gradient_noise(px[n] + 37.0 * k, py[n] + 17.0 * k) * 2.1 / 255.0 * np.sqrt(value)
                out[begin + n, k] = min(max(dithered, 0.0), 1.0)


def sunlight_color(altitude_deg: float) -> np.ndarray:
    """Return the colour (3,) that sunlight gives to the horizon: white light after its path through the air.

    Only the share ``SINGLE_SCATTERING_SHARE`` of the air's optical depth counts.
    """
    return np.exp(-SINGLE_SCATTERING_SHARE * min(_air_mass(altitude_deg), MAX_AIR_MASS) * np.array(OPTICAL_DEPTH_OF_AIR))


def _air_mass(altitude_deg: float) -> float:
    """Return the optical air mass of the path of sunlight, relative to the zenith (Kasten and Young 1989)."""
    altitude = max(altitude_deg, 0.0)
    return float(1.0 / (np.sin(np.radians(altitude)) + 0.50572 * (altitude + 6.07995) ** -1.6364))
