"""The irradiation at a point by month, as a model for JSON and as a table."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, date
from typing import Any

import numpy as np
from pyproj import CRS

from skugga.api.point.irradiation_values import (
    DEFAULT_AZIMUTH_DEG,
    IrradiationSums,
    LossByCause,
    MonthIrradiation,
    PointIrradiationOptions,
    PointIrradiationReport,
    check_plane,
    requested_dates,
    weather_name,
)
from skugga.api.point.report import point_surroundings
from skugga.api.point.values import PointQuery, TrackPoint
from skugga.api.weather_file import weather_of_file
from skugga.shadows.irradiation.at_point import CAUSES, PARTS, PointIrradiation, irradiation_at_point
from skugga.shadows.irradiation.ground_plane import ground_plane
from skugga.shadows.irradiation.light import SkyLight, clear_sky_light, weather_light
from skugga.shadows.irradiation.planes import TiltedPlane
from skugga.shadows.irradiation.suns import SunIntervals, default_step_min, sun_intervals
from skugga.shadows.irradiation.weather import Weather, check_weather_place, missing_weather
from skugga.shadows.point.horizon import Surroundings
from skugga.shadows.point.place import POINT_PARAMETER
from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import Clock, parse_clock
from skugga.terrain.geo.daily_windows import MINUTES_PER_DAY, DailyWindow, windows_between
from skugga.terrain.geo.world import World
from skugga.terrain.scene import Scene

LOST_FIELDS = ("lost_beam", "lost_sky", "lost_reflected")
"""Fields of a report with losses by cause."""

COLUMNS = ("total", *PARTS, "open_sky", *(f"{field}_{cause}" for field in LOST_FIELDS for cause in CAUSES))
"""Columns of a CSV, kWh/m2."""

_COLUMN_NAMES = tuple(f"{column}_kwh_m2" for column in COLUMNS)


def point_irradiation(
    scene: Scene, query: PointQuery, options: PointIrradiationOptions, crs: CRS | None = None
) -> PointIrradiationReport:
    """Return the irradiation at a point of a level. Raises ``InputError``.

    ``crs`` is the CRS of the query's ``lon`` and ``lat``; ``None``: degrees.
    """
    check_plane(options)
    first, last = requested_dates(query, options)
    windows = _windows(scene, query, first, last)
    surroundings = point_surroundings(scene, query, crs)
    place = surroundings.place
    assert place.lon_deg is not None and place.lat_deg is not None  # no windows exist in a flat world
    plane = _requested_plane(surroundings, options)
    suns, light = _suns_and_light(
        tuple(windows), options.step_min or default_step_min(len(windows)), place.lon_deg, place.lat_deg, place.eye_elevation_m,
        options.linke,
        None if options.weather is None else weather_of_file(options.weather, options.weather_columns),
    )  # fmt: skip
    months, month_of_sun = _months(windows, suns)
    result = irradiation_at_point(surroundings, plane, suns, light, month_of_sun, len(months), options.albedo)
    return PointIrradiationReport(
        level=scene.loaded.name, lon=place.lon_deg, lat=place.lat_deg, elevation_m=place.ground_m, height_m=place.height_m,
        first=windows[0].date, last=windows[-1].date, unit="kWh/m2", tilt=plane.tilt_deg, azimuth=plane.azimuth_deg,
        albedo=options.albedo, linke=options.linke, weather=weather_name(options),
        sky_view=result.sky_view, sky_view_of_relief=result.sky_view_of_relief,
        months=tuple(MonthIrradiation(month=month, **_sums(result, np.array([n]))) for n, month in enumerate(months)),
        all_months=IrradiationSums(**_sums(result, np.arange(len(months)))), remark=_remark(result, months),
    )  # fmt: skip


def weather_warnings(scene: Scene, query: PointQuery, options: PointIrradiationOptions) -> tuple[str, ...]:
    """Return warnings of weather that does not fit the place or the dates. Raises ``InputError``."""
    if options.weather is None or scene.world.off_earth_reason is not None:
        return ()
    weather = weather_of_file(options.weather, options.weather_columns)
    lon, lat = scene.world.anchor_lon_deg, scene.world.anchor_lat_deg
    windows = _windows(scene, query, *requested_dates(query, options))
    on_place = check_weather_place(weather, lon, lat, float(np.mean(scene.height_range_m)))
    return (*weather.warnings, *on_place, *missing_weather(weather, windows, lon, lat))


def irradiation_with_remark(scene: Scene, query: PointQuery, options: PointIrradiationOptions) -> PointIrradiationReport:
    """Return the irradiation at a point. For a point outside the level's data, values are null and the remark says why.

    Raises ``InputError``.
    """
    try:
        return point_irradiation(scene, query, options)
    except InputError as error:
        if error.name != POINT_PARAMETER:
            raise
        first, last = requested_dates(query, options)
        return PointIrradiationReport(
            level=scene.loaded.name, lon=query.lon, lat=query.lat, elevation_m=None, height_m=query.height, first=first, last=last,
            unit="kWh/m2", tilt=None, azimuth=None, albedo=options.albedo, linke=options.linke, weather=weather_name(options),
            sky_view=None,
            sky_view_of_relief=None, months=None, all_months=None, remark=f"no ground here. Use {error.allowed}",
        )  # fmt: skip


def irradiation_at_points(
    scene: Scene, points: Sequence[TrackPoint], query: PointQuery, options: PointIrradiationOptions
) -> list[PointIrradiationReport]:
    """Return the irradiation at each of many points. Those outside the level's data have nulls and a remark.

    ``query`` has the dates of all points. Raises ``InputError``.
    """

    def report_of(point: TrackPoint) -> PointIrradiationReport:
        place = {"lon": point.lon_deg, "lat": point.lat_deg, "height": point.height_m}
        return irradiation_with_remark(scene, query.model_copy(update=place), options)

    return [report_of(point) for point in points]


def named_sums(report: PointIrradiationReport) -> list[tuple[str, IrradiationSums]]:
    """Return the months of a report with their names; the sums of all months, ``all``, are last."""
    if report.months is None or report.all_months is None:
        return []
    return [*((month.month, month) for month in report.months), ("all", report.all_months)]


def csv_text(report: PointIrradiationReport) -> str:
    """Return a report as a CSV with a row for each month and one for all months."""
    header = ",".join(["month", *_COLUMN_NAMES])
    return "\n".join([header, *_csv_rows(report)]) + "\n"


def points_csv_text(reports: Sequence[PointIrradiationReport]) -> str:
    """Return the reports of many points as one CSV: for each point the rows of ``csv_text``, or one without values."""
    lines = [",".join(["lon", "lat", "height_m", "elevation_m", "month", *_COLUMN_NAMES])]
    for report in reports:
        elevation = "" if report.elevation_m is None else f"{report.elevation_m:.2f}"
        place = f"{report.lon:.10g},{report.lat:.10g},{report.height_m:g},{elevation}"
        lines += [f"{place},{row}" for row in _csv_rows(report) or ["all" + "," * len(COLUMNS)]]
    return "\n".join(lines) + "\n"


def _csv_rows(report: PointIrradiationReport) -> list[str]:
    """Return a row of a CSV for each month of a report and one for all months; none without values."""
    return [",".join([name, *(f"{_value(sums, column):.4f}" for column in COLUMNS)]) for name, sums in named_sums(report)]


def _windows(scene: Scene, query: PointQuery, first: date, last: date) -> list[DailyWindow]:
    """Return whole days from the first to the last date by the query's clock, or by solar time. Raises ``InputError``."""
    clock = parse_clock("clock", query.clock or "solar")
    try:
        return _cached_windows(scene.world, first, last, clock)
    except InputError as error:
        # A year that the request spells as such is no date in its messages.
        raise (error.renamed("year") if error.name == "date" and query.date is None else error) from None


