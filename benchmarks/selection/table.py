"""The table of measurements in the repository: a line with the device, then a line for each view."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from skugga.selector.cost.device_profile import DeviceProfile
from skugga.terrain.facts.descriptor import Descriptor

TABLE = Path(__file__).with_name("selection.jsonl")

ROW_COLUMNS = ("algorithms", "ms", "wrong", "wrong_cast", "interior", "coverage", "bytes")
"""Keys of a row (measured plan), in the order of its values in the file."""

DIGITS = 8
"""Significant digits of a descriptor's numbers: shares must still add up to no more than one."""

PROBE_DIGITS = 4
"""Significant digits of the numbers of probes."""

Figures = dict[str, Any]
"""A measured view's record by key."""


def write_table(views: Iterable[Figures], profile: DeviceProfile, path: Path = TABLE) -> None:
    """Write views' records, and the calibration of the device that measured them, as lines of JSON."""
    lines = [profile.model_dump(mode="json"), *map(_to_compact_record, views)]
    path.write_text("".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines), encoding="utf-8")


def read_table(path: Path = TABLE) -> tuple[list[Figures], DeviceProfile]:
    """Read the records of the views with more than one measured row, and the device's calibration."""
    first, *lines = path.read_text(encoding="utf-8").splitlines()
    return [
        view for view in map(_from_compact_record, map(json.loads, lines)) if len(view["rows"]) > 1
    ], DeviceProfile.model_validate_json(first)


def _to_compact_record(view: Figures) -> Figures:
    """Return a view's record in a compact form for the table.

    Default values and names of columns are omitted. ``picks`` and ``probe`` refer to rows by number.
    """
    names = list(view["rows"])
    descriptor = Descriptor.model_validate(_rounded(view["descriptor"])).model_dump(mode="json", exclude_defaults=True)
    probe = _with_rows(view, lambda rows: {str(names.index(row)): observations for row, observations in rows if row in names})
    return view | probe | {
        "descriptor": descriptor,
        "rows": {name: [row[column] for column in ROW_COLUMNS] for name, row in view["rows"].items()},
        "picks": {choice: names.index(row) for choice, row in view["picks"].items() if row in names},
    }  # fmt: skip


def _from_compact_record(line: Figures) -> Figures:
    """Return a view's record from its compact form in the file. Omitted default values of the descriptor stay omitted."""
    names = list(line["rows"])
    return line | _with_rows(line, lambda rows: {names[int(number)]: observations for number, observations in rows}) | {
        "rows": {name: dict(zip(ROW_COLUMNS, row, strict=True)) for name, row in line["rows"].items()},
        "picks": {choice: names[number] for choice, number in line["picks"].items()},
    }  # fmt: skip


def _with_rows(view: Figures, renamed: Callable[[Iterable[tuple[str, Any]]], Figures]) -> Figures:
    """Return the measurements of probes in a view with renamed rows and rounded numbers; empty without them.

    ``renamed`` maps pairs of row name and measurements to a dictionary with new names.
    """
    if not view.get("probe"):
        return {}
    probe = _rounded(view["probe"], PROBE_DIGITS)
    return {"probe": {**probe, "rows": renamed(probe["rows"].items())}}


def _rounded(value: Any, digits: int = DIGITS) -> Any:
    """Round every float in nested dictionaries and lists to ``digits`` significant digits."""
    match value:
        case float():
            return float(f"{value:.{digits}g}")
        case dict():
            return {key: _rounded(entry, digits) for key, entry in value.items()}
        case list():
            return [_rounded(entry, digits) for entry in value]
    return value
