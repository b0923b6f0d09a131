"""The irradiation of a block over a period: direct light sun by sun, and the light of the sky from sums.

Direct light counts where the line sweep sees the sun (``skugga.shadows.irradiation.direct``). All other parts are products: the sum
over the suns of light on an open plane, times what a cell sees of the sky or of its horizon. So a sun costs one sweep and one pass
over the block. With 770,000 cells of mountains a sun takes 11 ms on two cores: the sweep 4, its preparation 4, the light 1.

The vertical leans over a wide block: planes are those against the vertical at the block's centre, whose suns serve all cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from skugga.shadows.irradiation.dates import Dates
from skugga.shadows.irradiation.direct import DirectLight
from skugga.shadows.irradiation.light import Part, SkyLight, clear_sky_light, limit_horizon_band, reflected_light, weather_light
from skugga.shadows.irradiation.planes import LEVEL_PLANE, Plane, PlaneNormals, TiltedPlane, normals_of_plane, reflecting_share
from skugga.shadows.irradiation.sky import sky_of_grid, sky_of_planes
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.shadows.irradiation.surfaces import BlockSurfaces, ShadingSurface, block_surfaces
from skugga.shadows.irradiation.weather_records import Weather
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

SUN_PARTS: tuple[Part, ...] = ("beam", "circumsolar")
SKY_PARTS: tuple[Part, ...] = ("sky", "horizon_band", "reflected")
ALL_PARTS: tuple[Part, ...] = ("total", *SUN_PARTS, *SKY_PARTS)

HEIGHT_STEP_M = 50.0
"""Maximum metres between two heights for which light is computed. Between them it is interpolated linearly."""


@dataclass(frozen=True)
class IrradiationRules:
    """What counts as irradiation.

    Attributes
    ----------
    parts
        The parts of the light; each is a value of its own.
    plane
        The plane that receives it.
    albedo
        Albedo of the ground around, 0 to 1.
    linke_turbidity
        Linke's turbidity of the air; ``None``: pvlib's monthly climate.
    step_minutes
        Minutes between two suns.
    transmissivity
        Share of the light that comes through crowns of trees, 0 to 1.
    begin_later_each_day
        Whether the intervals of suns begin later each day (``skugga.shadows.irradiation.suns``).
    """

    parts: tuple[Part, ...] = ("total",)
    plane: Plane = "ground"
    albedo: float = 0.2
    linke_turbidity: float | None = None
    step_minutes: float = 60.0
    transmissivity: float = 0.0
    begin_later_each_day: bool = False


class MonthStore(Protocol):
    """Keeps the direct light of finished months of a block, so that a run can continue after it was stopped."""

    def load(self, month: str) -> np.ndarray | None:
        """Return the array of a month; ``None`` if it is not there."""

    def save(self, month: str, array: np.ndarray) -> None:
        """Keep the array of a month."""


def irradiation(
    scene: Scene,
    view: MapView,
    dates: Dates,
    rules: IrradiationRules,
    on_date: Callable[[], None] = lambda: None,
    store: MonthStore | None = None,
    weather: Weather | None = None,
    surfaces: BlockSurfaces | None = None,
) -> np.ndarray:
    """Return the irradiation of a block's cells, float32 (values, rows, cols), kWh/m2; NaN without ground.

    Parameters
    ----------
    scene, view
        The scene, and the block, with a node in each pixel. Buildings and trees count (``skugga.shadows.irradiation.surfaces``).
    dates
        The dates, and the periods that light is added up over.
    rules
        What counts.
    on_date
        Called as often as there are dates.
    store
        Keeps the months that are finished.
    weather
        The weather; ``None``: a clear sky.
    surfaces
        The surfaces of the block (``block_surfaces``), if they are known.

    Returns
    -------
    np.ndarray
        The periods one after the other, and in each of them the parts.

    Raises
    ------
    InputError
        Years outside of the sun's ephemeris, and dates of which the weather has no record.
    """
    surfaces = surfaces or block_surfaces(scene, view, rules.plane, rules.transmissivity)
    out = np.zeros((len(dates.periods), len(rules.parts), view.rows, view.cols), np.float32)
    shown = np.isfinite(surfaces.height_m)
    out[..., ~shown] = np.nan
    if not shown.any():
        return out.reshape(-1, view.rows, view.cols)
    row, col = view.centre_node
    lon, lat = (float(axis) for axis in scene.world.lon_lat(view.grid.crs, view.grid.x(col), view.grid.y(row)))
    heights_m = _light_heights_m(*scene.height_range_m)
    if weather is None:
        suns = sun_intervals(dates.windows, rules.step_minutes, lon, lat, rules.begin_later_each_day)
        light = clear_sky_light(suns, lon, lat, heights_m, rules.linke_turbidity)
    else:
        heights_m = heights_m[[0, -1]]
        suns, light = weather_light(weather, dates.windows, lon, lat)
    if isinstance(rules.plane, TiltedPlane):
        light = limit_horizon_band(light, suns, rules.plane)
    suns = replace(suns, hours=suns.hours * dates.days_represented(suns.moments))
    height_index = np.interp(np.nan_to_num(surfaces.height_m), heights_m, np.arange(len(heights_m))).astype(np.float32)
    if any(_targets(rules.parts, part) for part in SKY_PARTS):
        factors = _sky_factors(surfaces)
        for period, numbers in enumerate(_numbers_by_period(dates, suns)):
            sums = light_sums_kwh(_selected(light, numbers), suns.hours[numbers], rules.albedo)
            for part in SKY_PARTS:
                if targets := _targets(rules.parts, part):
                    by_height = np.interp(height_index, np.arange(len(heights_m)), sums[part]).astype(np.float32)
                    out[period, targets] += factors[part] * by_height
    lights = _direct_lights(light, rules.parts)
    if lights:
        _add_direct_light(scene, surfaces, height_index, dates, suns, lights, on_date, store, out)
    else:
        for _ in dates.windows:
            on_date()
    return out.reshape(-1, view.rows, view.cols)


def light_sums_kwh(light: SkyLight, hours: np.ndarray, albedo: float) -> dict[Part, np.ndarray]:
    """Return the light of all suns together by part, (heights,) kWh/m2, on the plane on which each part is given.

    These are planes that face the sun for beam and circumsolar light, level ones for the light of the sky, vertical ones for that
    of the horizon's band, and planes that face down for reflected light; ``total`` is all light on a level plane. ``hours`` (n,) is
    how long each sun shines.
    """
    values: dict[Part, np.ndarray] = {
        "total": light.level, "beam": light.beam, "circumsolar": light.circumsolar, "sky": light.isotropic,
        "horizon_band": light.horizon_band, "reflected": reflected_light(light, albedo),
    }  # fmt: skip
    return {part: power @ hours / 1000.0 for part, power in values.items()}


def _targets(parts: tuple[Part, ...], part: Part) -> list[int]:
    """Return the indices of the parts that one part of the light belongs to: itself and the total, where they are asked for."""
    return [number for number, asked in enumerate(parts) if asked in (part, "total")]


def _direct_lights(light: SkyLight, parts: tuple[Part, ...]) -> list[tuple[np.ndarray, list[int]]]:
    """Return the light from the sun's direction, (heights, n), W/m2, with the indices of the parts that it belongs to.

    Beam and circumsolar light that are asked for in the ``total`` alone are computed together.
    """
    if not set(SUN_PARTS) & set(parts):
        return [(light.beam + light.circumsolar, _targets(parts, "total"))] if "total" in parts else []
    lights = [(light.beam, _targets(parts, "beam")), (light.circumsolar, _targets(parts, "circumsolar"))]
    return [(power, targets) for power, targets in lights if targets]


def _selected(light: SkyLight, numbers: np.ndarray) -> SkyLight:
    """Return the light of some suns."""
    return SkyLight(*(getattr(light, name)[:, numbers] for name in ("beam", "circumsolar", "isotropic", "horizon_band", "level")))


def _numbers_by_period(dates: Dates, suns: SunIntervals) -> Iterator[np.ndarray]:
    """Yield the numbers of the suns of each period."""
    period_of = dates.period_numbers(suns.moments)
    for period in range(len(dates.periods)):
        yield np.flatnonzero(period_of == period)


def _sky_factors(surfaces: BlockSurfaces) -> dict[Part, np.ndarray]:
    """Return what the cells see of each part of the light that does not come from the sun's direction, (rows, cols)."""
    totals: dict[Part, np.ndarray] = {part: np.zeros(surfaces.height_m.shape, np.float32) for part in SKY_PARTS}
    for surface in surfaces.shading:
        for part, factor in _factors_behind(surface, surfaces.normals).items():
            totals[part] += np.float32(surface.share) * factor
    return totals


