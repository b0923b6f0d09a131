"""Questions about the sun and the sky, by Skugga and by other tools: seconds, and errors against truth.

    python -m benchmarks.sun_questions DATA --python PATH [--side 300] [--cells 1000] [--only hours,point,masks,horizons,sky]
        [--rasters "Big Tujunga,Essen,Quebec"] [--write-only]

DATA is a folder with the rasters of ``commands_and_rasters.WHOLE_RASTERS``. ``--python`` is the interpreter of the Python
packages, of Python 3.12 (`pip install whitebox-workflows insolation numba scipy solweig rasterio xarray-spatial surtgis`, `pip
install --no-build-isolation topocalc` and `pip install --no-deps rvt-py`). GRASS is Debian's `grass-core`, SAGA its `saga`. Tools
that are missing or fail are reported and skipped. ``--side`` is the side of the crops of the rasters for the sun hours, cells.
``--only`` measures some questions again, ``--rasters`` some rasters of the questions ``horizons`` and ``sky``; other figures are
kept. ``--write-only`` measures nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict
from datetime import date
from pathlib import Path

from benchmarks.report_pages import REPORTS, head_commit, write_between_marks
from benchmarks.sun_questions.commands_and_rasters import RASTERS, WHOLE_RASTERS, read_dem, tool_versions
from benchmarks.sun_questions.day_hours import HOURS_QUESTION, convention_check, hours_tools, measure_hours
from benchmarks.sun_questions.figures import ConventionCheck, QuestionCase, SunAnswer, SunComparison
from benchmarks.sun_questions.many_masks import MASKS_QUESTION, measure_masks
from benchmarks.sun_questions.one_horizon import HORIZON_QUESTION, horizon_tools, measure_horizons, points_by_kind
from benchmarks.sun_questions.page import format_summary, format_sun_page
from benchmarks.sun_questions.whole_rasters import (
    RASTER_HORIZONS_QUESTION,
    SKY_VIEW_QUESTION,
    RasterTool,
    RasterTruth,
    horizon_raster_tools,
    measure_raster,
    sky_view_tools,
)
from benchmarks.sweep_speed import processor_name

FOLDER = Path(__file__).parent
FIGURES_FILE = FOLDER / "sun_questions.json"
REPORT, PAGE = REPORTS / "sun-questions.md", REPORTS.parent / "sun-questions.md"

QUESTION_BY_OPTION = {
    "hours": HOURS_QUESTION,
    "point": HORIZON_QUESTION,
    "masks": MASKS_QUESTION,
    "horizons": RASTER_HORIZONS_QUESTION,
    "sky": SKY_VIEW_QUESTION,
}
"""Questions by their name on the command line."""


REPEATS = 2
"""Number of runs of a horizon, whose median is recorded."""


class Measurements:
    """Measurements of the questions so far.

    ``python`` is the interpreter of the other tools' packages. ``side`` is the side of crops for the sun hours, in cells. ``cells``
    is the number of sampled cells. Rasters are read from ``data`` and written to ``folder``. ``rasters`` are the names of those
    that are measured whole.
    """

    def __init__(self, data: Path, python: str, side: int, cells: int, folder: Path, rasters: list[str]) -> None:
        self._data, self._python, self._side, self._cells, self._folder = data, python, side, cells, folder
        self._rasters = rasters
        self._truth_by_raster: dict[str, RasterTruth] = {}
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

    def measure_raster_horizons(self) -> None:
        """Measure the fourth question: horizons of whole rasters."""
        self._measure_rasters(RASTER_HORIZONS_QUESTION, horizon_raster_tools(self._python))

    def measure_sky_views(self) -> None:
        """Measure the fifth question: sky view factors of whole rasters."""
        self._measure_rasters(SKY_VIEW_QUESTION, sky_view_tools(self._python))

    def _measure_rasters(self, question: str, tools: list[RasterTool]) -> None:
        """Measure tools on the whole rasters."""
        for name in self._rasters:
            dem = read_dem(self._data, name, None, self._folder)
            if dem is not None:
                rows, cols = dem.height_m.shape
                truth = self._truth_by_raster.setdefault(name, RasterTruth(dem, self._cells))
                self._add_case(
                    question,
                    name,
                    f"{WHOLE_RASTERS[name][2]}, {cols} x {rows} cells of {dem.cell_m:g} m; {self._cells} of them sampled; the two "
                    f"cuts of quads differ by {truth.mean_cut_deg:.2f} degrees of horizon in the mean",
                )
                for answer in measure_raster(question, tools, dem, truth, self.left_out):
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


def measure_questions(data: Path, python: str, side: int, cells: int, only: list[str], rasters: list[str]) -> SunComparison:
    """Measure the questions in ``only`` (keys of ``QUESTION_BY_OPTION``). Stored figures of other questions and rasters are kept.

    The other parameters are those of ``Measurements``.
    """
    with tempfile.TemporaryDirectory() as folder_name:
        measurements = Measurements(data, python, side, cells, Path(folder_name), rasters)
        for name in only:
            {
                "hours": measurements.measure_hours,
                "point": measurements.measure_horizons,
                "masks": measurements.measure_masks,
                "horizons": measurements.measure_raster_horizons,
                "sky": measurements.measure_sky_views,
            }[name]()
    questions = {QUESTION_BY_OPTION[name] for name in only}
    is_all = len(only) == len(QUESTION_BY_OPTION) and len(rasters) == len(WHOLE_RASTERS)
    stored = SunComparison.read(json.loads(FIGURES_FILE.read_text("utf-8"))) if FIGURES_FILE.exists() and not is_all else None

    def is_kept(entry: QuestionCase | SunAnswer) -> bool:
        """Return whether a stored entry is of a question or of a raster that was not measured again."""
        is_other_raster = entry.question in (RASTER_HORIZONS_QUESTION, SKY_VIEW_QUESTION) and entry.case not in rasters
        return entry.question not in questions or is_other_raster

    answers = [*filter(is_kept, stored.answers if stored else []), *measurements.answers]
    answered = {answer.tool for answer in answers}
    left_out = ({} if stored is None else stored.left_out) | measurements.left_out
    return SunComparison(
        where=f"{processor_name()}, {os.cpu_count()} cores",
        load=os.getloadavg()[0],
        took_s=measurements.elapsed_s + (stored.took_s if stored else 0.0),
        versions=({} if stored is None else stored.versions) | tool_versions(python),
        left_out={name: reason for name, reason in left_out.items() if name in measurements.left_out or name not in answered},
        checks=measurements.checks or (stored.checks if stored else []),
        cases=[*filter(is_kept, stored.cases if stored else []), *measurements.cases],
        answers=answers,
        date=date.today().isoformat(),
        commit=head_commit(),
    )


def main() -> None:
    """Measure the questions of the command line, and write figures and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="the folder of rasters")
    parser.add_argument(
        "--python", default=sys.executable, metavar="PATH", help="the interpreter that has the packages of the other tools"
    )
    parser.add_argument("--side", type=int, default=300)
    parser.add_argument("--cells", type=int, default=1000)
    parser.add_argument("--only", default=",".join(QUESTION_BY_OPTION), help="questions to measure, of this list")
    parser.add_argument("--rasters", default=",".join(WHOLE_RASTERS), help="rasters to measure whole, of this list")
    parser.add_argument("--write-only", action="store_true")
    args = parser.parse_args()
    if not args.write_only:
        if args.data is None or not set(args.only.split(",")) <= set(QUESTION_BY_OPTION):
            parser.error(f"DATA is missing, or --only is invalid. Allowed for --only: {', '.join(QUESTION_BY_OPTION)}.")
        if not set(args.rasters.split(",")) <= set(WHOLE_RASTERS):
            parser.error(f"--rasters is invalid. Allowed: {', '.join(WHOLE_RASTERS)}.")
        comparison = measure_questions(args.data, args.python, args.side, args.cells, args.only.split(","), args.rasters.split(","))
        FIGURES_FILE.write_text(json.dumps(asdict(comparison), indent=1) + "\n", "utf-8")
    comparison = SunComparison.read(json.loads(FIGURES_FILE.read_text("utf-8")))
    REPORT.write_text(format_sun_page(comparison), "utf-8")
    write_between_marks(PAGE, format_summary(comparison))


if __name__ == "__main__":
    main()
