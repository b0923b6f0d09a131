"""Colour of the visible surface: a style's tint, Lambert's law and sky light, in linear light, encoded as sRGB.

What light and which look a scene has is said here; the loops over pixels are in ``skugga.terrain.shading_loops``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.climate import Ramp
from skugga.terrain.compiled import in_shares
from skugga.terrain.gbuffer.bare_ground import BareGround
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene
from skugga.terrain.shading_loops import (
    LightHere,
    Look,
    Tints,
    albedo_rows,
    encode_rows,
    luminance_of,
    shade_bare_ground,
    shade_rows,
    slopes_sky,
)
from skugga.terrain.srgb import srgb_of_linear
from skugga.terrain.style import TINT_COUNT, tint_table, veil_table

LEVEL_ALBEDO = 0.42
"""Linear albedo of ground without any relief, which has no heights to tint."""

NORTH_EARTH, NO_DIRECTION = np.array([0.0, 0.0, 1.0]), np.zeros(3)
"""The earth's axis; and what stands for it where no latitude counts."""

SKY_SHARE = 0.28
"""Irradiance from the whole sky as a share of the sun's on level ground, for a sun down to ``EXPOSURE_FLOOR_DEG``."""

LEVEL_GROUND = 0.86
"""Linear exposure of level, lit, white ground: the same for every sun down to ``EXPOSURE_FLOOR_DEG``."""

EXPOSURE_FLOOR_DEG = 18.0
NIGHT_SKY = 0.08
"""Sky light of the night as a share of the day's, so that a map can be read."""

LAMP_ROOM_LIGHT = 0.4
"""Light from all round, as a share of the day's sky light, where lamps shine and there is no sun."""

MAP_FOLIAGE = 2.0
"""How much brighter foliage is in maps than leaves are: woods from above, with their own shadows, are nearly black."""

LEAF_GLOW = 0.3
"""Share of its light that foliage shows whichever way it is turned: leaves let light through and lie in all directions."""

CLOUD_LIGHT = (0.94, 0.97, 1.00)
"""Linear colour of the light that comes through clouds."""

OVERCAST_GROUND = 0.56
"""Linear exposure of level, white ground under clouds alone."""

SHORE_M = 1e-3
"""Ground that is no farther than this from the height of the water is water."""

_SRGB_STEPS = 4096


@dataclass(frozen=True)
class Daylight:
    """Light of the sun and of the sky, linear colours (3,): irradiance at normal incidence, and from the whole sky."""

    sun: np.ndarray
    sky: np.ndarray


def daylight_of(scene: Scene) -> Daylight:
    """The day's light over a level: clouds take the direct sun away where they are (all of it if there is nothing else, else
    by the effect ``clouds``), and make the sky grey.
    """
    cover, style = scene.loaded.level.weather.cloud_cover, scene.style
    clear, grey = np.array(style.skylight) * LEVEL_GROUND * SKY_SHARE / (1.0 + SKY_SHARE), np.array(CLOUD_LIGHT) * OVERCAST_GROUND
    sun = np.array(style.sunlight) * exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    return Daylight(np.zeros(3) if scene.loaded.level.weather.overcast else sun, (1.0 - cover) * clear + cover * grey)


def look_of(scene: Scene, view: MapView | PerspectiveView, frame: LocalFrame | None = None) -> Look:
    """A scene's style, with the way north in a ``frame`` where latitudes count. Clouds take the sky its colour and its bright side;
    without a sun it has neither, and there is no air over the ground; a perspective view has no veil by height.
    """
    style = scene.style
    clear = 0.0 if scene.sun is None else 1.0 - scene.loaded.level.weather.cloud_cover
    in_map = isinstance(view, MapView)
    steeper = style.slope_exaggeration_at(map_pixel_m(scene.world, view)) if isinstance(view, MapView) else style.slope_exaggeration
    return Look(
        tints_of(scene), NO_DIRECTION if frame is None else frame.directions_from_earth(NORTH_EARTH),
        style.sky_greying * clear, style.sky_towards_sun * clear, style.terminator, steeper, style.slope_limit,
        veil_table(style.aerial if in_map and scene.sun is not None else 0.0, style.aerial_m),
        MAP_FOLIAGE if in_map else 1.0,
    )  # fmt: skip


def tints_of(scene: Scene) -> Tints:
    """The colours of a scene's ground. A flat world lies at no latitude."""
    style, (low, high) = scene.style, scene.height_range_m
    return _tints(style.ramp, style.has_climate and not scene.world.flat) if high > low else _tints(None, False)


@cached("process", 16 * MIB)
def _tints(ramp: Ramp | None, has_climate: bool) -> Tints:
    colors = np.full((1, TINT_COUNT, 3), LEVEL_ALBEDO) if ramp is None else tint_table(ramp, has_climate)
    channels = np.moveaxis(colors, -1, 0)
    table = np.stack([*channels, luminance_of(*channels)], axis=1)
    differ = (table[1:] != table[:-1]).any(axis=1)
    from_on = np.where(differ.any(axis=1), differ.argmax(axis=1), TINT_COUNT)
    return Tints(np.ascontiguousarray(table), from_on.astype(np.int32))


