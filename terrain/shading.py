"""Colour of the visible surface: hypsometric tint, Lambert's law and sky light, in linear light, encoded as sRGB."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.cache import MIB, cached
from terrain.compiled import compiled
from terrain.gbuffer.bare_ground import BareGround
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gbuffer.resolve import FOREST, RELIEF
from terrain.scene import Scene
from terrain.srgb import linear_of_srgb, srgb_of_linear

TINT = (
    (0.00, "#8fb07c"),
    (0.18, "#b3c58c"),
    (0.38, "#dcd6a0"),
    (0.58, "#e0c494"),
    (0.78, "#d0a988"),
    (1.00, "#efe6cf"),
)
"""Hypsometric tint: share of the level's relief -> sRGB colour, from humid lowland to bare heights."""

WATER_ALBEDO = (0.102, 0.246, 0.392)
"""Linear albedo of standing water on a map, before what it mirrors: a calm blue (sRGB #5a88a8), darker than the tints."""

LEVEL_ALBEDO = 0.42
"""Linear albedo of ground without any relief, which has no heights to tint."""

SUNLIGHT = (1.00, 0.95, 0.86)
SKYLIGHT = (0.62, 0.76, 1.00)
"""Linear colours of direct and sky light."""

SKY_SHARE = 0.30
"""Irradiance from the whole sky as a share of the sun's at normal incidence."""

LEVEL_GROUND = 0.80
"""Linear exposure of level, lit, white ground: the same for every sun down to ``EXPOSURE_FLOOR_DEG``."""

EXPOSURE_FLOOR_DEG = 14.0
NIGHT_SKY = 0.08
"""Sky light of the night as a share of the day's, so that a map can be read."""

LAMP_ROOM_LIGHT = 0.4
"""Light from all round, as a share of the day's sky light, where lamps shine and there is no sun."""

LEAF_GLOW = 0.3
"""Share of its light that foliage shows whichever way it is turned: leaves let light through and lie in all directions."""

CLOUD_LIGHT = (0.94, 0.97, 1.00)
"""Linear colour of the light that comes through clouds."""

OVERCAST_GROUND = 0.56
"""Linear exposure of level, white ground under clouds alone."""

SHORE_M = 1e-3
"""Ground that is no farther than this from the height of the water is water."""

HIGH_SUN_DEG = 6.01
"""From here on the sun's altitude changes neither direct light nor the sky's (``_shade``, ``dusk_of``), and a hundredth of a degree
before: it is looked at in some places of a map alone.
"""

_SRGB_STEPS = 4096


@dataclass(frozen=True)
class Daylight:
    """Light of the sun and of the sky, linear colours (3,): irradiance at normal incidence, and from the whole sky."""

    sun: np.ndarray
    sky: np.ndarray


class Tints(NamedTuple):
    """Linear colours (n, 3) of ground from ``low_m`` on to ``relief_m`` above it."""

    low_m: float
    relief_m: float
    color: np.ndarray


class LightHere(NamedTuple):
    """A day's light, the direction (3,) to its sun in a frame, and the night's share of the sky's."""

    has_sun: bool
    to_sun_frame: np.ndarray
    sun: np.ndarray
    sky: np.ndarray
    night: float


def daylight_of(scene: Scene) -> Daylight:
    """The day's light over a level: clouds take the direct sun away where they are (all of it if there is nothing else, else
    by the effect ``clouds``), and make the sky grey.
    """
    exposure = exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    cover = scene.loaded.level.weather.cloud_cover
    clear, grey = np.array(SKYLIGHT) * SKY_SHARE * exposure, np.array(CLOUD_LIGHT) * OVERCAST_GROUND
    sun = np.array(SUNLIGHT) * exposure
    return Daylight(np.zeros(3) if scene.loaded.level.weather.overcast else sun, (1.0 - cover) * clear + cover * grey)


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
    low, high = scene.height_range_m
    to_sun = np.zeros(3) if scene.sun is None else scene.sun.in_frame(buffer.frame)
    tint = tint_table() if high > low else np.full((2, 3), LEVEL_ALBEDO)
    light = daylight_of(scene)
    if albedo is None:
        albedo = buffer.albedo if scene.loaded.level.water is None else albedo_of(buffer, scene)
    return _shade(
        buffer.shown, Tints(low, max(high - low, 1.0), tint),
        LightHere(scene.sun is not None, to_sun, light.sun, light.sky, night_of(scene)),
        scene.world.up_from(buffer.frame), LEAF_GLOW, albedo, sunlight, skylight, lamplight,
    )  # fmt: skip


