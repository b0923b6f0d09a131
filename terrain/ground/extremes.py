"""Running minima and maxima over many rows of values, column by column."""

from __future__ import annotations

from skugga.terrain.compiled import internal


@internal
def update_ranges(values, low, high):
    """Extend the range of each element, from ``low`` to ``high``, so that it includes the element of ``values``.

    NaN changes no range. All arrays have the same length. The loop compiles to vector instructions: comparisons with NaN are false.
    """
    for j in range(values.size):
        value = values[j]
        low[j] = value if value < low[j] else low[j]
        high[j] = value if value > high[j] else high[j]
