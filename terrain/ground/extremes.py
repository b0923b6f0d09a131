"""The least and the greatest of many rows of values, column by column."""

from __future__ import annotations

from skugga.terrain.compiled import internal


@internal
def widen(values, least, most):
    """Let ``least`` and ``most`` (all of the same length) reach as far as ``values``, place by place. NaN changes nothing.

    Written so that it compiles to vector instructions: NaN is neither less nor greater.
    """
    for j in range(values.size):
        value = values[j]
        least[j] = value if value < least[j] else least[j]
        most[j] = value if value > most[j] else most[j]
