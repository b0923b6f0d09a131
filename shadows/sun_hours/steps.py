"""The time step between samples of the sun: the longest for which a block's hours of sun remain accurate.

For some cells, walks along lines of sight find the horizon towards the sun for each minute of one day
(``skugga.shadows.sun_hours.sight_walks``). They show what longer steps would miss. That is sun through narrow gaps and shadows of
narrow objects, which begin and end between two samples. In mountains both are rare; at roofs and tree crowns both are frequent.
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

MAX_MISSED_MINUTES = {LONG_STEP_MINUTES: 0.03, MIDDLE_STEP_MINUTES: 0.006}
"""Upper bounds of the mean minutes a day that steps may miss, by step, the longest first.

Long steps miss 0.00 to 0.02 minutes in mountains (0.05 in December), 0.1 to 0.6 in cities and 0.4 to 1.7 on surfaces of woods.
Middle steps miss 0.000 to 0.005 in mountains, 0.01 to 0.07 in cities and 0.03 to 0.23 on surfaces of woods.
"""

IDENTITY_ORIENTATION = GridOrientation(axes_swapped=False, rows_reversed=False, cols_reversed=False)
"""The orientation that leaves a grid unchanged."""


def sampling_step_minutes(scene: Scene, nodes: BareNodes, day: WindowSun, min_altitude_deg: float, height_m: float) -> float:
    """Return the minutes between two samples of a day's sun, for a block of ground without objects.

    Points ``height_m`` metres above the ground are tested, while the sun is above ``min_altitude_deg``. Ground beside the block
    is ignored. It is far from most cells, and distant ground casts shadows that last longer than a step.
    """
    lit = lit_by_minute(scene, nodes, day, min_altitude_deg, height_m)
    for step, max_missed in MAX_MISSED_MINUTES.items():
        if missed_minutes(lit, int(step)).mean() <= max_missed:
            return step
    return SHORT_STEP_MINUTES


def lit_by_minute(scene: Scene, nodes: BareNodes, day: WindowSun, min_altitude_deg: float, height_m: float) -> np.ndarray:
    """Return whether some cells of a block see the sun, for each minute that it is up: bool (cells, minutes).

    The arguments are those of ``sampling_step_minutes``. At most ``MAX_SAMPLED_CELLS`` cells are chosen at random.
    """
    rows, cols = np.nonzero(nodes.shows_ground)
    sample = np.random.default_rng(0).choice(len(rows), min(MAX_SAMPLED_CELLS, len(rows)), replace=False)
    cells = np.stack([rows[sample], cols[sample]], axis=1)
    ground = walked_ground(scene, nodes, ())
    parts = [np.empty((len(cells), 0), bool)]
    for span in sun_spans(day, nodes.view, scene.world, min_altitude_deg, TRACK_INTERVAL_MINUTES):
        first, last = span.sample_minutes(0), span.sample_minutes(len(span.samples_minutes) - 1)
        for begin in np.arange(first, last, TRACK_INTERVAL_MINUTES):
            times = np.arange(begin, min(begin + TRACK_INTERVAL_MINUTES, last))
            track = sun_track(
                day, nodes, scene.world, IDENTITY_ORIENTATION, (float(begin), float(min(begin + TRACK_INTERVAL_MINUTES, last)))
            )
            parts.append(_sunlit_by_minute(ground, track, cells, height_m, times))
    return np.concatenate(parts, axis=1)


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
def _sunlit_by_minute(ground: WalkedGround, track: SunTrack, cells: np.ndarray, height_m: float, times: np.ndarray) -> np.ndarray:
    """Return whether cells (n, 2) see the sun at ``times`` (k,), minutes: bool (n, k).

    A cell is its row and column, and its eye is ``height_m`` metres above the ground. ``track`` gives the direction to the sun.
    """
    lit = np.empty((len(cells), len(times)), np.bool_)
    for n in range(len(cells)):
        for k in range(len(times)):
            clearance, _ = clearance_tangent(ground, track, cells[n, 0], cells[n, 1], height_m, times[k])
            lit[n, k] = clearance >= 0.0
    return lit
