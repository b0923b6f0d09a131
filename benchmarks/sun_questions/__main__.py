"""Sun hours, horizons of points and masks of a day, by Skugga and by other tools: seconds, and errors against truth.

    python -m benchmarks.sun_questions DATA --python PATH [--side 300] [--cells 1000] [--only hours,point,masks] [--write-only]

DATA is a folder with the rasters of ``commands_and_rasters.RASTERS``. ``--python`` is the interpreter of the Python packages
(`pip install whitebox-workflows insolation numba scipy solweig rasterio`, and `pip install --no-build-isolation topocalc`); GRASS
is Debian's `grass-core`. Tools that are missing or fail are reported and skipped. ``--side`` is the side of the crops of the
rasters for the sun hours, cells. ``--only`` measures some questions again and keeps the figures of the others. ``--write-only``
measures nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from benchmarks.sun_questions.commands_and_rasters import RASTERS, read_dem, tool_versions
from benchmarks.sun_questions.day_hours import HOURS_QUESTION, convention_check, hours_tools, measure_hours
from benchmarks.sun_questions.figures import ConventionCheck, QuestionCase, SunAnswer, SunComparison
from benchmarks.sun_questions.many_masks import MASKS_QUESTION, measure_masks
from benchmarks.sun_questions.one_horizon import HORIZON_QUESTION, horizon_tools, measure_horizons, points_by_kind
from benchmarks.sun_questions.page import format_sun_page
from benchmarks.sweep_speed import processor_name

FOLDER = Path(__file__).parent
FIGURES_FILE = FOLDER / "sun_questions.json"
PAGE = FOLDER.parents[1] / "docs" / "sun-questions.md"

QUESTION_BY_OPTION = {"hours": HOURS_QUESTION, "point": HORIZON_QUESTION, "masks": MASKS_QUESTION}
"""Questions by their name on the command line."""


REPEATS = 2
"""Number of runs of a horizon, whose median is recorded."""


class Measurements:
    """Measurements of the questions so far.

    ``python`` is the interpreter of the other tools' packages. ``side`` is the side of crops for the sun hours, in cells. ``cells``
    is the number of sampled cells. Rasters are read from ``data`` and written to ``folder``.
    """

    def __init__(self, data: Path, python: str, side: int, cells: int, folder: Path) -> None:
        self._data, self._python, self._side, self._cells, self._folder = data, python, side, cells, folder
        self.checks: list[ConventionCheck] = []
        self.cases: list[QuestionCase] = []
        self.answers: list[SunAnswer] = []
        self.left_out: dict[str, str] = {}
        self._begin = time.perf_counter()

    def measure_hours(self) -> None:
        """Measure the first question: hours of sun."""
        tools = []
        for tool in hours_tools(self._python):
            try:
                self.checks.append(convention_check(tool, self._folder))
                tools.append(tool)
                self._print_progress(f"conventions of {tool.name}")
            except RuntimeError as error:
                self.left_out[tool.name] = str(error)
        for name, (_, _, description) in RASTERS.items():
            dem = read_dem(self._data, name, self._side, self._folder)
            if dem is not None:
                rows, cols = dem.height_m.shape
                self._add_case(
                    HOURS_QUESTION,
                    name,
                    f"{description}: its middle, {cols} x {rows} cells of {dem.cell_m:g} m; {self._cells} of them sampled",
                )
                for answer in measure_hours(tools, dem, name, self._cells, self.left_out):
                    self._add_answer(answer)

    def measure_horizons(self) -> None:
        """Measure the second question: horizons of points."""
        for name, (_, _, description) in RASTERS.items():
            dem = read_dem(self._data, name, None, self._folder)
            if dem is not None:
                rows, cols = dem.height_m.shape
                for place in points_by_kind(dem):
                    self._add_case(
                        HORIZON_QUESTION, f"{name}, {place}", f"{description}, {cols} x {rows} cells of {dem.cell_m:g} m"
                    )
                for answer in measure_horizons(horizon_tools(self._python), dem, REPEATS, self.left_out):
                    self._add_answer(answer)

    def measure_masks(self) -> None:
        """Measure the third question: masks of a day."""
        name, (_, _, description) = next(iter(RASTERS.items()))
        dem = read_dem(self._data, name, None, self._folder)
        if dem is not None:
            rows, cols = dem.height_m.shape
            self._add_case(
                MASKS_QUESTION, name, f"{description}, {cols} x {rows} cells of {dem.cell_m:g} m; {2 * self._cells} of them sampled"
            )
            for answer in measure_masks(self._python, dem, 2 * self._cells, self.left_out):
                self._add_answer(answer)

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start of the measurements."""
        return time.perf_counter() - self._begin

    def _add_case(self, question: str, case: str, description: str) -> None:
        """Add the description of the raster ``case`` for which a question is asked."""
        self.cases.append(QuestionCase(question, case, description))

    def _add_answer(self, answer: SunAnswer) -> None:
        """Add an answer, and print it."""
        self.answers.append(answer)
        self._print_progress(f"{answer.case}: {answer.tool}: {answer.whole_s or 0.0:.1f} s, wrong {answer.wrong}")

    def _print_progress(self, message: str) -> None:
        """Print a message after the elapsed seconds."""
        print(f"{self.elapsed_s:4.0f} s  {message}", flush=True)


