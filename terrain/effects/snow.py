"""Snow cover: a white albedo on ground and roofs that are not too steep, and on the upper sides of tree crowns."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict, pixel_size
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.noise import fractal_at
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.scene import Scene
from skugga.terrain.shading import WATER_HEIGHT_TOLERANCE_M

SNOW_ALBEDO, ROCK_ALBEDO = (0.84, 0.86, 0.90), (0.23, 0.20, 0.17)
"""Linear albedos of settled snow, and of the rock and scree on steep ground."""

MAX_FULL_SNOW_SLOPE_DEG, MIN_BARE_SLOPE_DEG = 38.0, 52.0
"""Slopes below which all snow stays and above which none does. Most avalanches start between 30 and 45 degrees."""

SNOW_EDGE_NOISE_DEG, SNOW_EDGE_NOISE_WAVELENGTH_M, SNOW_OCTAVES, SNOW_SEED = 6.0, 90.0, 3, 29
"""Noise added to the slope, so that the snow's edge is irregular: amplitude in degrees, coarsest wavelength in metres, octaves,
seed.
"""

CROWN_SNOW_SHARE, CROWN_UP_COSINE_RANGE = 0.6, (0.7, 1.1)
"""Maximum share of snow on a crown, and the range over which the share rises from 0 to it.

The range is of the cosine between the crown's normal and the vertical, after noise is added.
"""

CLUMP_NOISE_AMPLITUDE, CLUMP_NOISE_WAVELENGTH_M = 0.3, 0.9
"""Noise added to the cosine between a crown's normal and the vertical: amplitude, and coarsest wavelength in metres.

It leaves twigs visible between clumps of snow.
"""


def apply_snow(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Blend the albedo (rows, cols, 3) of surfaces with that of snow, in place. Ground that is too steep for snow becomes rock."""
    buffer, scene = block.buffer, block.scene
    if not scene.loaded.level.weather.snow:
        return
    _apply_snow_albedo(
        albedo, buffer.shading_inputs, buffer.albedo, scene.world.up_origin(buffer.frame),
        scene.world.anchor_from_frame(buffer.frame),
        scene.elevation.water_m + WATER_HEIGHT_TOLERANCE_M, pixel_size(block),
    )  # fmt: skip


@compiled
def _apply_snow_albedo(albedo, shading_inputs, surface_albedo, up_origin, anchor_from_frame, water_m, size):
    """Blend the albedo (rows, cols, 3) with that of snow, in place. Undraped ground without snow becomes rock.

    ``surface_albedo`` (rows, cols, 3) is NaN where the ground has no imagery; ``None`` if that is everywhere. ``anchor_from_frame``
    is the rotation (3, 3) and the translation (3,) to the anchor's axes, for the noise. Ground below ``water_m`` metres does not
    change. ``size`` is a ``PixelSize``.
    """
    valid, kind, position, height, normal = shading_inputs
    rotation, origin = anchor_from_frame
    eye, tangent, pixel_m = size
    for i in range(valid.shape[0]):
        for j in range(valid.shape[1]):
            if not valid[i, j] or (kind[i, j] == RELIEF and height[i, j] <= water_m):
                continue
            n, p = normal[i, j], position[i, j]
            ux, uy, uz = p[0] - up_origin[0], p[1] - up_origin[1], p[2] - up_origin[2]
            up_cosine = (n[0] * ux + n[1] * uy + n[2] * uz) / np.sqrt(ux * ux + uy * uy + uz * uz)
            away_x, away_y, away_z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
            pixel_width_m = pixel_m + tangent * np.sqrt(away_x * away_x + away_y * away_y + away_z * away_z)
            x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + origin[0]
            y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + origin[1]
            if kind[i, j] == FOREST:
                share = _crown_snow_share(up_cosine, x, y, height[i, j], pixel_width_m)
            else:
                share = _slope_snow_share(np.degrees(np.arccos(min(max(up_cosine, -1.0), 1.0))), x, y, pixel_width_m)
            draped = False
            if surface_albedo is not None:
                draped = np.isfinite(surface_albedo[i, j, 0])
            for k in range(3):
                bare = albedo[i, j, k]
                if kind[i, j] == RELIEF and not draped:
                    bare = ROCK_ALBEDO[k]
                albedo[i, j, k] = bare + (SNOW_ALBEDO[k] - bare) * share


