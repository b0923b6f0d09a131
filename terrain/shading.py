"""Colour of the visible surface: a style's tint, Lambert's law and sky light, in linear light, encoded as sRGB.

This module prepares a scene's light and its shading parameters (``ShadingParameters``). ``skugga.terrain.shading_loops`` has the
loops over pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.color_ramp import ColorRamp
from skugga.terrain.compiled import run_in_chunks
from skugga.terrain.gbuffer.bare_ground import BareGround
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene
from skugga.terrain.shading_loops import (
    DaylightInFrame,
    LeafOptics,
    ShadingParameters,
    Tints,
    encode_rows,
    luminance_of,
    shade_bare_ground,
    shade_rows,
    write_albedo_rows,
    write_slope_sky_rows,
)
from skugga.terrain.srgb import srgb_of_linear
from skugga.terrain.style import TINT_HEIGHT_COUNT, has_directional_sky, tint_table, veil_table

FLAT_GROUND_ALBEDO = 0.42
"""Linear albedo of ground without relief, which has no heights to tint."""

NORTH_EARTH, ZERO_VECTOR = np.array([0.0, 0.0, 1.0]), np.zeros(3)
"""The earth's axis, and its placeholder where latitude has no effect."""

SKY_IRRADIANCE_SHARE = 0.42
"""Irradiance from the whole sky as a share of the sun's on level ground, for a sun down to ``MIN_EXPOSURE_SUN_ALTITUDE_DEG``."""

LEVEL_GROUND_EXPOSURE = 0.86
"""Linear exposure of level, sunlit, white ground. The same for every sun down to ``MIN_EXPOSURE_SUN_ALTITUDE_DEG``."""

MIN_EXPOSURE_SUN_ALTITUDE_DEG = 18.0
NIGHT_SKY_LIGHT_SHARE = 0.08
"""Sky light at night as a share of the day's, so that a map stays readable."""

LAMP_AMBIENT_SHARE = 0.4
"""Ambient light as a share of the day's sky light, in scenes with lamps and without a sun."""

MAP_FOLIAGE_ALBEDO_FACTOR = 2.0
"""Factor of foliage's albedo in maps. Woods seen from above, with their own shadows, would be nearly black."""

LEAF_TRANSLUCENCY = 0.3
"""Share of foliage's light that does not depend on its normal. Leaves are translucent and lie in all directions."""

LEAF_TRANSMITTANCE_RATIO = (0.87, 0.96, 0.0)
"""Transmittance of a leaf over its reflectance, linear RGB: transmitted light is yellower.

The leaf model PROSPECT-D (J.-B. Feret et al. 2017, fitted to measured leaves) gives the reflectance (0.066, 0.127, 0.032) and the
transmittance (0.057, 0.122, 0) for a green leaf: structure 1.5, 40 ug/cm2 of chlorophyll, 8 of carotenoids, 10 mg/cm2 of water and
9 of dry matter, under a black body of 5800 K. Leaves absorb nearly all blue light that enters them.
"""

CLOUD_LIGHT_COLOR = (0.94, 0.97, 1.00)
"""Linear colour of the light that passes through clouds."""

OVERCAST_GROUND_EXPOSURE = 0.56
"""Linear exposure of level, white ground under an overcast sky."""

WATER_HEIGHT_TOLERANCE_M = 1e-3
"""Ground within this distance of the water's height is water."""

_SRGB_TABLE_SIZE = 4096


@dataclass(frozen=True)
class Daylight:
    """Light of the sun and of the sky.

    Attributes
    ----------
    sun_irradiance
        (3,), linear colour: the sun's irradiance at normal incidence.
    sky_irradiance
        (3,), linear colour: the irradiance from the whole sky.
    """

    sun_irradiance: np.ndarray
    sky_irradiance: np.ndarray


def daylight_of(scene: Scene) -> Daylight:
    """Return the daylight over a level.

    Under an overcast sky the sun's direct light is 0. Under other clouds the effect ``clouds`` attenuates it later, pixel by pixel.
    Clouds make the sky's light grey.
    """
    cover, style = scene.loaded.level.weather.cloud_cover, scene.style
    clear_sky_light, grey = (
        np.array(style.sky_light_color) * LEVEL_GROUND_EXPOSURE * SKY_IRRADIANCE_SHARE / (1.0 + SKY_IRRADIANCE_SHARE),
        np.array(CLOUD_LIGHT_COLOR) * OVERCAST_GROUND_EXPOSURE,
    )
    sun = np.array(style.sunlight_color) * exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    return Daylight(np.zeros(3) if scene.loaded.level.weather.is_overcast else sun, (1.0 - cover) * clear_sky_light + cover * grey)


