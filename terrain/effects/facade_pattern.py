"""Pattern of façades: the albedo of a point on a wall or on a sloped roof, filtered by the pixel's footprint.

A pixel covers a rectangle on the wall. Windows are rectangles that repeat along the wall and upwards, so the covered share is the
product of two overlaps of periodic intervals, without any samples. Along each axis the share goes over to its mean where the period
falls from four pixels to two (the Nyquist limit).

The mean albedo of a wall is the colour of its mesh: the plaster is lighter by what windows, plinth and door make darker. So a
façade goes over into the plain wall with distance.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal
from skugga.terrain.ground.noise import hash_lattice_point, noise_at
from skugga.terrain.meshes.facade_layout import (
    BAY_COUNT,
    BAY_PITCH,
    DOOR_BASE,
    DOOR_CENTRE,
    DOOR_COLOR,
    DOOR_HALF_WIDTH,
    DOOR_TOP,
    FASCIA,
    FIRST_STOREY,
    FRAME,
    FRAME_COLOR,
    GABLE_HALF_WIDTH,
    GABLE_HEAD,
    GABLE_SILL,
    HALF_WIDTH,
    HEAD,
    LENGTH,
    MULLION,
    PLINTH,
    SHUTTER,
    SHUTTER_COLOR,
    SILL,
    SILL_DEPTH,
    STOREY_COUNT,
    STOREY_PITCH,
    TOP,
)

MAX_PERIOD_M = 4.5
"""Longest period of façades for their antialiasing: longer ones fade as this one does."""

MAX_GAIN, MIN_GAIN = 1.5, 0.8
"""Largest and smallest factor of a wall's colours that keeps its mean. The rest of the difference is added."""

GLASS_ALBEDO = (0.030, 0.040, 0.052)
CURTAIN_ALBEDO, CURTAIN_SHARE = 0.11, 0.25
"""Albedo that curtains and blinds add to glass, and their share of windows. All other windows are darker, with the same mean."""

GLASS_REFLECTANCE = 0.08
"""Reflectance of a window's two surfaces at normal incidence. C. Schlick's approximation (1994) raises it towards grazing views."""

SKY_REFLECTION, GROUND_REFLECTION, REFLECTION_TINT = 0.70, 0.25, (0.70, 0.90, 1.15)
"""Light of the sky and of the ground that glass mirrors, as albedos of a surface that would look as bright, and its tint."""

PLINTH_SHARE, PLINTH_ALBEDO = 0.55, 0.07
"""The plinth's albedo: a share of the wall's, and an added grey."""

FASCIA_SHARE, FASCIA_ALBEDO = 0.35, 0.13
SILL_ALBEDO = 0.46

DOOR_FRAME_M, SILL_OVERHANG_M, CROSSBAR_SHARE = 0.08, 0.06, 0.7
"""Width of a door's frame, overhang of sills beside windows, and height of the crossbar in windows as a share of the glass."""

TILE_ROW_M, TILE_WIDTH_M, ROW_SHADOW_SHARE, ROW_CONTRAST, TILE_CONTRAST = 0.36, 0.28, 0.2, 0.45, 0.16
"""Rows and widths of tiles, the share of a row in the shadow of the next one, its contrast, and that between tiles."""

SEAM_PITCH_M, SEAM_SHARE, SEAM_CONTRAST = 0.56, 0.09, 0.4
"""Distance of standing seams, the share of their shadows, and their contrast."""

SHEET_PITCH_M, SHEET_SHARE, SHEET_CONTRAST = 1.05, 0.06, 0.22
"""Width of sheets of felt on flat roofs, the share of their overlaps, and their contrast."""

WEATHER_WAVE_M, WEATHER_CONTRAST = 2.3, 0.12
"""Wavelength and amplitude of lighter and darker patches of a roof."""


@internal
def resolved_share(period, extent):
    """Return the share of a pattern's contrast that remains: 1 if its period spans four pixels' extents, 0 if it spans two."""
    return min(max(min(period, MAX_PERIOD_M) / (2.0 * max(extent, 1e-9)) - 1.0, 0.0), 1.0)


