"""The irradiation of a block of bare ground over a period: direct light sun by sun, and the light of the sky from sums.

For each sun the line sweep (``skugga.shadows.sweep``) says which cells see it. Its light, and the circumsolar light around it,
count there by the cosine of the angle of incidence. All other parts are products: the sum over the suns of light on an open plane,
times what a cell sees of the sky or of its horizon. So a sun costs one sweep and one pass over the block.

Suns are sorted by the orientation of the sweep's grid, and their light is added up in the order of that grid. The vertical leans
over a wide block: slopes are those against the plane at the block's centre, whose suns serve all cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from skugga.shadows.horizons.block_ground import block_grid, block_plane
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.sky_view import ground_slopes
from skugga.shadows.irradiation.light import SkyLight, clear_sky_light, reflected_light
from skugga.shadows.irradiation.sky import Plane, sky_of_grid
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.shadows.sun_hours.sun_hours import LINES_PER_COLUMN, holds_all_ground, under_clear_sky
from skugga.shadows.sweep.orientation import GridOrientation, copy_in_blocks
from skugga.shadows.sweep.sweep import clearance_of_nodes
from skugga.terrain.casters.reach import find_sun_casters
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.bare_nodes import BareNodes, bare_nodes
from skugga.terrain.geo.daily_windows import DailyWindow
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import Sun, azimuth_and_altitude, direction_enu
from skugga.terrain.scene import Scene

Part = Literal["total", "beam", "circumsolar", "sky", "horizon_band", "reflected"]
"""The parts of irradiation, and their total."""

HEIGHT_STEP_M = 50.0
"""Maximum metres between two heights for which light is computed. Between them it is interpolated linearly."""


@dataclass(frozen=True)
class IrradiationRules:
    """What counts as irradiation.

    Attributes
    ----------
    part
        The part of the light.
    plane
        The plane that receives it.
    albedo
        Albedo of the ground around, 0 to 1.
    linke_turbidity
        Linke's turbidity of the air; ``None``: pvlib's monthly climate.
    step_minutes
        Minutes between two suns.
    """

    part: Part = "total"
    plane: Plane = "ground"
    albedo: float = 0.2
    linke_turbidity: float | None = None
    step_minutes: float = 60.0


def irradiation(
    scene: Scene,
    view: MapView,
    windows: Sequence[DailyWindow],
    rules: IrradiationRules,
    on_day: Callable[[], None] | None = None,
) -> np.ndarray:
    """Return the irradiation of a block's cells under a clear sky, float32 (rows, cols), kWh/m2; NaN without ground.

    ``view`` has a node in each pixel. ``windows`` are those of the dates. ``on_day`` is called as often as there are windows. Only
    ground casts shadows, as the caller checks. Raises ``InputError`` for years outside of the sun's ephemeris.
    """
    nodes = bare_nodes(scene, view, 1)
    out = np.full((view.rows, view.cols), np.nan, np.float32)
    if not nodes.shows_ground.any():
        return out
    row, col = view.centre_node
    lon, lat = scene.world.lon_lat(view.grid.crs, view.grid.x(col), view.grid.y(row))
    suns = sun_intervals(windows, rules.step_minutes, float(lon), float(lat))
    heights_m = _light_heights_m(*scene.height_range_m)
    light = clear_sky_light(suns, float(lon), float(lat), heights_m, rules.linke_turbidity)
    height_index = np.interp(np.nan_to_num(nodes.height_m), heights_m, np.arange(len(heights_m))).astype(np.float32)
    grid = block_grid(scene, view)
    slopes = ground_slopes(grid) if rules.plane == "ground" else _level_slopes(grid)
    total = np.zeros(out.shape, np.float32)
    if rules.part in ("total", "sky", "horizon_band", "reflected"):
        total += _sky_irradiation(grid, slopes, height_index, suns, light, rules)
    if rules.part in ("total", "beam", "circumsolar"):
        total += _sun_irradiation(scene, nodes, slopes, height_index, suns, _direct_light(light, rules.part), len(windows), on_day)
    elif on_day is not None:
        for _ in windows:
            on_day()
    out[nodes.shows_ground] = total[nodes.shows_ground]
    return out


def light_sums_kwh(light: SkyLight, suns: SunIntervals, albedo: float) -> dict[Part, np.ndarray]:
    """Return the light of all suns together by part, (heights,) kWh/m2, on the plane on which each part is given.

    These are planes that face the sun for beam and circumsolar light, level ones for the light of the sky, vertical ones for that
    of the horizon's band, and planes that face down for reflected light; ``total`` is all light on a level plane.
    """
    values: dict[Part, np.ndarray] = {
        "total": light.level, "beam": light.beam, "circumsolar": light.circumsolar, "sky": light.isotropic,
        "horizon_band": light.horizon_band, "reflected": reflected_light(light, albedo),
    }  # fmt: skip
    return {part: power @ suns.hours / 1000.0 for part, power in values.items()}


def _direct_light(light: SkyLight, part: Part) -> np.ndarray:
    """Return the light from the sun's direction that counts in a part, (heights, n), W/m2."""
    if part == "total":
        return light.beam + light.circumsolar
    return light.beam if part == "beam" else light.circumsolar


