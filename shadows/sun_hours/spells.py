"""Intervals of direct sun (spells) of each cell: from clearances at moments to hours, first and last sun, and the longest spell.

A *clearance* is the margin by which a cell sees the sun: it is sunlit if the clearance is at least 0. Between two moments with
different signs the clearance crosses 0 once. Linear interpolation between them is inaccurate, since the nearest occluder changes:
by day it is mostly the cell's own neighbour, then a distant ridge. So the line through the two clearances before is extrapolated,
and the line through the two after. Each counts if it leads to a time between the moments (as in essentially non-oscillatory
schemes). In shadow the occluder is mostly the same ridge throughout, so the shadow's side has more weight. Where neither line leads
to such a time, a new occluder has appeared or an old one has gone. Clearances tell little about that time. The halfway time between
direct interpolation and the middle has the smallest error.

This is a first estimate. With long steps it is refined: a walk finds the cell's horizon towards the sun at that moment
(``skugga.shadows.sun_hours.sight_walks``). The method of false position then gives the next moment, ``MAX_WALKS`` times at most.
The loops are compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.sun_hours.quadratics import quadratic
from skugga.shadows.sun_hours.sight_walks import SunTrack, WalkedGround, clearance_tangent
from skugga.shadows.sweep.grid import GridOrientation, copy_into
from skugga.terrain.compiled import compiled, internal, map_on_cores

UNSHADED = np.float32(1e6)
"""Clearance without an occluder: its true value is unknown."""

SHADOW_SIDE_WEIGHT = 0.75
"""Weight of the time extrapolated from clearances in shadow, if those in the sun give another time."""

FLOOR_MARGIN_SINE = 0.002
"""Sine below the floor, about a tenth of a degree, at which clearances are meaningless.

Across a wide block such a sun has long risen elsewhere, and level ground hides it. A cell that is sunlit at the other moment is
then lit from its own sunrise, or until its own sunset.
"""

MAX_WALKS = 3
"""Maximum number of walks to a cell's horizon between two moments."""

CROSSING_TOLERANCE_MIN = 1.0
"""Tolerance in minutes for the last correction of a crossing: the remaining error is a tenth of that."""

BAND_ROWS = 128
"""Rows that a thread processes at a time."""


class SunSpells(NamedTuple):
    """Spells of direct sun of cells so far, float32 (n, m).

    Attributes
    ----------
    since
        Start of the current spell, minutes from the window's start; -1 in shade.
    day
        Minutes of sun of the current date.
    first, last
        Clock times of the first and the last sun of any date, minutes; NaN: never.
    longest
        The longest spell, minutes.
    total
        Minutes of sun of all complete dates.
    days
        Number of dates with enough sun.
    """

    since: np.ndarray
    day: np.ndarray
    first: np.ndarray
    last: np.ndarray
    longest: np.ndarray
    total: np.ndarray
    days: np.ndarray


class OcclusionTrack(NamedTuple):
    """The occlusion of cells between two moments.

    Attributes
    ----------
    ground
        The ground that casts shadows.
    track
        The sun.
    eye_height_m
        Metres of the eyes above their nodes.
    """

    ground: WalkedGround
    track: SunTrack
    eye_height_m: float


class ClockReading(NamedTuple):
    """A clock during a window.

    Attributes
    ----------
    start
        Its time at the window's start, minutes from midnight.
    change
        Minutes after that start at which the clock is put forward.
    advance_min
        Minutes by which it is put forward; 0: not at all.
    """

    start: float
    change: float
    advance_min: float


@dataclass(frozen=True, eq=False)
class ClearanceSample:
    """Clearances at a moment.

    Attributes
    ----------
    minutes
        The moment, minutes from the window's start.
    clearance
        float32 (n, m): clearances of the cells.
    above
        (k,): the sine of the sun's altitude less that of its floor, at the positions of a lattice.
    """

    minutes: float
    clearance: np.ndarray
    above: np.ndarray


def empty_spells(shape: tuple[int, int]) -> SunSpells:
    """Return the spells of cells before the first moment."""
    zeros = [np.zeros(shape, np.float32) for _ in range(4)]
    initial = [np.full(shape, value, np.float32) for value in (-1.0, np.nan, np.nan)]
    return SunSpells(initial[0], zeros[0], initial[1], initial[2], zeros[1], zeros[2], zeros[3])