@internal
def overlap_share(x, half, low, high):
    """Return the share of the interval [x - half, x + half] in [low, high]."""
    return max(min(x + half, high) - max(x - half, low), 0.0) / (2.0 * half)


@internal
def period_of(x, period, count):
    """Return the number of whole periods before ``x``, limited to 0 to ``count``, and the rest of ``x`` (0 at these limits)."""
    k = np.floor(x / period)
    if k < 0.0:
        return 0.0, 0.0
    if k >= count:
        return count, 0.0
    return k, x - k * period


@internal
def periodic_share(ends, per_metre, fade, count_per_metre, low, high):
    """Return the share of a pixel in repeated intervals [k * period + low, k * period + high], for k from 0.

    ``fade`` is the contrast to the mean. ``low`` is at least 0 and ``high`` at most the period. ``ends`` are the results of
    ``period_of`` at the pixel's first and last point, ``per_metre`` is 1 by the pixel's extent, and ``count_per_metre`` the mean
    number of intervals per metre.
    """
    first, first_rest, last, last_rest = ends
    width = high - low
    mean = count_per_metre * width
    if fade <= 0.0:
        return mean
    length = (last - first) * width + min(max(last_rest - low, 0.0), width) - min(max(first_rest - low, 0.0), width)
    return mean + fade * (length * per_metre - mean)


@internal
def single_share(x, half, fade, low, high, total):
    """Return the share of [x - half, x + half] in [low, high], with the contrast ``fade`` to its mean over [0, total]."""
    mean = max(min(high, total) - max(low, 0.0), 0.0) / total
    return mean if fade <= 0.0 else mean + fade * (overlap_share(x, half, low, high) - mean)


@internal
def window_shares(u, v, half_u, half_v, fade_u, fade_v, layout, r, bays, storeys):
    """Return the shares of glass, frames, shutters and sills in the windows of ``bays`` bays and ``storeys`` storeys.

    ``u`` and ``v`` count from the first corner of the first bay, and from the floor of its storey.
    """
    pitch, storey, length, top = layout[r, BAY_PITCH], layout[r, STOREY_PITCH], layout[r, LENGTH], layout[r, TOP]
    half_width, frame, mullion, shutter = layout[r, HALF_WIDTH], layout[r, FRAME], layout[r, MULLION], layout[r, SHUTTER]
    sill, head, depth = layout[r, SILL], layout[r, HEAD], layout[r, SILL_DEPTH]
    low, high = 0.5 * pitch - half_width, 0.5 * pitch + half_width
    ends_u = (*period_of(u - half_u, pitch, bays), *period_of(u + half_u, pitch, bays))
    ends_v = (*period_of(v - half_v, storey, storeys), *period_of(v + half_v, storey, storeys))
    scale_u, scale_v, mean_u, mean_v = 0.5 / half_u, 0.5 / half_v, bays / length, storeys / top
    outer_u = periodic_share(ends_u, scale_u, fade_u, mean_u, low, high)
    outer_v = periodic_share(ends_v, scale_v, fade_v, mean_v, sill, head)
    inner_u = periodic_share(ends_u, scale_u, fade_u, mean_u, low + frame, high - frame)
    inner_v = periodic_share(ends_v, scale_v, fade_v, mean_v, sill + frame, head - frame)
    if mullion > 0.0:
        inner_u -= periodic_share(ends_u, scale_u, fade_u, mean_u, 0.5 * (pitch - mullion), 0.5 * (pitch + mullion))
        bar = sill + CROSSBAR_SHARE * (head - sill)
        inner_v -= periodic_share(ends_v, scale_v, fade_v, mean_v, bar - 0.4 * mullion, bar + 0.4 * mullion)
    shutters, sills = 0.0, 0.0
    if shutter > 0.0:
        shutters = (periodic_share(ends_u, scale_u, fade_u, mean_u, low - shutter, high + shutter) - outer_u) * outer_v
    if depth > 0.0:
        sills = periodic_share(ends_u, scale_u, fade_u, mean_u, low - SILL_OVERHANG_M, high + SILL_OVERHANG_M)
        sills *= periodic_share(ends_v, scale_v, fade_v, mean_v, sill - depth, sill)
    glass = inner_u * inner_v
    return glass, outer_u * outer_v - glass, shutters, sills


