"""Quality of the selector: all choices of shadow algorithms for many views are measured, and compared with those of each policy.

    python -m benchmarks.selection unpack [--folder build/selection]          the records of the last measurement, to go on from
    python -m benchmarks.selection measure DATA [--folder build/selection] [--only NAME ...]   an hour on two cores
    python -m benchmarks.selection probe DATA [--folder build/selection]      what probes measure of every choice; half an hour
    python -m benchmarks.selection describe DATA [--folder build/selection]   descriptors, and what planning takes
    python -m benchmarks.selection compare DATA [--folder build/selection]    errors again, of rows and probes; times are kept
    python -m benchmarks.selection keep [--folder build/selection]            write it all to benchmarks/selection/selection.jsonl
    python -m benchmarks.selection accept                                     changed code has the times and errors of before
    python -m benchmarks.selection fit                                        write selector/cost/error_model.json and
                                                                              typical_device.json from there
    python -m benchmarks.selection judge [--write]                            print the tables of the report, or write them,
                                                                              and what accuracy costs into README and docs

A row is a measured plan of a view. A probe renders a few choices and compares them with ray-traced truth. Each command resumes
where it stopped. `time DATA` times all rows again, and `--again` repeats finished views. DATA is the folder of sample rasters. The
device must be calibrated (`skugga calibrate`).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from benchmarks.selection.code_versions import accept_code
from benchmarks.selection.cost_of_accuracy import device_name, write_cost_of_accuracy
from benchmarks.selection.fit import cases_of, fit_model
from benchmarks.selection.measure import compare_again, describe_again, measure_instance, measure_probes, time_again
from benchmarks.selection.page import page, with_tables
from benchmarks.selection.table import read_table, write_table
from benchmarks.selection.views import instances
from skugga.selector.cost.device_profile import load_profile
from skugga.terrain.gl.device import device

WORK_STEPS = {"measure": "rows", "time": "anew", "compare": "compared anew", "describe": "plan_ms", "probe": "probe"}
"""Steps that run view by view, and the key of a record that marks them as done."""

REPEATED_STEPS = {"time": time_again, "compare": compare_again, "describe": describe_again, "probe": measure_probes}
"""Functions of the steps that change a view's record."""

PAGE = Path(__file__).parents[2] / "docs" / "reports" / "selection.md"
MODEL = Path(__file__).parents[2] / "selector" / "cost" / "error_model.json"
TYPICAL_DEVICE = MODEL.with_name("typical_device.json")


def _rounded(value: Any) -> Any:
    """Round every number in nested dictionaries to four significant digits. ``None`` stays."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    return None if value is None else float(f"{value:.4g}")


def main() -> None:
    """Run the subcommand of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    for name, _ in WORK_STEPS.items():
        command = commands.add_parser(name)
        command.add_argument("data", type=Path)
        command.add_argument("--folder", type=Path, default=Path("build/selection"))
        command.add_argument("--only", nargs="*", default=[])
        command.add_argument("--again", action="store_true")
    for name in ("unpack", "keep"):
        commands.add_parser(name).add_argument("--folder", type=Path, default=Path("build/selection"))
    commands.add_parser("accept")
    commands.add_parser("fit")
    commands.add_parser("judge").add_argument("--write", action="store_true")
    args = parser.parse_args()
    if args.what in WORK_STEPS:
        _run_step(args.what, args.data, args.folder, args.only, args.again)
    elif args.what == "unpack":
        args.folder.mkdir(parents=True, exist_ok=True)
        for record in read_table()[0]:
            _write(args.folder, record)
    elif args.what == "accept":
        accept_code()
    elif args.what == "keep":
        profile = load_profile(device().renderer, device().version)
        if profile is None or profile.is_estimate:
            parser.error("the device is not calibrated: skugga calibrate")
        write_table([record for instance in instances() if (record := _read(args.folder, instance.name)) is not None], profile)
    elif args.what == "fit":
        views, profile = read_table()
        model = fit_model([case for view in views if not view.get("unseen") for case in cases_of(view)], profile)
        rounded = {key: _rounded(value) for key, value in model.model_dump(mode="json").items()}
        MODEL.write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
        TYPICAL_DEVICE.write_text(profile.model_dump_json(indent=1) + "\n", encoding="utf-8")
    else:
        views, profile = read_table()
        text = page(views, profile)
        print(text)
        if args.write:
            PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8"), text), encoding="utf-8")
            write_cost_of_accuracy(views, device_name(profile))


def _run_step(step: str, data: Path, folder: Path, only: list[str], repeats_done: bool) -> None:
    """Run a step (a key of ``WORK_STEPS``) for views whose names contain a word of ``only``, or for all views if ``only`` is empty.

    ``data`` is the folder of sample rasters, and ``folder`` that of the views' records. Views that have the step's results already
    are skipped unless ``repeats_done`` is true.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for instance in instances():
        record = _read(folder, instance.name)
        if (only and not any(word in instance.name for word in only)) or (record is None) != (step == "measure"):
            continue
        if record is not None and WORK_STEPS[step] in record and not repeats_done:
            continue
        start = time.perf_counter()
        new_record = measure_instance(instance, data) if record is None else REPEATED_STEPS[step](instance, data, record)
        _write(folder, new_record)
        print(f"{instance.name}: {time.perf_counter() - start:.1f} s", flush=True)


def _path(folder: Path, name: str) -> Path:
    """Return the JSON file in ``folder`` with the record of the view called ``name``."""
    return folder / ("".join(c if c.isalnum() else "_" for c in name) + ".json")


def _read(folder: Path, name: str) -> dict[str, Any] | None:
    """Return the record of a view by its name; ``None`` if the view was not measured."""
    path = _path(folder, name)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _write(folder: Path, record: dict[str, Any]) -> None:
    """Write a view's record into ``folder``, over an older record of the same view."""
    _path(folder, record["name"]).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