def shading_parameters(scene: Scene, view: MapView | PerspectiveView, frame: LocalFrame | None = None) -> ShadingParameters:
    """Return the shading parameters of a scene in a view, for the compiled loops.

    ``frame`` is the local frame of the direction of north, which is needed only where tints depend on latitude. Clouds reduce the
    desaturation in sky light and the sky's brighter side towards the sun, in proportion to their cover. Without a sun both are 0.
    The veil of air applies only to maps with a sun.
    """
    style = scene.style
    clear_sky_share = 0.0 if scene.sun is None else 1.0 - scene.loaded.level.weather.cloud_cover
    in_map = isinstance(view, MapView)
    exaggeration = (
        style.slope_exaggeration_at(map_pixel_m(scene.world, view)) if isinstance(view, MapView) else style.slope_exaggeration
    )
    sunward_share = 0.0 if in_map and has_directional_sky(style) else style.sunward_sky_light_share
    return ShadingParameters(
        tints_of(scene), ZERO_VECTOR if frame is None else frame.directions_from_earth(NORTH_EARTH),
        style.sky_light_desaturation * clear_sky_share, sunward_share * clear_sky_share,
        style.terminator_light_share, exaggeration,
        style.max_shaded_slope, veil_table(style.air_veil_share if in_map and scene.sun is not None else 0.0,
        style.air_veil_scale_height_m),
        MAP_FOLIAGE_ALBEDO_FACTOR if in_map else 1.0,
    )  # fmt: skip


def tints_of(scene: Scene) -> Tints:
    """Return the tints of a scene's ground. In a flat world they do not depend on latitude.

    Level ground without relief has the grey ``FLAT_GROUND_ALBEDO``.
    """
    style, (low, high) = scene.style, scene.height_range_m
    return _tints(style.ramp, style.has_latitude_tints and not scene.world.is_flat) if high > low else _tints(None, False)


@cached("process", 16 * MIB)
def _tints(ramp: ColorRamp | None, has_latitude_tints: bool) -> Tints:
    """Return the tints of a colour ramp (``None``: the grey ``FLAT_GROUND_ALBEDO`` at all heights).

    ``has_latitude_tints`` is whether they depend on latitude.
    """
    colors = np.full((1, TINT_HEIGHT_COUNT, 3), FLAT_GROUND_ALBEDO) if ramp is None else tint_table(ramp, has_latitude_tints)
    channels = np.moveaxis(colors, -1, 0)
    table = np.stack([*channels, luminance_of(*channels)], axis=1)
    differ = (table[1:] != table[:-1]).any(axis=1)
    first_difference = np.where(differ.any(axis=1), differ.argmax(axis=1), TINT_HEIGHT_COUNT)
    return Tints(np.ascontiguousarray(table), first_difference.astype(np.int32))


def sky_lit_albedo(albedo: np.ndarray, desaturation: float) -> np.ndarray:
    """Return linear albedos (..., 3) as they appear in sky light: nearer to grey of the same luminance.

    ``desaturation`` is ``ShadingParameters.sky_light_desaturation``.
    """
    grey = np.asarray(luminance_of(albedo[..., 0], albedo[..., 1], albedo[..., 2]))[..., None]
    return albedo + desaturation * (grey - albedo)


def max_slope_sky_factor(scene: Scene) -> float:
    """Return the largest factor of sky light on a slope, relative to an even sky. Slopes towards the sky's bright side have it."""
    return 1.0 + scene.style.sunward_sky_light_share * (np.sqrt(2.0) - 1.0)


def shade(
    buffer: GeometryBuffer,
    scene: Scene,
    sunlight: np.ndarray,
    albedo: np.ndarray | None = None,
    skylight: np.ndarray | None = None,
    lamplight: np.ndarray | None = None,
    gloss: np.ndarray | None = None,
) -> np.ndarray:
    """Return the linear display colour of a buffer's points.

    Parameters
    ----------
    sunlight
        (rows, cols), the visible share of the sun's direct light.
    albedo
        (rows, cols, 3), overrides the buffer's albedo.
    skylight
        (rows, cols), the visible share of the sky. Default: the share that each slope leaves visible without its surroundings.
    lamplight
        (rows, cols, 3), light of lamps.
    gloss
        (rows, cols, 4), the share of the sun's light that the surface mirrors, and the share that its diffuse light lacks.

    Returns
    -------
    numpy.ndarray
        (rows, cols, 3) float32 in [0, 1]; black where the pixel has no surface.
    """
    if albedo is None:
        albedo = buffer.albedo if scene.loaded.level.water is None else albedo_of(buffer, scene)
    out = np.zeros((*buffer.valid.shape, 3), np.float32)
    run_in_chunks(
        len(out), shade_rows, buffer.shading_inputs, shading_parameters(scene, buffer.view, buffer.frame),
        daylight_in_frame(scene, buffer.frame),
        scene.world.up_origin(buffer.frame), leaf_optics(buffer), albedo, sunlight, skylight, lamplight, gloss, out,
    )  # fmt: skip
    return out


