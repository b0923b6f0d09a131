"""Patterns of natural ground for compiled loops, each filtered by the width of a pixel: rows, stripes and noise.

All of them are functions of the position in metres from the level's anchor. Where a pixel is wider than half a period, a pattern
becomes its mean.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal
from skugga.terrain.ground.noise import noise_at, noise_slopes_at


@internal
def shown_share(wavelength_m, pixel_m):
    """Return the share of a wave's amplitude that pixels show: all where it spans four of them, none from two on (Nyquist)."""
    return min(max(wavelength_m / (2.0 * max(pixel_m, 1e-9)) - 1.0, 0.0), 1.0)


@internal
def filtered_noise(x, y, wavelength_m, pixel_m, seed):
    """Return gradient noise of a wavelength at a point, as pixels of a width show it."""
    share = shown_share(wavelength_m, pixel_m)
    return share * noise_at(x / wavelength_m, y / wavelength_m, seed) if share > 0.0 else 0.0


@internal
def sunlit_noise(x, y, wavelength_m, pixel_m, sun_x, sun_y, seed):
    """Return the noise as heights, and how much more than the smooth ground its slopes face the sun.

    (``sun_x``, ``sun_y``) is the horizontal part of the sun's direction along the ground, divided by the cosine to its normal. The
    brightness of a height h above the ground then changes by a share of minus its dot product with h's slope (Blinn 1978,
    "Simulation of wrinkled surfaces", SIGGRAPH 12(3):286-292).
    """
    share = shown_share(wavelength_m, pixel_m)
    if share <= 0.0:
        return 0.0, 0.0
    height, slope_x, slope_y = noise_slopes_at(x / wavelength_m, y / wavelength_m, seed)
    return share * height, -share * (slope_x * sun_x + slope_y * sun_y)


@internal
def sunlit_ridges(x, y, wavelength_m, pixel_m, sun_x, sun_y, seed):
    """Return ``sunlit_noise`` of heights with sharp crests, minus the noise's absolute value. It is about -0.8 to 0."""
    share = shown_share(0.7 * wavelength_m, pixel_m)
    if share <= 0.0:
        return -0.2 * (1.0 - share), 0.0
    height, slope_x, slope_y = noise_slopes_at(x / wavelength_m, y / wavelength_m, seed)
    facing = slope_x * sun_x + slope_y * sun_y
    return -share * abs(height) - 0.2 * (1.0 - share), share * (facing if height > 0.0 else -facing)


@internal
def _covered_by_stripes(position, width):
    """Return the length that stripes of a width, one in each period of length 1, cover from 0 to a position."""
    whole = np.floor(position)
    return whole * width + min(position - whole, width)


@internal
def stripe_share(position_m, period_m, width_m, pixel_m):
    """Return the share of a pixel that parallel stripes cover: an exact box filter over ``pixel_m``."""
    half = 0.5 * max(pixel_m, 1e-3) / period_m
    middle, width = position_m / period_m, width_m / period_m
    return (_covered_by_stripes(middle + half, width) - _covered_by_stripes(middle - half, width)) / (2.0 * half)


@internal
def furrow_light(position_m, period_m, pixel_m, sun_across):
    """Return the brightness of furrows relative to their mean, about -1 to 1.

    Crests are lighter than furrows, and slopes that face the sun lighter than those that face away. ``sun_across`` is the component
    across the furrows of the horizontal direction to the sun, times the cotangent of its altitude.
    """
    share = shown_share(period_m, pixel_m)
    if share <= 0.0:
        return 0.0
    phase = 2.0 * np.pi * (position_m / period_m - np.floor(position_m / period_m))
    return share * (0.4 * np.cos(phase) + 0.5 * sun_across * np.sin(phase))
