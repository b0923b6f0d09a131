"""Spells of sun, cell by cell: from clearances at moments to hours, first and last sun, and the longest spell. Compiled loops.

A *clearance* says by how much a cell's sight of the sun is free: the sun is seen where it is no less than 0. Between two moments at
which it has different signs it crosses 0 once. The line between the two is wrong, for what a cell is nearest to being shaded by
changes: by day mostly its own neighbour, then a ridge far away. So the line through the two clearances before is drawn on, and the
line through the two after, where they lead to a time between the moments (as essentially non-oscillatory schemes do). In shadow it
is mostly the same ridge that shades, so that side counts more. Where neither line leads there, something new has come between the
cell and the sun, or has gone, at a time that clearances hardly tell: least wrong is a time halfway from the direct line's to the
middle.

That is a first guess. Where steps are long it is mended: the horizon of the cell that crosses is looked for towards the sun of that
moment (``skugga.shadows.sun_hours.sight_walks``), then by the rule of false position towards the next guess's sun, ``WALKS`` times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.sun_hours.quadratics import quadratic
from skugga.shadows.sun_hours.sight_walks import SunTrack, WalkedGround, free_tangent
from skugga.shadows.sweep.grid import GridOrientation, copy_into
from skugga.terrain.compiled import compiled, internal, on_cores

UNSHADED = np.float32(1e6)
"""Clearance where nothing lies between a cell and the sun: how far it is from being shaded is not known."""

DARK_SHARE = 0.75
"""How much the time counts that clearances in shadow lead to, where those in the sun lead to another one."""

BELOW_FLOOR = 0.002
"""Sine below its floor, about a tenth of a degree, at which a sun's clearances say nothing: across a wide block it has long risen
elsewhere, and level ground hides it. What is lit at the other moment is then lit from its rise, or until its set.
"""

WALKS = 3
"""How many times a cell's horizon is looked for between two moments, at most."""

NEAR_MIN = 1.0
"""Minutes by which the last walk may move a crossing: what is left after it is a tenth of that."""

BAND_ROWS = 128
"""Rows that a thread works on at a time."""


class Spells(NamedTuple):
    """What is known of cells, float32 (n, m): ``since`` when the sun has been seen without a break, minutes from the window's
    start (-1: it is not); the minutes of sun of the ``day``; the readings of the clock, minutes, at the ``first`` and ``last``
    sun of any date (NaN: never) and the ``longest`` spell, minutes; the ``total`` minutes, and the ``days`` with enough sun.
    """

    since: np.ndarray
    day: np.ndarray
    first: np.ndarray
    last: np.ndarray
    longest: np.ndarray
    total: np.ndarray
    days: np.ndarray


class Sight(NamedTuple):
    """What cells see between two moments: the ground that casts, the sun, and how far above their nodes the cells look from."""

    ground: WalkedGround
    track: SunTrack
    raised: float


class ClockReading(NamedTuple):
    """What a clock reads at a window's start, minutes from midnight, and when and by how much it is put forward (0: not)."""

    start: float
    change: float
    by: float


@dataclass(frozen=True, eq=False)
class Moment:
    """Clearances (n, m) float32 of cells at a time, minutes from the window's start, and by how much the sun stands over its floor
    (in its altitude's sine) at the places of a lattice (k,).
    """

    minutes: float
    clearance: np.ndarray
    above: np.ndarray


def no_spells(shape: tuple[int, int]) -> Spells:
    """Of cells for which nothing was looked for yet."""
    zeros = [np.zeros(shape, np.float32) for _ in range(4)]
    never = [np.full(shape, value, np.float32) for value in (-1.0, np.nan, np.nan)]
    return Spells(never[0], zeros[0], never[1], never[2], zeros[1], zeros[2], zeros[3])


def turned_spells(spells: Spells, before: GridOrientation, after: GridOrientation) -> Spells:
    """The same in the order of another turned grid."""
    return Spells(*(turned_copy(values, before, after) for values in spells))


def turned_copy(values: np.ndarray, before: GridOrientation, after: GridOrientation) -> np.ndarray:
    """Values (n, m) of one turned grid in the order of another one."""
    there = after.turned(before.back(values))
    out = np.empty(there.shape, there.dtype)
    copy_into(there, out)
    return out


def add_between(
    spells: Spells,
    moments: tuple[Moment, Moment, Moment, Moment],
    clock: ClockReading,
    fit: np.ndarray,
    begins: bool,
    sight: Sight | None,
    cores: int,
) -> None:
    """Add what lies between the second and the third of four moments; ``begins``: no time before was looked at; ``fit`` as from
    ``quadratic_fit``. ``sight`` is what cells see in between, where it is known. The first may be the second, and the fourth the
    third, where there is no other.
    """
    before, here, there, after = moments
    times = np.array([moment.minutes for moment in moments])
    floored = min(float(here.above.min()), float(there.above.min())) <= 0.0
    floors = np.stack([fit @ here.above, fit @ there.above])

    def band(rows: slice) -> None:
        part = Spells(*(values[rows] for values in spells))
        four = (before.clearance[rows], here.clearance[rows], there.clearance[rows], after.clearance[rows])
        _add(part, *four, times, floors, begins, floored, rows.start, len(spells.day), clock, sight)

    _in_bands(band, len(spells.day), cores)


def end_spells(spells: Spells, minutes: float, clock: ClockReading) -> None:
    """End the spells that last, at a time."""
    _end(spells, minutes, clock)


