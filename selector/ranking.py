"""Select the best of several candidates by their times and errors, for limits of error and time. Pure arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from skugga.selector.formatting import format_duration, format_percent
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE

TIME_TIE_RATIO = 1.05
"""Maximum ratio of two times that count as equal. Of such candidates the more accurate one wins."""


@dataclass(frozen=True)
class CandidateFigures:
    """Time and errors of a candidate.

    Attributes
    ----------
    name
        Name of the candidate.
    ms
        Shadow time of the view, milliseconds.
    error
        The error that is compared with the requested limit (``wrong_cast`` or ``coverage``), in [0, 1].
    interior
        Share of interior errors (pixels that are wrong far from shadow edges), in [0, 1].
    """

    name: str
    ms: float
    error: float
    interior: float


@dataclass(frozen=True)
class RankingResult:
    """The best candidate for a target (limits of error and time).

    Attributes
    ----------
    winner
        The best candidate.
    meets_target
        Whether the winner meets the target.
    missed_by
        By how much it exceeds the limits, in words; ``None`` if it meets them.
    """

    winner: CandidateFigures
    meets_target: bool
    missed_by: str | None


def best_candidate(
    candidates: Sequence[CandidateFigures], max_error: float, max_ms: float | None = None, tie_ratio: float = TIME_TIE_RATIO
) -> RankingResult:
    """Return the best candidate for a maximum error, in [0, 1], and a maximum time in milliseconds; ``None`` is no time limit.

    1. The fastest candidate that meets the limits of error, interior error and time. Of the candidates whose times are at most
       ``tie_ratio`` times the least time, the most accurate one wins.
    2. Otherwise, the most accurate candidate within the time limit. Candidates with an interior error of at most
       ``MAX_INTERIOR_SHARE`` come first.
    3. Otherwise, the candidate with the smallest ``relative_overshoot``.

    Remaining ties are resolved by error, interior error, time and name. The algorithm ``none``, which draws no shadows, wins only
    if it is the only candidate. Raises ``ValueError`` without candidates.
    """
    capable = [figures for figures in candidates if figures.name != NO_SHADOWS] or list(candidates)
    if not capable:
        raise ValueError("no candidates. Pass at least one.")
    in_time = [figures for figures in capable if max_ms is None or figures.ms <= max_ms]
    accurate = [figures for figures in in_time if figures.error <= max_error and figures.interior <= MAX_INTERIOR_SHARE]
    if accurate:
        min_ms = min(figures.ms for figures in accurate)
        return RankingResult(
            min((figures for figures in accurate if figures.ms <= tie_ratio * min_ms), key=_accuracy_key), True, None
        )
    if max_ms is not None and in_time:
        winner = min(in_time, key=lambda figures: (_interior_rank(figures, max_error), *_accuracy_key(figures)))
    else:
        winner = min(capable, key=lambda figures: (relative_overshoot(figures, max_error, max_ms), *_accuracy_key(figures)))
    return RankingResult(winner, False, _missed_by(winner, max_error, max_ms))


def relative_overshoot(figures: CandidateFigures, max_error: float, max_ms: float | None = None) -> float:
    """Return the largest excess of error, interior error and time over their limits, relative to the limit; at least 0.

    A result of 0 means that all limits are met. The excess of the error is divided by at least ``MAX_INTERIOR_SHARE``, so that it
    is finite for a limit of 0.
    """
    return max(
        0.0,
        (figures.error - max_error) / max(max_error, MAX_INTERIOR_SHARE),
        figures.interior / MAX_INTERIOR_SHARE - 1.0,
        0.0 if max_ms is None else figures.ms / max_ms - 1.0,
    )


def _interior_rank(figures: CandidateFigures, max_error: float) -> float:
    """Return a sort key: 0 if the interior error is at most ``MAX_INTERIOR_SHARE``, else the relative overshoot."""
    return 0.0 if figures.interior <= MAX_INTERIOR_SHARE else relative_overshoot(figures, max_error)


def _accuracy_key(figures: CandidateFigures) -> tuple[float, float, float, str]:
    """Return a sort key that puts the most accurate candidate first: by error, interior error, time and name."""
    return figures.error, figures.interior, figures.ms, figures.name


def _missed_by(figures: CandidateFigures, max_error: float, max_ms: float | None) -> str:
    """Return by how much a candidate exceeds each limit, in words; empty if it exceeds none. ``max_ms`` of ``None`` is no limit."""
    over = []
    if figures.error > max_error:
        over.append(
            f"an error of {format_percent(figures.error)}, {format_percent(figures.error - max_error)} more "
            f"than {format_percent(max_error)}"
        )
    if figures.interior > MAX_INTERIOR_SHARE:
        excess = format_percent(figures.interior - MAX_INTERIOR_SHARE)
        over.append(
            f"an interior error of {format_percent(figures.interior)}, {excess} more than {format_percent(MAX_INTERIOR_SHARE)}"
        )
    if max_ms is not None and figures.ms > max_ms:
        over.append(f"{format_duration(figures.ms)}, {format_duration(figures.ms - max_ms)} more than {format_duration(max_ms)}")
    return "; ".join(over)
