"""Find a good viewpoint: a perspective view as a person would choose it, by scoring many candidates.

A candidate is scored on a lattice of the level's heights. Rays through some pixels are followed to the ground. The score rises with

* the contrast of light and shadow: the standard deviation of the ground's brightness over the picture;
* the relief: the standard deviation of the ground's heights over its distance;
* the angle between the view and the sun's azimuth: shadows are best seen from the side;
* the view's width: the distance of most ground, with no ground right in front of the eye;
* the share of rays that meet the ground, by a high power: sky, holes and the raster's edge count against a view.

Objects on the ground are ignored. They do not decide a landscape's viewpoint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.geo.sun import Sun
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.parts import PerspectiveSpec

LATTICE_SIDE_NODES = 257
"""Nodes of the lattice along its longer side."""

MAX_SEARCHED_SIDE_M, MAX_SEARCHED_SIDE_CELLS = 60_000.0, 240.0
"""Longest side of the part of a level that is searched, in metres or in cells, whichever is longer.

Beyond that distance air hides the ground. With fewer cells the picture would show single cells.
"""

FOV_DEG, ASPECT_RATIO = 40.0, 1.25
"""Vertical field of view, and the picture's ratio of width to height."""

EYES_PER_SIDE = 12
"""Candidate positions along either side."""

AZIMUTH_COUNT = 16
"""Candidate directions at each position."""
PITCHES_DEG = (14.0, 20.0, 26.0, 33.0)
"""Candidate angles below the horizon."""

EYE_HEIGHT_SHARES = (0.1, 0.15, 0.22)
"""Candidate heights of the eye above the ground, as shares of the shorter side."""

MIN_EYE_HEIGHT_CELLS = 12.0
"""Minimum height of the eye in cells. From nearer, the ground shows no detail."""

RAY_ROWS_COLS = (9, 11)
"""Rows and columns of rays per candidate."""

GROUND_SHARE_EXPONENT = 40.0
"""Power of the share of rays that meet ground in the score. With 2 % of sky the factor is less than a half."""

MIN_WIDE_VIEW_DISTANCE_SHARE = 0.6
"""Median distance of the visible ground from which on a view counts as wide, as a share of the level's shorter side."""

MIN_CLEAR_FOREGROUND_EYE_HEIGHTS = 1.2
"""Distance of the nearest ground from which on the foreground counts as free, in heights of the eye above ground."""

RELIEF_WEIGHT = 0.6
"""Weight of relief relative to that of light and shadow."""

SIDE_LIGHT_WEIGHT = 0.6
"""Share of the score that depends on the angle to the sun's azimuth."""


@dataclass(frozen=True, eq=False)
class _Lattice:
    """A lattice of the level's ground, northern row first.

    Attributes
    ----------
    height_m
        (rows, cols) float64, heights in metres; NaN without ground.
    brightness
        (rows, cols), brightness of each node, 0 to 1.
    step_m
        Distance between nodes in metres.
    points_earth_m
        (rows, cols, 3), earth-fixed points of height 0.
    """

    height_m: np.ndarray
    brightness: np.ndarray
    step_m: float
    points_earth_m: np.ndarray