def measure_questions(data: Path, python: str, side: int, cells: int, only: list[str]) -> SunComparison:
    """Measure the questions in ``only`` (keys of ``QUESTION_BY_OPTION``). The stored figures of the other questions are kept.

    The other parameters are those of ``Measurements``.
    """
    with tempfile.TemporaryDirectory() as folder_name:
        measurements = Measurements(data, python, side, cells, Path(folder_name))
        for name in only:
            {"hours": measurements.measure_hours, "point": measurements.measure_horizons, "masks": measurements.measure_masks}[
                name
            ]()
    questions = {QUESTION_BY_OPTION[name] for name in only}
    stored = (
        SunComparison.read(json.loads(FIGURES_FILE.read_text("utf-8")))
        if FIGURES_FILE.exists() and len(only) < len(QUESTION_BY_OPTION)
        else None
    )
    cases = [entry for entry in stored.cases if entry.question not in questions] if stored else []
    answers = [entry for entry in stored.answers if entry.question not in questions] if stored else []
    return SunComparison(
        where=f"{processor_name()}, {os.cpu_count()} cores",
        load=os.getloadavg()[0],
        took_s=measurements.elapsed_s + (stored.took_s if stored else 0.0),
        versions=tool_versions(python),
        left_out=({} if stored is None else stored.left_out) | measurements.left_out,
        checks=measurements.checks or (stored.checks if stored else []),
        cases=cases + measurements.cases,
        answers=answers + measurements.answers,
    )


def main() -> None:
    """Measure the questions of the command line, and write figures and page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="the folder of rasters")
    parser.add_argument(
        "--python", default=sys.executable, metavar="PATH", help="the interpreter that has the packages of the other tools"
    )
    parser.add_argument("--side", type=int, default=300)
    parser.add_argument("--cells", type=int, default=1000)
    parser.add_argument("--only", default=",".join(QUESTION_BY_OPTION), help="questions to measure: hours, point, masks")
    parser.add_argument("--write-only", action="store_true")
    args = parser.parse_args()
    if not args.write_only:
        if args.data is None or not set(args.only.split(",")) <= set(QUESTION_BY_OPTION):
            parser.error(f"DATA is missing, or --only is invalid. Allowed for --only: {', '.join(QUESTION_BY_OPTION)}.")
        comparison = measure_questions(args.data, args.python, args.side, args.cells, args.only.split(","))
        FIGURES_FILE.write_text(json.dumps(asdict(comparison), indent=1) + "\n", "utf-8")
    PAGE.write_text(format_sun_page(SunComparison.read(json.loads(FIGURES_FILE.read_text("utf-8")))), "utf-8")


if __name__ == "__main__":
    main()
