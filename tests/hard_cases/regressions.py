"""Regression bounds of ``wrong_cast``: what each cell of the hard cases had when it was last recorded, and half as much again.

The bounds of figures are claims, derived for each case. ``wrong_cast`` (the wrong pixels as a share of those in cast shadow)
depends on the pixels' size and the scene, and no bound of it can be derived. So a cell (a case by an algorithm) may not get worse
than ``GROWTH_FACTOR`` times its record.

``pytest tests/hard_cases --record-wrong-cast`` writes the records of the cases that it runs; nothing else writes them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

RECORDS_FILE = Path(__file__).with_name("wrong_cast.json")
"""The records: case, algorithm, ``quick`` or ``thorough``, figure, and its ``wrong_cast``."""

RECORD_OPTION = "--record-wrong-cast"
"""The option with which a run writes records instead of testing against them."""

FLOOR_PX = 3
"""Wrong pixels of a picture that do not count against its record.

Without them a record of 0 would fail by one pixel at an edge, which another compiler or rasteriser may round the other way.
"""

GROWTH_FACTOR = 1.5
"""How many times its record ``wrong_cast`` may be."""

RANDOM_CASES = frozenset({"X1"})
"""Cases whose situations are drawn anew with each change of their source, so that a record would say nothing of the next run."""

Records = dict[str, dict[str, dict[str, dict[str, float]]]]


@cache
def read_records(path: Path = RECORDS_FILE) -> Records:
    """Return the records of a file: by case, algorithm, size and figure."""
    return json.loads(path.read_text(encoding="utf-8"))


def size_name(record: Mapping[str, Any]) -> str:
    """Return the size of a trial's pictures, ``quick`` or ``thorough``."""
    return "thorough" if record["thorough"] else "quick"


def wrong_cast_values(record: Mapping[str, Any]) -> dict[str, float]:
    """Return ``wrong_cast`` of a trial by figure, for the figures whose pictures have cast shadow."""
    return {name: summary["wrong_cast"] for name, summary in record.get("sights", {}).items() if summary}


def regressions(record: Mapping[str, Any], records: Records) -> str:
    """Describe where ``wrong_cast`` of a trial has no record or exceeds ``GROWTH_FACTOR`` times its record; empty if nowhere.

    ``RANDOM_CASES`` have no records.
    """
    if record["id"] in RANDOM_CASES:
        return ""
    recorded = records.get(record["id"], {}).get(record["algorithm"], {}).get(size_name(record), {})
    problems = []
    for name, value in wrong_cast_values(record).items():
        if name not in recorded:
            problems.append(f"{name} has no record of wrong_cast; --record-wrong-cast writes it")
        elif not record["sights"][name]["wrong_cast_beyond_floor"] <= GROWTH_FACTOR * recorded[name]:
            problems.append(f"wrong_cast of {name} {value:.4g} over {GROWTH_FACTOR:g} times its record {recorded[name]:.4g}")
    return "; ".join(problems)


def updated_records(records: Records, trials: Iterable[Mapping[str, Any]]) -> Records:
    """Return records with those of some trials replaced."""
    result: Records = json.loads(json.dumps(records))
    for trial in trials:
        if trial["id"] in RANDOM_CASES:
            continue
        values = {name: float(f"{value:.4g}") for name, value in wrong_cast_values(trial).items()}
        if values:
            result.setdefault(trial["id"], {}).setdefault(trial["algorithm"], {})[size_name(trial)] = values
    return result


def write_records(records: Records, path: Path = RECORDS_FILE) -> None:
    """Write records to a file."""
    path.write_text(json.dumps(records, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    read_records.cache_clear()