def _level_slopes(grid: HorizonGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of level planes at a grid's eyes: 0."""
    zeros = np.zeros(grid.eye_heights_m.shape, np.float32)
    return zeros, zeros


def _sky_irradiation(
    grid: HorizonGrid,
    slopes: tuple[np.ndarray, np.ndarray],
    height_index: np.ndarray,
    suns: SunIntervals,
    light: SkyLight,
    rules: IrradiationRules,
) -> np.ndarray:
    """Return the irradiation from the sky, its horizon and the ground around, or that of one of them, (rows, cols), kWh/m2."""
    sky_view, band = sky_of_grid(grid, rules.plane, slopes)
    sums = light_sums_kwh(light, suns, rules.albedo)
    factors: dict[Part, np.ndarray] = {"sky": sky_view, "horizon_band": band, "reflected": np.float32(1.0) - sky_view}
    out = np.zeros(sky_view.shape, np.float32)
    for part, factor in factors.items():
        if rules.part in ("total", part):
            out += factor * np.interp(height_index, np.arange(len(sums[part])), sums[part]).astype(np.float32)
    return out


def _light_heights_m(low_m: float, high_m: float) -> np.ndarray:
    """Return at least two evenly spaced heights (k,) from the lowest to the highest ground, metres."""
    high_m = max(high_m, low_m + 1.0)
    return np.linspace(low_m, high_m, int(np.ceil((high_m - low_m) / HEIGHT_STEP_M)) + 1)


def _sun_irradiation(
    scene: Scene,
    nodes: BareNodes,
    slopes: tuple[np.ndarray, np.ndarray],
    height_index: np.ndarray,
    suns: SunIntervals,
    light: np.ndarray,
    days: int,
    on_day: Callable[[], None] | None,
) -> np.ndarray:
    """Return the irradiation from the suns' directions, float32 (rows, cols), kWh/m2.

    ``light`` (heights, n) is that on planes that face the sun, W/m2.
    """
    scene = under_clear_sky(scene)
    plane = block_plane(scene.world, nodes.view, *nodes.view.centre_node)
    slopes = _slopes_in_plane(slopes, plane.east_north_of_cell_m, scene.world.curvature)
    weights = np.ascontiguousarray((light * suns.hours / 1000.0).T, np.float32)
    has_all_ground = holds_all_ground(scene, nodes.view)
    sums = _TurnedSums(slopes, height_index)
    reported = 0
    for count, number in enumerate(np.argsort(suns.azimuth_deg, kind="stable").tolist(), 1):
        towards = direction_enu(float(suns.azimuth_deg[number]), float(suns.altitude_deg[number]))
        to_sun_earth = plane.earth_from_enu @ towards
        at_anchor = azimuth_and_altitude(to_sun_earth, scene.world.earth_from_anchor)
        lit = replace(scene, sun=Sun(*at_anchor, to_sun_earth, None, float(suns.refraction_deg[number])))
        patches = () if has_all_ground else find_sun_casters(lit, nodes)
        clearance = clearance_of_nodes(nodes, lit, patches, LINES_PER_COLUMN)
        sums.turn(clearance.orientation)
        sums.add(clearance.ray_height_m, clearance.shadow_ray_height_m, towards.astype(np.float32), weights[number])
        while on_day is not None and reported < days * count // len(suns):
            on_day()
            reported += 1
    while on_day is not None and reported < days:
        on_day()
        reported += 1
    return sums.total()


def _slopes_in_plane(
    slopes: tuple[np.ndarray, np.ndarray], east_north_of_cell_m: np.ndarray, curvature_per_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return slopes (rows, cols) to the east and to the north against the plane at a block's centre, float32.

    The level falls away from that plane with the distance from the centre.
    """
    rows, cols = slopes[0].shape
    down, right = np.arange(rows) - (rows - 1) / 2.0, np.arange(cols) - (cols - 1) / 2.0
    out = []
    for slope, (per_row, per_col) in zip(slopes, east_north_of_cell_m, strict=True):
        distance_m = (per_row * down)[:, None] + (per_col * right)[None, :]
        out.append((slope - curvature_per_m * distance_m).astype(np.float32))
    return out[0], out[1]


class _TurnedSums:
    """Sums of direct light over suns, in the order of the sun-aligned grid of the current orientation.

    Sums are over the normals' upward component, by which the total is multiplied once.
    """

    def __init__(self, slopes: tuple[np.ndarray, np.ndarray], height_index: np.ndarray) -> None:
        self._rasters = (*slopes, height_index)
        self._total = np.zeros(height_index.shape, np.float32)
        self._orientation: GridOrientation | None = None
        self._turned: tuple[np.ndarray, ...] = ()
        self._sum = np.empty((0, 0), np.float32)

    def turn(self, orientation: GridOrientation) -> None:
        """Continue in the order of another orientation."""
        if orientation == self._orientation:
            return
        self._flush()
        self._orientation = orientation
        self._turned = tuple(_contiguous(orientation.sun_aligned_view(raster)) for raster in self._rasters)
        self._sum = np.zeros(self._turned[0].shape, np.float32)

    def add(self, ray_height_m: np.ndarray, shadow_ray_height_m: np.ndarray, towards: np.ndarray, weights: np.ndarray) -> None:
        """Add the light of a sun in the direction ``towards`` (east, north, up), whose light at each height is ``weights``."""
        run_in_chunks(
            len(self._sum), _add_direct_light, ray_height_m, shadow_ray_height_m, *self._turned, towards, weights, self._sum
        )

    def total(self) -> np.ndarray:
        """Return the light of all suns, float32 (rows, cols)."""
        self._flush()
        east, north, _ = self._rasters
        out: np.ndarray = self._total / np.sqrt(np.float32(1.0) + east**2 + north**2)
        return out

    def _flush(self) -> None:
        """Add the sum of the current orientation to the total."""
        if self._orientation is not None:
            self._total += self._orientation.grid_order_view(self._sum)
        self._orientation = None


def _contiguous(values: np.ndarray) -> np.ndarray:
    """Return a contiguous copy of values (n, m)."""
    out = np.empty(values.shape, values.dtype)
    copy_in_blocks(values, out)
    return out


@compiled
def _add_direct_light(first, last, ray_height, shadow_ray_height, east, north, height_index, towards, weights, out):
    """Add the light of one sun of rows [first, last) to ``out``, over the upward component of the normals.

    A cell sees the sun if ``ray_height`` is not below ``shadow_ray_height``. ``east`` and ``north`` are slopes, ``towards`` (3,) is
    the direction to the sun in east, north and up. ``weights`` (k,) is its light at heights, whose (fractional) number
    is ``height_index``.
    """
    to_east, to_north, to_up = towards[0], towards[1], towards[2]
    last_step = len(weights) - 2
    for row in range(first, last):
        for col in range(out.shape[1]):
            index = height_index[row, col]
            step = min(int(index), last_step)
            share = index - np.float32(step)
            cosine = max(to_up - east[row, col] * to_east - north[row, col] * to_north, np.float32(0.0))
            power = cosine * (weights[step] + share * (weights[step + 1] - weights[step]))
            out[row, col] += power if ray_height[row, col] >= shadow_ray_height[row, col] else np.float32(0.0)
