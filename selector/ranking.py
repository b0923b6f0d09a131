"""Who wins: of candidates with a time and an error, measured or predicted, the one that a target asks for. Pure arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from skugga.selector.formatting import format_duration, format_percent
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.truth.metrics import MOST_INTERIOR

TIME_TIE_RATIO = 1.05
"""Times that lie as close as this count as one: the more accurate of two such candidates is taken."""


@dataclass(frozen=True)
class CandidateFigures:
    """A candidate's: shadow milliseconds of the view, ``error`` as the target counts it (``wrong_cast``, or ``coverage``), and the
    share of interior errors; shares in [0, 1].
    """

    name: str
    ms: float
    error: float
    interior: float


@dataclass(frozen=True)
class RankingResult:
    """The winner, whether it meets the target, and if it does not, by how much."""

    winner: CandidateFigures
    met: bool
    missed_by: str | None


def best(
    candidates: Sequence[CandidateFigures], max_error: float, max_ms: float | None = None, tie_ratio: float = TIME_TIE_RATIO
) -> RankingResult:
    """The candidate that a target asks for.

    1. Of those that meet the error (and the interior) within the time, the cheapest; of times within ``tie_ratio`` of the least,
    the most
       accurate.
    2. Else, of those within the time that is asked for, one without interior failure before one with it, then the most accurate.
    3. Else the nearest: the least of the larger of the overshoots, each relative to what is allowed.

    What still ties goes by error, interior, time and name. ``none`` is never taken because an error happens to be small: only where
    there is nothing else. Raises ``ValueError`` where there is nothing at all.
    """
    capable = [figures for figures in candidates if figures.name != NO_SHADOWS] or list(candidates)
    if not capable:
        raise ValueError("of no candidates there is no best one")
    in_time = [figures for figures in capable if max_ms is None or figures.ms <= max_ms]
    accurate = [figures for figures in in_time if figures.error <= max_error and figures.interior <= MOST_INTERIOR]
    if accurate:
        least_ms = min(figures.ms for figures in accurate)
        return RankingResult(
            min((figures for figures in accurate if figures.ms <= tie_ratio * least_ms), key=_accuracy), True, None
        )
    if max_ms is not None and in_time:
        winner = min(in_time, key=lambda figures: (_clean(figures, max_error), *_accuracy(figures)))
    else:
        winner = min(capable, key=lambda figures: (relative_overshoot(figures, max_error, max_ms), *_accuracy(figures)))
    return RankingResult(winner, False, _missed_by(winner, max_error, max_ms))


def relative_overshoot(figures: CandidateFigures, max_error: float, max_ms: float | None = None) -> float:
    """The larger of the overshoots of error, interior and time, each relative to what is allowed; 0 where the target is met.

    An error's is held against ``MOST_INTERIOR`` at least, so that a target of no error has a nearest candidate, too.
    """
    return max(
        0.0,
        (figures.error - max_error) / max(max_error, MOST_INTERIOR),
        figures.interior / MOST_INTERIOR - 1.0,
        0.0 if max_ms is None else figures.ms / max_ms - 1.0,
    )


def _clean(figures: CandidateFigures, max_error: float) -> float:
    """0 without interior failure, else how bad that or the error is."""
    return 0.0 if figures.interior <= MOST_INTERIOR else relative_overshoot(figures, max_error)


def _accuracy(figures: CandidateFigures) -> tuple[float, float, float, str]:
    return figures.error, figures.interior, figures.ms, figures.name


def _missed_by(figures: CandidateFigures, max_error: float, max_ms: float | None) -> str:
    over = []
    if figures.error > max_error:
        over.append(
            f"an error of {format_percent(figures.error)}, {format_percent(figures.error - max_error)} more "
            f"than {format_percent(max_error)}"
        )
    if figures.interior > MOST_INTERIOR:
        more = format_percent(figures.interior - MOST_INTERIOR)
        over.append(f"an interior error of {format_percent(figures.interior)}, {more} more than {format_percent(MOST_INTERIOR)}")
    if max_ms is not None and figures.ms > max_ms:
        over.append(f"{format_duration(figures.ms)}, {format_duration(figures.ms - max_ms)} more than {format_duration(max_ms)}")
    return "; ".join(over)
