"""The default sun of a level that names none. It stands low enough for the ground to cast shadows.

- Its azimuth and altitude are those of a real afternoon at the equinox. Beyond 60 degrees of latitude, where that sun stays low or
  below the horizon, they are those of midsummer.
- Its altitude is the slope angle that the share ``SHADED_GROUND_SHARE`` of the ground exceeds, facing away from the sun. These
  steepest slopes lie in shadow, and cast shadows.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.parts import SunSpec

SHADED_GROUND_SHARE = 0.05
"""Share of the ground whose slopes away from the sun are steeper than the sun's rays, and so lie in shadow."""

MIN_SUN_ALTITUDE_DEG, MAX_SUN_ALTITUDE_DEG = 4.0, 35.0
"""Bounds of the sun's altitude. A lower sun at the level's far side covers the map in shadow; a higher one casts little."""

METRES_PER_DEGREE = 111_195.0
"""Metres per degree of a great circle. The sun's altitude falls by a degree over this distance away from it."""

MAX_LEVEL_GROUND_SLOPE_DEG, LEVEL_GROUND_SUN_ALTITUDE_DEG = 0.5, 30.0
"""Slope angle below which ground counts as level, and the sun's altitude over level ground.

Only objects cast shadows on level ground.
"""

HIGH_LATITUDE_DEG, OBLIQUITY_DEG = 60.0, 23.44

MAX_SHARE_OF_NOON_ALTITUDE = 0.9
"""Upper bound of the sun's altitude as a share of its altitude at noon."""

FLAT_WORLD_SUN_AZIMUTH_DEG = 240.0
"""Azimuth for an engineering CRS, which has no latitude: an afternoon's south-west."""


def default_sun(world: World, elevation: Elevation) -> SunSpec:
    """Return the default sun of a level, with azimuth and altitude in whole degrees."""
    azimuth = FLAT_WORLD_SUN_AZIMUTH_DEG
    altitude = LEVEL_GROUND_SUN_ALTITUDE_DEG
    min_deg = MIN_SUN_ALTITUDE_DEG
    for _ in range(2):  # the slopes depend on the azimuth, and the azimuth on the altitude
        steepness_deg = _steep_slope_deg(world, elevation, azimuth)
        altitude = (
            LEVEL_GROUND_SUN_ALTITUDE_DEG
            if steepness_deg < MAX_LEVEL_GROUND_SLOPE_DEG
            else float(np.clip(steepness_deg, min_deg, MAX_SUN_ALTITUDE_DEG))
        )
        if not world.is_flat:
            azimuth, altitude = _afternoon_sun_position(world.anchor_lat_deg, altitude)
            min_deg = min(MIN_SUN_ALTITUDE_DEG + _far_side_distance_deg(world, elevation, azimuth), MAX_SUN_ALTITUDE_DEG)
    return SunSpec(azimuth=round(azimuth) % 360, altitude=round(altitude))


def _afternoon_sun_position(lat_deg: float, altitude_deg: float) -> tuple[float, float]:
    """Return the azimuth and altitude in degrees of the afternoon sun as it passes an altitude.

    The day is the equinox, or midsummer beyond ``HIGH_LATITUDE_DEG``. The returned altitude is at most
    ``MAX_SHARE_OF_NOON_ALTITUDE`` of that day's altitude at noon. The azimuth follows from sin(declination) = sin(lat) sin(alt) +
    cos(lat) cos(alt) cos(azimuth).
    """
    declination_deg = OBLIQUITY_DEG * np.sign(lat_deg) if abs(lat_deg) > HIGH_LATITUDE_DEG else 0.0
    altitude_deg = min(altitude_deg, MAX_SHARE_OF_NOON_ALTITUDE * (90.0 - abs(lat_deg - declination_deg)))
    lat, declination, altitude = np.radians([np.clip(lat_deg, -89.9, 89.9), declination_deg, altitude_deg])
    cosine = (np.sin(declination) - np.sin(lat) * np.sin(altitude)) / (np.cos(lat) * np.cos(altitude))
    return float(360.0 - np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), float(altitude_deg)


def _far_side_distance_deg(world: World, elevation: Elevation, azimuth_deg: float) -> float:
    """Return the distance from the level's centre to its far side along an azimuth, in degrees of a great circle."""
    azimuth = np.radians(azimuth_deg)
    cells = abs(np.sin(azimuth)) * elevation.cols + abs(np.cos(azimuth)) * elevation.rows
    return float(cells * elevation.cell_size_m(world.metres_per_unit) / 2.0 / METRES_PER_DEGREE)


def _steep_slope_deg(world: World, elevation: Elevation, azimuth_deg: float) -> float:
    """Return the slope angle in degrees that ``SHADED_GROUND_SHARE`` of the ground exceeds, facing away from an azimuth.

    Computed from the overview.
    """
    heights = elevation.overview.mean_heights_m
    if min(heights.shape) < 2:
        return 0.0
    cell_m = elevation.cell_size_m(world.metres_per_unit) * 2**elevation.overview.lod
    south, east = np.gradient(heights.astype(np.float64), cell_m)
    azimuth = np.radians(azimuth_deg)
    rise = east * np.sin(azimuth) - south * np.cos(azimuth)  # towards the sun
    valid_rise = rise[np.isfinite(rise)]
    return float(np.degrees(np.arctan(np.quantile(valid_rise, 1.0 - SHADED_GROUND_SHARE)))) if valid_rise.size else 0.0