@compiled
def _slope_snow_share(slope_deg, x_m, y_m, pixel_m):
    """Return the share, in [0, 1], of a slope that snow covers.

    ``slope_deg`` is the angle of the slope. (``x_m``, ``y_m``) is its place and ``pixel_m`` the width of pixels, for the noise.
    """
    if MAX_FULL_SNOW_SLOPE_DEG - 2.0 * SNOW_EDGE_NOISE_DEG < slope_deg < MIN_BARE_SLOPE_DEG + 2.0 * SNOW_EDGE_NOISE_DEG:
        slope_deg += SNOW_EDGE_NOISE_DEG * _fading_noise(x_m, y_m, SNOW_EDGE_NOISE_WAVELENGTH_M, pixel_m)
    return 1.0 - smoothstep_value((slope_deg - MAX_FULL_SNOW_SLOPE_DEG) / (MIN_BARE_SLOPE_DEG - MAX_FULL_SNOW_SLOPE_DEG))


@internal
def _crown_snow_share(up_cosine, x_m, y_m, height_m, pixel_m):
    """Return the share, in [0, 1], of snow on a crown at a point where the cosine between normal and vertical is ``up_cosine``.

    (``x_m``, ``y_m``) and ``height_m`` are the point's place and height, and ``pixel_m`` is the width of pixels, for the noise.
    """
    if up_cosine > CROWN_UP_COSINE_RANGE[0] - 2.0 * CLUMP_NOISE_AMPLITUDE:
        up_cosine += CLUMP_NOISE_AMPLITUDE * (
            _fading_noise(x_m, height_m, CLUMP_NOISE_WAVELENGTH_M, pixel_m)
            + _fading_noise(height_m, y_m, CLUMP_NOISE_WAVELENGTH_M, pixel_m)
        )
    return CROWN_SNOW_SHARE * smoothstep_value(
        (up_cosine - CROWN_UP_COSINE_RANGE[0]) / (CROWN_UP_COSINE_RANGE[1] - CROWN_UP_COSINE_RANGE[0])
    )


@internal
def _fading_noise(x_m, y_m, wavelength_m, pixel_m):
    """Return noise of about -1 to 1 at the place (``x_m``, ``y_m``), fixed to the ground, with waves ``wavelength_m`` long.

    It fades out as pixels, which are ``pixel_m`` wide, become as wide as its waves.
    """
    share = min(max(2.0 - 2.0 * pixel_m / wavelength_m, 0.0), 1.0)
    return share * fractal_at(x_m / wavelength_m, y_m / wavelength_m, SNOW_OCTAVES, SNOW_SEED) if share > 0.0 else 0.0


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: ``weather: {snow: true}``.

    Left out: no snow; nothing but water or sky that it could lie on.
    """
    facts = descriptor.facts["snow"]
    if not facts["lies"]:
        return Verdict(False, "the level sets no snow")
    if not facts["on"]:
        return Verdict(False, str(facts["why"]))
    return Verdict(True, f"snow lies on slopes below {MAX_FULL_SNOW_SLOPE_DEG:.0f} to {MIN_BARE_SLOPE_DEG:.0f} degrees")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of snow.

    - ``lies``: whether the level has snow.
    - ``on``: whether any visible surface can carry snow.
    - ``why``: the reason if no surface can; else ``None``.
    """
    level = scene.loaded.level
    reason = None
    if level.water is not None and scene.objects.caster_kinds == ("relief",) and scene.height_range_m[1] <= scene.elevation.water_m:
        reason = f"all ground lies below the water level, {level.water.level:g} m"
    elif coarse_view is not None and len(coarse_view.points_frame_m) == 0 and scene.objects.trees is None:
        reason = "the view shows only sky"
    return {"lies": level.weather.snow, "on": reason is None, "why": reason}


EFFECT = Effect("snow: all of it up to slopes of 38 degrees, none from 52", judge, facts, stage="albedo", apply=apply_snow)