def _factors_behind(surface: ShadingSurface, normals: PlaneNormals) -> dict[Part, np.ndarray]:
    """Return what planes see behind a surface of each part of the light of ``SKY_PARTS``, float32 (rows, cols)."""
    if surface.without_trees is None:
        sky_view, band = sky_of_grid(surface.grid, normals)
        return {"sky": sky_view, "horizon_band": band, "reflected": np.float32(1.0) - sky_view}
    level = normals_of_plane(LEVEL_PLANE, (normals.up.shape[0], normals.up.shape[1]))
    (sky_view, band), (level_sky_view, _) = sky_of_planes(surface.grid, [normals, level])
    if surface.lift_m is not None:
        for factor in (sky_view, band, level_sky_view):
            factor[np.isinf(surface.lift_m)] = 0.0  # no light comes through a crown
    without_trees, _ = sky_of_grid(surface.without_trees, level)
    return {"sky": sky_view, "horizon_band": band, "reflected": reflecting_share(sky_view, level_sky_view, without_trees)}


def _light_heights_m(low_m: float, high_m: float) -> np.ndarray:
    """Return at least two evenly spaced heights (k,) from the lowest to the highest ground, metres."""
    high_m = max(high_m, low_m + 1.0)
    return np.linspace(low_m, high_m, int(np.ceil((high_m - low_m) / HEIGHT_STEP_M)) + 1)


