"""Results of `sun_questions`: answers of tools to three sun questions, and which tools are faster and more accurate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.peers.figures import ToolRecord, ToolStanding


@dataclass(frozen=True)
class SunAnswer:
    """A tool's answer to a question in one case.

    Seconds of computing by its own clock, of the whole process, and CPU seconds of the process and its children; ``None`` if not
    measured. ``wrong`` is the mean error and ``wrong_p99`` its 99th percentile, with the sun, the earth and the north that the tool
    uses. ``wrong_as_is`` is the mean error against astronomy's sun on the round earth. The unit is minutes, degrees or shares of
    cells, by question. ``scaled`` marks seconds that were extrapolated from a part of the work.
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


@dataclass(frozen=True)
class ConventionCheck:
    """A tool's hours on a level floor, and the length of the day by its own sun.

    Before a long cliff it has the mean error in minutes against the closed form.
    """

    tool: str
    floor_h: float
    day_h: float
    cliff_wrong_min: float


@dataclass(frozen=True)
class QuestionCase:
    """The data of a question: its name and a description."""

    question: str
    case: str
    about: str


@dataclass(frozen=True)
class SunComparison:
    """All results. ``versions`` are those of tools; ``left_out`` are names of tools with the reason."""

    where: str
    load: float
    took_s: float
    versions: dict[str, str]
    left_out: dict[str, str]
    checks: list[ConventionCheck]
    cases: list[QuestionCase]
    answers: list[SunAnswer]

    @staticmethod
    def read(values: dict[str, Any]) -> SunComparison:
        """Build it from JSON values."""
        kinds = {"checks": ConventionCheck, "cases": QuestionCase, "answers": SunAnswer}
        return SunComparison(**{**values, **{key: [kind(**entry) for entry in values[key]] for key, kind in kinds.items()}})

    def of(self, question: str, case: str | None = None) -> list[SunAnswer]:
        """Return the answers to a question; of one case, if given."""
        return [answer for answer in self.answers if answer.question == question and case in (None, answer.case)]


ANSWER_CLOCKS: dict[str, Callable[[SunAnswer], float | None]] = {
    "computing": lambda answer: answer.compute_s,
    "the whole process": lambda answer: answer.whole_s,
    "CPU time of the whole process": lambda answer: answer.cpu_s,
}
"""The clocks by which tools are compared."""


def standings(comparison: SunComparison, question: str, clock: str) -> dict[str, list[ToolStanding]]:
    """Return the standings of all tools in each case of a question, if they have seconds by a clock and an error."""
    result: dict[str, list[ToolStanding]] = {}
    for answer in comparison.of(question):
        taken_s = ANSWER_CLOCKS[clock](answer)
        if taken_s is not None and answer.wrong is not None:
            tool = ToolRecord(answer.tool, "", "", answer.ours, True, 0.0)
            result.setdefault(answer.case, []).append(ToolStanding(tool, taken_s, answer.wrong))
    return result
