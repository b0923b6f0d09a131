"""Running minima and maxima over many rows of values, column by column."""

from __future__ import annotations

from skugga.terrain.compiled import internal


@internal
def widen(values, least, most):
    """Extend the ranges from ``least`` to ``most`` so that they include ``values``, element by element. NaN changes nothing.

    All arrays have the same length. The loop compiles to vector instructions: comparisons with NaN are false.
    """
    for j in range(values.size):
        value = values[j]
        least[j] = value if value < least[j] else least[j]
        most[j] = value if value > most[j] else most[j]
