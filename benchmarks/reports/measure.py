"""Compare the algorithms in one scene: write its report and its plot, and return its figures for the page."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.reports.scenes import ReportScene
from skugga.api.catalogue import find_level
from skugga.api.cli.snapshot import scene_and_view
from skugga.api.report.comparison import comparison_facts, write_page, write_plot
from skugga.api.report.summary import casts_shadow, format_summary
from skugga.selector.measure.compare import Comparison, compare
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.level.parts import SunSpec

MAX_REPORT_BYTES = 1_000_000
"""Size limit of a published report."""

Figures = dict[str, Any]
"""Stored figures of a scene, or of a row (measured choice) of it, by key."""

ROW_KEYS = ("wrong_cast", "coverage", "soft_error", "interior", "cold", "pareto", "pareto_soft")
"""Stored values of a row, in addition to its time and its name."""


def measure_scene(scene: ReportScene, data: Path, report: Path, plot: Path, time_limit_s: float | None = None) -> Figures:
    """Compare the algorithms in a scene, write the report and the plot, and return the figures to store.

    Raises ``RuntimeError``, and writes nothing, if the report is too large.
    """
    load, start = os.getloadavg()[0], time.perf_counter()
    sun = None if scene.sun is None else SunSpec(azimuth=scene.sun[0], altitude=scene.sun[1])
    opened, view = scene_and_view(find_level(scene.level_path(data)), scene.view, sun, scene.size, scene.bounds)
    limit_s = scene.time_limit_s if time_limit_s is None else time_limit_s
    comparison = compare(opened, view, scene.view, time_limit_s=limit_s)
    took_s = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        write_page(opened, comparison, page, scene.view, scene.command, MAX_REPORT_BYTES)
        write_report(page.read_text(encoding="utf-8"), report)
    write_plot(opened, comparison, plot, scene.view)
    return stored_figures(scene, comparison, comparison_facts(opened, comparison, scene.view)) | {
        "time_limit_s": limit_s, "took_s": round(took_s), "load": round(load, 1),
    }  # fmt: skip


def write_report(text: str, report: Path) -> None:
    """Write the text of a report to a file. Raises ``RuntimeError`` if it is larger than the limit."""
    size = len(text.encode())
    if size >= MAX_REPORT_BYTES:
        raise RuntimeError(f"{report}: {size} bytes. A published report must have less than {MAX_REPORT_BYTES} bytes.")
    write_atomically(report, text)


def stored_figures(scene: ReportScene, comparison: Comparison, report_facts: dict[str, str]) -> Figures:
    """Return the figures of a comparison to store. ``report_facts`` are the report's facts about the run."""
    return {
        "command": scene.command,
        "title": scene.title,
        "data": scene.data_attribution,
        **{
            key: report_facts[key] for key in ("level", "view", "size", "light", "device", "driver", "processors", "Skugga", "made")
        },
        "error": comparison.error_metric,
        "cast": comparison.cast_share,
        "boundary": comparison.undecided_share,
        "noise_floor": comparison.noise_floor,
        "default": comparison.default_row_name,
        "summary": format_summary(comparison),
        "remarks": comparison.remarks,
        "left_out": list(comparison.left_out),
        "rows": {
            row.figures["name"]: {"ms": row.figures["ms_median"], **{key: row.figures[key] for key in ROW_KEYS}}
            for row in comparison.rows
            if casts_shadow(row.figures, comparison.light)
        },
    }
