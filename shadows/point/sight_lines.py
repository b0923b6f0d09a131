"""Lines of sight from a point: their positions on the ground's grid, and the earth's curvature along them.

A line is the geodesic of its azimuth on the ellipsoid. It leaves the vertical plane by up to 14 mm in 100 km. It drops below the
tangent plane like a circle with the ellipsoid's radius in that azimuth (Euler's formula, 1/R = cos^2 A / M + sin^2 A / N). After
100 km the drop is accurate to 0.1 m, a millionth of a radian (0.04 m at the latitudes from 0 to 80).

The positions on the grid are exact for ``EXACT_AZIMUTH_COUNT`` azimuths and a few distances. Between these azimuths a trigonometric
polynomial interpolates them. Few harmonics suffice, because each one belongs to a further power of the distance divided by the
earth's radius. At a pole of a grid in degrees this fails, and the positions are computed for every azimuth. Between two distances
a line is straight on the grid. Each distance is an eighth larger than the one before. So the error is at most a few
hundred-thousandths of the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import PagedRelief
from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, is_longitude_latitude, transformer
from skugga.terrain.ground.elevation import Elevation

FIRST_DISTANCE_M, DISTANCE_GROWTH = 500.0, 1.125
"""The first distance in metres at which positions of lines are computed, and the factor from one distance to the next."""

EXACT_AZIMUTH_COUNT, HARMONIC_COUNT = 20, 8
"""Number of azimuths with exact positions, and number of harmonics of the polynomial that interpolates between them."""

HARMONICS_TOLERANCE_NODES = 1e-3
"""Tolerance in nodes for the harmonics that the polynomial leaves out. If they exceed it, every line is computed exactly."""


@dataclass(frozen=True, eq=False)
class SightLines:
    """Lines of sight towards n azimuths, at k distances.

    Attributes
    ----------
    azimuth_deg
        (n,), clockwise from true north (in a flat world from grid north).
    distance_m
        (k,): distances along the ground at height 0, the first one 0.
    row, col
        (n, k): fractional rows and columns on the ground's grid.
    curvature
        (n,), 1 / metres: the earth's curvature along each line; 0 in a flat world.
    """

    azimuth_deg: np.ndarray
    distance_m: np.ndarray
    row: np.ndarray
    col: np.ndarray
    curvature: np.ndarray


def sight_lines(ground: PagedRelief, place: PointPlace, azimuth_deg: np.ndarray, farthest_m: float) -> SightLines:
    """Return the lines of sight from a place towards azimuths (n,) in degrees.

    They reach at least to ``farthest_m``, or to the edge of the area where the grid's CRS is defined.
    """
    count = max(int(np.ceil(np.log(max(farthest_m / FIRST_DISTANCE_M, 1.0)) / np.log(DISTANCE_GROWTH))), 1)
    distance = np.concatenate([[0.0], FIRST_DISTANCE_M * DISTANCE_GROWTH ** np.arange(count + 1)])
    if ground.world.is_flat:
        row, col = _nodes_on_flat_world(ground, place, azimuth_deg, distance)
        return SightLines(azimuth_deg, distance, row, col, np.zeros(len(azimuth_deg)))
    polynomials = _sight_line_polynomials(ground.world, ground.elevation, ground.grid, place, count)
    distance = distance[: polynomials.real_coefficients.shape[1] // 2]
    if polynomials.is_accurate:
        nodes = _interpolate_azimuths(
            polynomials.real_coefficients, polynomials.imaginary_coefficients, np.radians(azimuth_deg)
        ).reshape(-1, len(distance), 2)
        nodes[:, 0] = place.row, place.col
    else:
        nodes = _nodes_on_globe(ground.grid, place, azimuth_deg, distance)
    return SightLines(azimuth_deg, distance, nodes[..., 0].copy(), nodes[..., 1].copy(), _curvature_per_m(place, azimuth_deg))


@dataclass(frozen=True, eq=False)
class SightLinePolynomials:
    """Trigonometric polynomials in the azimuth that give the rows and columns of lines of sight at k distances.

    They interpolate between the exact lines at a few azimuths.

    Attributes
    ----------
    real_coefficients, imaginary_coefficients
        (m, 2 k): real and imaginary parts of the coefficients, for m harmonics.
    is_accurate
        Whether the polynomials are accurate between these azimuths.
    """

    real_coefficients: np.ndarray
    imaginary_coefficients: np.ndarray
    is_accurate: bool


@cached("scene", 4 * MIB)
def _sight_line_polynomials(world: World, elevation: Elevation, grid: Grid, place: PointPlace, count: int) -> SightLinePolynomials:
    """Return the polynomials for lines of sight from a place, at ``count`` + 2 distances.

    Distances beyond the edge of the area where the grid's CRS is defined are left out. The result is cached, since a report uses
    one place several times.
    """
    distance = np.concatenate([[0.0], FIRST_DISTANCE_M * DISTANCE_GROWTH ** np.arange(count + 1)])
    nodes = _nodes_on_globe(grid, place, np.arange(EXACT_AZIMUTH_COUNT) * (360.0 / EXACT_AZIMUTH_COUNT), distance)
    finite = np.isfinite(nodes).all(axis=(0, 2))
    nodes = nodes[:, : int(np.argmin(finite)) if not finite.all() else len(distance)]
    harmonics = np.fft.rfft(nodes, axis=0).reshape(EXACT_AZIMUTH_COUNT // 2 + 1, -1) / EXACT_AZIMUTH_COUNT
    is_smooth = bool(np.abs(harmonics[HARMONIC_COUNT:]).max(initial=0.0) * EXACT_AZIMUTH_COUNT < HARMONICS_TOLERANCE_NODES)
    return SightLinePolynomials(harmonics[:HARMONIC_COUNT].real.copy(), harmonics[:HARMONIC_COUNT].imag.copy(), is_smooth)


def _nodes_on_flat_world(
    ground: PagedRelief, place: PointPlace, azimuth_deg: np.ndarray, distance_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (n, k) on the grid of a flat world, at distances (k,) towards azimuths (n,) in degrees."""
    azimuth = np.radians(azimuth_deg)[:, None]
    units = distance_m / (ground.world.metres_per_unit * ground.grid.step)
    return place.row - units * np.cos(azimuth) / ground.grid.y_to_x_step_ratio, place.col + units * np.sin(azimuth)


