"""The time step between samples of the sun: the longest for which a block's hours of sun remain accurate.

For some cells, walks along lines of sight find the clearance tangent, that of the sun's altitude less that of the horizon, for each
minute of one day (``skugga.shadows.sun_hours.sight_walks``). They show the error of longer steps. With the long step crossings are
interpolated between clearance tangents, so the test does the same. With the middle step only what happens between two samples is
tested: sun through narrow gaps and shadows of narrow objects. In mountains both errors are small; at roofs and tree crowns both are
large.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.sun_hours.sight_walks import SunTrack, WalkedGround, clearance_tangent, sun_track, walked_ground
from skugga.shadows.sun_hours.suns import WindowSun, sun_spans
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.bare_nodes import BareNodes
from skugga.terrain.scene import Scene

LONG_STEP_MINUTES, MIDDLE_STEP_MINUTES, SHORT_STEP_MINUTES = 12.0, 3.0, 1.0
"""Minutes between two samples: the long and the middle step for ground where they miss little, and the short step for other ground.

With steps beyond the middle one crossings are located by angles (``skugga.shadows.sun_hours.marched_clearances``), so that the long
step is as accurate as the middle one where it misses nothing. Hours of sun are accurate to a third of a minute.
"""

MAX_SAMPLED_CELLS = 1000
"""Number of cells of a block, chosen at random, that are tested."""

TRACK_INTERVAL_MINUTES = 15
"""Minutes during which the sun's path is approximated by a parabola."""

MAX_LONG_STEP_ERROR_MINUTES = 0.25
"""Upper bound of the mean error of a day's sun, minutes, by the interpolation in long steps.

Mountains have 0.18 to 0.26, rough ones 0.35 to 0.6, cities 1.3 to 2.4. Most of it has no part in the error against rays, which is
0.2 to 0.3 minutes with any step.
"""

MAX_MISSED_MINUTES = 0.006
"""Upper bound of the mean minutes a day that middle steps may miss.

Mountains have 0.000 to 0.005, cities 0.01 to 0.07, and surfaces of woods 0.03 to 0.23.
"""

IDENTITY_ORIENTATION = GridOrientation(axes_swapped=False, rows_reversed=False, cols_reversed=False)
"""The orientation that leaves a grid unchanged."""


def sampling_step_minutes(scene: Scene, nodes: BareNodes, day: WindowSun, min_altitude_deg: float, height_m: float) -> float:
    """Return the minutes between two samples of a day's sun, for a block of ground without objects.

    Points ``height_m`` metres above the ground are tested, while the sun is above ``min_altitude_deg``. Ground beside the block
    is ignored. It is far from most cells, and distant ground casts shadows that last longer than a step.
    """
    clearances = clearance_tangents_by_minute(scene, nodes, day, min_altitude_deg, height_m)
    if sum(interpolation_error_minutes(of_span, int(LONG_STEP_MINUTES)) for of_span in clearances) <= MAX_LONG_STEP_ERROR_MINUTES:
        return LONG_STEP_MINUTES
    lit = np.concatenate([of_span >= 0.0 for of_span in clearances], axis=1)
    missed_of_cells = missed_minutes(lit, int(MIDDLE_STEP_MINUTES))
    return MIDDLE_STEP_MINUTES if missed_of_cells.mean() <= MAX_MISSED_MINUTES else SHORT_STEP_MINUTES