@cached("process", 4 * MIB)
def _cached_windows(world: World, first: date, last: date, clock: Clock) -> list[DailyWindow]:
    """Return whole days from the first to the last date, which all points of a level share. Raises ``InputError``."""
    return windows_between(world, first, last, 1, (0.0, MINUTES_PER_DAY), clock)


@cached("process", 16 * MIB)
def _suns_and_light(
    windows: tuple[DailyWindow, ...],
    step_min: float,
    lon_deg: float,
    lat_deg: float,
    height_m: float,
    linke: float | None,
    weather: Weather | None,
) -> tuple[SunIntervals, SkyLight]:
    """Return the suns of windows at a position, and their light at a height. The planes of a point share them."""
    if weather is not None:
        return weather_light(weather, windows, lon_deg, lat_deg)
    suns = sun_intervals(windows, step_min, lon_deg, lat_deg, begin_later_each_day=True)
    return suns, clear_sky_light(suns, lon_deg, lat_deg, np.array([height_m]), linke)


def _requested_plane(surroundings: Surroundings, options: PointIrradiationOptions) -> TiltedPlane:
    """Return the plane of a request."""
    if options.plane == "ground":
        return ground_plane(surroundings.scene, surroundings.place)
    return TiltedPlane(options.tilt or 0.0, DEFAULT_AZIMUTH_DEG if options.azimuth is None else options.azimuth)


def _months(windows: list[DailyWindow], suns: SunIntervals) -> tuple[list[str], np.ndarray]:
    """Return the months of windows, such as 2023-06, and the index (n,) of the month of each sun."""
    month_of_window = [f"{window.date:%Y-%m}" for window in windows]
    months = list(dict.fromkeys(month_of_window))
    starts = np.array([window.start.astimezone(UTC).replace(tzinfo=None) for window in windows], "datetime64[us]")
    window_of_sun = np.searchsorted(starts, suns.moments, side="right") - 1
    return months, np.array([months.index(month) for month in month_of_window])[window_of_sun]


def _sums(result: PointIrradiation, months: np.ndarray) -> dict[str, Any]:
    """Return the fields of ``IrradiationSums`` for some months, by their indices."""
    return {
        **{part: values[months].sum() for part, values in result.received.items()},
        "open_sky": result.open_sky["total"][months].sum(),
        **{
            f"lost_{light}": LossByCause(**{cause: values[months].sum() for cause, values in by_cause.items()})
            for light, by_cause in result.lost.items()
        },
    }


def _value(sums: IrradiationSums, column: str) -> float:
    """Return the value of one of ``COLUMNS``."""
    field = next((field for field in LOST_FIELDS if column.startswith(f"{field}_")), None)
    if field is None:
        return float(getattr(sums, column))
    return float(getattr(getattr(sums, field), column.removeprefix(f"{field}_")))


def _remark(result: PointIrradiation, months: list[str]) -> str | None:
    """Return a sentence on months without sun; ``None`` if the sun reaches the point in each."""
    if not result.has_sun.any():
        return "polar night: the sun stays below the level horizon on all dates"
    remarks = []
    if not result.has_sun.all():
        dark = [month for month, has_sun in zip(months, result.has_sun, strict=True) if not has_sun]
        remarks.append(f"polar night in {', '.join(dark)}")
    if result.open_sky["beam"].sum() > 0.0 and not result.received["beam"].any():
        remarks.append("terrain or objects hide the sun on all dates")
    return "; ".join(remarks) or None
