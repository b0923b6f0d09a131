"""Merge the figures of several devices on one page. Table cells show the figures of all devices; each device has its own verdicts.

The first device in the file of figures is the main device of the page.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.seeds.claims import Claim, Experiment, Figures, Tables, format_claims, format_section
from skugga.terrain.gl.device import Device

DeviceFigures = dict[str, Any]
"""A device's record: ``software`` tells whether it is a software renderer, ``experiments`` holds figures by experiment, and
``commits`` the commits of the code that measured them, by experiment, where they are known."""

FiguresByDevice = dict[str, DeviceFigures]
"""Records by the device's OpenGL renderer name."""

NO_GPU_NOTE = """**Nothing on this page was measured on a GPU: there was none.** On a machine with one,
`python -m benchmarks.seeds` makes all experiments there, and puts their figures beside these; `SKUGGA_EGL_DEVICE` says on which
device, and `skugga doctor` lists them ([a GPU](../operating.md#a-gpu))."""

GPU_TIMING_NOTE = """\
On a GPU a pass ends when it has handed over what is to be drawn; the time of drawing falls to the pass that first
reads some of it. So shares of stages mean less there than whole times."""


def read_figures(path: Path) -> FiguresByDevice:
    """Return all stored figures by device and experiment; empty if the file does not exist."""
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def add_figures(measured: FiguresByDevice, device: Device, name: str, figures: Figures, commit: str | None = None) -> None:
    """Replace the figures of the experiment ``name`` of a device. The figures of other devices are kept.

    ``commit`` is the commit of the code that measured them; ``None`` if it is not known.
    """
    device_figures = measured.setdefault(device.renderer, {"software": device.egl_device.is_software, "experiments": {}})
    device_figures["experiments"][name] = figures
    if commit is not None:
        device_figures.setdefault("commits", {})[name] = commit
    else:
        device_figures.get("commits", {}).pop(name, None)


def current_commit() -> str | None:
    """Return the short name of the commit that is checked out, with ``-dirty`` after changes; ``None`` without git."""
    try:
        command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() or None
    except (OSError, subprocess.CalledProcessError):
        return None


def format_devices(measured: FiguresByDevice) -> str:
    """Format the list of devices for the page."""
    names = list(measured)
    lines = [f"Device: {names[0]}."]
    if len(names) > 1:
        listed = "; ".join(f"({number}) {name}" for number, name in enumerate(names, 1))
        lines = [f"Devices: {listed}. Where their figures differ, tables have one for each, in this order, as `1.00 / 0.52`."]
    if all(device_figures["software"] for device_figures in measured.values()):
        return "\n\n".join([*lines, NO_GPU_NOTE])
    return "\n\n".join([*lines, GPU_TIMING_NOTE])


def format_experiment(name: str, experiment: Experiment, measured: FiguresByDevice) -> str | None:
    """Format an experiment's section as Markdown, with the figures of all devices that ran it; ``None`` without figures."""
    sections = {
        device: experiment.make_section(device_figures["experiments"][name])
        for device, device_figures in measured.items()
        if name in device_figures["experiments"]
    }
    if not sections:
        return None
    (first_device, section), *other_sections = sections.items()
    device_note = "" if first_device == next(iter(measured)) else f" (measured on {first_device} alone)"
    commit = measured[first_device].get("commits", {}).get(name)
    device_note += "" if commit is None else f" Measured at commit {commit}."
    tables = _merge_tables(section.tables, {device: other.tables for device, other in other_sections})
    page = format_section(replace(section, method=section.method + device_note, tables=tables))
    return "\n".join([page, *(_format_device_claims(device, other.claims) for device, other in other_sections if other.claims)])


def _merge_tables(tables: Tables, other_tables: Mapping[str, Tables]) -> Tables:
    """Merge the tables of all devices, so that a cell shows the values of each device.

    ``tables`` are those of the first device, ``other_tables`` those of other devices by name. A table with other rows or columns
    than that of the first device stays separate, below the merged table.
    """
    result: Tables = []
    for number, (title, rows) in enumerate(tables):
        merged_rows, separate_tables = [[{key: [value] for key, value in row.items()} for row in rows], []]
        for device, device_tables in other_tables.items():
            rows_there = device_tables[number][1] if number < len(device_tables) else []
            if _table_layout(rows_there) != _table_layout(rows):
                separate_tables.append((f"{title}: {device}", rows_there))
                continue
            for row, device_row in zip(merged_rows, rows_there, strict=True):
                for key, value in device_row.items():
                    row[key].append(value)
        cells = [
            {key: values[0] if len({*values}) == 1 else " / ".join(values) for key, values in row.items()} for row in merged_rows
        ]
        result += [(title, cells), *separate_tables]
    return result


def _table_layout(rows: list[dict[str, str]]) -> list[tuple[tuple[str, ...], str]]:
    """Return the columns and the label of each row. Tables are merged if these are equal."""
    return [((*row,), next(iter(row.values()))) for row in rows]


def _format_device_claims(device: str, claims: list[Claim]) -> str:
    """Format the table of claims with the verdicts of a further device."""
    return "\n".join([f"**The same claims on {device}**", "", *format_claims(claims), ""])