def find_viewpoint(world: World, elevation: Elevation, sun: Sun | None) -> PerspectiveSpec | None:
    """Return a good perspective view of a level under its sun (``None``: lit from above).

    Returns ``None`` if no candidate shows enough ground.
    """
    lattice = _lattice(world, elevation, sun)
    rows, cols = lattice.height_m.shape
    short_m = (min(rows, cols) - 1) * lattice.step_m
    heights_m = np.maximum(
        np.multiply(EYE_HEIGHT_SHARES, short_m), MIN_EYE_HEIGHT_CELLS * elevation.cell_size_m(world.metres_per_unit)
    )
    row, col = (np.linspace(0.04, 0.96, EYES_PER_SIDE) * (count - 1) for count in (rows, cols))
    eyes = np.stack(np.meshgrid(np.rint(row), np.rint(col), indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int64)
    azimuths = np.radians(np.arange(AZIMUTH_COUNT) * 360.0 / AZIMUTH_COUNT)
    sun_azimuth = np.nan if sun is None else np.radians(sun.azimuth_deg)
    scores = _view_scores(
        lattice.height_m,
        lattice.brightness,
        lattice.step_m,
        eyes,
        np.unique(heights_m),
        azimuths,
        np.radians(PITCHES_DEG),
        sun_azimuth,
    )
    if not scores.max() > 0.0:
        return None
    eye, height, azimuth, pitch = (int(index) for index in np.unravel_index(scores.argmax(), scores.shape))
    eye_m = float(f"{np.unique(heights_m)[height]:.3g}")
    row0, col0 = eyes[eye]
    down = np.radians(PITCHES_DEG[pitch])
    direction = np.array([np.sin(azimuths[azimuth]) * np.cos(down), np.cos(azimuths[azimuth]) * np.cos(down), -np.sin(down)])
    ray_hit = _ray_hit(lattice.height_m, lattice.step_m, row0, col0, lattice.height_m[row0, col0] + eye_m, *direction)
    if not np.isfinite(ray_hit[0]):
        return None
    target = lattice.points_earth_m[int(np.rint(ray_hit[1])), int(np.rint(ray_hit[2]))]
    coordinates = _level_coordinates(world, elevation, np.stack([lattice.points_earth_m[row0, col0], target]))
    return PerspectiveSpec(kind="perspective", eye=(*coordinates[0], eye_m), target=(*coordinates[1], 0.0), fov=FOV_DEG)


def _level_coordinates(world: World, elevation: Elevation, points_earth_m: np.ndarray) -> list[tuple[float, float]]:
    """Return positions in the coordinates of level files: degrees, or metres from the anchor in a flat world.

    Rounded to a tenth of a cell.
    """
    if world.is_flat:
        return [(round(float(east), 2), round(float(north), 2)) for east, north, _ in points_earth_m]
    cell_deg = elevation.cell_size_m(world.metres_per_unit) / 111_320.0
    digits = int(np.clip(np.ceil(-np.log10(cell_deg / 10.0)), 3, 8))
    lon, lat = world.lon_lat(elevation.crs, *world.map_position(elevation.crs, points_earth_m)[:2])
    return [(round(float(x), digits), round(float(y), digits)) for x, y in zip(lon, lat, strict=True)]


def _lattice(world: World, elevation: Elevation, sun: Sun | None) -> _Lattice:
    """Return the lattice of the level, or of its most rugged part where the level is wider than the searched part."""
    cell_m = elevation.cell_size_m(world.metres_per_unit)
    widest_m = max(MAX_SEARCHED_SIDE_M, MAX_SEARCHED_SIDE_CELLS * cell_m)
    row, col = (elevation.rows - 1) / 2, (elevation.cols - 1) / 2
    if max(elevation.rows, elevation.cols) * cell_m > widest_m:
        row, col = _most_rugged_cell(world, elevation, sun, widest_m / cell_m)
    high_m, wide_m = (min((count - 1) * cell_m, widest_m) for count in (elevation.rows, elevation.cols))
    step_m = max(max(high_m, wide_m) / (LATTICE_SIDE_NODES - 1), cell_m)
    rows, cols = (max(int(length / step_m), 1) + 1 for length in (high_m, wide_m))
    x, y = (float(v) for v in elevation.xy(row, col))
    origin, up = world.points_at_zero_height(elevation.crs, np.float64(x), np.float64(y))
    axes = world.earth_from_enu(origin, up)
    north, east = np.meshgrid(
        (np.arange(rows)[::-1] - (rows - 1) / 2) * step_m, (np.arange(cols) - (cols - 1) / 2) * step_m, indexing="ij"
    )
    points = origin + east[..., None] * axes[:, 0] + north[..., None] * axes[:, 1]
    level = max(int(np.log2(max(step_m / cell_m, 1.0))), 0)
    map_x, map_y, _ = world.map_position(elevation.crs, points)
    inside = elevation.covers(map_x, map_y)
    at_row, at_col = elevation.cell_of(map_x, map_y)
    height, valid = elevation.heights_at(level, np.where(inside, at_row, np.nan), np.where(inside, at_col, np.nan))
    height_m = np.where(valid, height, np.nan).astype(np.float64)
    if sun is None:
        light = np.ones_like(height_m)
    else:
        light = _brightness(height_m, step_m, axes.T @ sun.to_sun_earth)
    return _Lattice(height_m, light, step_m, points)


def _most_rugged_cell(world: World, elevation: Elevation, sun: Sun | None, side_cells: float) -> tuple[float, float]:
    """Return the row and column of the centre of the most rugged square with a side of ``side_cells`` cells.

    It is found on the raster's overview. Relief counts for less where the sun stands lower than at the anchor.
    """
    from scipy.ndimage import uniform_filter

    heights, factor = elevation.overview.mean_heights_m.astype(np.float64), 2**elevation.overview.lod
    valid = np.isfinite(heights)
    side = max(round(side_cells / factor), 3)
    share = uniform_filter(valid.astype(np.float64), side, mode="constant")
    filled = np.where(valid, heights, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = uniform_filter(filled, side, mode="constant") / share
        spread = np.sqrt(np.maximum(uniform_filter(filled**2, side, mode="constant") / share - mean**2, 0.0))
    scores = np.where(valid, spread * share**4, -1.0)
    if sun is not None:
        cell_positions = ((np.arange(count) + 0.5) * factor - 0.5 for count in heights.shape)
        _, up = world.points_at_zero_height(elevation.crs, *elevation.xy(*np.meshgrid(*cell_positions, indexing="ij")))
        scores *= np.clip(np.nan_to_num(up @ sun.to_sun_earth) / max(np.sin(np.radians(sun.altitude_deg)), 0.01), 0.0, 1.0)
    row, col = np.unravel_index(scores.argmax(), scores.shape)
    return (float(row) + 0.5) * factor - 0.5, (float(col) + 0.5) * factor - 0.5


def _brightness(height_m: np.ndarray, step_m: float, to_sun: np.ndarray) -> np.ndarray:
    """Return the brightness (rows, cols) of nodes: the cosine of the sun's angle of incidence, 0 in shadow."""
    if min(height_m.shape) < 2 or to_sun[2] <= 0.0:
        return np.zeros_like(height_m)
    south, east = np.gradient(height_m, step_m)
    cosine = (to_sun[2] - east * to_sun[0] + south * to_sun[1]) / np.sqrt(1.0 + east**2 + south**2)
    return np.where(_lit_mask(height_m, step_m, *to_sun), np.clip(np.nan_to_num(cosine), 0.0, 1.0), 0.0)


@compiled
def _ray_hit(height_m, step_m, row, col, z_m, east, north, up):
    """Return where a ray meets the ground: horizontal distance in metres, row and column of the lattice; NaN if it does not.

    The ray starts above the node ``row``, ``col`` at the height ``z_m`` (metres, as those of the lattice). ``east``, ``north``,
    ``up`` are its direction, of any length.
    """
    rows, cols = height_m.shape
    horizontal_length = np.sqrt(east**2 + north**2)
    d_row, d_col, rise = -north / horizontal_length / step_m, east / horizontal_length / step_m, up / horizontal_length
    t = 0.7 * step_m
    while t < 1e7:
        r, c = row + t * d_row, col + t * d_col
        if r < 0.0 or c < 0.0 or r > rows - 1.0 or c > cols - 1.0:
            break
        ground = height_m[int(r + 0.5), int(c + 0.5)]
        if np.isnan(ground):
            break
        if z_m + t * rise <= ground:
            return t, r, c
        t += max(0.7 * step_m, 0.01 * t)
    return np.nan, np.nan, np.nan


@compiled
def _lit_mask(height_m, step_m, east, north, up):
    """Return the mask (rows, cols) of nodes from which a ray towards a distant light meets no ground.

    ``east``, ``north`` and ``up`` are the direction to the light.
    """
    rows, cols = height_m.shape
    out = np.zeros(height_m.shape, np.bool_)
    for i in range(rows):
        for j in range(cols):
            if not np.isnan(height_m[i, j]):
                distance, _, _ = _ray_hit(height_m, step_m, float(i), float(j), height_m[i, j] + 0.02 * step_m, east, north, up)
                out[i, j] = np.isnan(distance)
    return out


@compiled
def _view_scores(height_m, brightness, step_m, eyes, eye_heights_m, azimuths, pitches, sun_azimuth):
    """Return the score of each candidate (eyes, heights, azimuths, pitches); 0 for an unusable one.

    ``eyes`` (n, 2) are rows and columns of nodes, ``eye_heights_m`` heights above the ground there. ``azimuths`` count clockwise
    from north, and ``pitches`` down from the horizon, radians. ``sun_azimuth`` is NaN without a sun.
    """
    rows, cols = RAY_ROWS_COLS
    half_height = np.tan(np.radians(FOV_DEG) / 2.0)
    out = np.zeros((len(eyes), len(eye_heights_m), len(azimuths), len(pitches)))
    hits = np.empty((3, rows * cols))
    for e in range(len(eyes)):
        row, col = eyes[e, 0], eyes[e, 1]
        if np.isnan(height_m[row, col]):
            continue
        for h in range(len(eye_heights_m)):
            z = height_m[row, col] + eye_heights_m[h]
            for a in range(len(azimuths)):
                side_factor = 1.0 - SIDE_LIGHT_WEIGHT
                if not np.isnan(sun_azimuth):
                    side_factor += SIDE_LIGHT_WEIGHT * abs(np.sin(azimuths[a] - sun_azimuth))
                for p in range(len(pitches)):
                    count = 0
                    for i in range(rows):
                        down = half_height * (2.0 * i / (rows - 1) - 1.0)
                        for j in range(cols):
                            right = half_height * ASPECT_RATIO * (2.0 * j / (cols - 1) - 1.0)
                            forward = np.cos(pitches[p]) - down * np.sin(pitches[p])
                            up = -np.sin(pitches[p]) - down * np.cos(pitches[p])
                            east = forward * np.sin(azimuths[a]) + right * np.cos(azimuths[a])
                            north = forward * np.cos(azimuths[a]) - right * np.sin(azimuths[a])
                            t, r, c = _ray_hit(height_m, step_m, float(row), float(col), z, east, north, up)
                            if not np.isnan(t):
                                k, m = int(r + 0.5), int(c + 0.5)
                                hits[0, count], hits[1, count], hits[2, count] = brightness[k, m], height_m[k, m], t
                                count += 1
                    if count > 8:
                        ground_share = count / (rows * cols)
                        median_m = np.median(hits[2, :count])
                        width_factor = np.sqrt(
                            min(median_m / (MIN_WIDE_VIEW_DISTANCE_SHARE * step_m * (min(height_m.shape) - 1.0)), 1.0)
                        )
                        foreground_factor = (
                            min(np.min(hits[2, :count]) / (MIN_CLEAR_FOREGROUND_EYE_HEIGHTS * eye_heights_m[h]), 1.0) ** 2
                        )
                        contrast = np.std(hits[0, :count]) + RELIEF_WEIGHT * np.std(hits[1, :count]) / median_m
                        out[e, h, a, p] = (
                            ground_share**GROUND_SHARE_EXPONENT * side_factor * width_factor * foreground_factor * contrast
                        )
    return out
