"""Report the sun and the horizon at points of an open level."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from skugga.api.library.argument_types import CrsLike, Date, Time, validate_arguments
from skugga.api.library.caller_warnings import warn_caller
from skugga.api.library.level_state import LevelState, requested_sun
from skugga.api.point.horizons import DEFAULT_AZIMUTHS, horizons_at_points
from skugga.api.point.irradiation import point_irradiation, weather_warnings
from skugga.api.point.irradiation_values import PointIrradiationOptions, PointIrradiationReport
from skugga.api.point.report import point_report, point_surroundings
from skugga.api.point.values import PointQuery, PointReport
from skugga.shadows.point.horizon import PointHorizon, horizon_profile


class LevelPoints(LevelState):
    """The methods of ``OpenLevel`` for points."""

    @validate_arguments
    def point(
        self,
        lon: float,
        lat: float,
        *,
        time: Time | None = None,
        date: Date | None = None,
        clock: str | None = None,
        height: float = 0.0,
        year: int | None = None,
        crs: CrsLike | None = None,
    ) -> PointReport:
        """Report the sun at a point: at a time, on a day, and on each day of a year.

        Parameters
        ----------
        lon, lat
            The point in degrees, or its x and y in ``crs``.
        time
            The time, as in ``render``.
        date
            The day.
        clock
            The clock of the day, as in ``sun_hours``.
        height
            Metres above the ground.
        year
            A year, for the hours of sun of each of its days.
        crs
            The CRS of ``lon`` and ``lat``, in any form that pyproj accepts.

        Returns
        -------
        PointReport
            The report.

        Raises
        ------
        SkuggaError
            For a wrong argument.
        """
        scene = self._scene.with_sun(requested_sun(time, None, None))
        query = PointQuery(lon=lon, lat=lat, height=height, date=cast("datetime.date | None", date), clock=clock, year=year)
        self._issue_object_warnings()
        return point_report(scene, query, crs)

    @validate_arguments
    def point_irradiation(
        self,
        lon: float,
        lat: float,
        *,
        year: int | None = None,
        date: Date | None = None,
        to: Date | None = None,
        plane: Literal["level", "ground"] | None = None,
        tilt: float | None = None,
        azimuth: float | None = None,
        albedo: float = 0.2,
        linke: float | None = None,
        clock: str = "solar",
        step_min: float | None = None,
        weather: Path | None = None,
        weather_columns: str | None = None,
        height: float = 0.0,
        crs: CrsLike | None = None,
    ) -> PointIrradiationReport:
        """Report the energy of sunlight and skylight on a plane at a point, by month.

        Parameters
        ----------
        lon, lat
            The point in degrees, or its x and y in ``crs``.
        year
            A whole year. Without it and ``date``: this year.
        date, to
            One date, or the first and the last of several.
        plane
            ``level`` (the default), or ``ground``, its own slope.
        tilt, azimuth
            Tilt of another plane, 0 to 180 degrees (90 is a wall), and the azimuth that it faces (default: 180, south).
        albedo
            Albedo of the ground around.
        linke
            Linke's turbidity of the air (default: the place's monthly climate).
        clock
            The clock of the dates, as in ``sun_hours``.
        step_min
            Minutes between two suns (default: 60 for 28 dates and more, else 10).
        weather, weather_columns
            A weather file instead of a clear sky, and the columns of a CSV, as in the command.
        height
            Metres above the ground.
        crs
            The CRS of ``lon`` and ``lat``, in any form that pyproj accepts.

        Returns
        -------
        PointIrradiationReport
            Received light by part, light under an open sky, and losses by cause, kWh/m2, for each month and all of them.

        Raises
        ------
        SkuggaError
            For a wrong argument.
        """
        first = cast("datetime.date | None", date)
        query = PointQuery(lon=lon, lat=lat, height=height, date=first, clock=clock, year=year)
        options = PointIrradiationOptions(
            to=cast("datetime.date | None", to), plane=plane, tilt=tilt, azimuth=azimuth, albedo=albedo, linke=linke,
            step_min=step_min, weather=weather, weather_columns=weather_columns,
        )  # fmt: skip
        self._issue_object_warnings()
        for text in weather_warnings(self._scene, query, options):
            warn_caller(text)
        return point_irradiation(self._scene, query, options, crs)

    @validate_arguments
    def horizon(self, lon: float, lat: float, *, height: float = 0.0, crs: CrsLike | None = None) -> PointHorizon:
        """Return the horizon profile of a point in 720 directions, from ground, buildings and trees.

        Parameters
        ----------
        lon, lat, height, crs
            The point, as in ``point``.

        Returns
        -------
        PointHorizon
            ``azimuth_deg``, clockwise from true north, and ``elevation_deg``.

        Raises
        ------
        SkuggaError
            For a wrong argument.
        """
        query = PointQuery(lon=lon, lat=lat, height=height)
        self._issue_object_warnings()
        return horizon_profile(point_surroundings(self._scene, query, crs))

    @validate_arguments
    def point_horizons(
        self, points: Any, azimuths: int = DEFAULT_AZIMUTHS, *, height: Any = 0.0, crs: CrsLike | None = None
    ) -> np.ndarray:
        """Return the horizons of many points, computed on all cores: those that ``horizon`` gives for each of them.

        Parameters
        ----------
        points
            (points, 2): longitudes and latitudes in degrees, or x and y in ``crs``.
        azimuths
            The number of azimuths, evenly spaced from true north, clockwise.
        height
            Metres above the ground, for all points or for each.
        crs
            The CRS of ``points``, in any form that pyproj accepts.

        Returns
        -------
        numpy.ndarray
            Degrees (points, azimuths); -90 where nothing is in the way.

        Raises
        ------
        SkuggaError
            For a wrong argument.

        Notes
        -----
        The open share of the sky is ``1 - np.sin(np.radians(np.maximum(horizon_deg, 0))).mean(axis=1)``.
        """
        self._issue_object_warnings()
        return horizons_at_points(self._scene, points, azimuths, height, crs).horizon_deg
