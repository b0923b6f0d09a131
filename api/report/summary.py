"""Summary of a comparison in sentences: the fastest row (measured plan), the most accurate row, and the cost of accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from skugga.selector.formatting import format_duration, format_list, format_percent, format_two_digits
from skugga.selector.measure.compare import Comparison
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE

RowFigures = dict[str, Any]
"""Measured figures of a row by key, as ``skugga.api.report.page.table.COLUMNS`` explains them; errors are fractions of 1."""


MAX_EXACT_NOISE_FLOORS = 3.0
"""An error below this multiple of the noise floor counts as exact."""
EQUAL_TIME_RATIO = 1.05
"""Times that differ by less than this ratio count as equal."""
DEFAULT_MAX_ERROR = 0.03
"""Default maximum error of levels."""


def format_summary(comparison: Comparison) -> list[str]:
    """Return sentences on the rows that cast shadows; an empty list if no row does.

    The cost of accuracy is the time of rows on the Pareto front. It starts from the fastest row, in steps that at least halve the
    error. It ends where the error is 0 or below ``MAX_EXACT_NOISE_FLOORS`` times the noise floor, since truth is no more accurate.
    """
    rows = [row.figures for row in comparison.rows if casts_shadow(row.figures, comparison.light)]
    if not rows:
        return []
    summary = _SummaryWriter(comparison.error_metric, MAX_EXACT_NOISE_FLOORS * comparison.noise_floor)
    front = sorted((f for f in rows if f["pareto"]), key=lambda f: (f["ms_median"], summary.error_of(f)))
    return [
        *summary.extreme_sentences(rows), *summary.cost_sentences(front), *_default_sentences(rows, comparison),
        *_softest_sentences(rows, comparison.error_metric),
        *summary.failure_sentences(rows), *_dominated_sentences(rows, comparison.light),
    ]  # fmt: skip


def casts_shadow(figures: RowFigures, light: str) -> bool:
    """Return whether a row uses any algorithm other than ``none`` for a light."""
    return algorithm_family(figures, light) != NO_SHADOWS


def algorithm_family(figures: RowFigures, light: str) -> str:
    """Return a row's algorithms for a light, without settings, such as ``sweep + shadow_map``; ``none`` if none casts."""
    names = [name for name in figures["algorithm"].get(light, {}).values() if name != NO_SHADOWS]
    return " + ".join(dict.fromkeys(names)) or NO_SHADOWS


def is_on_front(figures: RowFigures, light: str) -> bool:
    """Return whether a row casts shadows for a light and is on the Pareto front."""
    return figures["pareto"] and casts_shadow(figures, light)