@internal
def write_wall_color(out, wall, u, v, half_u, half_v, fade_u, fade_v, layout, r, colors):
    """Write the albedo (3,) of a wall's point to ``out``, and return the share of glass.

    ``wall`` (3,) is the plaster's albedo, and ``layout[r]`` the wall's layout. ``colors`` are the albedos (n, 3) of frames,
    shutters and doors. The pixel covers ``half_u`` and ``half_v`` to each side; ``fade_u`` and ``fade_v`` are the contrasts along
    both axes.
    """
    frame_colors, shutter_colors, door_colors = colors
    length, top, bays, pitch = layout[r, LENGTH], layout[r, TOP], layout[r, BAY_COUNT], layout[r, BAY_PITCH]
    storey, first_storey = layout[r, STOREY_PITCH], layout[r, FIRST_STOREY]
    glass, frame, shutter, sill, door = 0.0, 0.0, 0.0, 0.0, 0.0
    if bays > 0.0:
        storeys = layout[r, STOREY_COUNT] - first_storey
        glass, frame, shutter, sill = window_shares(
            u, v - first_storey * storey, half_u, half_v, fade_u, fade_v, layout, r, bays, storeys
        )
    plinth = single_share(v, half_v, fade_v, -1e3, layout[r, PLINTH], top)
    half_door, centre = layout[r, DOOR_HALF_WIDTH], layout[r, DOOR_CENTRE]
    if half_door > 0.0:
        base, head = layout[r, DOOR_BASE], layout[r, DOOR_TOP]
        door_u = single_share(u, half_u, fade_u, centre - half_door, centre + half_door, length)
        plinth -= (
            door_u * single_share(v, half_v, fade_v, base, min(layout[r, PLINTH], head), top) if layout[r, PLINTH] > base else 0.0
        )
        outer = door_u * single_share(v, half_v, fade_v, base, head, top)
        inner_u = single_share(u, half_u, fade_u, centre - half_door + DOOR_FRAME_M, centre + half_door - DOOR_FRAME_M, length)
        door = inner_u * single_share(v, half_v, fade_v, base, head - DOOR_FRAME_M, top)
        frame += outer - door
        if bays > 0.0 and first_storey == 0.0:
            first_bay = max(np.floor((centre - half_door) / pitch), 0.0)
            door_bays = min(np.floor((centre + half_door) / pitch), bays - 1.0) - first_bay + 1.0
            removed = window_shares(u - first_bay * pitch, v, half_u, half_v, fade_u, fade_v, layout, r, door_bays, 1.0)
            glass, frame, shutter, sill = glass - removed[0], frame - removed[1], shutter - removed[2], sill - removed[3]
    half_gable = layout[r, GABLE_HALF_WIDTH]
    if half_gable > 0.0 and v > top - half_v:
        border, low, high = layout[r, FRAME], layout[r, GABLE_SILL], layout[r, GABLE_HEAD]
        outer = overlap_share(u, half_u, 0.5 * length - half_gable, 0.5 * length + half_gable) * overlap_share(v, half_v, low, high)
        inner = overlap_share(u, half_u, 0.5 * length - half_gable + border, 0.5 * length + half_gable - border)
        inner *= overlap_share(v, half_v, low + border, high - border)
        contrast = fade_u * fade_v
        glass, frame = glass + contrast * inner, frame + contrast * (outer - inner)
    fascia = single_share(v, half_v, fade_v, top - layout[r, FASCIA], top, top)
    rest = max(1.0 - glass - frame - shutter - sill - door - plinth - fascia, 0.0)
    f, s, d = int(layout[r, FRAME_COLOR]), int(layout[r, SHUTTER_COLOR]), int(layout[r, DOOR_COLOR])
    for k in range(3):
        color = rest * wall[k] + plinth * (PLINTH_SHARE * wall[k] + PLINTH_ALBEDO)
        color += fascia * (FASCIA_SHARE * wall[k] + FASCIA_ALBEDO) + sill * SILL_ALBEDO
        color += glass * GLASS_ALBEDO[k] + frame * frame_colors[f, k] + shutter * shutter_colors[s, k] + door * door_colors[d, k]
        out[k] = color
    return glass


