"""Runs of sweep lines: adjacent lines that are processed at once, since their positions vary almost linearly."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import internal

MAX_RUN_LINES = 512
"""Maximum number of lines in a run (lines of one number in adjacent cells, which are processed at once)."""

LINEARITY_TOLERANCE = 0.01
"""Tolerance in cells for positions in a run of adjacent lines, which are interpolated linearly between its first and last line."""


@internal
def max_run_length(cubic, low, high, position_factor):
    """Return the maximum number of adjacent lines or nodes whose positions a straight line interpolates between both ends.

    The positions are ``position_factor`` times the value of the cubic ``cubic`` (4,), constant term first, at consecutive integers
    from ``low`` to ``high``. The tolerance is ``LINEARITY_TOLERANCE``. The result is at most ``MAX_RUN_LINES``.
    """
    bend = position_factor * max(abs(2.0 * cubic[2] + 6.0 * cubic[3] * low), abs(2.0 * cubic[2] + 6.0 * cubic[3] * high))
    return (
        MAX_RUN_LINES
        if bend * MAX_RUN_LINES * MAX_RUN_LINES <= 8.0 * LINEARITY_TOLERANCE
        else max(int(np.sqrt(8.0 * LINEARITY_TOLERANCE / bend)), 2)
    )
