"""Intervals of direct sun (spells) of each cell: hours, first and last sun and the longest spell, from clearances at moments.

A *clearance* is the margin by which a cell sees the sun. The cell is sunlit if it is at least 0. If the clearances at two
successive moments have different signs, it is assumed to cross 0 once between them, at a time that is estimated as follows.

- Linear interpolation between the two moments is inaccurate, because the ground that limits the clearance changes. In sunlight it
  is mostly the cell's own neighbour, in shadow a distant ridge.
- So two lines are extrapolated: the one through the last two clearances before the crossing, and the one through the first two
  after it. A line counts if it crosses 0 between the moments (as in essentially non-oscillatory schemes).
- In shadow the occluder is mostly the same ridge at both moments. So the line through clearances in shadow has more weight.
- If neither line counts, an occluder has appeared or disappeared. Then the estimate is halfway between the result of linear
  interpolation and the middle of the two moments, which had the smallest error.

With longer time steps angles take the place of metres where that is possible
(``skugga.shadows.sun_hours.marched_clearances``): the tangents of the sun's altitude less those of the horizon. They change nearly
linearly, so a line through those of the two moments gives the crossing.

Otherwise, and with still longer time steps, the estimate is refined. A walk along the line of sight finds the cell's horizon
towards the sun at the estimated time (``skugga.shadows.sun_hours.sight_walks``). The method of false position then gives a better
time, and so on, with at most ``MAX_WALKS`` walks. The loops are compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.sun_hours.quadratics import evaluate_quadratic
from skugga.shadows.sun_hours.sight_walks import SunTrack, WalkedGround, clearance_tangent
from skugga.shadows.sweep.orientation import GridOrientation, copy_values
from skugga.terrain.compiled import compiled, internal, map_on_cores

NO_OCCLUDER_CLEARANCE = np.float32(1e6)
"""Clearance of a cell without any occluder."""

SHADOW_SIDE_WEIGHT = 0.75
"""Weight of the time extrapolated from clearances in shadow, against that from clearances in the sun."""

FLOOR_MARGIN_SINE = 0.002
"""Depth of the sun below the minimum altitude that counts, as a sine, from which clearances are ignored: a tenth of a degree.

Such a low sun occurs at one side of a wide block, while it has risen at the other side. A cell that is sunlit at the next moment
then counts as lit from its own sunrise on. A cell that was sunlit at the moment before counts as lit until its own sunset.
"""

MAX_WALKS = 3
"""Maximum number of walks along a cell's line of sight to refine one crossing."""

MAX_INTERPOLATED_MINUTES = 12.5
"""Time step, minutes, up to which clearance tangents at its two moments locate a crossing without walks.

In mountains hours of sun with steps of 12 minutes are wrong by 0.04 minutes more than with steps of a minute.
"""

CROSSING_TOLERANCE_MINUTES = 1.0
"""Correction of a crossing's time, minutes, below which no further walk follows. The remaining error is a tenth of it."""

NO_TANGENTS = np.zeros((0, 0), np.float32)
"""An empty array, where the clearance tangents of cells are not known."""

BAND_ROWS = 128
"""Rows that a thread processes at a time."""


class SunSpells(NamedTuple):
    """Spells (unbroken intervals) of direct sun at cells up to a moment, float32 (n, m) each.

    Attributes
    ----------
    spell_start_minutes
        Start of the current spell, minutes after the start of the day's window of time; -1 in shade.
    day_minutes
        Minutes of sun on the current date.
    first_minutes, last_minutes
        Earliest and latest clock time of sun on any date, minutes from midnight; NaN without sun.
    longest_minutes
        The longest spell on any date, minutes.
    total_minutes
        Minutes of sun on all complete dates.
    day_count
        Number of dates with enough sun.
    """

    spell_start_minutes: np.ndarray
    day_minutes: np.ndarray
    first_minutes: np.ndarray
    last_minutes: np.ndarray
    longest_minutes: np.ndarray
    total_minutes: np.ndarray
    day_count: np.ndarray


