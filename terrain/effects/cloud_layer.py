"""The layer of clouds: its density anywhere, and where rays meet it.

The clouds are a layer without thickness at a constant height. Their density is fractal noise over metres east and north of the
level's anchor, which drifts with time. Their shadows (``clouds``) and the sky (``sky_clouds``) show the same layer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.noise import OCTAVE_GAIN, noise_at
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.scene import Scene

CLOUD_HEIGHT_M, CLOUD_CLEARANCE_M = 1500.0, 500.0
"""Height of the clouds above the level's mean ground, and their minimum height above its highest ground."""

CLOUD_DRIFT_M_PER_S = (10.0 * np.sin(np.radians(67.5)), 10.0 * np.cos(np.radians(67.5)))
"""East and north components of the clouds' velocity: 10 m/s towards the east-north-east."""

MIN_SUN_ALTITUDE_SINE = np.sin(np.radians(5.0))
"""Lower bound of the sine of the sun's altitude in the projection of points to the layer. Without it shadows would move ever faster
towards sunset.
"""

COARSEST_CLOUD_WAVELENGTH_M, CLOUD_OCTAVES, CLOUD_SEED = 4000.0, 5, 71
"""Wavelength of the coarsest octave, number of octaves, seed. The finest octave has a wavelength of 250 m."""

CLOUD_EDGE_WIDTH = 0.26
"""Difference of the noise between the edge of a cloud and its densest part."""

CLOUD_TRANSMITTANCE = 0.25
"""Transmittance of the densest cloud under a broken sky."""

MAX_NOISE, MAX_NOISE_SLOPE = 0.756, 2.32
"""Upper bounds of the value and of the slope of ``skugga.terrain.ground.noise.noise_at``, over all its gradients."""

MAX_OCTAVE_SUM = MAX_NOISE * (1.0 - OCTAVE_GAIN**CLOUD_OCTAVES) / (1.0 - OCTAVE_GAIN)
"""Upper bound of the sum of all octaves."""

FADE_WAVELENGTH_SHARES = 1 / 16, 1 / 2
"""Pixel sizes, as shares of ``COARSEST_CLOUD_WAVELENGTH_M``, between which clouds fade into their mean density."""


class CloudLayer(NamedTuple):
    """The clouds of a scene.

    Attributes
    ----------
    cloud_cover
        Share of the sky that clouds cover.
    noise_threshold
        Value of the noise in the middle of a cloud's edge.
    max_opacity
        Share of the direct sunlight that the densest cloud blocks.
    height_m
        Height of the layer, metres.
    to_sun_anchor
        Unit vector to the sun (3,), in the anchor's axes.
    up_origin_anchor_m
        Point (3,) from which "up" points away, in the anchor's axes, metres.
    drift_m
        Drift east and north (2,), metres.
    """

    cloud_cover: float
    noise_threshold: float
    max_opacity: float
    height_m: float
    to_sun_anchor: np.ndarray
    up_origin_anchor_m: np.ndarray
    drift_m: np.ndarray


def cloud_layer_of(scene: Scene) -> CloudLayer:
    """Return the clouds of a scene, which must have a sun.

    The transmittance of the densest cloud falls to 0 as the cover approaches 1, so that the transition to an overcast sky is
    continuous.
    """
    world, cover = scene.world, scene.loaded.level.weather.cloud_cover
    anchor_from_earth = world.earth_from_anchor.T
    assert scene.sun is not None
    centre = np.array([0.0, 0.0, -1e12]) if world.is_flat else -anchor_from_earth @ world.anchor_earth_m
    return CloudLayer(
        cover, noise_threshold_of(cover), 1.0 - CLOUD_TRANSMITTANCE * (1.0 - cover**4),
        max(_mean_height_m(scene.elevation) + CLOUD_HEIGHT_M, scene.height_range_m[1] + CLOUD_CLEARANCE_M),
        anchor_from_earth @ scene.sun.to_sun_earth, centre, scene.clock_seconds * np.array(CLOUD_DRIFT_M_PER_S),
    )  # fmt: skip


@cached("scene", MIB)
def _mean_height_m(elevation: Elevation) -> float:
    """Return the mean height of the level's ground, metres."""
    return float(np.nanmean(elevation.overview.mean_heights_m))


def noise_threshold_of(cloud_cover: float) -> float:
    """Return the value that the noise exceeds on the share ``cloud_cover`` of a plane. For 0 and 1 it lies beyond all values."""
    limit = MAX_OCTAVE_SUM + CLOUD_EDGE_WIDTH / 2.0
    shares, values = _noise_distribution()
    return float(np.interp(cloud_cover, [0.0, *shares, 1.0], [limit, *values, -limit]))