def turned_spells(spells: SunSpells, before: GridOrientation, after: GridOrientation) -> SunSpells:
    """Return spells in the order of another turned grid."""
    return SunSpells(*(turned_copy(values, before, after) for values in spells))


def turned_copy(values: np.ndarray, before: GridOrientation, after: GridOrientation) -> np.ndarray:
    """Return values (n, m) of one turned grid in the order of another one."""
    view = after.turned(before.restored(values))
    out = np.empty(view.shape, view.dtype)
    copy_into(view, out)
    return out


def add_between(
    spells: SunSpells,
    moments: tuple[ClearanceSample, ClearanceSample, ClearanceSample, ClearanceSample],
    clock: ClockReading,
    fit: np.ndarray,
    begins: bool,
    occlusion: OcclusionTrack | None,
    cores: int,
) -> None:
    """Add the sun between the second and the third of four moments.

    The first may equal the second, and the fourth the third, at the ends of a span. ``begins`` marks the first step of a span.
    ``fit`` is a ``quadratic_fit``. ``occlusion``, if given, refines the crossings.
    """
    before, start_moment, end_moment, after = moments
    times = np.array([moment.minutes for moment in moments])
    floored = min(float(start_moment.above.min()), float(end_moment.above.min())) <= 0.0
    floors = np.stack([fit @ start_moment.above, fit @ end_moment.above])

    def band(rows: slice) -> None:
        part = SunSpells(*(values[rows] for values in spells))
        four = (before.clearance[rows], start_moment.clearance[rows], end_moment.clearance[rows], after.clearance[rows])
        _add_sun(part, *four, times, floors, begins, floored, rows.start, len(spells.day), clock, occlusion)

    _in_bands(band, len(spells.day), cores)


def end_spells(spells: SunSpells, minutes: float, clock: ClockReading) -> None:
    """End all current spells at a moment."""
    _end_all_spells(spells, minutes, clock)


def end_day(spells: SunSpells, threshold_min: float) -> None:
    """Add a date's minutes to the total, and begin the next date."""
    np.add(spells.total, spells.day, out=spells.total)
    np.add(spells.days, spells.day >= np.float32(threshold_min), out=spells.days, casting="unsafe")
    spells.day[:] = 0.0


def clearances(ray_height: np.ndarray, shade: np.ndarray, eye_height_m: float, out: np.ndarray, cores: int) -> np.ndarray:
    """Write to ``out`` (n, m), and return, the clearances of eyes ``eye_height_m`` above the cells' levels."""

    def band(rows: slice) -> None:
        _compute_clearances(ray_height[rows], shade[rows], np.float32(eye_height_m), out[rows])

    _in_bands(band, len(out), cores)
    return out


def _in_bands(work: Callable[[slice], None], rows: int, cores: int) -> None:
    map_on_cores(work, (slice(first, min(first + BAND_ROWS, rows)) for first in range(0, rows, BAND_ROWS)), cores)


@compiled
def _compute_clearances(ray_height, shade, eye_height_m, out):
    rows, cols = out.shape
    for i in range(rows):
        ray_height_row, shade_row, out_row = ray_height[i], shade[i], out[i]
        for j in range(cols):
            clearance = ray_height_row[j] - shade_row[j] + eye_height_m
            out_row[j] = UNSHADED if clearance > UNSHADED else clearance


