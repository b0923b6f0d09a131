"""The sun of a level that names none: low enough, at its own place, that the ground throws shadows.

It stands where the sun really passes on an afternoon of the equinox; beyond 60 degrees of latitude, where that sun stays low or
below the horizon, on midsummer's. Its height is that of the steeper slopes that fall away from it: what is steeper still lies in
shadow, and throws some.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.parts import SunSpec

STEEPER_SHARE = 0.05
"""Share of the ground that falls away from the sun more steeply than its rays."""

LEAST_DEG, MOST_DEG = 4.0, 35.0
"""A sun lower than this, where it stands lowest over the level, drowns a map in shadow; one above that throws little."""

METRES_PER_DEGREE = 111_195.0
"""Along a great circle: the sun stands lower by a degree so far away from it."""

LEVEL_GROUND_DEG, OVER_LEVEL_GROUND_DEG = 0.5, 30.0
"""Ground with hardly a slope as steep as the first throws no shadow worth a low sun: what stands on it decides."""

HIGH_LATITUDE_DEG, OBLIQUITY_DEG = 60.0, 23.44

BELOW_NOON = 0.9
"""How high the sun may stand, as a share of its height at noon."""

FLAT_WORLD_AZIMUTH_DEG = 240.0
"""An engineering CRS has no latitude: the afternoon's south-west."""


def own_sun(world: World, elevation: Elevation) -> SunSpec:
    """The sun, in whole degrees."""
    azimuth = FLAT_WORLD_AZIMUTH_DEG
    altitude = OVER_LEVEL_GROUND_DEG
    low = LEAST_DEG
    for _ in range(2):  # the slopes that count hang on the azimuth, and that on the altitude
        steep = _steepness_deg(world, elevation, azimuth)
        altitude = OVER_LEVEL_GROUND_DEG if steep < LEVEL_GROUND_DEG else float(np.clip(steep, low, MOST_DEG))
        if not world.flat:
            azimuth, altitude = _afternoon(world.anchor_lat_deg, altitude)
            low = min(LEAST_DEG + _half_way_deg(world, elevation, azimuth), MOST_DEG)
    return SunSpec(azimuth=round(azimuth) % 360, altitude=round(altitude))


def _afternoon(lat_deg: float, altitude_deg: float) -> tuple[float, float]:
    """Azimuth at which the sun reaches an altitude in the afternoon, and that altitude, or less where it stays lower.

    From sin(declination) = sin(lat) sin(alt) + cos(lat) cos(alt) cos(azimuth).
    """
    declination_deg = OBLIQUITY_DEG * np.sign(lat_deg) if abs(lat_deg) > HIGH_LATITUDE_DEG else 0.0
    altitude_deg = min(altitude_deg, BELOW_NOON * (90.0 - abs(lat_deg - declination_deg)))
    lat, declination, altitude = np.radians([np.clip(lat_deg, -89.9, 89.9), declination_deg, altitude_deg])
    cosine = (np.sin(declination) - np.sin(lat) * np.sin(altitude)) / (np.cos(lat) * np.cos(altitude))
    return float(360.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), float(altitude_deg)


def _half_way_deg(world: World, elevation: Elevation, azimuth_deg: float) -> float:
    """How far it is from the level's middle to its far side from an azimuth, degrees of a great circle."""
    azimuth = np.radians(azimuth_deg)
    cells = abs(np.sin(azimuth)) * elevation.cols + abs(np.cos(azimuth)) * elevation.rows
    return float(cells * elevation.cell_size_m(world.metres_per_unit) / 2.0 / METRES_PER_DEGREE)


def _steepness_deg(world: World, elevation: Elevation, azimuth_deg: float) -> float:
    """The slope that ``STEEPER_SHARE`` of the ground exceeds as it falls away from an azimuth, degrees, from the overview."""
    heights = elevation.overview.heights_m
    if min(heights.shape) < 2:
        return 0.0
    cell_m = elevation.cell_size_m(world.metres_per_unit) * 2**elevation.overview.level
    south, east = np.gradient(heights.astype(np.float64), cell_m)
    azimuth = np.radians(azimuth_deg)
    rise = east * np.sin(azimuth) - south * np.cos(azimuth)  # towards the sun
    known = rise[np.isfinite(rise)]
    return float(np.degrees(np.arctan(np.quantile(known, 1.0 - STEEPER_SHARE)))) if known.size else 0.0