def end_day(spells: Spells, threshold_min: float) -> None:
    """Add a date's minutes to all dates', and begin another one."""
    np.add(spells.total, spells.day, out=spells.total)
    np.add(spells.days, spells.day >= np.float32(threshold_min), out=spells.days, casting="unsafe")
    spells.day[:] = 0.0


def clearances(level: np.ndarray, shade: np.ndarray, raised: float, out: np.ndarray, cores: int) -> np.ndarray:
    """Clearances (n, m), as ``out`` after it is filled, of cells that are raised by so much above their levels."""

    def band(rows: slice) -> None:
        _clear(level[rows], shade[rows], np.float32(raised), out[rows])

    _in_bands(band, len(out), cores)
    return out


def _in_bands(work: Callable[[slice], None], rows: int, cores: int) -> None:
    on_cores(work, (slice(first, min(first + BAND_ROWS, rows)) for first in range(0, rows, BAND_ROWS)), cores)


@compiled
def _clear(level, shade, raised, out):
    rows, cols = out.shape
    for i in range(rows):
        own, above, row = level[i], shade[i], out[i]
        for j in range(cols):
            free = own[j] - above[j] + raised
            row[j] = UNSHADED if free > UNSHADED else free


@compiled
def _add(spells, before, here, there, after, times, floors, begins, floored, first_row, count, clock, sight):
    t0, t1 = times[1], times[2]
    rows, cols = here.shape
    for i in range(rows):
        for j in range(cols):
            e0, e1 = here[i, j], there[i, j]
            lit0, lit1 = e0 >= 0.0, e1 >= 0.0
            if lit0 == lit1 and not begins and not floored:
                continue
            if np.isnan(e0) or np.isnan(e1):
                continue
            begin, end = t0, t1
            if lit0 != lit1:
                crossing = _crossing(before[i, j], e0, e1, after[i, j], times)
                if sight is not None:
                    crossing = _walked(sight, first_row + i, j, lit0, crossing, t0, t1)
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
                    begin = max(t0 if lit1 and s0 < -BELOW_FLOOR else begin, t0 + (t1 - t0) * s0 / (s0 - s1))
                elif s1 <= 0.0:
                    end = min(t1 if lit0 and s1 < -BELOW_FLOOR else end, t0 + (t1 - t0) * s0 / (s0 - s1))
            since = np.float64(spells.since[i, j])
            if since >= 0.0 and (end < begin or begin > t0):
                _close(spells, i, j, since, t0, clock)
                since = -1.0
            if end >= begin:
                if since < 0.0:
                    since = begin
                if end < t1:
                    _close(spells, i, j, since, end, clock)
                    since = -1.0
            spells.since[i, j] = since


@internal
def _crossing(before, e0, e1, after, times):
    """When a clearance crosses 0 between the second and the third of four times."""
    tb, t0, t1, ta = times[0], times[1], times[2], times[3]
    by_before = by_after = np.nan
    if tb < t0 and before < UNSHADED and e0 < UNSHADED and before != e0:
        by_before = t0 + e0 * (t0 - tb) / (before - e0)
    if ta > t1 and after < UNSHADED and e1 < UNSHADED and after != e1:
        by_after = t1 - e1 * (ta - t1) / (after - e1)
    dark, lit = (by_after, by_before) if e0 >= 0.0 else (by_before, by_after)
    known_dark, known_lit = t0 <= dark <= t1, t0 <= lit <= t1
    if known_dark:
        return DARK_SHARE * dark + (1.0 - DARK_SHARE) * lit if known_lit else dark
    if known_lit:
        return lit
    middle = 0.5 * (t0 + t1)
    if e0 >= UNSHADED or e1 >= UNSHADED:
        return middle
    return 0.5 * (middle + t0 + (t1 - t0) * e0 / (e0 - e1))


@internal
def _walked(sight, i, j, lit0, crossing, t0, t1):
    """When the sun passes a cell's horizon between two moments, from about when; it is lit at the first one or not."""
    low, high = t0, t1
    t, before, free_before = crossing, np.nan, np.nan
    for _ in range(WALKS):
        free, rate = free_tangent(sight.ground, sight.track, i, j, sight.raised, t)
        if (free >= 0.0) == lit0:
            low = t
        else:
            high = t
        following = t - free / rate if np.isnan(before) else t - free * (t - before) / (free - free_before)
        if not low < following < high:
            following = 0.5 * (low + high)
        before, free_before = t, free
        t, moved = following, abs(following - t)
        if moved < NEAR_MIN:
            break
    return t


@internal
def _read(clock, t):
    return t + clock.start + (clock.by if clock.by != 0.0 and t >= clock.change else 0.0)


@internal
def _close(spells, i, j, since, until, clock):
    """End a spell of sun of a cell."""
    length = until - since
    if length <= 0.0:
        return
    spells.day[i, j] += length
    spells.longest[i, j] = max(spells.longest[i, j], length)
    begun, ended = _read(clock, since), _read(clock, until)
    if not spells.first[i, j] <= begun:
        spells.first[i, j] = begun
    if not spells.last[i, j] >= ended:
        spells.last[i, j] = ended


@compiled
def _end(spells, until, clock):
    rows, cols = spells.since.shape
    for i in range(rows):
        for j in range(cols):
            since = np.float64(spells.since[i, j])
            if since >= 0.0:
                _close(spells, i, j, since, until, clock)
                spells.since[i, j] = -1.0
