"""The report of the sun at a point, as a model for JSON."""

from __future__ import annotations

from datetime import UTC, date, datetime, tzinfo

import numpy as np
from pyproj import CRS

from skugga.api.point.values import DayHours, PointQuery, PointReport, ReportedCaster, ReportedDay, ReportedInterval, ReportedMoment
from skugga.shadows.point.clock import clock_of
from skugga.shadows.point.horizon import SunCaster, Surroundings, load_surroundings, sun_occluders
from skugga.shadows.point.place import POINT_PARAMETER, place_at
from skugga.shadows.point.sun_angles import scene_sun_at
from skugga.shadows.point.sun_day import SunDay, sun_day
from skugga.shadows.point.sun_year import sun_year
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import check_date
from skugga.terrain.scene import Scene

NO_DAY_REMARK = "a day needs longitude and latitude on the earth"
NO_SUN_REMARK = "the level has no default sun. Give a time"


def point_report(scene: Scene, query: PointQuery, crs: CRS | None = None) -> PointReport:
    """Return the report of a point of a level under the scene's sun. Raises ``InputError``.

    ``crs`` is the CRS of the query's ``lon`` and ``lat``; ``None``: degrees, or metres in a flat world.
    """
    surroundings = point_surroundings(scene, query, crs)
    place = surroundings.place
    day = requested_day(scene, query, place.lon_deg)
    clock = requested_clock(scene, query, place.lon_deg, day)
    sun_moment, remarks = reported_sun(surroundings), []
    if sun_moment is None:
        remarks.append(NO_SUN_REMARK)
    reported = None
    if (reason := scene.world.off_earth_reason) is not None and query.date is None and query.year is None:
        remarks.append(f"{reason}: {NO_DAY_REMARK}")
    else:
        reported = _reported_day(sun_day(surroundings, day, clock), _clock_name(query, clock))
    year = None if query.year is None else sun_year(surroundings, query.year, clock)
    return PointReport(
        level=scene.loaded.name, lon=place.lon_deg, lat=place.lat_deg, elevation_m=place.ground_m, height_m=place.height_m,
        now=sun_moment, day=reported,
        year=None if year is None else tuple(
            DayHours(date=date_of_year, daylight_h=daylight, direct_h=direct)
            for date_of_year, daylight, direct in zip(year.days, year.daylight_h, year.direct_sun_h, strict=True)
        ),
        remark="; ".join(remarks) or None,
    )  # fmt: skip


def report_with_remark(scene: Scene, query: PointQuery) -> PointReport:
    """Return the report of a point. For a point outside the level's data, values are null and the remark names the valid range.

    Raises ``InputError``.
    """
    try:
        return point_report(scene, query)
    except InputError as error:
        if error.name != POINT_PARAMETER:
            raise
        lon, lat = (None, None) if scene.world.is_flat else (query.lon, query.lat)
        return PointReport(
            level=scene.loaded.name, lon=lon, lat=lat, elevation_m=None, height_m=query.height, now=None, day=None, year=None,
            remark=f"no ground here. Use {error.allowed}",
        )  # fmt: skip


def point_surroundings(scene: Scene, query: PointQuery, crs: CRS | None = None) -> Surroundings:
    """Return a point's place and its surroundings. Raises ``InputError``.

    ``crs`` is the CRS of the query's ``lon`` and ``lat``; ``None``: degrees, or metres in a flat world.
    """
    return load_surroundings(scene, place_at(scene, (query.lon, query.lat), crs, query.height))


def reported_sun(surroundings: Surroundings) -> ReportedMoment | None:
    """Return the scene's sun at a place; ``None`` if the scene has none."""
    sun, scene = scene_sun_at(surroundings.scene, surroundings.place), surroundings.scene
    if sun is None or scene.sun is None:
        return None
    (caster,) = sun_occluders(surroundings, *map(np.array, sun))
    return ReportedMoment(
        time=scene.sun.time, azimuth=sun[0], altitude=sun[1], lit=caster is None and sun[1] > 0.0, by=reported_caster(caster)
    )


def requested_day(scene: Scene, query: PointQuery, lon_deg: float | None) -> date:
    """Return the day of a query: its date, or the day of the sun's time, or today, in this order.

    Days are those of the query's clock, or of the offset of the sun's time, or of solar time, in this order. ``lon_deg`` is the
    longitude for solar time; ``None`` in a flat world. Raises ``InputError`` for a date outside the supported years, and for an
    unknown clock.
    """
    if query.date is not None:
        check_date(query.date)
        return query.date
    moment = None if scene.sun is None else scene.sun.time
    if moment is not None and query.clock is None:
        return moment.date()
    moment = moment or query.now or datetime.now(UTC)
    return moment.astimezone(clock_of("solar" if query.clock is None else query.clock, lon_deg, moment.date())).date()


def requested_clock(scene: Scene, query: PointQuery, lon_deg: float | None, day: date) -> tzinfo:
    """Return the clock of a query: its own, or the offset of the sun's time, or solar time. Raises ``InputError``.

    ``lon_deg`` is the longitude for solar time; ``None`` in a flat world. ``day`` is the day on which solar time is taken.
    """
    if query.clock is None and scene.sun is not None and scene.sun.time is not None and scene.sun.time.tzinfo is not None:
        return scene.sun.time.tzinfo
    return clock_of("solar" if query.clock is None else query.clock, lon_deg, day)


def reported_caster(caster: SunCaster | None) -> ReportedCaster | None:
    """Return the report of a caster; ``None`` for none."""
    if caster is None:
        return None
    return ReportedCaster(
        kind=caster.kind, distance_m=caster.distance_m, azimuth=caster.azimuth_deg, elevation=caster.elevation_deg,
        height_m=caster.height_m, lon=caster.lon_deg, lat=caster.lat_deg,
    )  # fmt: skip


def _reported_day(day: SunDay, clock: str) -> ReportedDay:
    """Return the report of a day's sun. ``clock`` is the clock's name."""
    intervals = tuple(
        ReportedInterval(
            begin=interval.begin, end=interval.end, after=reported_caster(interval.occluder_before),
            before=reported_caster(interval.occluder_after),
        )
        for interval in day.sunlit_intervals
    )  # fmt: skip
    return ReportedDay(
        date=day.day, clock=clock, sunrise=day.sunrise, first_sun=day.first_sun, last_sun=day.last_sun, sunset=day.sunset,
        noon=day.noon, noon_altitude=day.noon_altitude_deg, daylight_h=day.daylight_h, direct_h=day.direct_sun_h,
        masked_h=day.hidden_sun_h, sunlit=intervals, remark=day.remark,
    )  # fmt: skip


def _clock_name(query: PointQuery, clock: tzinfo) -> str:
    """Return the name of a clock as the query spells it, or else the clock's own name."""
    return str(clock.tzname(datetime.now(UTC))) if query.clock is None else query.clock