def shaded_ground(ground: BareGround, scene: Scene, sunlight: np.ndarray) -> np.ndarray:
    """sRGB (rows, cols, 3) uint8 of bare ground: ``srgb_encoded`` of ``shade``, in one pass. ``sunlight`` (rows, cols) is the share
    of the sun's direct light that arrives. Black where there is no ground.
    """
    assert scene.sun is not None
    low, high = scene.height_range_m
    light, to_sun = daylight_of(scene), scene.sun.in_frame(ground.frame)
    out = np.zeros((*ground.there.shape, 3), np.uint8)
    if ground.height_m.size:
        _shade_ground(
            ground.there[ground.window], ground.height_m, ground.normal_frame, ground.sky_share, sunlight[ground.window],
            Tints(low, max(high - low, 1.0), tint_table() if high > low else np.full((2, 3), LEVEL_ALBEDO)),
            LightHere(True, to_sun, light.sun, light.sky, night_of(scene)), _sines_of_sun(ground, scene, to_sun), _srgb_table(),
            out[ground.window],
        )  # fmt: skip
    return out


def _sines_of_sun(ground: BareGround, scene: Scene, to_sun_frame: np.ndarray) -> np.ndarray | None:
    """Sines of the sun's altitude (r, c) in the ground's window; ``None`` where it is high everywhere."""
    view, surface = ground.window_view, scene.surface(ground.view.grid)
    row0, col0, centre = int(view.row0), int(view.col0), scene.world.up_from(ground.frame)
    some = np.meshgrid(*(np.rint(np.linspace(0, size - 1, 9)).astype(np.int64) for size in (view.rows, view.cols)), indexing="ij")
    row, col = (axis.ravel() for axis in some)
    points = surface.positions(row + row0, col + col0, np.full(row.size, scene.height_range_m[0], np.float32), ground.frame)
    if np.nanmin(_sines(points, centre, to_sun_frame)) > np.sin(np.radians(HIGH_SUN_DEG)):
        return None
    position = surface.points(row0, col0, ground.height_m, ground.frame)
    return _sines(position.reshape(-1, 3), centre, to_sun_frame).reshape(ground.height_m.shape)


@compiled
def _sines(position, centre, to_sun):
    """Sines (n,) of the sun's altitude at points (n, 3)."""
    out = np.empty(len(position))
    for n in range(len(position)):
        x, y, z = position[n, 0] - centre[0], position[n, 1] - centre[1], position[n, 2] - centre[2]
        out[n] = (to_sun[0] * x + to_sun[1] * y + to_sun[2] * z) / np.sqrt(x * x + y * y + z * z)
    return out


