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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import PagedRelief
from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import CORES, compiled, map_on_cores, run_in_chunks
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
    """Lines of sight from p places towards the same n azimuths, at up to k distances: those of the first place, of the second, ...

    Attributes
    ----------
    distance_m
        (k,): distances along the ground at height 0, the first one 0.
    distance_count
        int (p * n,): number of distances of each line; rows and columns at further distances have no meaning.
    row, col
        (p * n, k): fractional rows and columns on the ground's grid.
    curvature
        (p * n,), 1 / metres: the earth's curvature along each line; 0 in a flat world.
    """

    distance_m: np.ndarray
    distance_count: np.ndarray
    row: np.ndarray
    col: np.ndarray
    curvature: np.ndarray


def sight_lines(ground: PagedRelief, places: Sequence[PointPlace], azimuth_deg: np.ndarray, farthest_m: np.ndarray) -> SightLines:
    """Return the lines of sight from places (p,) towards azimuths (n,) in degrees.

    They reach at least to ``farthest_m`` (p,), or to the edge of the area where the grid's CRS is defined.
    """
    steps = np.ceil(np.log(np.maximum(farthest_m / FIRST_DISTANCE_M, 1.0)) / np.log(DISTANCE_GROWTH))
    counts = np.maximum(steps, 1.0).astype(np.int64) + 2
    if ground.world.is_flat:
        distance = _distances_m(int(counts.max()))
        row, col = _nodes_on_flat_world(ground, places, azimuth_deg, distance)
        curvature = np.zeros(len(row))
    else:
        if len(places) == 1:
            polynomials = _cached_polynomials(ground.world, ground.elevation, ground.grid, places[0], int(counts[0]))
        else:
            polynomials = _sight_line_polynomials(ground.grid, places, counts)
        counts = polynomials.distance_count
        distance = _distances_m(polynomials.coefficients.shape[-1])
        row, col = _interpolated_nodes(polynomials, places, azimuth_deg)
        for n in np.flatnonzero(~polynomials.is_accurate).tolist():
            lines = slice(n * len(azimuth_deg), (n + 1) * len(azimuth_deg))
            (nodes,) = _nodes_on_globe(ground.grid, places[n : n + 1], azimuth_deg, distance)
            row[lines], col[lines] = nodes[..., 0], nodes[..., 1]
        curvature = _curvature_per_m(places, azimuth_deg)
    return SightLines(distance, np.repeat(counts, len(azimuth_deg)), row, col, curvature)


def _distances_m(count: int) -> np.ndarray:
    """Return the first ``count`` distances, metres, at which lines have positions."""
    return np.concatenate([[0.0], FIRST_DISTANCE_M * DISTANCE_GROWTH ** np.arange(count - 1)])


@dataclass(frozen=True, eq=False)
class SightLinePolynomials:
    """Trigonometric polynomials in the azimuth that give the rows and columns of lines of sight from p places at k distances.

    They interpolate between the exact lines at a few azimuths.

    Attributes
    ----------
    coefficients
        (p, 2, 2, m, k): for rows and for columns the real and the imaginary parts of the coefficients, for m harmonics.
    distance_count
        int (p,): number of distances of each place's lines.
    is_accurate
        bool (p,): whether a place's polynomials are accurate between these azimuths.
    """

    coefficients: np.ndarray
    distance_count: np.ndarray
    is_accurate: np.ndarray


@cached("scene", 4 * MIB)
def _cached_polynomials(world: World, elevation: Elevation, grid: Grid, place: PointPlace, count: int) -> SightLinePolynomials:
    """Return the polynomials of one place. They are cached, since a report uses one place several times."""
    return _sight_line_polynomials(grid, [place], np.array([count]))


def _sight_line_polynomials(grid: Grid, places: Sequence[PointPlace], counts: np.ndarray) -> SightLinePolynomials:
    """Return the polynomials for lines of sight from places (p,), each at its own number of distances, ``counts`` (p,).

    Distances beyond the edge of the area where the grid's CRS is defined are left out.
    """
    parts = np.array_split(np.arange(len(places)), min(CORES, len(places)))
    azimuth, distance = np.arange(EXACT_AZIMUTH_COUNT) * (360.0 / EXACT_AZIMUTH_COUNT), _distances_m(int(counts.max()))
    nodes = np.concatenate(
        map_on_cores(lambda part: _nodes_on_globe(grid, [places[n] for n in part], azimuth, distance), parts, len(parts))
    )
    is_missing = ~np.isfinite(nodes).all(axis=(1, 3))
    is_missing |= np.arange(len(distance)) >= counts[:, None]
    counts = np.where(is_missing.any(axis=1), is_missing.argmax(axis=1), len(distance))
    nodes = np.where(np.arange(len(distance))[:, None] < counts[:, None, None, None], nodes, 0.0)
    harmonics = np.fft.rfft(nodes, axis=1) / EXACT_AZIMUTH_COUNT
    ignored = np.abs(harmonics[:, HARMONIC_COUNT:]).max(axis=(1, 2, 3), initial=0.0)
    kept = harmonics[:, :HARMONIC_COUNT].transpose(0, 3, 1, 2)
    is_accurate = ignored * EXACT_AZIMUTH_COUNT < HARMONICS_TOLERANCE_NODES
    return SightLinePolynomials(np.stack([kept.real, kept.imag], axis=2), counts, is_accurate)


