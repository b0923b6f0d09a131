"""The table at the end of a run: hard case by algorithm, each measured figure beside its bound.

``pytest -m thorough tests/hard_cases --hard-cases-table docs/reports/hard-cases.md`` writes it into the report, between its two
marks.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from tests.hard_cases.cases import ENGINE, RECORD_PROPERTY, SHADOW_ALGORITHMS, exceeded_bounds, untested_figures
from tests.hard_cases.regressions import RECORD_OPTION, RECORDS_FILE, read_records, updated_records, write_records

SHORT_TITLES = {
    "shadow_map": "map", "perspective_shadow_map": "perspective", "light_space_perspective_map": "light space",
    "shadow_volume": "volumes", "reconstructed_volume": "rebuilt",
}  # fmt: skip
"""Titles of columns that are shorter than the algorithm's name."""

COLUMNS = {name: SHORT_TITLES.get(name, name) for name in (*SHADOW_ALGORITHMS, ENGINE)}
"""Algorithms as the table's columns, with their titles."""

TABLE = "table"
"""The name of the table's marks in the document."""

FIND_PROPERTY = "hard_case_find"
"""The key under which a test reports a new situation over its bounds."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        RECORD_OPTION,
        action="store_true",
        help="record wrong_cast of the hard cases that run, instead of testing against its record",
    )
    parser.addoption("--hard-cases-table", metavar="FILE", help="put the table of the thorough hard cases into a Markdown file")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(_Table(config), "hard cases")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move the mutants to the end: a deliberate defect means nothing before everything else holds."""
    items.sort(key=lambda item: item.path.name == "test_mutants.py")


