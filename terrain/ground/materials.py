"""Materials of natural ground for compiled loops: the colour of meadows, fields, woods, rock and scree at a point.

Each function returns a linear albedo. Patterns are filtered by the pixel's footprint (``skugga.terrain.ground.patterns``), so from
far away each material has its mean colour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import internal
from skugga.terrain.ground.land_cover import CROP, ICE, MEADOW, ORCHARD, PLOUGHED, RIPE_CROP, ROCK, SCREE, STUBBLE, YARD
from skugga.terrain.ground.noise import noise_at
from skugga.terrain.ground.patterns import filtered_noise, furrow_light, shown_share, stripe_share, sunlit_noise, sunlit_ridges
from skugga.terrain.interpolation_loops import smoothstep_value

COVER_ALBEDOS = (
    (0.26, 0.37, 0.15), (0.175, 0.305, 0.085), (0.50, 0.40, 0.18), (0.44, 0.365, 0.20), (0.215, 0.160, 0.108), (0.24, 0.34, 0.14),
    (0.185, 0.175, 0.095), (0.20, 0.25, 0.105), (0.23, 0.28, 0.13), (0.29, 0.27, 0.245), (0.37, 0.35, 0.32), (0.60, 0.53, 0.39),
    (0.33, 0.26, 0.18), (0.25, 0.33, 0.15), (0.33, 0.32, 0.30), (0.055, 0.105, 0.135), (0.86, 0.89, 0.92),
)  # fmt: skip
"""Mean linear albedo of each class of land cover, in the order of ``skugga.terrain.ground.land_cover``.

They are about 2.5 times those of real ground: the level ground of a picture is exposed like a map's, whose tints are as light.
"""

MEADOW_LUMINANCE, MEADOW_SATURATION, DRY_SATURATION = 0.64, 1.8, 1.3
"""Luminance of a meadow relative to the ramp's tint, and the powers by which green and yellow tints become more saturated."""

PALE_TINT_CHROMA, GREEN_TINT_CHROMA = 0.10, 0.30
"""Chroma (1 minus smallest over largest channel) of tints without vegetation, as ice, and of those that are all meadow."""

MATERIAL_SEED = 131


class Footprint(NamedTuple):
    """A pixel on the ground, and the sun's direction, in the anchor's axes (east, north, up).

    Attributes
    ----------
    x, y, height
        The pixel's centre, metres.
    across, along, vertical
        Widths in metres: across the line of sight, along it, and of the heights within the pixel.
    view_x, view_y
        Horizontal unit vector of the line of sight.
    sun_x, sun_y
        Horizontal part of the sun's direction along the ground, divided by its cosine to the ground's normal, at most 2 long; 0
        without a sun. On level ground it is the cotangent of the sun's altitude.
    """

    x: float
    y: float
    height: float
    across: float
    along: float
    vertical: float
    view_x: float
    view_y: float
    sun_x: float
    sun_y: float


@internal
def scaled(color, factor):
    """Return a colour (3 channels) times a factor."""
    return color[0] * factor, color[1] * factor, color[2] * factor


@internal
def blended(first, second, share):
    """Return the colour a share of the way from ``first`` to ``second``."""
    return (
        first[0] + share * (second[0] - first[0]),
        first[1] + share * (second[1] - first[1]),
        first[2] + share * (second[2] - first[2]),
    )


@internal
def meadow_color(red, green, blue):
    """Return the albedo of a meadow where the ramp has a tint. Pale tints, those of rock and ice, change less or not at all."""
    luminance = max(0.2126 * red + 0.7152 * green + 0.0722 * blue, 1e-6)
    chroma = 1.0 - min(red, green, blue) / max(red, green, blue, 1e-6)
    share = smoothstep_value((chroma - PALE_TINT_CHROMA) / (GREEN_TINT_CHROMA - PALE_TINT_CHROMA))
    greenness = smoothstep_value((green / max(red, 1e-6) - 0.95) / 0.2)
    power = DRY_SATURATION + greenness * (MEADOW_SATURATION - DRY_SATURATION)
    # Near 1, r (1 + (p - 1) (r - 1)) is the power p of a channel's ratio r to the luminance: within 3 % from 0.6 to 1.25.
    scale, slope = MEADOW_LUMINANCE, (power - 1.0) / luminance
    meadow = (
        scale * red * (2.0 - power + slope * red),
        scale * green * (2.0 - power + slope * green),
        scale * blue * (2.0 - power + slope * blue),
    )
    return blended((red, green, blue), meadow, share)