def clearance_tangents_by_minute(
    scene: Scene, nodes: BareNodes, day: WindowSun, min_altitude_deg: float, height_m: float
) -> list[np.ndarray]:
    """Return the clearance tangents of some cells of a block for each minute that the sun is up, (cells, minutes) for each span.

    They are tangents of the sun's altitude less those of the horizon. The arguments are those of ``sampling_step_minutes``. At most
    ``MAX_SAMPLED_CELLS`` cells are chosen at random.
    """
    rows, cols = np.nonzero(nodes.shows_ground)
    sample = np.random.default_rng(0).choice(len(rows), min(MAX_SAMPLED_CELLS, len(rows)), replace=False)
    cells = np.stack([rows[sample], cols[sample]], axis=1)
    ground = walked_ground(scene, nodes, ())
    spans = [np.empty((len(cells), 0))]
    for span in sun_spans(day, nodes.view, scene.world, min_altitude_deg, TRACK_INTERVAL_MINUTES):
        first, last = span.sample_minutes(0), span.sample_minutes(len(span.samples_minutes) - 1)
        parts = [np.empty((len(cells), 0))]
        for begin in np.arange(first, last, TRACK_INTERVAL_MINUTES):
            end = min(begin + TRACK_INTERVAL_MINUTES, last)
            track = sun_track(day, nodes, scene.world, IDENTITY_ORIENTATION, (float(begin), float(end)))
            parts.append(_clearances_by_minute(ground, track, cells, height_m, np.arange(begin, end)))
        spans.append(np.concatenate(parts, axis=1))
    return spans


def interpolation_error_minutes(clearance: np.ndarray, step_minutes: int) -> float:
    """Return the mean absolute error of cells' minutes of sun, if their clearances are interpolated in steps; 0 without minutes.

    ``clearance`` (n, m) are the clearances of n cells in m successive minutes, at least 0 in sunlight. Between two minutes they
    change linearly.
    """
    last = clearance.shape[1] - 1
    if last < 1:
        return 0.0
    every_minute, steps = np.arange(last + 1), np.append(np.arange(0, last, step_minutes), last)
    return float(np.abs(_sunlit_minutes(clearance, steps) - _sunlit_minutes(clearance, every_minute)).mean())


def _sunlit_minutes(clearance: np.ndarray, minutes: np.ndarray) -> np.ndarray:
    """Return the minutes of sun of cells (n,) whose clearances change linearly from one of ``minutes`` to the next one."""
    begin, end = clearance[:, minutes[:-1]], clearance[:, minutes[1:]]
    above, below = np.maximum(np.maximum(begin, end), 0.0), np.minimum(np.minimum(begin, end), 0.0)
    lit_share = np.where(above > below, above / np.where(above > below, above - below, 1.0), 1.0)
    return np.asarray(lit_share @ np.diff(minutes))


def missed_minutes(lit: np.ndarray, step_minutes: int) -> np.ndarray:
    """Return the absolute errors of a day's minutes of sun at n cells, if only every ``step_minutes``-th minute is sampled: (n,).

    ``lit`` bool (n, minutes) is the truth. If two successive samples differ, the first change between them is assumed to be located
    exactly. If they are equal, all changes between them are missed.
    """
    error_minutes = np.zeros(len(lit))
    for begin in range(0, lit.shape[1] - 1, step_minutes):
        end = min(begin + step_minutes, lit.shape[1] - 1)
        inside = lit[:, begin:end]
        before, after = lit[:, begin], lit[:, end]
        first_change = np.where((inside != before[:, None]).any(axis=1), (inside != before[:, None]).argmax(axis=1), end - begin)
        same_until = np.where(before == after, end - begin, first_change)
        counted_minutes = np.where(before, same_until, end - begin - same_until)
        error_minutes += counted_minutes - inside.sum(axis=1)
    return np.abs(error_minutes)


@compiled
def _clearances_by_minute(
    ground: WalkedGround, track: SunTrack, cells: np.ndarray, height_m: float, times: np.ndarray
) -> np.ndarray:
    """Return the clearance tangents of cells (n, 2) at ``times`` (k,), minutes: (n, k).

    A cell is its row and column, and its eye is ``height_m`` metres above the ground. ``track`` gives the direction to the sun.
    """
    clearance = np.empty((len(cells), len(times)))
    for n in range(len(cells)):
        for k in range(len(times)):
            clearance[n, k], _ = clearance_tangent(ground, track, cells[n, 0], cells[n, 1], height_m, times[k])
    return clearance