def _interpolated_nodes(
    polynomials: SightLinePolynomials, places: Sequence[PointPlace], azimuth_deg: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (p * n, k) of the lines of sight from places (p,) towards azimuths (n,) in degrees."""
    angle = np.radians(azimuth_deg)[:, None] * np.arange(HARMONIC_COUNT)
    weight = np.where(np.arange(HARMONIC_COUNT) > 0, 2.0, 1.0)
    start = np.array([(place.row, place.col) for place in places])
    shape = len(places) * len(azimuth_deg), polynomials.coefficients.shape[-1]
    row, col = np.empty(shape), np.empty(shape)
    run_in_chunks(
        len(places),
        _interpolate_azimuths,
        polynomials.coefficients,
        weight * np.cos(angle),
        weight * np.sin(angle),
        start,
        row,
        col,
    )
    return row, col


def _nodes_on_flat_world(
    ground: PagedRelief, places: Sequence[PointPlace], azimuth_deg: np.ndarray, distance_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (p * n, k) on the grid of a flat world, from places (p,) towards azimuths (n,) at distances (k,)."""
    azimuth = np.radians(azimuth_deg)[:, None]
    units = distance_m / (ground.world.metres_per_unit * ground.grid.step)
    row, col = (np.array(v)[:, None, None] for v in zip(*((place.row, place.col) for place in places), strict=True))
    rows, cols = row - units * np.cos(azimuth) / ground.grid.y_to_x_step_ratio, col + units * np.sin(azimuth)
    return rows.reshape(-1, len(distance_m)), cols.reshape(-1, len(distance_m))


def _nodes_on_globe(grid: Grid, places: Sequence[PointPlace], azimuth_deg: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Return rows and columns (p, n, k, 2) on a grid, from places (p,) towards azimuths (n,) at distances (k,).

    Azimuths are in degrees, distances in metres. The results are NaN where the grid's CRS is not defined.
    """
    shape = len(places), len(azimuth_deg), len(distance_m)
    lon0, lat0, x0, col0 = (
        np.array(v, np.float64)[:, None, None] for v in zip(*((p.lon_deg, p.lat_deg, p.x, p.col) for p in places), strict=True)
    )
    lon, lat, azimuth, distance = (np.broadcast_to(v, shape).ravel() for v in (lon0, lat0, azimuth_deg[:, None], distance_m))
    lon, lat, _ = places[0].ellipsoid.fwd(lon, lat, azimuth, distance)
    x, y = np.asarray(lon).reshape(shape), np.asarray(lat).reshape(shape)
    if not is_longitude_latitude(grid.crs):
        x, y = transformer(LONGITUDE_LATITUDE, grid.crs).transform(x, y)
    if grid.crs.is_geographic:
        x = x0 + (x - x0 + 180.0) % 360.0 - 180.0
    nodes = np.stack([grid.row(y), grid.col(x)], axis=-1)
    if grid.crs.is_geographic:
        nodes[..., 1] += col0 - grid.col(x0)
    return np.where(np.isfinite(nodes), nodes, np.nan)


def _curvature_per_m(places: Sequence[PointPlace], azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the ellipsoid's curvature (p * n,), 1 / metres, at places (p,) in vertical planes with azimuths (n,) in degrees."""
    ellipsoid = places[0].ellipsoid
    latitude = np.radians(np.array([place.lat_deg for place in places], np.float64))[:, None]
    root = 1.0 - ellipsoid.es * np.sin(latitude) ** 2
    meridian, prime_vertical = ellipsoid.a * (1.0 - ellipsoid.es) / root**1.5, ellipsoid.a / root**0.5
    azimuth = np.radians(azimuth_deg)
    return (np.cos(azimuth) ** 2 / meridian + np.sin(azimuth) ** 2 / prime_vertical).ravel()


@compiled
def _interpolate_azimuths(first, last, coefficients, cosine, sine, start, row, col):
    """Write the values of the trigonometric polynomials of the places from ``first`` to ``last`` to ``row`` and ``col`` (p * n, k).

    ``coefficients`` are those of ``SightLinePolynomials``. ``cosine`` and ``sine`` (n, m) are those of the multiples of n azimuths,
    with the weights of the harmonics. At the first distance, the values are the rows and columns ``start`` (p, 2) of the places.
    """
    count, harmonics = cosine.shape
    for p in range(first, last):
        for n in range(count):
            line = p * count + n
            for axis in range(2):
                out = row[line] if axis == 0 else col[line]
                real, imaginary = coefficients[p, axis, 0], coefficients[p, axis, 1]
                for k in range(out.shape[0]):
                    out[k] = real[0, k]
                for m in range(1, harmonics):
                    for k in range(out.shape[0]):
                        out[k] += cosine[n, m] * real[m, k] - sine[n, m] * imaginary[m, k]
                out[0] = start[p, axis]