@internal
def rock_color(base, at):
    """Return the albedo of bare rock: beds along the heights, and ridges of all sizes with a side in the sun.

    Beds are noise that is long in the horizontal and short in height. They bend by noise of a larger wavelength.
    """
    bend = 17.0 * filtered_noise(at.x, at.y, 210.0, at.along, MATERIAL_SEED)
    bed, lateral = 0.0, 0.6 * at.x + 0.8 * at.y
    wavelength, amplitude = 97.0, 0.26
    for k in range(5):
        share = shown_share(wavelength, at.vertical)
        if share <= 0.0:
            break
        bed += amplitude * share * noise_at((at.height + bend) / wavelength, lateral / (6.0 * wavelength), MATERIAL_SEED + 1 + k)
        wavelength, amplitude = wavelength / 3.1, amplitude * 0.85
    tone, light, x, y, sun_x, sun_y = 0.0, 0.0, at.x, at.y, at.sun_x, at.sun_y
    wavelength, amplitude = 190.0, 0.30
    for k in range(8):
        if wavelength <= 2.0 * at.along:
            break
        if k < 2:  # long creases would look like seams
            height, facing = sunlit_noise(x, y, wavelength, at.along, sun_x, sun_y, MATERIAL_SEED + 7 + k)
            tone += 0.1 * height
        else:
            height, facing = sunlit_ridges(x, y, wavelength, at.along, sun_x, sun_y, MATERIAL_SEED + 7 + k)
            tone += 0.3 * (height + 0.2)
        light += amplitude * facing
        x, y, sun_x, sun_y = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y, 0.8 * sun_x - 0.6 * sun_y, 0.6 * sun_x + 0.8 * sun_y
        wavelength, amplitude = wavelength / 2.6, amplitude * 0.93
    factor = min(max((1.0 + bed + tone) * (1.0 + min(max(light, -0.75), 0.75)), 0.2), 1.9)
    return base[0] * factor * (1.0 + 0.10 * bed), base[1] * factor, base[2] * factor * (1.0 - 0.14 * bed)


@internal
def scree_color(base, at):
    """Return the albedo of scree: stones of several sizes with a side in the sun."""
    tone, light = 0.0, 0.0
    wavelength = 11.0
    for k in range(6):
        height, facing = sunlit_noise(at.x, at.y, wavelength, at.along, at.sun_x, at.sun_y, MATERIAL_SEED + 20 + k)
        tone += 0.13 * height
        light += 0.16 * facing
        wavelength = wavelength / 2.7
    return scaled(base, min(max(1.0 + tone + light, 0.4), 1.7))


