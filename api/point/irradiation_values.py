"""Requests and answers on irradiation at a point. ``skugga.api.point.irradiation`` computes the answers."""

from __future__ import annotations

from datetime import UTC, date, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from skugga.api.point.values import LonLatDegrees, PointQuery, RoundDegrees, RoundMetres, rounded
from skugga.terrain.errors import InputError, Problem

_Date = date  # a second name, because the field ``date`` of a model hides the type

Energy = Annotated[float, rounded(4)]
"""Energy of light, kWh/m2."""

Share = Annotated[float, rounded(4)]

DEFAULT_AZIMUTH_DEG = 180.0
"""Azimuth of a plane unless the request has one: south, as in pvlib."""


class _IrradiationModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PointIrradiationOptions(_IrradiationModel):
    """What is asked of the irradiation at a point, besides the point, its height and its ``year`` or ``date``.

    ``to`` is the last of several dates. The plane is level, or the ground's own (``plane``), or has a ``tilt`` of 0 to 180 degrees
    and faces an ``azimuth`` (180, south, unless given). ``albedo`` is that of the ground around. ``linke`` is Linke's turbidity of
    the air (``None``: the place's monthly climate). ``step_min`` are the minutes between two suns (``None``: 60 for 28 dates and
    more, else 10). ``weather`` is a weather file instead of a clear sky, and ``weather_columns`` are the columns of a CSV.
    """

    to: _Date | None = None
    plane: Literal["level", "ground"] | None = None
    tilt: float | None = Field(default=None, ge=0.0, le=180.0)
    azimuth: float | None = Field(default=None, ge=0.0, le=360.0)
    albedo: float = Field(default=0.2, ge=0.0, le=1.0)
    linke: float | None = Field(default=None, ge=1.0, le=20.0)
    step_min: float | None = Field(default=None, ge=1.0, le=60.0)
    weather: Path | None = None
    weather_columns: str | None = None


class LossByCause(_IrradiationModel):
    """Light that is lost, kWh/m2: to the ground (``relief``), to buildings and models (``solids``), and to trees (``forest``)."""

    relief: Energy
    solids: Energy
    forest: Energy


class IrradiationSums(_IrradiationModel):
    """Light on the plane in a period, kWh/m2.

    ``total`` is what the plane receives, the sum of five parts. ``open_sky`` is what it would receive without terrain and objects:
    ``total`` and all losses. ``lost_beam`` is lost sunlight with its circumsolar light, ``lost_sky`` other lost skylight.
    ``lost_reflected`` is negative where a cause reflects more light, in place of the sky that it hides, than it takes.
    """

    total: Energy
    beam: Energy
    circumsolar: Energy
    sky: Energy
    horizon_band: Energy
    reflected: Energy
    open_sky: Energy
    lost_beam: LossByCause
    lost_sky: LossByCause
    lost_reflected: LossByCause

    def lost(self, cause: Literal["relief", "solids", "forest"]) -> float:
        """Return the light that a cause takes, less the light that it reflects, kWh/m2."""
        return float(sum(getattr(part, cause) for part in (self.lost_beam, self.lost_sky, self.lost_reflected)))


class MonthIrradiation(IrradiationSums):
    """Light on the plane in a month, such as ``2023-06``, or in those of its dates that were asked for."""

    month: str


class PointIrradiationReport(_IrradiationModel):
    """Irradiation at a point under a clear sky, or with a file's weather. Values are null off the level's data, as ``remark`` says.

    ``tilt`` and ``azimuth`` are those of the plane. ``sky_view`` is the plane's sky view factor, and ``sky_view_of_relief`` that
    behind the ground alone. ``linke`` is null for the place's monthly climate.
    """

    level: str
    lon: LonLatDegrees
    lat: LonLatDegrees
    elevation_m: Annotated[float | None, rounded(2)]
    height_m: RoundMetres
    first: _Date
    last: _Date
    unit: Literal["kWh/m2"]
    tilt: RoundDegrees | None
    azimuth: RoundDegrees | None
    albedo: float
    linke: float | None
    weather: str
    sky_view: Share | None
    sky_view_of_relief: Share | None
    months: tuple[MonthIrradiation, ...] | None
    all_months: IrradiationSums | None
    remark: str | None


def weather_name(options: PointIrradiationOptions) -> str:
    """Return the name of the light: clear sky, or that of the weather file."""
    return "clear sky" if options.weather is None else options.weather.name


def check_plane(options: PointIrradiationOptions) -> None:
    """Raise ``InputError`` for options of the plane, and of the weather, that exclude or need each other."""
    if options.plane is not None and options.tilt is not None:
        raise InputError.conflict("tilt", "plane")
    if options.azimuth is not None and options.tilt is None:
        raise InputError("azimuth", Problem("needs a tilted plane"), "Add a tilt, in degrees")
    if options.weather is None and options.weather_columns is not None:
        raise InputError.missing("weather", "Columns are those of a weather file")
    if options.weather is not None and options.linke is not None:
        raise InputError.conflict("linke", "weather", "Leave it out: the file has its own light")


def requested_dates(query: PointQuery, options: PointIrradiationOptions) -> tuple[date, date]:
    """Return the first and the last date of a request: those of its year, or its own, or those of this year (UTC).

    Raises ``InputError``.
    """
    if query.date is None:
        if options.to is not None:
            raise InputError("to", Problem("needs a first date"), "Add a date")
        year = query.year or (query.now or datetime.now(UTC)).year
        return date(year, 1, 1), date(year, 12, 31)
    if query.year is not None:
        raise InputError.conflict("date", "year")
    return query.date, options.to or query.date