def _add_direct_light(
    scene: Scene,
    surfaces: BlockSurfaces,
    height_index: np.ndarray,
    dates: Dates,
    suns: SunIntervals,
    lights: list[tuple[np.ndarray, list[int]]],
    on_date: Callable[[], None],
    store: MonthStore | None,
    out: np.ndarray,
) -> None:
    """Add the irradiation from the suns' directions to ``out`` (periods, parts, rows, cols), kWh/m2.

    ``lights`` are those of ``_direct_lights``. Months are computed one after the other. ``store`` keeps those that are finished.
    """
    period_of, date_of = dates.period_numbers(suns.moments), dates.date_numbers(suns.moments)
    direct = DirectLight(scene, surfaces, height_index)
    first_date = first_period = 0
    for month in dates.months():
        numbers_of_month = np.flatnonzero((date_of >= first_date) & (date_of < first_date + len(month.windows)))
        periods = [0] if dates.per == "period" else list(range(first_period, first_period + len(month.periods)))
        first_date, first_period = first_date + len(month.windows), first_period + len(month.periods)
        month_name = f"{month.windows[0].date:%Y-%m}"
        kept = None if store is None else store.load(month_name)
        if kept is None:
            progress = _DateProgress(len(month.windows), len(numbers_of_month), on_date)
            of_periods = [numbers_of_month[period_of[numbers_of_month] == period] for period in periods]
            powers = [power for power, _ in lights]
            kept = np.stack([np.stack(direct.irradiation(suns, powers, numbers, progress.add_sun)) for numbers in of_periods])
            progress.finish()
            if store is not None:
                store.save(month_name, kept)
        else:
            for _ in month.windows:
                on_date()
        for period, of_lights in zip(periods, kept, strict=True):
            for values, (_, targets) in zip(of_lights, lights, strict=True):
                out[period, targets] += values


class _DateProgress:
    """Reports dates while suns are added, in proportion, since suns are not sorted by date."""

    def __init__(self, dates: int, suns: int, on_date: Callable[[], None]) -> None:
        self._dates, self._suns, self._on_date = dates, suns, on_date
        self._reported, self._added = 0, 0

    def add_sun(self) -> None:
        """Count one sun."""
        self._added += 1
        self._report(self._dates * self._added // self._suns)

    def finish(self) -> None:
        """Report the dates that are left."""
        self._report(self._dates)

    def _report(self, count: int) -> None:
        """Report dates up to a count."""
        for _ in range(count - self._reported):
            self._on_date()
        self._reported = max(self._reported, count)