@internal
def field_color(base, cover, at, row_x, row_y, variation):
    """Return the albedo of arable land, with rows along (``row_x``, ``row_y``), tramlines, swaths or furrows.

    ``variation`` from -1 to 1 makes fields of one class differ.
    """
    across_rows = at.view_y * row_x - at.view_x * row_y
    along_rows = at.view_x * row_x + at.view_y * row_y
    pixel = np.sqrt((at.along * across_rows) ** 2 + (at.across * along_rows) ** 2)
    position = at.y * row_x - at.x * row_y
    sun_across = at.sun_y * row_x - at.sun_x * row_y
    if cover == PLOUGHED:
        passes = stripe_share(position, 5.4, 2.7, pixel) - 0.5
        light = furrow_light(position, 0.9, pixel, sun_across)
        clods = filtered_noise(at.x, at.y, 0.31, at.along, MATERIAL_SEED + 30)
        wet = filtered_noise(at.x, at.y, 31.0, at.along, MATERIAL_SEED + 31)
        return scaled(base, 1.0 + 0.14 * variation + 0.16 * passes + 0.5 * light + 0.3 * clods + 0.22 * wet)
    if cover == STUBBLE:
        straw = stripe_share(position, 7.0, 1.6, pixel) - 1.6 / 7.0
        light = furrow_light(position, 0.26, pixel, sun_across)
        tracks = stripe_share(position + 3.0, 14.0, 0.6, pixel) - 0.6 / 14.0
        factor = 1.0 + 0.13 * variation + 0.24 * straw + 0.24 * light - 0.28 * tracks
        return base[0] * factor, base[1] * factor * (1.0 - 0.03 * straw), base[2] * factor * (1.0 + 0.08 * variation)
    # Wheels keep to tramlines, which lie as far apart as a sprayer is wide.
    wheels = stripe_share(position, 24.0, 0.55, pixel) + stripe_share(position - 1.9, 24.0, 0.55, pixel)
    light = furrow_light(position, 0.25, pixel, sun_across)
    if cover == CROP or cover == RIPE_CROP:
        growth = filtered_noise(at.x, at.y, 37.0, at.along, MATERIAL_SEED + 32)
        factor = 1.0 + 0.16 * variation + 0.20 * light + 0.14 * growth
        color = base[0] * factor * (1.0 + 0.12 * variation), base[1] * factor, base[2] * factor
        return blended(color, (0.27, 0.225, 0.15), 0.6 * wheels)
    rows = stripe_share(position, 4.0, 1.1, pixel)  # an orchard
    return blended(base, (0.29, 0.24, 0.16), 0.55 * rows)


@internal
def cover_color(cover, albedos, meadow, at, row_x, row_y, variation):
    """Return the albedo of a class of land cover at a point. ``albedos`` (n, 3) is ``COVER_ALBEDOS``, ``meadow`` the default."""
    base = albedos[cover, 0], albedos[cover, 1], albedos[cover, 2]
    if cover == MEADOW:
        # Hay is cut in swaths; pastures are not.
        swath = 0.0
        if variation > 0.0:
            across_rows = at.view_y * row_x - at.view_x * row_y
            along_rows = at.view_x * row_x + at.view_y * row_y
            pixel = np.sqrt((at.along * across_rows) ** 2 + (at.across * along_rows) ** 2)
            swath = stripe_share(at.y * row_x - at.x * row_y, 6.0, 3.0, pixel) - 0.5
        factor = 1.0 + 0.10 * variation + 0.11 * swath
        return meadow[0] * factor * (1.0 + 0.10 * variation), meadow[1] * factor, meadow[2] * factor * (1.0 + 0.08 * variation)
    if cover == YARD:
        patch = filtered_noise(at.x, at.y, 23.0, at.along, MATERIAL_SEED + 40)
        lawn = 0.5 * (meadow[0] + base[0]), 0.5 * (meadow[1] + base[1]), 0.5 * (meadow[2] + base[2])
        return blended(lawn, (0.34, 0.29, 0.21), min(max(1.2 * patch - 0.25, 0.0), 0.5))
    if cover == CROP or cover == RIPE_CROP or cover == STUBBLE or cover == PLOUGHED or cover == ORCHARD:
        return field_color(base, cover, at, row_x, row_y, variation)
    if cover == ROCK:
        return rock_color(base, at)
    if cover == SCREE:
        return scree_color(base, at)
    if cover == ICE:
        return base
    tone = filtered_noise(at.x, at.y, 9.0, at.along, MATERIAL_SEED + 41)
    tone += filtered_noise(at.x, at.y, 2.3, at.along, MATERIAL_SEED + 42)
    return scaled(base, 1.0 + 0.28 * tone)