class WalkInput(NamedTuple):
    """The input of walks that find the horizons of cells between two moments.

    Attributes
    ----------
    ground
        The ground that casts shadows.
    track
        The direction to the sun.
    eye_height_m
        Height of the eyes above the nodes of the ground, metres.
    """

    ground: WalkedGround
    track: SunTrack
    eye_height_m: float


class ClockReading(NamedTuple):
    """The readings of a clock during a day's window of time, which may include a change to or from summer time.

    Attributes
    ----------
    start_minutes
        Reading at the window's start, minutes from midnight.
    change_minutes
        Time of the clock change, minutes after the window's start.
    advance_minutes
        Minutes by which the clock is put forward then; 0 without a change.
    """

    start_minutes: float
    change_minutes: float
    advance_minutes: float


@dataclass(frozen=True, eq=False)
class ClearanceSample:
    """The clearances of cells at a moment: the margins by which they see the sun.

    Attributes
    ----------
    minutes
        The moment, minutes after the start of the day's window of time.
    clearance
        float32 (n, m): clearances of the cells, at least 0 in sunlight.
    above_floor_sine
        (k,): the sine of the sun's altitude less that of the minimum altitude that counts, at k positions of the block.
    marched_tangent
        float32 (n, m): the tangent of the sun's altitude less that of the horizon, at cells whose clearance changes its sign before
        or after the moment; undefined at other cells. ``None`` if it is not known.
    """

    minutes: float
    clearance: np.ndarray
    above_floor_sine: np.ndarray
    marched_tangent: np.ndarray | None = None


def empty_spells(shape: tuple[int, int]) -> SunSpells:
    """Return the initial spells of cells (n, m) of a given shape, without any sun."""
    zeros = [np.zeros(shape, np.float32) for _ in range(4)]
    initial = [np.full(shape, value, np.float32) for value in (-1.0, np.nan, np.nan)]
    return SunSpells(initial[0], zeros[0], initial[1], initial[2], zeros[1], zeros[2], zeros[3])


def sun_aligned_spells(spells: SunSpells, before: GridOrientation, after: GridOrientation) -> SunSpells:
    """Return spells of the grid turned by ``before`` in the order of the grid turned by ``after``."""
    return SunSpells(*(sun_aligned_copy(values, before, after) for values in spells))


def sun_aligned_copy(values: np.ndarray, before: GridOrientation, after: GridOrientation) -> np.ndarray:
    """Return a copy of values (n, m) of the grid turned by ``before`` in the order of the grid turned by ``after``."""
    view = after.sun_aligned_view(before.grid_order_view(values))
    out = np.empty(view.shape, view.dtype)
    copy_values(view, out)
    return out


def add_sun_between(
    spells: SunSpells,
    moments: tuple[ClearanceSample, ClearanceSample, ClearanceSample, ClearanceSample],
    clock: ClockReading,
    fit_matrix: np.ndarray,
    is_first_step: bool,
    walk_input: WalkInput | None,
    sun_tangent_bulge: float,
    cores: int,
) -> None:
    """Add the sun between the second and the third of four successive moments to ``spells``.

    The outer two moments improve the estimate of crossings. At the start of a span (an interval with the sun up) the first moment
    equals the second one, and at its end the fourth equals the third one. ``is_first_step`` tells whether this is the first time
    step of a span. ``fit_matrix`` is the ``quadratic_fit`` for ``ClearanceSample.above_floor_sine``. ``walk_input``, unless it is
    ``None``, refines the crossings by walks. ``sun_tangent_bulge`` is the tangent of the sun's altitude midway between the second
    and the third moment, less the mean of the tangents at these two.
    """
    before, start_moment, end_moment, after = moments
    times = np.array([moment.minutes for moment in moments])
    floored = min(float(start_moment.above_floor_sine.min()), float(end_moment.above_floor_sine.min())) <= 0.0
    floors = np.stack([fit_matrix @ start_moment.above_floor_sine, fit_matrix @ end_moment.above_floor_sine])

    start_tangent, end_tangent = start_moment.marched_tangent, end_moment.marched_tangent
    if start_tangent is None or end_tangent is None:
        start_tangent = end_tangent = NO_TANGENTS

    def add_band(rows: slice) -> None:
        part = SunSpells(*(values[rows] for values in spells))
        four = (before.clearance[rows], start_moment.clearance[rows], end_moment.clearance[rows], after.clearance[rows])
        tangents = start_tangent[rows], end_tangent[rows]
        _add_sun(
            part, *four, *tangents, sun_tangent_bulge, times, floors, is_first_step, floored, rows.start, len(spells.day_minutes),
            clock, walk_input,
        )  # fmt: skip

    _run_in_bands(add_band, len(spells.day_minutes), cores)


