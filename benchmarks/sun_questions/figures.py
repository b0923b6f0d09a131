"""Results of `sun_questions`: the tools' answers to questions about the sun, and which tools are faster and more accurate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.peers.figures import ToolRecord, ToolStanding


@dataclass(frozen=True)
class SunAnswer:
    """A tool's answer to a question in one case.

    Three durations are recorded: computing by the tool's own clock, the whole process, and CPU time of the process and its
    children. They are seconds, and ``None`` if not measured. ``scaled`` marks durations that were extrapolated from a part of the
    work.

    ``wrong`` is the mean error and ``wrong_p99`` its 99th percentile. Their truth uses the tool's own solar positions, shape of the
    earth and north. ``wrong_as_is`` is the mean error against NREL's solar positions on the round earth. ``wrong_in_reach`` is that
    against ground within the distance up to which the tool looks, if it looks less far than the raster's rim. The unit of errors is
    minutes, degrees, shares of cells or per cent of the sky, depending on the question. ``peak_mb`` is the peak memory of the
    largest process, MB.
    """

    question: str
    case: str
    tool: str
    ours: bool
    compute_s: float | None
    whole_s: float | None
    cpu_s: float | None
    wrong: float | None
    wrong_p99: float | None
    wrong_as_is: float | None = None
    scaled: bool = False
    wrong_in_reach: float | None = None
    peak_mb: float | None = None


@dataclass(frozen=True)
class ConventionCheck:
    """Check of a tool's conventions.

    Attributes
    ----------
    tool
        Name of the tool.
    floor_h
        Its hours of sun on a level floor.
    day_h
        The length of the day by its own sun, hours.
    cliff_wrong_min
        Its mean error before a long cliff against the closed form, minutes.
    """

    tool: str
    floor_h: float
    day_h: float
    cliff_wrong_min: float


@dataclass(frozen=True)
class QuestionCase:
    """Data for which a question is asked.

    Attributes
    ----------
    question
        The question.
    case
        Name of the data.
    about
        Description of the data.
    """

    question: str
    case: str
    about: str


@dataclass(frozen=True)
class SunComparison:
    """All results.

    Attributes
    ----------
    where
        Processor and number of cores of the machine.
    load
        One-minute load average at the end.
    took_s
        Duration of the measurement, seconds.
    versions
        Versions of the tools.
    left_out
        Names of skipped tools, with the reason.
    checks, cases, answers
        Checks of conventions, data of the questions, and results.
    date, commit
        Date of the latest measurement, ISO 8601, and abbreviated hash of its commit.
    """

    where: str
    load: float
    took_s: float
    versions: dict[str, str]
    left_out: dict[str, str]
    checks: list[ConventionCheck]
    cases: list[QuestionCase]
    answers: list[SunAnswer]
    date: str = "unknown"
    commit: str = "unknown"

    @staticmethod
    def read(values: dict[str, Any]) -> SunComparison:
        """Build the comparison from values of its JSON file."""
        entry_classes = {"checks": ConventionCheck, "cases": QuestionCase, "answers": SunAnswer}
        return SunComparison(
            **{**values, **{key: [entry_class(**entry) for entry in values[key]] for key, entry_class in entry_classes.items()}}
        )

    def answers_to(self, question: str, case: str | None = None) -> list[SunAnswer]:
        """Return the answers to a question, optionally only those in one case."""
        return [answer for answer in self.answers if answer.question == question and case in (None, answer.case)]


ANSWER_CLOCKS: dict[str, Callable[[SunAnswer], float | None]] = {
    "computing": lambda answer: answer.compute_s,
    "the whole process": lambda answer: answer.whole_s,
    "CPU time of the whole process": lambda answer: answer.cpu_s,
}
"""The clocks by which tools are compared."""


def tool_standings(comparison: SunComparison, question: str, clock: str) -> dict[str, list[ToolStanding]]:
    """Return the tools' standings in each case of a question. ``clock`` is a key of ``ANSWER_CLOCKS``.

    Tools without seconds by ``clock``, or without an error, are omitted.
    """
    result: dict[str, list[ToolStanding]] = {}
    for answer in comparison.answers_to(question):
        taken_s = ANSWER_CLOCKS[clock](answer)
        if taken_s is not None and answer.wrong is not None:
            tool = ToolRecord(answer.tool, "", "", answer.ours, True, 0.0)
            result.setdefault(answer.case, []).append(ToolStanding(tool, taken_s, answer.wrong))
    return result
