"""What is asked of points, and what is answered, as values; what answers is in ``report`` and ``track``."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime
from typing import Annotated, Any

from pydantic import AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field

from skugga.shadows.point.terms import HIGHEST_EYE_M, CasterType

MAX_POINTS = 10_000
"""Most points of a request or a file."""

_Date = date  # under this name the models' own fields leave it alone


class _Reported(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _rounded(digits: int) -> BeforeValidator:
    return BeforeValidator(lambda value: None if value is None else round(float(value), digits))


RoundDegrees = Annotated[float, _rounded(3)]
RoundMetres = Annotated[float, _rounded(2)]
RoundHours = Annotated[float, _rounded(4)]
LonLatDegrees = Annotated[float | None, _rounded(7)]


class PointQuery(_Reported):
    """What is asked of a point: its coordinates (longitude and latitude; in a flat world metres east and north of the middle),
    metres above the ground, a day and the clock that tells it, and the year whose hours by day are wanted. ``now`` lies in the day
    that is meant where neither the query nor the level's sun has one (``None``: the clock of this machine says).
    """

    lon: float = Field(allow_inf_nan=False)
    lat: float = Field(allow_inf_nan=False)
    height: float = Field(default=0.0, ge=0.0, le=HIGHEST_EYE_M, allow_inf_nan=False)
    date: _Date | None = None
    clock: str | None = Field(default=None, max_length=60)
    year: int | None = Field(default=None, ge=1800, le=2200)
    now: AwareDatetime | None = None


class ReportedCaster(_Reported):
    """What hides the sun: its kind, distance along the ground, direction, angle above the eye's level, and place."""

    kind: CasterType
    distance_m: RoundMetres
    azimuth: RoundDegrees
    elevation: RoundDegrees
    height_m: RoundMetres
    lon: LonLatDegrees
    lat: LonLatDegrees


class ReportedMoment(_Reported):
    """The sun at a moment: where it stands, whether it shines on the point, and if not, what hides it; ``by`` is null by night."""

    time: datetime | None
    azimuth: RoundDegrees
    altitude: RoundDegrees
    lit: bool
    by: ReportedCaster | None


class ReportedInterval(_Reported):
    """Direct sun from ``begin`` to ``end``; what hid it before (``after``) and hides it then (``before``)."""

    begin: datetime
    end: datetime
    after: ReportedCaster | None
    before: ReportedCaster | None


class ReportedDay(_Reported):
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


class DayHours(_Reported):
    """RoundHours of a day for which the sun is up, and shines on the point."""

    date: _Date
    daylight_h: RoundHours
    direct_h: RoundHours


class PointReport(_Reported):
    """What a point sees of the sun. Where ``elevation_m``, ``now`` or ``day`` is null, ``remark`` says why."""

    level: str
    lon: LonLatDegrees
    lat: LonLatDegrees
    elevation_m: Annotated[float | None, _rounded(2)]
    height_m: RoundMetres
    now: ReportedMoment | None
    day: ReportedDay | None
    year: tuple[DayHours, ...] | None
    remark: str | None


@dataclass(frozen=True)
class TrackPoint:
    """A point in degrees, metres above the ground, and when somebody is there (``None``: whenever is asked)."""

    lon_deg: float
    lat_deg: float
    height_m: float = 0.0
    time: datetime | None = None


@dataclass(frozen=True)
class PointAnswerRow:
    """What a point of many sees: ``remark`` says why the rest is ``None``."""

    elevation_m: float | None
    now: ReportedMoment | None
    direct_h: float | None
    remark: str | None

    def as_json(self, point: TrackPoint) -> dict[str, Any]:
        """The row of a point as JSON has it."""
        return {
            "lon": point.lon_deg, "lat": point.lat_deg, "height_m": point.height_m,
            "time": None if point.time is None else point.time.isoformat(),
            "elevation_m": None if self.elevation_m is None else round(self.elevation_m, 2),
            "now": None if self.now is None else self.now.model_dump(mode="json"),
            "direct_h": None if self.direct_h is None else round(self.direct_h, 4), "remark": self.remark,
        }  # fmt: skip
