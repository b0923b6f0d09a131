"""Lines of sight from a point: where the vertical plane of an azimuth crosses the ground's grid, and how the earth curves away.

A line is the geodesic of its azimuth on the ellipsoid, which leaves the vertical plane by less than a millimetre in 100 km. It
bends away from the tangent plane as the circle of the ellipsoid's radius in that azimuth does (Euler's formula,
1/R = cos^2 A / M + sin^2 A / N): after 100 km that is right to 0.1 m, a ten-millionth of a radian.

Where a line runs on the grid is computed exactly for ``SPOKES`` azimuths and a few distances. Between azimuths it is the
trigonometric polynomial through them: a map's distortion grows with powers of the distance over the earth's radius, one harmonic a
power. Where that does not do, at a pole of a grid in degrees, every azimuth is computed. Between distances a line is straight on
the grid: they grow by an eighth, so that it lies aside by a few hundred-thousandths of its distance at most.
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

FIRST_M, GROWTH = 500.0, 1.125
"""The first distance at which lines are placed, and how these grow."""

SPOKES, HARMONICS = 20, 8
"""Azimuths whose lines are placed exactly, and how many terms those between them have."""

SPOKES_ERROR = 1e-3
"""Nodes by which the highest harmonics may move a line; else each is placed by itself."""


@dataclass(frozen=True, eq=False)
class SightLines:
    """Lines towards n azimuths, at k distances.

    Attributes
    ----------
    azimuth_deg
        (n,) clockwise from true north (in a flat world from grid north).
    distance_m
        (k,) along the ground at height 0, from 0 on.
    row, col
        (n, k) nodes of the ground's grid.
    curvature
        (n,) one over the earth's radius in metres; 0 in a flat world.
    """

    azimuth_deg: np.ndarray
    distance_m: np.ndarray
    row: np.ndarray
    col: np.ndarray
    curvature: np.ndarray


def sight_lines(ground: PagedRelief, place: PointPlace, azimuth_deg: np.ndarray, farthest_m: float) -> SightLines:
    """The lines from a place towards azimuths (n,), up to a distance, or up to where the grid's CRS ends."""
    count = max(int(np.ceil(np.log(max(farthest_m / FIRST_M, 1.0)) / np.log(GROWTH))), 1)
    distance = np.concatenate([[0.0], FIRST_M * GROWTH ** np.arange(count + 1)])
    if ground.world.flat:
        row, col = _flat_nodes(ground, place, azimuth_deg, distance)
        return SightLines(azimuth_deg, distance, row, col, np.zeros(len(azimuth_deg)))
    spokes = _spokes(ground.world, ground.elevation, ground.grid, place, count)
    distance = distance[: spokes.real.shape[1] // 2]
    if spokes.smooth:
        nodes = _between_spokes(spokes.real, spokes.imaginary, np.radians(azimuth_deg)).reshape(-1, len(distance), 2)
        nodes[:, 0] = place.row, place.col
    else:
        nodes = _globe_nodes(ground.grid, place, azimuth_deg, distance)
    return SightLines(azimuth_deg, distance, nodes[..., 0].copy(), nodes[..., 1].copy(), _curvature(place, azimuth_deg))


@dataclass(frozen=True, eq=False)
class Spokes:
    """The trigonometric polynomials (m, 2 k) of rows and columns at k distances, and whether they tell lines between the spokes."""

    real: np.ndarray
    imaginary: np.ndarray
    smooth: bool


@cached("scene", 4 * MIB)
def _spokes(world: World, elevation: Elevation, grid: Grid, place: PointPlace, count: int) -> Spokes:
    """The spokes of a place, as far as the grid's CRS goes; kept, since a report looks from one place several times."""
    distance = np.concatenate([[0.0], FIRST_M * GROWTH ** np.arange(count + 1)])
    nodes = _globe_nodes(grid, place, np.arange(SPOKES) * (360.0 / SPOKES), distance)
    known = np.isfinite(nodes).all(axis=(0, 2))
    nodes = nodes[:, : int(np.argmin(known)) if not known.all() else len(distance)]
    harmonics = np.fft.rfft(nodes, axis=0).reshape(SPOKES // 2 + 1, -1) / SPOKES
    smooth = bool(np.abs(harmonics[HARMONICS:]).max(initial=0.0) * SPOKES < SPOKES_ERROR)
    return Spokes(harmonics[:HARMONICS].real.copy(), harmonics[:HARMONICS].imag.copy(), smooth)


def _flat_nodes(
    ground: PagedRelief, place: PointPlace, azimuth_deg: np.ndarray, distance_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    azimuth = np.radians(azimuth_deg)[:, None]
    units = distance_m / (ground.world.metres_per_unit * ground.grid.step)
    return place.row - units * np.cos(azimuth) / ground.grid.stretch, place.col + units * np.sin(azimuth)


def _globe_nodes(grid: Grid, place: PointPlace, azimuth_deg: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Rows and columns (n, k, 2) at distances (k,) towards azimuths (n,); NaN beyond the end of the grid's CRS."""
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


def _curvature(place: PointPlace, azimuth_deg: np.ndarray) -> np.ndarray:
    """One over the ellipsoid's radius (n,) in vertical planes."""
    assert place.lat_deg is not None
    a, es = place.ellipsoid.a, place.ellipsoid.es
    root = 1.0 - es * np.sin(np.radians(place.lat_deg)) ** 2
    meridian, prime_vertical = a * (1.0 - es) / root**1.5, a / root**0.5
    azimuth = np.radians(azimuth_deg)
    return np.cos(azimuth) ** 2 / meridian + np.sin(azimuth) ** 2 / prime_vertical


@compiled
def _between_spokes(real, imaginary, azimuth):
    """Values (n, k) of trigonometric polynomials with terms (m, k) at azimuths (n,) in radians."""
    out = np.empty((len(azimuth), real.shape[1]))
    for n in range(len(azimuth)):
        for k in range(real.shape[1]):
            out[n, k] = real[0, k]
        for m in range(1, len(real)):
            cosine, sine = 2.0 * np.cos(m * azimuth[n]), 2.0 * np.sin(m * azimuth[n])
            for k in range(real.shape[1]):
                out[n, k] += cosine * real[m, k] - sine * imaginary[m, k]
    return out