@compiled
def _add_sun(spells, before, start, stop, after, times, floors, begins, floored, first_row, count, clock, occlusion):
    t0, t1 = times[1], times[2]
    rows, cols = start.shape
    for i in range(rows):
        for j in range(cols):
            e0, e1 = start[i, j], stop[i, j]
            lit0, lit1 = e0 >= 0.0, e1 >= 0.0
            if lit0 == lit1 and not begins and not floored:
                continue
            if np.isnan(e0) or np.isnan(e1):
                continue
            begin, end = t0, t1
            if lit0 != lit1:
                crossing = _estimate_crossing(before[i, j], e0, e1, after[i, j], times)
                if occlusion is not None:
                    crossing = _refine_crossing(occlusion, first_row + i, j, lit0, crossing, t0, t1)
                if lit0:
                    end = crossing
                else:
                    begin = crossing
            elif not lit0:
                end = t0 - 1.0
            if floored:
                y, x = (first_row + i) / max(count - 1, 1), j / max(cols - 1, 1)
                s0, s1 = quadratic(floors[0], y, x), quadratic(floors[1], y, x)
                if s0 <= 0.0 and s1 <= 0.0:
                    end = t0 - 1.0
                elif s0 <= 0.0:
                    begin = max(t0 if lit1 and s0 < -FLOOR_MARGIN_SINE else begin, t0 + (t1 - t0) * s0 / (s0 - s1))
                elif s1 <= 0.0:
                    end = min(t1 if lit0 and s1 < -FLOOR_MARGIN_SINE else end, t0 + (t1 - t0) * s0 / (s0 - s1))
            since = np.float64(spells.since[i, j])
            if since >= 0.0 and (end < begin or begin > t0):
                _end_spell(spells, i, j, since, t0, clock)
                since = -1.0
            if end >= begin:
                if since < 0.0:
                    since = begin
                if end < t1:
                    _end_spell(spells, i, j, since, end, clock)
                    since = -1.0
            spells.since[i, j] = since


@internal
def _estimate_crossing(before, e0, e1, after, times):
    """Estimate when a clearance crosses 0 between the second and the third of four moments."""
    tb, t0, t1, ta = times[0], times[1], times[2], times[3]
    by_before = by_after = np.nan
    if tb < t0 and before < UNSHADED and e0 < UNSHADED and before != e0:
        by_before = t0 + e0 * (t0 - tb) / (before - e0)
    if ta > t1 and after < UNSHADED and e1 < UNSHADED and after != e1:
        by_after = t1 - e1 * (ta - t1) / (after - e1)
    dark, lit = (by_after, by_before) if e0 >= 0.0 else (by_before, by_after)
    known_dark, known_lit = t0 <= dark <= t1, t0 <= lit <= t1
    if known_dark:
        return SHADOW_SIDE_WEIGHT * dark + (1.0 - SHADOW_SIDE_WEIGHT) * lit if known_lit else dark
    if known_lit:
        return lit
    middle = 0.5 * (t0 + t1)
    if e0 >= UNSHADED or e1 >= UNSHADED:
        return middle
    return 0.5 * (middle + t0 + (t1 - t0) * e0 / (e0 - e1))


@internal
def _refine_crossing(occlusion, i, j, lit0, crossing, t0, t1):
    """Refine the estimate of when the sun passes a cell's horizon; ``lit0``: the cell is sunlit at the earlier moment."""
    low, high = t0, t1
    t, before, clearance_before = crossing, np.nan, np.nan
    for _ in range(MAX_WALKS):
        clearance, rate = clearance_tangent(occlusion.ground, occlusion.track, i, j, occlusion.eye_height_m, t)
        if (clearance >= 0.0) == lit0:
            low = t
        else:
            high = t
        following = t - clearance / rate if np.isnan(before) else t - clearance * (t - before) / (clearance - clearance_before)
        if not low < following < high:
            following = 0.5 * (low + high)
        before, clearance_before = t, clearance
        t, correction_min = following, abs(following - t)
        if correction_min < CROSSING_TOLERANCE_MIN:
            break
    return t


@internal
def _clock_time(clock, t):
    return t + clock.start + (clock.advance_min if clock.advance_min != 0.0 and t >= clock.change else 0.0)


@internal
def _end_spell(spells, i, j, since, until, clock):
    """End a cell's spell of sun."""
    length = until - since
    if length <= 0.0:
        return
    spells.day[i, j] += length
    spells.longest[i, j] = max(spells.longest[i, j], length)
    begun, ended = _clock_time(clock, since), _clock_time(clock, until)
    if not spells.first[i, j] <= begun:
        spells.first[i, j] = begun
    if not spells.last[i, j] >= ended:
        spells.last[i, j] = ended


@compiled
def _end_all_spells(spells, until, clock):
    rows, cols = spells.since.shape
    for i in range(rows):
        for j in range(cols):
            since = np.float64(spells.since[i, j])
            if since >= 0.0:
                _end_spell(spells, i, j, since, until, clock)
                spells.since[i, j] = -1.0
