"""The figures of several devices on one page: table cells show those of all devices, and claims are judged for each device.

The first device in the file of figures is the page's main device.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.seeds.claims import Claim, Experiment, Figures, Tables, claims_table, markdown
from skugga.terrain.gl.device import Device

DeviceFigures = dict[str, Any]
"""A device's record: whether it is in ``software``, and its ``experiments`` by name."""

Measured = dict[str, DeviceFigures]
"""Records by OpenGL's name of the device."""

NO_GPU = """**Nothing on this page was measured on a GPU: there was none.** On a machine with one,
`python -m benchmarks.seeds` makes all experiments there, and puts their figures beside these; `SKUGGA_EGL_DEVICE` says on which
device, and `skugga doctor` lists them ([a GPU](operating.md#a-gpu))."""

LATER = """On a GPU a pass ends when it has handed over what is to be drawn; the time of drawing falls to the pass that first
reads some of it. So shares of stages mean less there than whole times."""


def read_measured(path: Path) -> Measured:
    """Return all stored measurements, by device and experiment; empty if the file does not exist."""
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def add_figures(measured: Measured, device: Device, name: str, figures: Figures) -> None:
    """Replace an experiment's figures of a device. The figures of other devices are kept."""
    of_device = measured.setdefault(device.renderer, {"software": device.egl_device.software, "experiments": {}})
    of_device["experiments"][name] = figures


def about_devices(measured: Measured) -> str:
    """Return the text about the devices for the page."""
    names = list(measured)
    lines = [f"Device: {names[0]}."]
    if len(names) > 1:
        listed = "; ".join(f"({number}) {name}" for number, name in enumerate(names, 1))
        lines = [f"Devices: {listed}. Where their figures differ, tables have one for each, in this order, as `1.00 / 0.52`."]
    if all(device_figures["software"] for device_figures in measured.values()):
        return "\n\n".join([*lines, NO_GPU])
    return "\n\n".join([*lines, LATER])


def section_of(name: str, experiment: Experiment, measured: Measured) -> str | None:
    """Format an experiment's part of the page as Markdown, with the figures of all devices that ran it."""
    sections = {
        device: experiment.section(device_figures["experiments"][name])
        for device, device_figures in measured.items()
        if name in device_figures["experiments"]
    }
    if not sections:
        return None
    (first, section), *other_sections = sections.items()
    only = "" if first == next(iter(measured)) else f" (measured on {first} alone)"
    tables = _merge_tables(section.tables, {device: other.tables for device, other in other_sections})
    page = markdown(replace(section, method=section.method + only, tables=tables))
    return "\n".join([page, *(_judged(device, other.claims) for device, other in other_sections if other.claims)])


def _merge_tables(tables: Tables, other_tables: Mapping[str, Tables]) -> Tables:
    """Merge the tables of all devices, so that a cell shows the values of each device.

    A table whose rows differ from those of the first device is not merged. It stands below as a table of its own.
    """
    result: Tables = []
    for number, (title, rows) in enumerate(tables):
        merged_rows, separate_tables = [[{key: [value] for key, value in row.items()} for row in rows], []]
        for device, device_tables in other_tables.items():
            rows_there = device_tables[number][1] if number < len(device_tables) else []
            if _heads(rows_there) != _heads(rows):
                separate_tables.append((f"{title}: {device}", rows_there))
                continue
            for row, valid in zip(merged_rows, rows_there, strict=True):
                for key, value in valid.items():
                    row[key].append(value)
        cells = [
            {key: values[0] if len({*values}) == 1 else " / ".join(values) for key, values in row.items()} for row in merged_rows
        ]
        result += [(title, cells), *separate_tables]
    return result


def _heads(rows: list[dict[str, str]]) -> list[tuple[tuple[str, ...], str]]:
    """Return the columns and row labels of a table. Tables can be merged if these are equal."""
    return [((*row,), next(iter(row.values()))) for row in rows]


def _judged(device: str, claims: list[Claim]) -> str:
    return "\n".join([f"**The same claims on {device}**", "", *claims_table(claims), ""])