class _Table:
    """Collects the records of this run from all of its processes."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.records: list[dict[str, Any]] = []
        self.finds: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call":
            self.records += [json.loads(str(value)) for key, value in report.user_properties if key == RECORD_PROPERTY]
            self.finds += [str(value) for key, value in report.user_properties if key == FIND_PROPERTY]

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        for thorough in (False, True):
            records = [record for record in self.records if record["thorough"] == thorough]
            if records:
                terminalreporter.section(f"hard cases, {'thorough' if thorough else 'quick'}: figure per algorithm")
                for line in as_text(records):
                    terminalreporter.write_line(line)
        if self.finds:
            terminalreporter.section("new situations over their bounds, as lines for COUNTEREXAMPLES of test_properties.py")
            for line in self.finds:
                terminalreporter.write_line(line)
        if self.config.getoption(RECORD_OPTION) and not hasattr(self.config, "workerinput"):
            write_records(updated_records(read_records(), self.records))
            terminalreporter.write_line(f"wrong_cast of {len(self.records)} trials is recorded in {RECORDS_FILE}")
        target = self.config.getoption("--hard-cases-table")
        if target and not hasattr(self.config, "workerinput"):
            replace_section(Path(target), TABLE, as_markdown([record for record in self.records if record["thorough"]]))
            terminalreporter.write_line(f"the table lies in {target}")


def case_order(case: str) -> tuple[int, str, int]:
    """Return the sort key of a case: H1, H2, ... H34, then G1, ..., then the rest by letter."""
    letters, number = re.fullmatch(r"([A-Z]+)(\d+)", case).groups()  # type: ignore[union-attr]
    return ("HG".find(letters) if letters in "HG" else 2), letters, int(number)


def rows(records: Iterable[dict[str, Any]]) -> list[tuple[dict[str, Any], str, dict[str, str]]]:
    """Return (case, figure's name, {algorithm: cell}) in the catalogue's order.

    A cell is ``refused`` or a figure, with ``!`` if it exceeds its bound, and with the text of ``coverage_text``.
    """
    by_case: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        by_case.setdefault(record["id"], []).append(record)
    result = []
    for case in sorted(by_case, key=case_order):
        case_records = by_case[case]
        for name in case_records[0]["bounds"]:
            cells = {}
            for record in case_records:
                if "refusal" in record:
                    cells[record["algorithm"]] = "refused"
                else:
                    figure = f"{record['figures'][name]:.2g}" + ("!" if name in exceeded_bounds(record) else "")
                    cells[record["algorithm"]] = f"{figure} {coverage_text(record, name)}".rstrip()
            result.append((case_records[0], name, cells))
    return result


def coverage_text(record: dict[str, Any], name: str) -> str:
    """Return ``wrong_cast`` of the worst picture and the figure's coverage of the cast shadow, in per cent, as ``(0.3 %, 82)``.

    ``not tested`` precedes it if the coverage is too small. Figures that do not judge cast shadow get an empty text.
    """
    coverage = record.get("sights", {}).get(name)
    if not coverage:
        return ""
    wrong_percent = f"{100.0 * coverage['wrong_cast']:.2g}"
    return f"({'not tested: ' if name in untested_figures(record) else ''}{wrong_percent}, {100.0 * coverage['sees']:.0f})"


def as_text(records: Iterable[dict[str, Any]]) -> list[str]:
    """Return the table for a terminal."""
    lines = [f"{'case':5} {'figure':38} {'bound':>8}  " + " ".join(f"{title:>16}" for title in COLUMNS.values())]
    for case, name, cells in rows(records):
        figures = " ".join(f"{cells.get(algorithm, ''):>16}" for algorithm in COLUMNS)
        lines.append(f"{case['id']:5} {name:38} {case['bounds'][name]:>8.2g}  {figures}".rstrip())
    return lines


def as_markdown(records: Iterable[dict[str, Any]]) -> str:
    """Return the table for a document, with the set-ups, what must hold, and the reasons of the refusals below it."""
    records = list(records)
    algorithms = [algorithm for algorithm in COLUMNS if algorithm in {record["algorithm"] for record in records}]
    lines = ["| case | what must hold | figure | bound | " + " | ".join(COLUMNS[a] for a in algorithms) + " |"]
    lines.append("| --- | --- | --- | ---: |" + " ---: |" * len(algorithms))
    last = None
    for case, name, cells in rows(records):
        head = ("", "") if case["id"] == last else (f"**{case['id']}**", f"{case['title']}. *{case['set_up']}.*")
        figures = " | ".join(cells.get(algorithm, "") for algorithm in algorithms)
        lines.append(f"| {head[0]} | {head[1]} | {name} | {case['bounds'][name]:.2g} | {figures} |")
        last = case["id"]
    refusals: dict[tuple[str, str], list[str]] = {}
    for record in sorted(records, key=lambda record: case_order(record["id"])):
        if "refusal" in record:
            refusals.setdefault((record["algorithm"], record["refusal"]), []).append(record["id"])
    if refusals:
        lines += ["", "Refused:", ""]
        order = {algorithm: number for number, algorithm in enumerate(SHADOW_ALGORITHMS)}
        for (algorithm, reason), cases in sorted(refusals.items(), key=lambda item: order[item[0][0]]):
            lines.append(f"- `{algorithm}`, in {', '.join(dict.fromkeys(cases))}: {reason}.")
    return "\n".join(lines)


def section_of(path: Path, name: str) -> str:
    """Return the text between a document's marks of a name. Raises ``ValueError`` if a mark is absent."""
    return _split_at_marks(path, name)[1].strip("\n")


def replace_section(path: Path, name: str, text: str) -> None:
    """Replace the text between a document's marks of a name. Raises ``ValueError`` if a mark is absent."""
    head, _, tail = _split_at_marks(path, name)
    path.write_text(f"{head}\n{text}\n{tail}", encoding="utf-8")


def _split_at_marks(path: Path, name: str) -> tuple[str, str, str]:
    """Return the parts of a document up to a mark, between both marks, and from the other mark on."""
    start, end = f"<!-- {name}: start -->", f"<!-- {name}: end -->"
    head, found_start, rest = path.read_text(encoding="utf-8").partition(start)
    middle, found_end, tail = rest.partition(end)
    if not (found_start and found_end):
        raise ValueError(f"{path} has no {start} and {end}")
    return head + start, middle, end + tail
