"""The sky over a point in figures: the horizon all round, and the sun's path of the day over it, for others to draw."""

from __future__ import annotations

from datetime import UTC, date, datetime, tzinfo

import numpy as np
from pydantic import BaseModel, ConfigDict

from skugga.shadows.point.horizon import PointHorizon, Surroundings, sun_reaches
from skugga.shadows.point.sun_angles import angles_at, sun_looks
from skugga.terrain.geo.clock import day_ends

SUN_STEP_S = 300.0
"""Between two places of the sun on its path."""

ANGLE_DIGITS = 2
"""Of angles in degrees."""


_Date = date  # under this name the model's own field leaves it alone


class _Figures(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SunOnPath(_Figures):
    """The sun above the level horizon: when, where in degrees, and whether it shines on the point."""

    time: datetime
    azimuth: float
    altitude: float
    lit: bool


class HorizonFigures(_Figures):
    """Degrees above the level plane through the eye towards each of the azimuths, of ground, of buildings and models, and of
    leaves; 0 where there is nothing higher.
    """

    azimuth: tuple[float, ...]
    relief: tuple[float, ...]
    solids: tuple[float, ...]
    forest: tuple[float, ...]


class SkyFigures(_Figures):
    """The horizon, and the sun of a day every five minutes; ``path`` is empty where it does not rise, and in a flat world."""

    date: _Date
    horizon: HorizonFigures
    path: tuple[SunOnPath, ...]


def sky_figures(around: Surroundings, horizon: PointHorizon, day: date, clock: tzinfo) -> SkyFigures:
    """The figures of a place's sky on a day by a clock. Raises ``InputError`` for years for which no sun is computed."""
    heights = {name: _rounded(np.maximum(getattr(horizon, f"{name}_deg"), 0.0)) for name in ("relief", "solids", "forest")}
    path = () if around.scene.world.off_earth else _path(around, day, clock)
    return SkyFigures(date=day, horizon=HorizonFigures(azimuth=_rounded(horizon.azimuth_deg), **heights), path=path)


def _path(around: Surroundings, day: date, clock: tzinfo) -> tuple[SunOnPath, ...]:
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_ends(day, clock))
    when, to_sun = sun_looks(around.scene.world, begin, end, SUN_STEP_S)
    azimuth, altitude = angles_at(around.place, to_sun)
    lit = sun_reaches(around, azimuth, altitude)
    return tuple(
        SunOnPath(
            time=datetime.fromtimestamp(round(float(when[n])), UTC).astimezone(clock),
            azimuth=round(float(azimuth[n]), ANGLE_DIGITS),
            altitude=round(float(altitude[n]), ANGLE_DIGITS), lit=bool(lit[n]),
        )
        for n in np.flatnonzero(altitude > 0.0)
    )  # fmt: skip


def _rounded(degrees: np.ndarray) -> tuple[float, ...]:
    return tuple(np.round(np.asarray(degrees, np.float64), ANGLE_DIGITS).tolist())
