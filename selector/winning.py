"""Who wins: of candidates with a time and an error, measured or predicted, the one that a target asks for. Pure arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from selector.words import duration, percent

MOST_INTERIOR = 0.001
"""Share of the decidable pixels that may be wrong inside a shadow or a light: more is failure, not aliasing. It is also the least
that overshoots of an error are held against, so that a target of no error has a nearest candidate, too.
"""

ALIKE = 1.05
"""Times that lie as close as this count as one: the more accurate of two such candidates is taken."""

NOTHING = "none"
"""The name of what casts no shadows."""


@dataclass(frozen=True)
class Figures:
    """A candidate's: shadow milliseconds of the view, ``error`` as the target counts it (``wrong_cast``, or ``coverage``), and the
    share of interior errors; shares in [0, 1].
    """

    name: str
    ms: float
    error: float
    interior: float


@dataclass(frozen=True)
class Verdict:
    """The winner, whether it meets the target, and if it does not, by how much."""

    winner: Figures
    met: bool
    missed_by: str | None


def best(candidates: Sequence[Figures], max_error: float, max_ms: float | None = None, alike: float = ALIKE) -> Verdict:
    """The candidate that a target asks for.

    1. Of those that meet the error (and the interior) within the time, the cheapest; of times ``alike`` to the least, the most
       accurate.
    2. Else, of those within the time that is asked for, one without interior failure before one with it, then the most accurate.
    3. Else the nearest: the least of the larger of the overshoots, each relative to what is allowed.

    What still ties goes by error, interior, time and name. ``none`` is never taken because an error happens to be small: only where
    there is nothing else. Raises ``ValueError`` where there is nothing at all.
    """
    able = [one for one in candidates if one.name != NOTHING] or list(candidates)
    if not able:
        raise ValueError("of no candidates there is no best one")
    in_time = [one for one in able if max_ms is None or one.ms <= max_ms]
    accurate = [one for one in in_time if one.error <= max_error and one.interior <= MOST_INTERIOR]
    if accurate:
        least_ms = min(one.ms for one in accurate)
        return Verdict(min((one for one in accurate if one.ms <= alike * least_ms), key=_accuracy), True, None)
    if max_ms is not None and in_time:
        winner = min(in_time, key=lambda one: (_clean(one, max_error), *_accuracy(one)))
    else:
        winner = min(able, key=lambda one: (overshoot(one, max_error, max_ms), *_accuracy(one)))
    return Verdict(winner, False, _missed_by(winner, max_error, max_ms))


def overshoot(figures: Figures, max_error: float, max_ms: float | None = None) -> float:
    """The larger of the overshoots of error, interior and time, each relative to what is allowed; 0 where the target is met."""
    return max(
        0.0,
        (figures.error - max_error) / max(max_error, MOST_INTERIOR),
        figures.interior / MOST_INTERIOR - 1.0,
        0.0 if max_ms is None else figures.ms / max_ms - 1.0,
    )


def _clean(figures: Figures, max_error: float) -> float:
    """0 without interior failure, else how bad that or the error is."""
    return 0.0 if figures.interior <= MOST_INTERIOR else overshoot(figures, max_error)


def _accuracy(figures: Figures) -> tuple[float, float, float, str]:
    return figures.error, figures.interior, figures.ms, figures.name


def _missed_by(figures: Figures, max_error: float, max_ms: float | None) -> str:
    over = []
    if figures.error > max_error:
        over.append(f"an error of {percent(figures.error)}, {percent(figures.error - max_error)} more than {percent(max_error)}")
    if figures.interior > MOST_INTERIOR:
        more = percent(figures.interior - MOST_INTERIOR)
        over.append(f"an interior error of {percent(figures.interior)}, {more} more than {percent(MOST_INTERIOR)}")
    if max_ms is not None and figures.ms > max_ms:
        over.append(f"{duration(figures.ms)}, {duration(figures.ms - max_ms)} more than {duration(max_ms)}")
    return "; ".join(over)
