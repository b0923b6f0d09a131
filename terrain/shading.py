"""Colour of the visible surface: hypsometric tint, Lambert's law and sky light, in linear light, encoded as sRGB."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from terrain.camera import PerspectiveView
from terrain.compiled import compiled
from terrain.geometry import GeometryBuffer
from terrain.level import SUN
from terrain.lights import CONE_EDGE
from terrain.scene import Scene

TINT = (
    (0.00, "#8fb07c"),
    (0.18, "#b3c58c"),
    (0.38, "#dcd6a0"),
    (0.58, "#e0c494"),
    (0.78, "#d0a988"),
    (1.00, "#efe6cf"),
)
"""Hypsometric tint: share of the level's relief -> sRGB colour, from humid lowland to bare heights."""

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

SKY_ZENITH, SKY_HORIZON = (0.20, 0.36, 0.66), (0.72, 0.82, 0.92)
"""Linear colours of the day's sky behind a perspective view."""

_SRGB_STEPS = 4096


def shade(buffer: GeometryBuffer, scene: Scene, visibilities: dict[str, np.ndarray]) -> np.ndarray:
    """Linear display colour (rows, cols, 3) float32 in [0, 1] of a buffer's points, given each light's visibility.

    Black where nothing is there; in perspective the sky.
    """
    low, high = scene.height_range_m
    exposure = exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    to_sun = np.zeros(3) if scene.sun is None else buffer.frame.frame_from_earth @ scene.sun.to_sun_earth
    dark = np.zeros(buffer.there.shape, np.float32)
    lamps = [lamp for name, lamp in scene.lamps.items() if name in visibilities]
    night = LAMP_ROOM_LIGHT if lamps and scene.sun is None else NIGHT_SKY
    numbers = np.zeros((len(lamps), 11))
    for row, lamp in zip(numbers, lamps, strict=True):
        position = buffer.frame.frame_from_earth @ (lamp.position_earth_m - buffer.frame.origin_earth_m)
        axis = buffer.frame.frame_from_earth @ lamp.earth_from_lamp[:, 2]
        strength = lamp.intensity * lamp.reference_m**2 * exposure
        rim = np.cos(np.radians([lamp.cutoff_deg, lamp.cutoff_deg * (1.0 - CONE_EDGE)])) if lamp.kind == "spot" else (-2.0, -1.5)
        row[:] = [*position, *axis, *(np.array(lamp.color) * strength), *rim]
    shines = np.stack([visibilities[lamp.name] for lamp in lamps]) if lamps else np.zeros((0, *dark.shape), np.float32)
    albedo = buffer.albedo if buffer.albedo is not None else np.zeros((0, 0, 3), np.float32)
    tint = tint_table() if high > low else np.full((2, 3), LEVEL_ALBEDO)
    linear = _shade(
        buffer.there, buffer.kind, buffer.height_m, buffer.shading_normal_frame, albedo, visibilities.get(SUN, dark), to_sun,
        _up_centre(scene, buffer), buffer.position_frame_m, np.float64(low), np.float64(max(high - low, 1.0)), tint,
        np.array(SUNLIGHT) * exposure, np.array(SKYLIGHT) * SKY_SHARE * exposure, scene.sun is not None, night, numbers, shines,
        LEAF_GLOW,
    )  # fmt: skip
    return linear


def sky(scene: Scene, view: PerspectiveView, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """Linear display colour (n, 3) of the sky in some pixels of a view: paler towards the horizon, dark by night."""
    up = np.array([0.0, 0.0, 1.0]) if scene.world.flat else view.eye_earth_m / np.linalg.norm(view.eye_earth_m)
    altitude = -90.0 if scene.sun is None else scene.sun.altitude_deg
    dusk = float(np.clip((altitude + 12.0) / 18.0, 0.0, 1.0))
    light = 0.02 + 0.98 * dusk * dusk * (3.0 - 2.0 * dusk)
    tangents = np.array([view.col0, view.row0, view.step]) / view.focal_px
    return _sky(rows, cols, tangents, up @ view.earth_from_camera, np.array(SKY_HORIZON) * light, np.array(SKY_ZENITH) * light)


@compiled
def _sky(rows, cols, tangents, up, horizon, zenith):  # type: ignore[no-untyped-def]
    out = np.empty((rows.size, 3), np.float32)
    for n in range(rows.size):
        x, y = tangents[0] + cols[n] * tangents[2], tangents[1] + rows[n] * tangents[2]
        sine = (x * up[0] + y * up[1] + up[2]) / np.sqrt(1.0 + x * x + y * y)
        share = 1.0 - np.exp(-4.0 * max(sine, 0.0))
        for k in range(3):
            out[n, k] = (1.0 - share) * horizon[k] + share * zenith[k]
    return out


def encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB (IEC 61966-2-1) as uint8 of linear display colour in [0, 1]."""
    return _srgb_table()[np.minimum((linear * _SRGB_STEPS).astype(np.int32), _SRGB_STEPS - 1)]


def exposure_of(altitude_deg: float | None) -> float:
    """Exposure for a sun's altitude at the anchor (``None``: no sun, but lamps of its strength): level, lit, white ground
    keeps its brightness.
    """
    if altitude_deg is None:
        return LEVEL_GROUND
    level = np.sin(np.radians(max(altitude_deg, EXPOSURE_FLOOR_DEG))) + SKY_SHARE
    return LEVEL_GROUND / float(level)


def tint_table(steps: int = 256) -> np.ndarray:
    """The hypsometric tint as linear colours (steps, 3) over the level's relief."""
    stops = np.array([stop for stop, _ in TINT])
    colours = np.array([[int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)] for _, text in TINT])
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    at = np.linspace(0.0, 1.0, steps)
    return np.stack([np.interp(at, stops, linear[:, k]) for k in range(3)], axis=1)