@cached("process", 16 * MIB)
def _noise_distribution() -> tuple[np.ndarray, np.ndarray]:
    """Return shares of a plane (n,), and for each the noise value (n,) that is exceeded on that share of the plane.

    They are measured on a square whose side is 195 of the coarsest wavelengths.
    """
    # Steps of the golden ratio have no common period with the lattice.
    values = np.sort(_noise_on_grid(np.arange(256) * 0.76393202250021))[::-1]
    return (np.arange(values.size)[32::64] + 0.5) / values.size, values[32::64]


@compiled
def _noise_on_grid(x):
    """Return the noise (n * n,) at all pairs of the coordinates ``x`` (n,), in units of ``COARSEST_CLOUD_WAVELENGTH_M``."""
    out = np.empty(x.size * x.size)
    for i in range(x.size):
        for j in range(x.size):
            out[i * x.size + j] = cloud_noise(
                x[j] * COARSEST_CLOUD_WAVELENGTH_M, x[i] * COARSEST_CLOUD_WAVELENGTH_M, -np.inf, np.inf
            )
    return out


@compiled
def cloud_noise(x_m, y_m, low, high):
    """Return the sum of the noise's octaves at the place (``x_m``, ``y_m``) in the layer.

    The sum stops early once the remaining octaves cannot change whether it is below ``low`` or above ``high``.
    """
    # The lattice is rotated, and each octave again by the angle of the 3-4-5 triangle, as in ``skugga.terrain.ground.noise``.
    x, y = (0.6 * x_m - 0.8 * y_m) / COARSEST_CLOUD_WAVELENGTH_M, (0.8 * x_m + 0.6 * y_m) / COARSEST_CLOUD_WAVELENGTH_M
    total, amplitude = 0.0, 1.0
    for k in range(CLOUD_OCTAVES):
        total += amplitude * noise_at(x, y, CLOUD_SEED + k)
        amplitude *= OCTAVE_GAIN
        remaining = MAX_OCTAVE_SUM - MAX_NOISE * (1.0 - amplitude) / (1.0 - OCTAVE_GAIN)
        if total + remaining < low or total - remaining > high:
            break
        x, y = 2.0 * (0.8 * x - 0.6 * y) + 17.3, 2.0 * (0.6 * x + 0.8 * y) - 9.1
    return total


@compiled
def density_at(x_m, y_m, noise_threshold):
    """Return the relative cloud density at the place (``x_m``, ``y_m``) in the layer: 0 in gaps, 1 inside clouds.

    ``noise_threshold`` is that of the ``CloudLayer``.
    """
    return density_of_noise(
        cloud_noise(x_m, y_m, noise_threshold - CLOUD_EDGE_WIDTH / 2.0, noise_threshold + CLOUD_EDGE_WIDTH / 2.0), noise_threshold
    )


@compiled
def density_of_noise(noise, noise_threshold):
    """Return the relative cloud density, in [0, 1], for a value of the noise. It is 0.5 at ``noise_threshold``."""
    return smoothstep_value((noise - noise_threshold) / CLOUD_EDGE_WIDTH + 0.5)


@internal
def layer_position(x, y, z, height, layer_height_m, direction, up_origin, drift_m, min_sine):
    """Return the intersection (x, y) of a point's ray with the layer, in metres of the noise.

    These are metres east and north of the anchor, minus the clouds' drift. ``height`` is the point's height, ``layer_height_m``
    that of the layer. ``direction`` (3,) is the ray's unit vector, and ``min_sine`` the lower bound of the sine of its altitude.
    ``up_origin`` and ``drift_m`` are fields of the ``CloudLayer``. All coordinates are in the anchor's axes.
    """
    ux, uy, uz = x - up_origin[0], y - up_origin[1], z - up_origin[2]
    sine = (ux * direction[0] + uy * direction[1] + uz * direction[2]) / np.sqrt(ux * ux + uy * uy + uz * uz)
    distance_m = (layer_height_m - height) / max(sine, min_sine)
    return x + distance_m * direction[0] - drift_m[0], y + distance_m * direction[1] - drift_m[1]


@compiled
def fade_share(pixel_m):
    """Return the share, in [0, 1], of the mean density in the density that pixels ``pixel_m`` metres wide show."""
    return min(
        max(
            (pixel_m / COARSEST_CLOUD_WAVELENGTH_M - FADE_WAVELENGTH_SHARES[0])
            / (FADE_WAVELENGTH_SHARES[1] - FADE_WAVELENGTH_SHARES[0]),
            0.0,
        ),
        1.0,
    )
