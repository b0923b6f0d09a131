"""The sky over a point as numbers for clients to draw: the horizon profile and the sun's path of a day."""

from __future__ import annotations

from datetime import UTC, date, datetime, tzinfo

import numpy as np
from pydantic import BaseModel, ConfigDict

from skugga.shadows.point.horizon import PointHorizon, Surroundings, sees_sun
from skugga.shadows.point.sun_angles import sun_angles_at, sun_samples
from skugga.terrain.geo.clock import day_bounds

SUN_PATH_STEP_S = 300.0
"""Time between two positions of the sun on its path."""

ANGLE_DECIMALS = 2
"""Decimals of angles in degrees."""


_Date = date  # a second name, because the field ``date`` of the model hides the type


class _FiguresModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SunOnPath(_FiguresModel):
    """The sun above the level horizon: time, azimuth and altitude in degrees, and whether it lights the point."""

    time: datetime
    azimuth: float
    altitude: float
    lit: bool


class HorizonFigures(_FiguresModel):
    """Horizon angles in degrees above the level plane through the eye, for each azimuth.

    ``relief`` is the ground, ``solids`` are buildings and models, ``forest`` is foliage. An angle is 0 if nothing rises higher.
    """

    azimuth: tuple[float, ...]
    relief: tuple[float, ...]
    solids: tuple[float, ...]
    forest: tuple[float, ...]


class SkyFigures(_FiguresModel):
    """The horizon, and the sun of a day every five minutes; ``path`` is empty if the sun does not rise, and in a flat world."""

    date: _Date
    horizon: HorizonFigures
    path: tuple[SunOnPath, ...]


def sky_figures(surroundings: Surroundings, horizon: PointHorizon, day: date, clock: tzinfo) -> SkyFigures:
    """Return the horizon and the sun's path at a place on a day of a clock. Raises ``InputError`` for unsupported years."""
    heights = {name: _rounded(np.maximum(getattr(horizon, f"{name}_deg"), 0.0)) for name in ("relief", "solids", "forest")}
    path = () if surroundings.scene.world.off_earth_reason else _sun_path(surroundings, day, clock)
    return SkyFigures(date=day, horizon=HorizonFigures(azimuth=_rounded(horizon.azimuth_deg), **heights), path=path)


def _sun_path(surroundings: Surroundings, day: date, clock: tzinfo) -> tuple[SunOnPath, ...]:
    """Return the sun above the level horizon on a day of a clock, every ``SUN_PATH_STEP_S`` seconds."""
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_bounds(day, clock))
    times_s, to_sun = sun_samples(surroundings.scene.world, begin, end, SUN_PATH_STEP_S)
    azimuth, altitude = sun_angles_at(surroundings.place, to_sun)
    lit = sees_sun(surroundings, azimuth, altitude)
    return tuple(
        SunOnPath(
            time=datetime.fromtimestamp(round(float(times_s[n])), UTC).astimezone(clock),
            azimuth=round(float(azimuth[n]), ANGLE_DECIMALS),
            altitude=round(float(altitude[n]), ANGLE_DECIMALS), lit=bool(lit[n]),
        )
        for n in np.flatnonzero(altitude > 0.0)
    )  # fmt: skip


def _rounded(degrees: np.ndarray) -> tuple[float, ...]:
    """Return angles in degrees, rounded to ``ANGLE_DECIMALS`` decimals."""
    return tuple(np.round(np.asarray(degrees, np.float64), ANGLE_DECIMALS).tolist())
