"""Materials of buildings: colours of walls and roofs, chosen by a hash of the building's place."""

from __future__ import annotations

import zlib

import numpy as np
from pyproj import CRS

from skugga.terrain.meshes.body import srgb_albedo

WALL_COLORS = ((0.80, 0.76, 0.68), (0.77, 0.76, 0.73), (0.75, 0.66, 0.52), (0.58, 0.40, 0.32), (0.64, 0.63, 0.60))
"""sRGB: plaster, whitewash, ochre, brick, concrete."""

ROOF_COLORS = ((0.57, 0.35, 0.27), (0.48, 0.36, 0.30), (0.38, 0.40, 0.43), (0.44, 0.43, 0.42), (0.56, 0.57, 0.57))
"""sRGB: red and brown tile, slate, felt, zinc."""

ALBEDO_FACTOR_RANGE = (0.92, 1.06)
"""Range of factors that make a building darker or lighter than its material."""


def hash_bits(centre: np.ndarray, crs: CRS) -> int:
    """Return 32 bits that choose a building's materials, a hash of its centre (2,) in a CRS."""
    step = 1e-6 if crs.is_geographic else 0.1
    return zlib.crc32(np.rint(centre / step).astype("<i8").tobytes())


def wall_and_roof_albedo(bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear albedo (3,) of wall and roof of a building that its hash ``bits`` choose."""
    wall, roof = WALL_COLORS[bits % len(WALL_COLORS)], ROOF_COLORS[(bits >> 8) % len(ROOF_COLORS)]
    shade = ALBEDO_FACTOR_RANGE[0] + (ALBEDO_FACTOR_RANGE[1] - ALBEDO_FACTOR_RANGE[0]) * (bits >> 16) / 0xFFFF
    return srgb_albedo(np.array(wall) * shade), srgb_albedo(np.array(roof) * shade)
