"""The published reports of `skugga compare` (docs/compare), and the page that compares them (docs/reports/comparisons.md).

    python -m benchmarks.reports DATA [--only NAME ...] [--time-limit S]     twelve minutes on two cores, for all
    python -m benchmarks.reports --write-only                                write the page again from the stored figures

DATA is the folder of sample rasters. Each scene is measured in a process of its own. If one fails, its error is printed and the
others continue. Figures are stored by scene (reports.json), so that ``--only`` updates single scenes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.reports.measure import measure_scene
from benchmarks.reports.page import format_comparisons
from benchmarks.reports.scenes import SCENES
from benchmarks.selection.page import with_tables

ROOT = Path(__file__).parents[2]
RECORDS_FILE = Path(__file__).with_name("reports.json")
PAGE = ROOT / "docs" / "reports" / "comparisons.md"
REPORTS, PLOTS = ROOT / "docs" / "compare", ROOT / "docs" / "images"


def stored_records() -> dict[str, dict[str, Any]]:
    """Return the stored figures of each compared scene, in the order of the page."""
    records = json.loads(RECORDS_FILE.read_text(encoding="utf-8")) if RECORDS_FILE.exists() else {}
    return {name: records[name] for name in SCENES if name in records}


def write_page() -> None:
    """Write the page from the stored figures."""
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8"), format_comparisons(stored_records())), encoding="utf-8")


def make_report(name: str, data: Path, time_limit_s: float | None) -> None:
    """Measure the scene ``name``, and write its report, its plot and its figures.

    If ``time_limit_s`` is ``None``, the scene's own limit applies.
    """
    scene_record = measure_scene(SCENES[name], data, REPORTS / f"{name}.html", PLOTS / f"compare-{name}.svg", time_limit_s)
    RECORDS_FILE.write_text(json.dumps(stored_records() | {name: scene_record}, indent=1) + "\n", encoding="utf-8")
    print(
        f"{name}: {len(scene_record['rows'])} rows, {len(scene_record['left_out'])} left out, {scene_record['took_s']} s",
        flush=True,
    )


def make_reports(names: list[str], options: list[str]) -> list[str]:
    """Measure each scene in a process of its own, and return the names of the scenes that failed.

    ``options`` are further words of the command line.
    """
    failed = []
    for name in names:
        status = subprocess.run([sys.executable, "-m", "benchmarks.reports", *options, "--only", name], check=False).returncode
        if status:
            print(f"{name}: failed, exit status {status}", file=sys.stderr, flush=True)
            failed.append(name)
    return failed


def main() -> None:
    """Measure the scenes of the command line, and write their reports and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="the folder of sample rasters")
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES), metavar="NAME", help=", ".join(SCENES))
    parser.add_argument("--time-limit", type=float, metavar="S", help="time limit of each scene, seconds; default: the scene's own")
    parser.add_argument("--write-only", action="store_true")
    args = parser.parse_args()
    if args.write_only:
        write_page()
        return
    if args.data is None:
        parser.error("DATA is missing. Name the folder of sample rasters.")
    if len(args.only) == 1:
        make_report(args.only[0], args.data, args.time_limit)
        write_page()
        return
    limit = [] if args.time_limit is None else ["--time-limit", f"{args.time_limit:g}"]
    if failed := make_reports(args.only, [str(args.data), *limit]):
        raise SystemExit(f"failed: {', '.join(failed)}. Repeat them: python -m benchmarks.reports DATA --only {' '.join(failed)}")


if __name__ == "__main__":
    main()