def end_spells(spells: SunSpells, minutes: float, clock: ClockReading) -> None:
    """End all current spells at a moment, ``minutes`` after the start of the day's window of time."""
    _end_all_spells(spells, minutes, clock)


def end_day(spells: SunSpells, threshold_minutes: float) -> None:
    """Add the current date's minutes of sun to the total, and set them to 0 for the next date.

    A date with at least ``threshold_minutes`` minutes of sun counts in ``SunSpells.day_count``.
    """
    np.add(spells.total_minutes, spells.day_minutes, out=spells.total_minutes)
    np.add(spells.day_count, spells.day_minutes >= np.float32(threshold_minutes), out=spells.day_count, casting="unsafe")
    spells.day_minutes[:] = 0.0


def compute_clearances(
    ray_height: np.ndarray, shadow_ray_heights: np.ndarray, eye_height_m: float, out: np.ndarray, cores: int
) -> np.ndarray:
    """Compute the clearances of eyes above the cells' nodes into ``out`` float32 (n, m), and return it.

    ``ray_height`` and ``shadow_ray_heights`` (n, m), metres, are those of ``NodeClearance`` (``skugga.shadows.sweep.sweep``).
    ``eye_height_m`` is the height of the eyes, converted to ray height.
    """

    def write_band(rows: slice) -> None:
        _write_clearances(ray_height[rows], shadow_ray_heights[rows], np.float32(eye_height_m), out[rows])

    _run_in_bands(write_band, len(out), cores)
    return out


def _run_in_bands(work: Callable[[slice], None], rows: int, cores: int) -> None:
    """Call ``work`` with consecutive slices that cover ``rows`` rows, on several threads."""
    map_on_cores(work, (slice(first, min(first + BAND_ROWS, rows)) for first in range(0, rows, BAND_ROWS)), cores)


@compiled
def _write_clearances(ray_height, shadow_ray_heights, eye_height_m, out):
    """Write ray heights less shadow heights plus the height of the eyes to ``out`` (rows, cols), metres.

    The parameters are those of ``compute_clearances``.
    """
    rows, cols = out.shape
    for i in range(rows):
        ray_height_row, shade_row, out_row = ray_height[i], shadow_ray_heights[i], out[i]
        for j in range(cols):
            clearance = ray_height_row[j] - shade_row[j] + eye_height_m
            out_row[j] = NO_OCCLUDER_CLEARANCE if clearance > NO_OCCLUDER_CLEARANCE else clearance


