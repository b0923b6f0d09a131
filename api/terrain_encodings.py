"""Encodings of heights as colours for 3D clients: Mapbox Terrain-RGB and Terrarium.

Heights are rounded once, half to even, to the nearest code. Resampling such a picture would corrupt it, because the colour bytes
are the digits of a number.
"""

from __future__ import annotations

import numpy as np

MAX_24_BIT_CODE = 2**24 - 1
"""Largest code of three bytes."""


def encode_terrain_rgb(height_m: np.ndarray) -> np.ndarray:
    """Encode heights (rows, cols) as Mapbox Terrain-RGB, uint8 (rows, cols, 3), in steps of 0.1 m from -10,000 m.

    ``height = -10000 + (R * 65536 + G * 256 + B) * 0.1`` (Mapbox, "Terrain-RGB v1"). Heights beyond the range are clamped.
    """
    return _encode_three_bytes((height_m.astype(np.float64) + 10000.0) * 10.0)


def encode_terrarium(height_m: np.ndarray) -> np.ndarray:
    """Encode heights (rows, cols) as Terrarium, uint8 (rows, cols, 3), in steps of 1/256 m from -32,768 m.

    ``height = R * 256 + G + B / 256 - 32768`` (Tilezen, "Terrain tiles formats"). Heights beyond the range are clamped.
    """
    return _encode_three_bytes((height_m.astype(np.float64) + 32768.0) * 256.0)


def _encode_three_bytes(codes: np.ndarray) -> np.ndarray:
    """Return codes (rows, cols), rounded and clamped to 24 bits, as uint8 (rows, cols, 3), the most significant byte first."""
    rounded_codes = np.clip(np.rint(codes), 0, MAX_24_BIT_CODE).astype(np.uint32)
    return np.stack([rounded_codes >> 16, rounded_codes >> 8 & 255, rounded_codes & 255], axis=-1).astype(np.uint8)