def in_shade(albedo: np.ndarray, look: Look) -> np.ndarray:
    """Linear albedos (..., 3) as the sky's light shows them: nearer to grey of the same luminance."""
    grey = np.asarray(luminance_of(albedo[..., 0], albedo[..., 1], albedo[..., 2]))[..., None]
    return albedo + look.sky_greying * (grey - albedo)


def most_sky(scene: Scene) -> float:
    """The largest factor that a slope has of the sky's light beyond the share that it sees: towards the sky's bright side."""
    return 1.0 + scene.style.sky_towards_sun * (np.sqrt(2.0) - 1.0)


def shade(
    buffer: GeometryBuffer,
    scene: Scene,
    sunlight: np.ndarray,
    albedo: np.ndarray | None = None,
    skylight: np.ndarray | None = None,
    lamplight: np.ndarray | None = None,
) -> np.ndarray:
    """Linear display colour (rows, cols, 3) float32 in [0, 1] of a buffer's points.

    ``sunlight`` (rows, cols) is the share of the sun's direct light that arrives; ``albedo`` (rows, cols, 3) goes before the
    buffer's own; ``skylight`` (rows, cols) is the share of the sky that is seen (without it: what a slope leaves of it by itself),
    ``lamplight`` (rows, cols, 3) what comes from elsewhere. Black where nothing is there.
    """
    if albedo is None:
        albedo = buffer.albedo if scene.loaded.level.water is None else albedo_of(buffer, scene)
    out = np.zeros((*buffer.there.shape, 3), np.float32)
    in_shares(
        len(out), shade_rows, buffer.shown, look_of(scene, buffer.view, buffer.frame), light_here(scene, buffer.frame),
        scene.world.up_from(buffer.frame), LEAF_GLOW, albedo, sunlight, skylight, lamplight, out,
    )  # fmt: skip
    return out


def light_here(scene: Scene, frame: LocalFrame) -> LightHere:
    """A scene's day in a frame."""
    light, to_sun = daylight_of(scene), np.zeros(3) if scene.sun is None else scene.sun.in_frame(frame)
    return LightHere(scene.sun is not None, to_sun, light.sun, light.sky, night_of(scene))


def shaded_ground(ground: BareGround, scene: Scene, sunlight: np.ndarray) -> np.ndarray:
    """sRGB (rows, cols, 3) uint8 of bare ground: ``srgb_encoded`` of ``shade``, in one pass. ``sunlight`` (rows, cols) is the share
    of the sun's direct light that arrives. Black where there is no ground.
    """
    assert scene.sun is not None
    out = np.zeros((*ground.there.shape, 3), np.uint8)
    if ground.height_m.size:
        light = light_here(scene, ground.frame)
        shade_bare_ground(
            ground.there[ground.window], ground.height_m, ground.normal_frame, ground.up_frame, ground.sky_share,
            sunlight[ground.window], look_of(scene, ground.view, ground.frame), light, _srgb_table(),
            out[ground.window],
        )  # fmt: skip
    return out


def open_sky(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Share of the sky (rows, cols) float32 that a slope leaves by itself: half of it upright, all of it lying flat."""
    out = np.zeros(buffer.there.shape, np.float32)
    centre = scene.world.up_from(buffer.frame)
    in_shares(len(out), slopes_sky, buffer.there, buffer.shading_normal_frame, buffer.position_frame_m, centre, out)
    return out


def night_of(scene: Scene) -> float:
    """Sky light of the night, or of a room, as a share of the day's."""
    return LAMP_ROOM_LIGHT if scene.lamps and scene.sun is None else NIGHT_SKY


def albedo_of(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Linear albedo (rows, cols, 3) float32 of a buffer's points, the ground's tint and water included: a new array."""
    albedo = np.zeros((*buffer.there.shape, 3), np.float32)
    in_shares(
        len(albedo), albedo_rows, buffer.shown, scene.world.up_from(buffer.frame), buffer.albedo,
        look_of(scene, buffer.view, buffer.frame), albedo,
    )  # fmt: skip
    if scene.loaded.level.water is not None:
        water = water_in(buffer, scene)
        albedo[water if buffer.albedo is None else water & np.isnan(buffer.albedo[..., 0])] = scene.style.water
    return albedo


def water_in(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Where (rows, cols) a buffer shows standing water: ground at its height."""
    return (buffer.kind == RELIEF) & (np.abs(buffer.height_m - scene.elevation.water_m) <= SHORE_M)


def srgb_encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB as uint8 of linear display colour in [0, 1]."""
    out = np.empty(linear.shape, np.uint8)
    flat = np.ascontiguousarray(linear).reshape(-1)
    in_shares(flat.size, encode_rows, flat, _srgb_table(), out.reshape(-1))
    return out


def exposure_of(altitude_deg: float | None) -> float:
    """Exposure for a sun's altitude at the anchor (``None``: no sun, but lamps of its strength): level, lit, white ground keeps its
    brightness down to ``EXPOSURE_FLOOR_DEG``, and what the sky gives of it for every sun.
    """
    if altitude_deg is None:
        return LEVEL_GROUND
    return LEVEL_GROUND / ((1.0 + SKY_SHARE) * float(np.sin(np.radians(max(altitude_deg, EXPOSURE_FLOOR_DEG)))))


@cached("process", MIB)
def _srgb_table() -> np.ndarray:
    return np.rint(255.0 * srgb_of_linear((np.arange(_SRGB_STEPS) + 0.5) / _SRGB_STEPS)).astype(np.uint8)