@dataclass(frozen=True)
class _SummaryWriter:
    """Writer of the sentences about one kind of error.

    Attributes
    ----------
    error_key
        Key of the error among the figures of a row.
    max_exact_error
        Errors up to this value count as exact.
    """

    error_key: str
    max_exact_error: float

    def error_of(self, figures: RowFigures) -> float:
        """Return the error of a row as a fraction of 1."""
        return float(figures[self.error_key])

    def is_exact(self, figures: RowFigures) -> bool:
        """Return whether the error of a row lies within the noise of truth."""
        return self.error_of(figures) <= self.max_exact_error

    def extreme_sentences(self, rows: list[RowFigures]) -> list[str]:
        """Return sentences on the fastest and the most accurate row."""
        fastest = min(rows, key=lambda f: (f["ms_median"], self.error_of(f)))
        best = min(rows, key=lambda f: (0.0 if self.is_exact(f) else self.error_of(f), f["ms_median"]))
        exact_count = sum(map(self.is_exact, rows))
        if len(rows) == 1:
            return [f"{best['name']} is the only one that casts shadows here: {self._result(best)}."]
        if fastest is best:
            others_clause = f"; {exact_count - 1} more {'is' if exact_count == 2 else 'are'} as accurate" if exact_count > 1 else ""
            return [f"{best['name']} is both the fastest and the most accurate: {self._result(best)}{others_clause}."]
        times = f", {_format_ratio(best['ms_median'] / fastest['ms_median'])} the time" if fastest["ms_median"] > 0.0 else ""
        if exact_count > 1:
            accuracy_sentence = f"{exact_count} rows are exact within the noise of truth; the fastest of them is {best['name']}"
            accuracy_sentence = f"{accuracy_sentence}, in {format_duration(best['ms_median'])}"
        else:
            accuracy_sentence = f"The most accurate is {best['name']}: {self._result(best)}"
        return [f"The fastest is {fastest['name']}: {self._result(fastest)}.", f"{accuracy_sentence}{times}."]

    def cost_sentences(self, front: list[RowFigures]) -> list[str]:
        """Return a sentence on the cost of each step of accuracy along a Pareto front, from the fastest row on."""
        sentences, current = [], front[0] if front else None
        while current is not None and not self.is_exact(current):
            next_ = next((f for f in front if self.is_exact(f) or self.error_of(f) <= self.error_of(current) / 2.0), None)
            if next_ is not None and current["ms_median"] > 0.0:
                sentences.append(self._cost_sentence(current, next_))
            current = next_
        return sentences

    def _cost_sentence(self, current: RowFigures, better: RowFigures) -> str:
        """Return a sentence on the time that the more accurate row ``better`` takes, compared with the row ``current``."""
        ratio = better["ms_median"] / current["ms_median"]
        cost_clause = (
            f"{f'costs {_format_ratio(ratio)} the' if ratio >= EQUAL_TIME_RATIO else 'takes hardly more'} time "
            f"({current['name']} to {better['name']})"
        )
        if self.is_exact(better):
            return f"Bringing the error from {format_percent(self.error_of(current))} down to the noise of truth {cost_clause}."
        if self.error_of(better) > self.error_of(current) / 2.5:
            return f"Halving the error from {format_percent(self.error_of(current))} {cost_clause}."
        return (
            f"Bringing the error from {format_percent(self.error_of(current))} down to "
            f"{format_percent(self.error_of(better))} {cost_clause}."
        )

    def failure_sentences(self, rows: list[RowFigures]) -> list[str]:
        """Return a sentence on rows with a small error that are wrong far from shadow edges; an empty list without such rows."""
        failing_rows = [f for f in rows if f["interior"] > MAX_INTERIOR_SHARE and self.error_of(f) <= DEFAULT_MAX_ERROR]
        if not failing_rows:
            return []
        worst = max(f["interior"] for f in failing_rows)
        has, possessive, up_to = ("has", "its", "") if len(failing_rows) == 1 else ("have", "their", "up to ")
        return [
            f"{format_list([f['name'] for f in failing_rows])} {has} interior errors, although {possessive} error is small: {up_to}"
            f"{format_percent(worst)} of the surface is wrong away from shadow edges, which is no aliasing."
        ]

    def _result(self, figures: RowFigures) -> str:
        """Return the error and the time of a row as text."""
        error_phrase = "of the cast shadow wrong" if self.error_key == "wrong_cast" else "difference in shadow share"
        error_text = (
            "exact within the noise of truth"
            if self.is_exact(figures)
            else f"{format_percent(self.error_of(figures))} {error_phrase}"
        )
        return f"{error_text}, in {format_duration(figures['ms_median'])}"


def _default_sentences(rows: list[RowFigures], comparison: Comparison) -> list[str]:
    """Return a sentence on the default plan: it is on a Pareto front, or another row is more accurate in no more time."""
    default = next((f for f in rows if f["name"] == comparison.default_row_name), None)
    if default is None:
        return []
    if default["pareto"] or default["pareto_soft"]:
        fronts = [by for front, by in (("pareto", comparison.error_metric), ("pareto_soft", "soft_error")) if default[front]]
        return [f"The default, {default['name']}, is on the front by {format_list(fronts)}: nothing is better in no more time."]
    better = min(
        (f for f in rows if f["pareto"] and f["ms_median"] <= default["ms_median"]),
        key=lambda f: (f[comparison.error_metric], f["ms_median"]),
        default=None,
    )
    if better is None:
        return []
    return [f"Better than the default, {default['name']}, in no more time is {better['name']}."]


def _softest_sentences(rows: list[RowFigures], error: str) -> list[str]:
    """Return a sentence on the row with the smallest soft error, unless it is also the most accurate one."""
    softest, best = (min(rows, key=lambda f: (f[by], f["ms_median"])) for by in ("soft_error", error))
    if softest is best:
        return []
    soft_error, time = format_percent(softest["soft_error"]), format_duration(softest["ms_median"])
    return [f"Nearest to the soft edges of truth is {softest['name']}: {soft_error} soft error, in {time}."]


def _dominated_sentences(rows: list[RowFigures], light: str) -> list[str]:
    """Return a sentence on algorithms that are never on the Pareto front; an empty list if all are."""
    on_front_names = {name for f in rows if f["pareto"] for name in _algorithms(f, light)}
    dominated = [name for name in dict.fromkeys(name for f in rows for name in _algorithms(f, light)) if name not in on_front_names]
    if not dominated or not on_front_names:
        return []
    serve, are, pronoun = ("serves", "is", "its") if len(dominated) == 1 else ("serve", "are", "their")
    return [
        f"{format_list(dominated, max_items=6)} {serve} this view, but {are} never on the front: "
        f"at each of {pronoun} settings that were compared, something else is no slower and no less accurate."
    ]


def _algorithms(figures: RowFigures, light: str) -> list[str]:
    """Return the names of a row's algorithms for a light; ``none`` if none casts."""
    return algorithm_family(figures, light).split(" + ")


def _format_ratio(ratio: float) -> str:
    """Return a ratio of times as text, such as ``2.5 times``."""
    return f"{format_two_digits(ratio)} times"
