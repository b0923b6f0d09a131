"""Pages of measurements in ``docs/reports``. Each names the command, date, commit and device of its figures."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from benchmarks.sweep_speed import processor_name

ROOT = Path(__file__).resolve().parents[1]
REPORTS = ROOT / "docs" / "reports"


@dataclass(frozen=True)
class Provenance:
    """Origin of a report's figures.

    Attributes
    ----------
    command
        The command line that measures them.
    date
        Date of the measurement, ISO 8601.
    commit
        Abbreviated hash of the measured commit, or of the commit that stored the figures; "unknown" without git.
    device
        Processor or graphics card, and the number of cores.
    """

    command: str
    date: str
    commit: str
    device: str


PROVENANCE_PATTERN = re.compile(r"^Command: `[^`]+`\. Date: \d{4}-\d\d-\d\d\. Commit: `[^`]+`\.\nDevice: .+\.$", re.MULTILINE)
"""Pattern of the paragraph that ``format_provenance`` returns."""


def format_provenance(provenance: Provenance) -> str:
    """Format the first paragraph of a report."""
    return f"Command: `{provenance.command}`. Date: {provenance.date}. Commit: `{provenance.commit}`.\nDevice: {provenance.device}."


def measured_here(command: str) -> Provenance:
    """Return the provenance of figures that this process measures."""
    return Provenance(command, date.today().isoformat(), head_commit(), f"{processor_name()}, {os.cpu_count()} cores")


def head_commit(folder: Path = ROOT) -> str:
    """Return the abbreviated hash of the commit that is checked out in ``folder``, or "unknown" without git."""
    try:
        process = subprocess.run(["git", "log", "-1", "--format=%h"], cwd=folder, capture_output=True, text=True, check=False)
    except OSError:  # a machine without git
        return "unknown"
    return process.stdout.strip() or "unknown"


BEGIN, END = "<!-- measured -->\n", "<!-- end of measured -->\n"
"""Marks around the generated part of a page that is otherwise written by hand."""


def write_between_marks(page: Path, text: str) -> None:
    """Replace the generated part of a page. Raises ``ValueError`` if the page has no marks."""
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page}: marks are missing: {BEGIN.strip()} ... {END.strip()}")
    page.write_text(f"{before}{BEGIN}\n{text}\n\n{END}{after}", encoding="utf-8")