def open_sky(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Share of the sky (rows, cols) float32 that a slope leaves by itself: half of it upright, all of it lying flat."""
    return _open_sky(buffer.there, buffer.shading_normal_frame, buffer.position_frame_m, scene.world.up_from(buffer.frame))


@compiled
def _open_sky(there, normal, position, centre):
    out = np.zeros(there.shape, np.float32)
    for i in range(there.shape[0]):
        for j in range(there.shape[1]):
            if there[i, j]:
                n, p = normal[i, j], position[i, j]
                x, y, z = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
                out[i, j] = 0.5 + 0.5 * (n[0] * x + n[1] * y + n[2] * z) / np.sqrt(x * x + y * y + z * z)
    return out


def night_of(scene: Scene) -> float:
    """Sky light of the night, or of a room, as a share of the day's."""
    return LAMP_ROOM_LIGHT if scene.lamps and scene.sun is None else NIGHT_SKY


def albedo_of(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Linear albedo (rows, cols, 3) float32 of a buffer's points, the ground's tint and water included: a new array."""
    low, high = scene.height_range_m
    tint = tint_table() if high > low else np.full((2, 3), LEVEL_ALBEDO)
    albedo = _albedo(buffer.there, buffer.height_m, buffer.albedo, np.float64(low), np.float64(max(high - low, 1.0)), tint)
    if scene.loaded.level.water is not None:
        water = water_in(buffer, scene)
        albedo[water if buffer.albedo is None else water & np.isnan(buffer.albedo[..., 0])] = WATER_ALBEDO
    return albedo


def water_in(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Where (rows, cols) a buffer shows standing water: ground at its height."""
    return (buffer.kind == RELIEF) & (np.abs(buffer.height_m - scene.elevation.water_m) <= SHORE_M)


def srgb_encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB as uint8 of linear display colour in [0, 1]."""
    return _srgb_table()[np.minimum((linear * _SRGB_STEPS).astype(np.int32), _SRGB_STEPS - 1)]


def exposure_of(altitude_deg: float | None) -> float:
    """Exposure for a sun's altitude at the anchor (``None``: no sun, but lamps of its strength): level, lit, white ground
    keeps its brightness.
    """
    if altitude_deg is None:
        return LEVEL_GROUND
    level = np.sin(np.radians(max(altitude_deg, EXPOSURE_FLOOR_DEG))) + SKY_SHARE
    return LEVEL_GROUND / float(level)


def tint_table() -> np.ndarray:
    """The hypsometric tint as linear colours (256, 3) over the level's relief."""
    stops = np.array([stop for stop, _ in TINT])
    colours = np.array([[int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)] for _, text in TINT])
    linear = linear_of_srgb(colours)
    shares = np.linspace(0.0, 1.0, 256)
    return np.stack([np.interp(shares, stops, linear[:, k]) for k in range(3)], axis=1)


@cached("process", MIB)
def _srgb_table() -> np.ndarray:
    return np.rint(255.0 * srgb_of_linear((np.arange(_SRGB_STEPS) + 0.5) / _SRGB_STEPS)).astype(np.uint8)


@compiled
def dusk_of(sine):
    """Share of the day's sky light for the sine of the sun's altitude: all from 6 degrees on, none below -12 (nautical dusk)."""
    altitude = np.degrees(np.arcsin(min(max(sine, -1.0), 1.0)))
    share = min(max((altitude + 12.0) / 18.0, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@compiled
def _shade(shown, tints, light_here, centre, glow, albedo, sunlight, skylight, lamplight):
    # What is None is decided when this is compiled: each variant holds the code of what it is given alone.
    there, kind, position, height, normal = shown
    low, relief, tint = tints
    has_sun, to_sun, sun, sky, night = light_here
    rows, cols = there.shape
    out = np.zeros((rows, cols, 3), np.float32)
    for i in range(rows):
        for j in range(cols):
            if not there[i, j]:
                continue
            n, p = normal[i, j], position[i, j]
            leaf = glow if kind[i, j] == FOREST else 0.0
            ux, uy, uz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            # Direct light fades in over the first degree of the sun's altitude here.
            sine = (to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz) / length if has_sun else -1.0
            direct = min(max(np.degrees(np.arcsin(min(max(sine, -1.0), 1.0))), 0.0), 1.0) * sunlight[i, j]
            sky_here = night + (1.0 - night) * dusk_of(sine)
            facing = max(n[0] * to_sun[0] + n[1] * to_sun[1] + n[2] * to_sun[2], 0.0)
            facing = (leaf + (1.0 - leaf) * facing) * direct
            if skylight is None:
                seen = 0.5 + 0.5 * (n[0] * ux + n[1] * uy + n[2] * uz) / length
            else:
                seen = skylight[i, j]
            share = min(max((height[i, j] - low) / relief, 0.0), 1.0) * (tint.shape[0] - 1)
            at = min(int(share), tint.shape[0] - 2)
            for k in range(3):
                light = sun[k] * facing + sky[k] * sky_here * seen
                if lamplight is not None:
                    light += lamplight[i, j, k]
                own = tint[at, k] + (tint[at + 1, k] - tint[at, k]) * (share - at)
                if albedo is not None:
                    if np.isfinite(albedo[i, j, 0]):
                        own = albedo[i, j, k]
                shown = own * light
                # A shoulder: slopes that face a low sun keep their tint.
                out[i, j, k] = shown if shown <= 0.5 else 1.0 - 0.25 / shown
    return out


@compiled
def _shade_ground(there, height, normal, sky_share, sunlight, tints, light_here, sines, table, out):
    """``_shade`` of bare ground and ``srgb_encoded`` of that, row by row: in loops that compile to vector instructions, and what is
    looked up in tables between them.
    """
    low, relief, tint = tints
    _, to_sun, sun, sky, night = light_here
    cols = there.shape[1]
    direct, sky_here, facing = np.empty(cols), np.ones(cols), np.empty(cols)
    beyond, at = np.empty(cols), np.empty(cols, np.int32)
    own, step = np.empty(cols), np.empty(cols, np.int32)
    tints_of, rises_of = np.empty((3, len(tint))), np.empty((3, len(tint)))
    for k in range(3):
        for n in range(len(tint) - 1):
            tints_of[k, n], rises_of[k, n] = tint[n, k], tint[n + 1, k] - tint[n, k]
    for i in range(there.shape[0]):
        direct[:] = sunlight[i]
        if sines is not None:
            for j in range(cols):
                sine = sines[i, j]
                direct[j] *= min(max(np.degrees(np.arcsin(min(max(sine, -1.0), 1.0))), 0.0), 1.0)
                sky_here[j] = night + (1.0 - night) * dusk_of(sine)
        _face(normal[i], (to_sun[0], to_sun[1], to_sun[2]), direct, facing)
        _place_in_tint(height[i], low, relief, tint.shape[0], beyond, at)
        for k in range(3):
            _look_up_tint(tints_of[k], rises_of[k], at, beyond, own)
            _srgb_steps_of(own, sun[k], sky[k], facing, sky_here, sky_share[i], table.size, step)
            _look_up_srgb(there[i], step, table, out[i, :, k])


@compiled
def _face(normal, to_sun, direct, out):
    """How much of the direct light falls on ground with normals (n, 3)."""
    for j in range(out.size):
        facing = normal[j, 0] * to_sun[0] + normal[j, 1] * to_sun[1] + normal[j, 2] * to_sun[2]
        out[j] = max(facing, 0.0) * direct[j]


@compiled
def _place_in_tint(height, low, relief, count, beyond, at):
    """The tint of heights: which of ``count`` colours lies below, and by what share of the way to the next they are beyond."""
    for j in range(height.size):
        share = min(max((height[j] - low) / relief, 0.0), 1.0) * (count - 1)
        at[j] = np.int32(min(share, count - 2.0) if share > 0.0 else 0.0)  # any where there is no ground
        beyond[j] = share - at[j]


@compiled
def _look_up_tint(tints, rises, at, beyond, out):
    for j in range(at.size):
        out[j] = tints[at[j]] + rises[at[j]] * beyond[j]


@compiled
def _srgb_steps_of(own, sun, sky, facing, sky_here, sky_share, steps, out):
    """Which of the table's ``steps`` the colour is that ground shows of light, with a shoulder."""
    many = np.float32(steps)
    for j in range(out.size):
        shown = own[j] * (sun * facing[j] + sky * sky_here[j] * sky_share[j])
        linear = np.float32(shown if shown <= 0.5 else 1.0 - 0.25 / shown)
        step = linear * many
        out[j] = min(np.int32(step if step > 0.0 else 0.0), np.int32(steps - 1))


@compiled
def _look_up_srgb(there, step, table, out):
    for j in range(step.size):
        if there[j]:
            out[j] = table[step[j]]


@compiled
def _albedo(there, height, albedo, low, relief, tint):
    rows, cols = there.shape
    out = np.zeros((rows, cols, 3), np.float32)
    for i in range(rows):
        for j in range(cols):
            if not there[i, j]:
                continue
            share = min(max((height[i, j] - low) / relief, 0.0), 1.0) * (tint.shape[0] - 1)
            at = min(int(share), tint.shape[0] - 2)
            for k in range(3):
                out[i, j, k] = tint[at, k] + (tint[at + 1, k] - tint[at, k]) * (share - at)
                if albedo is not None:
                    if np.isfinite(albedo[i, j, 0]):
                        out[i, j, k] = albedo[i, j, k]
    return out