def leaf_optics(buffer: GeometryBuffer) -> LeafOptics:
    """Return the optical properties of foliage in a buffer's view. Maps show the sunlit side of leaves alone."""
    if isinstance(buffer.view, MapView):
        return LeafOptics(LEAF_TRANSLUCENCY, np.zeros(3), np.zeros(3))
    return LeafOptics(LEAF_TRANSLUCENCY, np.array(LEAF_TRANSMITTANCE_RATIO), buffer.view.in_frame(buffer.frame)[0])


def daylight_in_frame(scene: Scene, frame: LocalFrame) -> DaylightInFrame:
    """Return the daylight of a scene in a frame."""
    light, to_sun = daylight_of(scene), np.zeros(3) if scene.sun is None else scene.sun.in_frame(frame)
    return DaylightInFrame(scene.sun is not None, to_sun, light.sun_irradiance, light.sky_irradiance, night_sky_share(scene))


def shaded_ground_srgb(ground: BareGround, scene: Scene, sunlight: np.ndarray) -> np.ndarray:
    """Return the sRGB colour (rows, cols, 3) uint8 of bare ground: ``encode_srgb`` of ``shade``, in one pass.

    ``sunlight`` (rows, cols) is the visible share of the sun's direct light, 0 to 1. Pixels without ground are black.
    """
    assert scene.sun is not None
    out = np.zeros((*ground.valid.shape, 3), np.uint8)
    if ground.height_m.size:
        light = daylight_in_frame(scene, ground.frame)
        shade_bare_ground(
            ground.valid[ground.window], ground.height_m, ground.normal_frame, ground.up_frame, ground.visible_sky_share,
            sunlight[ground.window], shading_parameters(scene, ground.view, ground.frame), light, _srgb_table(),
            out[ground.window],
        )  # fmt: skip
    return out


def slope_sky_view_factor(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Return the sky-view factor (rows, cols) float32 of each slope without its surroundings: 0.5 if vertical, 1 if level."""
    out = np.zeros(buffer.valid.shape, np.float32)
    centre = scene.world.up_origin(buffer.frame)
    run_in_chunks(len(out), write_slope_sky_rows, buffer.valid, buffer.shading_normal_frame, buffer.position_frame_m, centre, out)
    return out


def night_sky_share(scene: Scene) -> float:
    """Return the sky light at night, or the ambient light of a room, as a share of the day's."""
    return LAMP_AMBIENT_SHARE if scene.lamps and scene.sun is None else NIGHT_SKY_LIGHT_SHARE


def albedo_of(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Return the linear albedo (rows, cols, 3) float32 of a buffer's points, with tint and water, as a new array."""
    albedo = np.zeros((*buffer.valid.shape, 3), np.float32)
    run_in_chunks(
        len(albedo), write_albedo_rows, buffer.shading_inputs, scene.world.up_origin(buffer.frame), buffer.albedo,
        shading_parameters(scene, buffer.view, buffer.frame), albedo,
    )  # fmt: skip
    if scene.loaded.level.water is not None:
        water = water_mask(buffer, scene)
        albedo[water if buffer.albedo is None else water & np.isnan(buffer.albedo[..., 0])] = scene.style.water_albedo
    return albedo


def water_mask(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Return the mask (rows, cols) of pixels that show standing water: ground at the water's height."""
    return (buffer.surface_kind == RELIEF) & (np.abs(buffer.height_m - scene.elevation.water_m) <= WATER_HEIGHT_TOLERANCE_M)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear display colour in [0, 1] as sRGB, uint8."""
    out = np.empty(linear.shape, np.uint8)
    flat = np.ascontiguousarray(linear).reshape(-1)
    run_in_chunks(flat.size, encode_rows, flat, _srgb_table(), out.reshape(-1))
    return out


def exposure_of(altitude_deg: float | None) -> float:
    """Return the exposure for the sun's altitude in degrees at the anchor; ``None`` if lamps are the only lights.

    Level, sunlit, white ground keeps its brightness down to ``MIN_EXPOSURE_SUN_ALTITUDE_DEG``. Its sky light is the same for every
    sun.
    """
    if altitude_deg is None:
        return LEVEL_GROUND_EXPOSURE
    return LEVEL_GROUND_EXPOSURE / (
        (1.0 + SKY_IRRADIANCE_SHARE) * float(np.sin(np.radians(max(altitude_deg, MIN_EXPOSURE_SUN_ALTITUDE_DEG))))
    )


@cached("process", MIB)
def _srgb_table() -> np.ndarray:
    """Return the sRGB codes uint8 (n,) of linear colours at even steps from 0 to 1."""
    return np.rint(255.0 * srgb_of_linear((np.arange(_SRGB_TABLE_SIZE) + 0.5) / _SRGB_TABLE_SIZE)).astype(np.uint8)
