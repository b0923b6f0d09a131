"""Requests and answers on the sun at points. ``report`` and ``track`` compute the answers."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime
from typing import Annotated, Any

from pydantic import AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field

from skugga.shadows.point.terms import MAX_EYE_HEIGHT_M, CasterType

MAX_POINTS = 10_000
"""Limit of points in a request or a file."""

_Date = date  # a second name, because the field ``date`` of a model hides the type


class _ReportModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def rounded(decimals: int) -> BeforeValidator:
    """Return a pydantic validator that rounds a number to ``decimals`` decimals, without -0.0, and leaves ``None``."""
    return BeforeValidator(lambda value: None if value is None else round(float(value), decimals) + 0.0)


RoundDegrees = Annotated[float, rounded(3)]
RoundMetres = Annotated[float, rounded(2)]
RoundHours = Annotated[float, rounded(4)]
LonLatDegrees = Annotated[float | None, rounded(7)]


class PointQuery(_ReportModel):
    """A request on the sun at a point.

    ``lon`` and ``lat`` are degrees; in a flat world they are metres east and north of the centre. ``height`` is in metres above
    the ground. ``date`` is a day of ``clock``. ``year`` requests the hours of sun of each day of that year. ``now`` is the current
    time; it sets the day if neither the query nor the level's sun has one (``None``: the clock of this machine).
    """

    lon: float = Field(allow_inf_nan=False)
    lat: float = Field(allow_inf_nan=False)
    height: float = Field(default=0.0, ge=0.0, le=MAX_EYE_HEIGHT_M, allow_inf_nan=False)
    date: _Date | None = None
    clock: str | None = Field(default=None, max_length=60)
    year: int | None = Field(default=None, ge=1800, le=2200)
    now: AwareDatetime | None = None


class ReportedCaster(_ReportModel):
    """The occluder of the sun: kind, distance along the ground, azimuth, angle above the eye's level, height, position."""

    kind: CasterType
    distance_m: RoundMetres
    azimuth: RoundDegrees
    elevation: RoundDegrees
    height_m: RoundMetres
    lon: LonLatDegrees
    lat: LonLatDegrees


class ReportedMoment(_ReportModel):
    """The sun at a moment: its position, whether it lights the point, and its occluder if not; ``by`` is null at night."""

    time: datetime | None
    azimuth: RoundDegrees
    altitude: RoundDegrees
    lit: bool
    by: ReportedCaster | None


class ReportedInterval(_ReportModel):
    """Direct sun from ``begin`` to ``end``. ``after`` is the occluder before the interval, ``before`` the one after it."""

    begin: datetime
    end: datetime
    after: ReportedCaster | None
    before: ReportedCaster | None


class ReportedDay(_ReportModel):
    """A day's sun: see ``skugga.shadows.point.sun_day.SunDay``."""

    date: _Date
    clock: str
    sunrise: datetime | None
    first_sun: datetime | None
    last_sun: datetime | None
    sunset: datetime | None
    noon: datetime
    noon_altitude: RoundDegrees
    daylight_h: RoundHours
    direct_h: RoundHours
    masked_h: RoundHours
    sunlit: tuple[ReportedInterval, ...]
    remark: str | None


class DayHours(_ReportModel):
    """Hours of a day for which the sun is up, and for which it lights the point."""

    date: _Date
    daylight_h: RoundHours
    direct_h: RoundHours


class PointReport(_ReportModel):
    """The sun at a point. If ``elevation_m``, ``now`` or ``day`` is null, ``remark`` gives the reason."""

    level: str
    lon: LonLatDegrees
    lat: LonLatDegrees
    elevation_m: Annotated[float | None, rounded(2)]
    height_m: RoundMetres
    now: ReportedMoment | None
    day: ReportedDay | None
    year: tuple[DayHours, ...] | None
    remark: str | None


@dataclass(frozen=True)
class TrackPoint:
    """A point of a file or a track.

    Attributes
    ----------
    lon_deg, lat_deg
        Position, degrees.
    height_m
        Height above the ground, metres.
    time
        Time of arrival; ``None`` uses the time of the request.
    """

    lon_deg: float
    lat_deg: float
    height_m: float = 0.0
    time: datetime | None = None


@dataclass(frozen=True)
class PointRow:
    """The sun at one of many points.

    Attributes
    ----------
    elevation_m
        Elevation of the ground, metres.
    now
        The sun at the point's time.
    direct_h
        Hours of direct sun of the day.
    remark
        Reason if the other values are ``None``.
    """

    elevation_m: float | None
    now: ReportedMoment | None
    direct_h: float | None
    remark: str | None

    def as_json(self, point: TrackPoint) -> dict[str, Any]:
        """Return the row of a point as values for JSON."""
        return {
            "lon": point.lon_deg, "lat": point.lat_deg, "height_m": point.height_m,
            "time": None if point.time is None else point.time.isoformat(),
            "elevation_m": None if self.elevation_m is None else round(self.elevation_m, 2),
            "now": None if self.now is None else self.now.model_dump(mode="json"),
            "direct_h": None if self.direct_h is None else round(self.direct_h, 4), "remark": self.remark,
        }  # fmt: skip