@internal
def glass_variation(u, v, layout, r, seed):
    """Return the albedo that curtains and blinds add to the window at a point, with mean 0 over many windows."""
    i = np.int64(np.floor(u / max(layout[r, BAY_PITCH], 0.1)))
    j = np.int64(np.floor(v / max(layout[r, STOREY_PITCH], 0.1)))
    has_curtain = hash_lattice_point(i, j + 1000 * r, seed) < np.uint32(CURTAIN_SHARE * 2**32)
    return CURTAIN_ALBEDO * ((1.0 if has_curtain else 0.0) - CURTAIN_SHARE)


@internal
def mirrored_light(facing, up_share):
    """Return the light that glass mirrors, as an albedo.

    ``facing`` is the cosine between the line of sight and the wall's normal. ``up_share`` is the vertical component of the
    line of sight, which the reflection in a wall keeps.
    """
    reflectance = GLASS_REFLECTANCE + (1.0 - GLASS_REFLECTANCE) * (1.0 - facing) ** 5
    sky_share = min(max(0.5 + 4.0 * up_share, 0.0), 1.0)
    return reflectance * (GROUND_REFLECTION + (SKY_REFLECTION - GROUND_REFLECTION) * sky_share)


@internal
def line_share(x, extent, period, share):
    """Return the share of a pixel around ``x`` in endless lines that cover the first ``share`` of each period."""
    first, last = (x - 0.5 * extent) / period, (x + 0.5 * extent) / period
    covered = (np.floor(last) - np.floor(first)) * share
    covered += min(last - np.floor(last), share) - min(first - np.floor(first), share)
    return covered * period / extent


@internal
def tile_factor(t, s, extent_t, extent_s, seed):
    """Return the factor of a roof's albedo ``t`` metres along its eaves and ``s`` metres up its slope, under tiles."""
    fade_s, fade_t = resolved_share(TILE_ROW_M, extent_s), resolved_share(TILE_WIDTH_M, extent_t)
    if fade_s <= 0.0:
        return 1.0
    shadow = line_share(s, extent_s, TILE_ROW_M, ROW_SHADOW_SHARE)
    factor = 1.0 - ROW_CONTRAST * fade_s * (shadow - ROW_SHADOW_SHARE)
    if fade_t > 0.0:
        row = np.int64(np.floor(s / TILE_ROW_M))
        column = np.int64(np.floor(t / TILE_WIDTH_M + 0.5 * (row % 2)))
        tone = hash_lattice_point(column, row, seed) / 4294967296.0 - 0.5
        factor += TILE_CONTRAST * fade_s * fade_t * tone
    return factor


@internal
def seam_factor(t, extent_t, pitch, share, contrast):
    """Return the factor of a roof's albedo ``t`` metres along its eaves, under seams that cover a share of each ``pitch``."""
    fade = resolved_share(pitch, extent_t)
    if fade <= 0.0:
        return 1.0
    return 1.0 - contrast * fade * (line_share(t, extent_t, pitch, share) - share)


@internal
def weather_factor(t, s, extent_t, extent_s, seed):
    """Return the factor of lighter and darker patches of a roof."""
    fade = resolved_share(WEATHER_WAVE_M, max(extent_t, extent_s))
    if fade <= 0.0:
        return 1.0
    return 1.0 + WEATHER_CONTRAST * fade * noise_at(t / WEATHER_WAVE_M, s / WEATHER_WAVE_M, seed)