def _nodes_on_globe(grid: Grid, place: PointPlace, azimuth_deg: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Return rows and columns (n, k, 2) on a grid, at distances (k,) in metres towards azimuths (n,) in degrees.

    They are NaN where the grid's CRS is not defined.
    """
    azimuth, distance = (v.ravel() for v in np.broadcast_arrays(azimuth_deg[:, None], distance_m))
    lon, lat, _ = place.ellipsoid.fwd(np.full(azimuth.size, place.lon_deg), np.full(azimuth.size, place.lat_deg), azimuth, distance)
    x, y = np.asarray(lon), np.asarray(lat)
    if not is_longitude_latitude(grid.crs):
        x, y = transformer(LONGITUDE_LATITUDE, grid.crs).transform(x, y)
    if grid.crs.is_geographic:
        x = place.x + (x - place.x + 180.0) % 360.0 - 180.0
    row, col = grid.row(y), grid.col(x)
    nodes = np.stack([row, col], axis=-1).reshape(len(azimuth_deg), len(distance_m), 2)
    if grid.crs.is_geographic:
        nodes[..., 1] += place.col - grid.col(place.x)
    return np.where(np.isfinite(nodes), nodes, np.nan)


def _curvature_per_m(place: PointPlace, azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the ellipsoid's curvature (n,), 1 / metres, in vertical planes with azimuths (n,) in degrees."""
    assert place.lat_deg is not None
    a, es = place.ellipsoid.a, place.ellipsoid.es
    root = 1.0 - es * np.sin(np.radians(place.lat_deg)) ** 2
    meridian, prime_vertical = a * (1.0 - es) / root**1.5, a / root**0.5
    azimuth = np.radians(azimuth_deg)
    return np.cos(azimuth) ** 2 / meridian + np.sin(azimuth) ** 2 / prime_vertical


@compiled
def _interpolate_azimuths(real, imaginary, azimuth):
    """Return the values (n, k) of trigonometric polynomials at azimuths (n,) in radians.

    ``real`` and ``imaginary`` (m, k) are the real and the imaginary parts of their coefficients.
    """
    out = np.empty((len(azimuth), real.shape[1]))
    for n in range(len(azimuth)):
        for k in range(real.shape[1]):
            out[n, k] = real[0, k]
        for m in range(1, len(real)):
            cosine, sine = 2.0 * np.cos(m * azimuth[n]), 2.0 * np.sin(m * azimuth[n])
            for k in range(real.shape[1]):
                out[n, k] += cosine * real[m, k] - sine * imaginary[m, k]
    return out
