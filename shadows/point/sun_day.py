"""A day's sun at a point: when it rises, when it clears what stands before it, and what does.

The sun is the middle of its disc, refracted as everywhere in this engine, and up where it stands above the level plane through the
point. It is looked at every ``STEP_S``; where it comes or goes between two looks, that is found to ``FINE_STEP_S``. Sun or
shade of less than ``STEP_S`` may be missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, tzinfo

import numpy as np

from skugga.shadows.point.horizon import SunCaster, Surroundings, sun_reaches, what_hides
from skugga.shadows.point.sun_angles import angles_at, sun_looks
from skugga.terrain.geo.clock import day_ends

STEP_S = 60.0
FINE_STEP_S = 2.0
COARSE_STEP_S = 300.0


@dataclass(frozen=True)
class SunlitInterval:
    """Direct sun from ``begin`` to ``end``; what hid it before and hides it after: ``None`` where it rose or set over the level
    horizon, or the day began or ended.
    """

    begin: datetime
    end: datetime
    after: SunCaster | None
    before: SunCaster | None

    @property
    def hours(self) -> float:
        """How long it lasts."""
        return (self.end - self.begin).total_seconds() / 3600.0


@dataclass(frozen=True)
class SunDay:
    """A day's sun at a point, from midnight to midnight by a clock.

    ``sunrise`` and ``sunset`` are over the level horizon, ``None`` where the day has none; ``first_sun`` and ``last_sun`` are the
    ends of direct sun, ``None`` without any. ``daylight_h`` is how long the sun is up, ``direct_h`` how long it shines on the
    point, ``masked_h`` how long it is hidden meanwhile. ``remark`` says in words why something is ``None``.
    """

    day: date
    sunrise: datetime | None
    sunset: datetime | None
    noon: datetime
    noon_altitude_deg: float
    first_sun: datetime | None
    last_sun: datetime | None
    daylight_h: float
    direct_h: float
    masked_h: float
    sunlit: tuple[SunlitInterval, ...]
    remark: str | None


def sun_day(around: Surroundings, day: date, clock: tzinfo) -> SunDay:
    """The sun of a day at a place. Raises ``InputError`` in a flat world, for years for which no sun is computed, and for a day
    that the clock's calendar leaves out.
    """
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_ends(day, clock))
    when, to_sun = sun_looks(around.scene.world, begin, end, STEP_S)
    azimuth, altitude = angles_at(around.place, to_sun)
    lit = sun_reaches(around, azimuth, altitude)

    def moment_of(second: float) -> datetime:
        return datetime.fromtimestamp(round(second), UTC).astimezone(clock)

    up = altitude > 0.0
    rises, sets = (_crossings(when, altitude, rising) for rising in (True, False))
    changes = np.flatnonzero(lit[1:] != lit[:-1])
    at = _refined(around, when, azimuth, altitude, lit, changes)
    bounds = np.concatenate([[begin] if lit[0] else [], at, [end] if lit[-1] else []])
    hidden = _casters_beside(around, when, azimuth, altitude, lit, changes)
    hidden = [*([None] if lit[0] else []), *hidden, *([None] if lit[-1] else [])]
    sunlit = tuple(
        SunlitInterval(moment_of(bounds[n]), moment_of(bounds[n + 1]), hidden[n], hidden[n + 1]) for n in range(0, len(bounds), 2)
    )
    daylight = _length(when, altitude, up, rises, sets)
    direct = float(sum(bounds[1::2] - bounds[::2]))
    highest = int(np.argmax(altitude))
    return SunDay(
        day=day,
        sunrise=moment_of(rises[0]) if len(rises) else None,
        sunset=moment_of(sets[-1]) if len(sets) else None,
        noon=moment_of(_top(when, altitude, highest)),
        noon_altitude_deg=float(altitude[highest]),
        first_sun=sunlit[0].begin if sunlit else None,
        last_sun=sunlit[-1].end if sunlit else None,
        daylight_h=daylight / 3600.0,
        direct_h=direct / 3600.0,
        masked_h=max(daylight - direct, 0.0) / 3600.0,
        sunlit=sunlit,
        remark=_remark(up, bool(sunlit), len(rises), len(sets)),
    )


def _remark(up: np.ndarray, shines: bool, rises: int, sets: int) -> str | None:
    if not up.any():
        return "polar night: the sun stays below the level horizon all day"
    if up.all():
        ending = "" if shines else ", but something stands before it all day"
        return f"polar day: the sun does not set{ending}"
    if not shines:
        return "the sun rises, but something stands before it all day"
    if not (rises and sets):
        return f"the sun does not {'set' if rises else 'rise'} on this day"
    return None


def _crossings(when: np.ndarray, altitude_deg: np.ndarray, rising: bool) -> np.ndarray:
    """When the altitude passes 0 upwards or downwards, linear between two looks."""
    up = altitude_deg > 0.0
    n = np.flatnonzero(up[1:] & ~up[:-1] if rising else ~up[1:] & up[:-1])
    share = altitude_deg[n] / (altitude_deg[n] - altitude_deg[n + 1])
    return when[n] + share * (when[n + 1] - when[n])


def _length(when: np.ndarray, altitude_deg: np.ndarray, up: np.ndarray, rises: np.ndarray, sets: np.ndarray) -> float:
    """Seconds for which the sun is up."""
    begins = np.concatenate([[when[0]] if up[0] else [], rises])
    ends = np.concatenate([sets, [when[-1]] if up[-1] else []])
    return float(np.sum(ends - begins))


def _top(when: np.ndarray, altitude_deg: np.ndarray, n: int) -> float:
    """When the altitude is highest: the vertex of the parabola through three looks."""
    if not 0 < n < len(when) - 1:
        return float(when[n])
    before, at, after = altitude_deg[n - 1 : n + 2]
    bend = before - 2.0 * at + after
    return float(when[n] + (0.5 * (before - after) / bend if bend else 0.0) * STEP_S)


def _refined(
    around: Surroundings,
    when: np.ndarray,
    azimuth_deg: np.ndarray,
    altitude_deg: np.ndarray,
    lit: np.ndarray,
    changes: np.ndarray,
) -> np.ndarray:
    """When sun comes or goes, between looks ``changes`` and the following ones, seconds; the sun moves evenly between two looks."""
    if not len(changes):
        return np.zeros(0)
    count = int(STEP_S / FINE_STEP_S)
    share = np.arange(1, count) / count
    turned = (azimuth_deg[changes + 1] - azimuth_deg[changes] + 180.0) % 360.0 - 180.0
    azimuth = azimuth_deg[changes, None] + share * turned[:, None]
    altitude = altitude_deg[changes, None] + share * (altitude_deg[changes + 1] - altitude_deg[changes])[:, None]
    fine = sun_reaches(around, azimuth.ravel(), altitude.ravel()).reshape(azimuth.shape)
    fine = np.concatenate([fine, lit[changes + 1, None]], axis=1)
    first = np.argmax(fine != lit[changes, None], axis=1)  # of several, the first change
    return when[changes] + (first + 0.5) / count * (when[changes + 1] - when[changes])


def _casters_beside(
    around: Surroundings,
    when: np.ndarray,
    azimuth_deg: np.ndarray,
    altitude_deg: np.ndarray,
    lit: np.ndarray,
    changes: np.ndarray,
) -> list[SunCaster | None]:
    """What hides the sun on the dark side of each change."""
    dark = np.where(lit[changes], changes + 1, changes)
    return what_hides(around, azimuth_deg[dark], altitude_deg[dark]) if len(dark) else []


def hours_between_looks(around: Surroundings, day: date, clock: tzinfo) -> float:
    """Hours of direct sun of a day, from looks every ``COARSE_STEP_S`` alone: for many points, 2.5 minutes off at most at each
    end of sun."""
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_ends(day, clock))
    _, to_sun = sun_looks(around.scene.world, begin + COARSE_STEP_S / 2, end, COARSE_STEP_S)
    azimuth, altitude = angles_at(around.place, to_sun[:-1])
    return float(sun_reaches(around, azimuth, altitude).sum() * COARSE_STEP_S / 3600.0)
