"""Output of a comparison: a table on the terminal; a report and false-colour pictures in a folder."""

from __future__ import annotations

import os
import shlex
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from skugga.api.report.report import LEFT_OUT_REMARK, MAX_PAGE_BYTES, write_report, write_scatter
from skugga.api.report.summary import format_summary
from skugga.selector.measure.compare import Comparison, ComparisonRow, false_colours
from skugga.selector.planner.planner import make_plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.render import render_frame
from skugga.terrain.atomic_files import atomic_path
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene


def check_outputs(folder: Path | None, rows_file: Path | None) -> None:
    """Create the folder and check the file of rows before the comparison, which takes minutes. Raises ``InputError``."""
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            raise InputError("--output", str(folder), "a folder, or a path where a folder can be created") from None
    if rows_file is not None and (rows_file.is_dir() or not rows_file.parent.is_dir()):
        raise InputError("--json", str(rows_file), "a file in an existing folder")


def print_comparison(comparison: Comparison, base_command: str) -> None:
    """Print a row for each measured plan, lowest ``wrong_cast`` first, then the summary and the remarks.

    ``base_command`` is the command line of the comparison, to which ``--only ROW`` can be appended.
    """
    console = Console(width=148)
    table = Table(box=None, header_style="bold")
    table.add_column("algorithm-texels-taps-bits", no_wrap=True, overflow="ignore")
    for title in (
        "ms",
        "at rest",
        "wrong cast %",
        "soft %",
        "wrong %",
        "false %",
        "missed %",
        "edge p95 px",
        "interior %",
        "coverage %",
        "MB",
        "front",
    ):
        table.add_column(title, justify="right")
    for row in sorted(comparison.rows, key=lambda row: row.figures["wrong_cast"]):
        table.add_row(*_table_cells(row))
    console.print(table)
    console.print(
        f"boundary {100 * comparison.undecided_share:.2f} % of the surface (errors are not counted there), "
        f"surface {100 * comparison.simplification_share:.2f} % (difference of the rendered grid from the full raster), "
        f"noise floor {100 * comparison.noise_floor:.3f} % {comparison.error_metric.replace('_', ' ')}"
    )
    if any(row.figures["cold"] for row in comparison.rows):
        console.print("?: time of the first run only, which includes compilation and allocation")
    for sentence in format_summary(comparison):
        console.print(sentence)
    for remark in comparison.remarks:
        console.print(f"note: {remark}")
    if comparison.left_out:
        console.print(f"note: {LEFT_OUT_REMARK}. To measure them, run:")
        for command in commands_of_left_out(comparison, base_command):
            console.print(f"  {command}", soft_wrap=True, highlight=False, markup=False)


def write_comparison(scene: Scene, comparison: Comparison, folder: Path, view: str, base_command: str) -> None:
    """Write ``report.html``, its scatter plot as ``scatter.svg``, and one PNG for each row (measured plan).

    A row's PNG shows false shadow in red and missed shadow in blue. ``base_command`` is that of ``print_comparison``.
    """
    base = write_page(scene, comparison, folder / "report.html", view, base_command)
    write_plot(scene, comparison, folder / "scatter.svg", view)
    for row in comparison.rows:
        with atomic_path(folder / f"{row.figures['name']}.png") as part:
            Image.fromarray(false_colours(base.mean(axis=2), row)).save(part)


def write_page(
    scene: Scene, comparison: Comparison, path: Path, view: str, base_command: str, max_bytes: int = MAX_PAGE_BYTES
) -> np.ndarray:
    """Write the report of at most ``max_bytes`` bytes. Return the view without cast shadows, uint8 (rows, cols, 3)."""
    plan = make_plan(describe(scene, comparison.view, view), scene.loaded.level, {"algorithm": NO_SHADOWS})
    base = render_frame(scene, comparison.view, plan).color
    write_report(
        path, comparison, base, comparison_facts(scene, comparison, view), commands_of_left_out(comparison, base_command), max_bytes
    )
    return base


def write_plot(scene: Scene, comparison: Comparison, path: Path, view: str) -> None:
    """Write the scatter plot of the report as an SVG file."""
    facts = comparison_facts(scene, comparison, view)
    write_scatter(path, comparison, [f"{scene.loaded.name}, {view}", f"{facts['light']}; {facts['size']}; {facts['device']}"])


def commands_of_left_out(comparison: Comparison, base_command: str) -> list[str]:
    """Return the command lines that measure the rows for which the time limit left no time.

    ``base_command`` is that of ``print_comparison``.
    """
    return [f"{base_command} --only {shlex.quote(name)}" for name in comparison.left_out]


def comparison_facts(scene: Scene, comparison: Comparison, view: str) -> dict[str, str]:
    """Return the facts of a comparison for its report: level, view, light, device and time."""
    loaded, gl = scene.loaded, device()
    light = comparison.light
    if light == SUN and scene.sun is not None:
        light = f"the sun, azimuth {scene.sun.azimuth_deg:.1f}°, altitude {scene.sun.altitude_deg:.1f}°"
    return {
        "level": f"{loaded.name}: {loaded.level.title}" if loaded.level.title not in ("", loaded.name) else loaded.name,
        "view": view,
        "size": f"{comparison.view.cols} x {comparison.view.rows} pixels",
        "light": light,
        "device": gl.renderer,
        "driver": gl.version,
        "processors": str(os.cpu_count()),
        "Skugga": version("skugga"),
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def _table_cells(row: ComparisonRow) -> list[str]:
    """Return the figures of a row as texts, in the order of the table's columns."""
    f = row.figures
    return [
        f["name"],
        f"{f['ms_median']:.0f}" + ("?" if f["cold"] else ""),
        "" if f["ms_at_rest"] is None else f"{f['ms_at_rest']:.0f}",
        f"{100 * f['wrong_cast']:.2f}",
        f"{100 * f['soft_error']:.2f}",
        f"{100 * f['wrong']:.3f}",
        f"{100 * f['false_shadow']:.3f}",
        f"{100 * f['missed_shadow']:.3f}",
        f"{f['edge_p95']:.2f}",
        f"{100 * f['interior']:.4f}",
        f"{100 * f['coverage']:.2f}",
        f"{f['bytes'] / 1e6:.0f}",
        "*" if f["pareto"] else "",
    ]