@compiled
def _add_sun(
    spells, before, start, stop, after, start_tangent, stop_tangent, sun_tangent_bulge, times, floors, is_first_step, crosses_floor,
    first_row, count, clock, walk_input,
):  # fmt: skip
    """Add the sun of some rows between two moments to ``spells``, which holds these rows alone.

    ``before``, ``start``, ``stop`` and ``after`` (rows, cols) are the clearances at the four moments ``times`` (4,), minutes; the
    sun between the second and the third one is added. ``start_tangent`` and ``stop_tangent`` (rows, cols) are the clearance
    tangents of these two, or empty; ``sun_tangent_bulge`` is that of ``add_sun_between``. ``floors`` (2, 6) are quadratics of the
    sun's height above the floor (the minimum altitude that counts), as a sine, at these two moments. ``crosses_floor`` tells
    whether the sun may be below the floor at a cell. The rows begin at row ``first_row`` of the ``count`` rows of the block.
    ``is_first_step``, ``clock`` and ``walk_input`` are those of ``add_sun_between``.
    """
    t0, t1 = times[1], times[2]
    rows, cols = start.shape
    for i in range(rows):
        for j in range(cols):
            e0, e1 = start[i, j], stop[i, j]
            lit0, lit1 = e0 >= 0.0, e1 >= 0.0
            if lit0 == lit1 and not is_first_step and not crosses_floor:
                continue
            if np.isnan(e0) or np.isnan(e1):
                continue
            begin, end = t0, t1
            if lit0 != lit1:
                crossing = np.nan
                if start_tangent.size and stop_tangent.size:
                    crossing = _interpolate_crossing(start_tangent[i, j], stop_tangent[i, j], lit0, sun_tangent_bulge, t0, t1)
                is_interpolated = not np.isnan(crossing)
                if not is_interpolated:
                    crossing = _estimate_crossing(before[i, j], e0, e1, after[i, j], times)
                if walk_input is not None and not (is_interpolated and t1 - t0 <= MAX_INTERPOLATED_MINUTES):
                    crossing = _refine_crossing(walk_input, first_row + i, j, lit0, crossing, t0, t1)
                if lit0:
                    end = crossing
                else:
                    begin = crossing
            elif not lit0:
                end = t0 - 1.0
            if crosses_floor:
                y, x = (first_row + i) / max(count - 1, 1), j / max(cols - 1, 1)
                s0, s1 = evaluate_quadratic(floors[0], y, x), evaluate_quadratic(floors[1], y, x)
                if s0 <= 0.0 and s1 <= 0.0:
                    end = t0 - 1.0
                elif s0 <= 0.0:
                    begin = max(t0 if lit1 and s0 < -FLOOR_MARGIN_SINE else begin, t0 + (t1 - t0) * s0 / (s0 - s1))
                elif s1 <= 0.0:
                    end = min(t1 if lit0 and s1 < -FLOOR_MARGIN_SINE else end, t0 + (t1 - t0) * s0 / (s0 - s1))
            since = np.float64(spells.spell_start_minutes[i, j])
            if since >= 0.0 and (end < begin or begin > t0):
                _end_spell(spells, i, j, since, t0, clock)
                since = -1.0
            if end >= begin:
                if since < 0.0:
                    since = begin
                if end < t1:
                    _end_spell(spells, i, j, since, end, clock)
                    since = -1.0
            spells.spell_start_minutes[i, j] = since


@internal
def _interpolate_crossing(c0, c1, lit0, sun_tangent_bulge, t0, t1):
    """Interpolate the time at which a clearance tangent crosses 0 between ``t0`` and ``t1``, where it is ``c0`` and ``c1``.

    The tangent of the horizon changes linearly, that of the sun along a parabola, which rises by ``sun_tangent_bulge`` above its
    chord. The result is NaN if the signs of the tangents do not fit ``lit0``, whether the cell is sunlit at ``t0``.
    """
    c0, c1 = np.float64(c0), np.float64(c1)
    if (c0 >= 0.0) != lit0 or (c1 >= 0.0) == lit0:
        return np.nan
    u = c0 / (c0 - c1)
    slope = c1 - c0 + 4.0 * sun_tangent_bulge * (1.0 - 2.0 * u)
    if slope * (c1 - c0) > 0.0:  # one step of Newton's method, from the chord's crossing
        u -= 4.0 * sun_tangent_bulge * u * (1.0 - u) / slope
    return t0 + (t1 - t0) * min(max(u, 0.0), 1.0)