@lru_cache(maxsize=1)
def _srgb_table() -> np.ndarray:
    linear = (np.arange(_SRGB_STEPS) + 0.5) / _SRGB_STEPS
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * coded).astype(np.uint8)


def _up_centre(scene: Scene, buffer: GeometryBuffer) -> np.ndarray:
    """The frame point that "up" points away from: the earth's centre, or one far below a flat world."""
    if scene.world.flat:
        return np.array([0.0, 0.0, -1e12])
    return -buffer.frame.frame_from_earth @ buffer.frame.origin_earth_m


@compiled
def _shade(
    there, kind, height, normal, albedo, visibility, to_sun, centre, position, low, relief, tint, sun, sky, has_sun, night,
    lamps, shines, glow,
):  # type: ignore[no-untyped-def]  # fmt: skip
    rows, cols = there.shape
    out = np.zeros((rows, cols, 3), np.float32)
    light = np.empty(3)
    for i in range(rows):
        for j in range(cols):
            if not there[i, j]:
                continue
            n, p = normal[i, j], position[i, j]
            leaf = glow if kind[i, j] == 3 else 0.0
            ux, uy, uz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            up = (n[0] * ux + n[1] * uy + n[2] * uz) / length
            # Direct light fades in over the first degree of the sun's altitude here, sky light from nautical dusk (-12) to 6.
            sine = (to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz) / length
            altitude = np.degrees(np.arcsin(min(max(sine, -1.0), 1.0))) if has_sun else -90.0
            direct = min(max(altitude, 0.0), 1.0) * visibility[i, j]
            dusk = min(max((altitude + 12.0) / 18.0, 0.0), 1.0)
            sky_here = night + (1.0 - night) * dusk * dusk * (3.0 - 2.0 * dusk)
            facing = max(n[0] * to_sun[0] + n[1] * to_sun[1] + n[2] * to_sun[2], 0.0)
            facing = (leaf + (1.0 - leaf) * facing) * direct
            for k in range(3):
                light[k] = sun[k] * facing + sky[k] * sky_here * (0.5 + 0.5 * up)
            for m in range(len(lamps)):
                lamp = lamps[m]
                x, y, z = lamp[0] - p[0], lamp[1] - p[1], lamp[2] - p[2]
                away = np.sqrt(x * x + y * y + z * z)
                if away == 0.0 or shines[m, i, j] == 0.0:
                    continue
                across = max(n[0] * x + n[1] * y + n[2] * z, 0.0) / away
                cosine = -(lamp[3] * x + lamp[4] * y + lamp[5] * z) / away
                rim = min(max((cosine - lamp[9]) / (lamp[10] - lamp[9]), 0.0), 1.0)
                share = (leaf + (1.0 - leaf) * across) * rim * shines[m, i, j] / (away * away)
                for k in range(3):
                    light[k] += lamp[6 + k] * share
            share = min(max((height[i, j] - low) / relief, 0.0), 1.0) * (tint.shape[0] - 1)
            at = min(int(share), tint.shape[0] - 2)
            plain = len(albedo) == 0 or not np.isfinite(albedo[i, j, 0])
            for k in range(3):
                own = tint[at, k] + (tint[at + 1, k] - tint[at, k]) * (share - at) if plain else albedo[i, j, k]
                shown = own * light[k]
                # A shoulder: slopes that face a low sun keep their tint.
                out[i, j, k] = shown if shown <= 0.5 else 1.0 - 0.25 / shown
    return out
