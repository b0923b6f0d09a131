"""The sRGB transfer function. Source: IEC 61966-2-1."""

from __future__ import annotations

import numpy as np


def linear_of_srgb(srgb: np.ndarray) -> np.ndarray:
    """Return linear colour of sRGB in [0, 1]."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_of_linear(linear: np.ndarray) -> np.ndarray:
    """Return sRGB of linear colour. The curve continues beyond 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