@internal
def _estimate_crossing(before, e0, e1, after, times):
    """Estimate the time at which a clearance crosses 0 between the second and the third of four moments.

    ``before``, ``e0``, ``e1`` and ``after`` are the clearances at ``times`` (4,), minutes.
    """
    tb, t0, t1, ta = times[0], times[1], times[2], times[3]
    by_before = by_after = np.nan
    if tb < t0 and before < NO_OCCLUDER_CLEARANCE and e0 < NO_OCCLUDER_CLEARANCE and before != e0:
        by_before = t0 + e0 * (t0 - tb) / (before - e0)
    if ta > t1 and after < NO_OCCLUDER_CLEARANCE and e1 < NO_OCCLUDER_CLEARANCE and after != e1:
        by_after = t1 - e1 * (ta - t1) / (after - e1)
    dark, lit = (by_after, by_before) if e0 >= 0.0 else (by_before, by_after)
    known_dark, known_lit = t0 <= dark <= t1, t0 <= lit <= t1
    if known_dark:
        return SHADOW_SIDE_WEIGHT * dark + (1.0 - SHADOW_SIDE_WEIGHT) * lit if known_lit else dark
    if known_lit:
        return lit
    middle = 0.5 * (t0 + t1)
    if e0 >= NO_OCCLUDER_CLEARANCE or e1 >= NO_OCCLUDER_CLEARANCE:
        return middle
    return 0.5 * (middle + t0 + (t1 - t0) * e0 / (e0 - e1))


@internal
def _refine_crossing(walk_input, i, j, lit0, crossing, t0, t1):
    """Refine the estimated time ``crossing`` at which the sun passes a cell's horizon, between ``t0`` and ``t1``, by walks.

    The cell has row ``i`` and column ``j`` of the block's sun-aligned grid. ``lit0`` tells whether it is sunlit at ``t0``. Times
    are in minutes after the start of the day's window of time. ``walk_input`` is a ``WalkInput``.
    """
    low, high = t0, t1
    t, before, clearance_before = crossing, np.nan, np.nan
    for _ in range(MAX_WALKS):
        clearance, rate = clearance_tangent(walk_input.ground, walk_input.track, i, j, walk_input.eye_height_m, t)
        if (clearance >= 0.0) == lit0:
            low = t
        else:
            high = t
        following = t - clearance / rate if np.isnan(before) else t - clearance * (t - before) / (clearance - clearance_before)
        if not low < following < high:
            following = 0.5 * (low + high)
        before, clearance_before = t, clearance
        t, correction_minutes = following, abs(following - t)
        if correction_minutes < CROSSING_TOLERANCE_MINUTES:
            break
    return t


@internal
def _clock_time(clock, minutes):
    """Return the clock's reading, minutes from midnight, at ``minutes`` after the window's start."""
    return (
        minutes
        + clock.start_minutes
        + (clock.advance_minutes if clock.advance_minutes != 0.0 and minutes >= clock.change_minutes else 0.0)
    )


@internal
def _end_spell(spells, i, j, since, until, clock):
    """Record a spell of sun of the cell at row ``i`` and column ``j`` of ``spells``.

    It lasts from ``since`` to ``until``, minutes after the start of the day's window of time. ``clock`` is a ``ClockReading``.
    """
    length = until - since
    if length <= 0.0:
        return
    spells.day_minutes[i, j] += length
    spells.longest_minutes[i, j] = max(spells.longest_minutes[i, j], length)
    begun, ended = _clock_time(clock, since), _clock_time(clock, until)
    if not spells.first_minutes[i, j] <= begun:
        spells.first_minutes[i, j] = begun
    if not spells.last_minutes[i, j] >= ended:
        spells.last_minutes[i, j] = ended


@compiled
def _end_all_spells(spells, until, clock):
    """End the current spells of all cells at the moment ``until``, minutes after the start of the day's window of time.

    ``clock`` is a ``ClockReading``.
    """
    rows, cols = spells.spell_start_minutes.shape
    for i in range(rows):
        for j in range(cols):
            since = np.float64(spells.spell_start_minutes[i, j])
            if since >= 0.0:
                _end_spell(spells, i, j, since, until, clock)
                spells.spell_start_minutes[i, j] = -1.0
