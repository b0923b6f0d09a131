"""Heights as colours, for clients that draw terrain in three dimensions: the encodings of Mapbox and of Terrarium.

A height is rounded once, half to even, to the nearest that can be told. Nothing may resample such a picture: its bytes are digits.
"""

from __future__ import annotations

import numpy as np

LARGEST = 2**24 - 1
"""Of three bytes together."""


def terrain_rgb(height_m: np.ndarray) -> np.ndarray:
    """Mapbox Terrain-RGB: heights (rows, cols) as RGB (rows, cols, 3) uint8, in steps of 0.1 m from -10,000 m.

    ``height = -10000 + (R * 65536 + G * 256 + B) * 0.1`` (Mapbox, "Terrain-RGB v1"); heights beyond its ends are the ends.
    """
    return _three_bytes((height_m.astype(np.float64) + 10000.0) * 10.0)


def terrarium(height_m: np.ndarray) -> np.ndarray:
    """Terrarium: heights (rows, cols) as RGB (rows, cols, 3) uint8, in steps of 1/256 m from -32,768 m.

    ``height = R * 256 + G + B / 256 - 32768`` (Tilezen, "Terrain tiles formats"); heights beyond its ends are the ends.
    """
    return _three_bytes((height_m.astype(np.float64) + 32768.0) * 256.0)


def _three_bytes(steps: np.ndarray) -> np.ndarray:
    whole = np.clip(np.rint(steps), 0, LARGEST).astype(np.uint32)
    return np.stack([whole >> 16, whole >> 8 & 255, whole & 255], axis=-1).astype(np.uint8)
