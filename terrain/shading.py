"""Colour of the visible surface: hypsometric tint, Lambert's law and sky light, in linear light, encoded as sRGB."""

from __future__ import annotations

import numpy as np

from terrain.compiled import compiled
from terrain.geometry import GeometryBuffer
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

_SRGB_STEPS = 4096


def shade(buffer: GeometryBuffer, scene: Scene, visibility: np.ndarray) -> np.ndarray:
    """Colour (rows, cols, 3) uint8, sRGB, of a buffer's points under a sun visibility; black where nothing is there."""
    low, high = scene.height_range_m
    exposure = exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    to_sun = np.zeros(3) if scene.sun is None else buffer.frame.frame_from_earth @ scene.sun.to_sun_earth
    return _shade(
        buffer.there, buffer.height_m, buffer.shading_normal_frame, visibility, to_sun, _up_centre(scene, buffer),
        buffer.position_frame_m, np.float64(low), np.float64(max(high - low, 1.0)), tint_table(),
        np.array(SUNLIGHT) * exposure, np.array(SKYLIGHT) * SKY_SHARE * exposure, _srgb_table(), scene.sun is not None, NIGHT_SKY,
    )  # fmt: skip


def exposure_of(altitude_deg: float | None) -> float:
    """Exposure for a sun's altitude at the anchor (``None``: no sun): level, lit, white ground keeps its brightness."""
    level = np.sin(np.radians(max(-90.0 if altitude_deg is None else altitude_deg, EXPOSURE_FLOOR_DEG))) + SKY_SHARE
    return LEVEL_GROUND / float(level)


def tint_table(steps: int = 256) -> np.ndarray:
    """The hypsometric tint as linear colours (steps, 3) over the level's relief."""
    stops = np.array([stop for stop, _ in TINT])
    colours = np.array([[int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)] for _, text in TINT])
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    at = np.linspace(0.0, 1.0, steps)
    return np.stack([np.interp(at, stops, linear[:, k]) for k in range(3)], axis=1)


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
def _shade(there, height, normal, visibility, to_sun, centre, position, low, relief, tint, sun, sky, srgb, has_sun, night):  # type: ignore[no-untyped-def]
    rows, cols = there.shape
    out = np.zeros((rows, cols, 3), np.uint8)
    last = srgb.size - 1
    for i in range(rows):
        for j in range(cols):
            if not there[i, j]:
                continue
            n = normal[i, j]
            ux, uy, uz = position[i, j, 0] - centre[0], position[i, j, 1] - centre[1], position[i, j, 2] - centre[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            up = (n[0] * ux + n[1] * uy + n[2] * uz) / length
            # Direct light fades in over the first degree of the sun's altitude here, sky light from nautical dusk (-12) to 6.
            sine = (to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz) / length
            altitude = np.degrees(np.arcsin(min(max(sine, -1.0), 1.0))) if has_sun else -90.0
            direct = min(max(altitude, 0.0), 1.0) * visibility[i, j]
            dusk = min(max((altitude + 12.0) / 18.0, 0.0), 1.0)
            sky_here = night + (1.0 - night) * dusk * dusk * (3.0 - 2.0 * dusk)
            facing = max(n[0] * to_sun[0] + n[1] * to_sun[1] + n[2] * to_sun[2], 0.0) * direct
            share = min(max((height[i, j] - low) / relief, 0.0), 1.0) * (tint.shape[0] - 1)
            at = min(int(share), tint.shape[0] - 2)
            for k in range(3):
                albedo = tint[at, k] + (tint[at + 1, k] - tint[at, k]) * (share - at)
                light = albedo * (sun[k] * facing + sky[k] * sky_here * (0.5 + 0.5 * up))
                shown = light if light <= 0.5 else 1.0 - 0.25 / light  # a shoulder: slopes that face a low sun keep their tint
                out[i, j, k] = srgb[min(int(shown * srgb.size), last)]
    return out
