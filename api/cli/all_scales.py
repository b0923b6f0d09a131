"""Probe a level's maps at all scales: print one table, and optionally save the probes.

A probe renders a few candidate algorithms and compares them with ray-traced truth. Services on this device use saved probes to plan
tiles.
"""

from __future__ import annotations

from typing import Any

from rich import box
from rich.table import Table

from skugga.api.cli.all_views import plan_facts, plan_table_cells
from skugga.api.cli.tables import table_with_names
from skugga.api.cli.times import read_duration
from skugga.api.device_calibration import calibration
from skugga.api.file_stamps import file_stamps, level_version, watched_files
from skugga.api.map_probing import SCALE_BUDGET_S, probe_maps
from skugga.selector.map_probes import PROBE_SETTINGS, MapProbes
from skugga.selector.measure.probe import ProbedView
from skugga.selector.probe_store import save_probes
from skugga.shadows.plan import Plan
from skugga.terrain.errors import InputError, LevelError, Problem
from skugga.terrain.gl import device as gl
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene


def probe_all_scales(
    level: LevelSource, policy: str, overrides: dict[str, Any], sun: SunSpec | None, budget: str | None, write: bool
) -> tuple[list[tuple[int, Plan]], str | None]:
    """Return the plans of a level's maps by scale, and a message about the file of saved probes.

    A pixel has a side of ``2 ** scale`` metres. ``policy`` names the policy that chooses, and ``overrides`` replace settings of the
    level's ``shadows``. ``budget`` is the time of each probe as text, such as 3s. The message is ``None`` unless ``write`` is true.
    Raises ``SkuggaError``.
    """
    if policy != "probe":
        raise InputError("--policy", policy, "probe, the only policy of --all-scales")
    for name, value in overrides.items():
        if value is not None and name not in PROBE_SETTINGS:
            raise InputError.conflict(
                f"--{name.replace('_', '-')}", "--all-scales", "Leave it out: tiles use the value of the level file"
            )
    budget_s = SCALE_BUDGET_S if budget is None else read_duration("--budget", budget).total_seconds()
    loaded = load_level(level)
    stamps = file_stamps(watched_files(loaded))  # before the files are read, as a service does
    scene = build_scene(loaded).with_sun(sun)
    plans: list[tuple[int, Plan]] = []

    def add_plan(scale: int, probed: ProbedView) -> None:
        plans.append((scale, probed.plan))

    try:
        probes = probe_maps(scene, calibration(), overrides, budget_s, add_plan)
    finally:
        scene.close()
    return plans, _save_probes(level_version(loaded, stamps), probes) if write else None


def _save_probes(version: str, probes: MapProbes) -> str:
    """Save the probes of the level with this version for the device in use, and return a message that names the file.

    Raises ``LevelError`` if the file cannot be written.
    """
    renderer, driver = gl.renderer_and_version()
    try:
        path = save_probes(renderer, driver, version, probes)
    except OSError as error:
        raise LevelError(
            "--write", Problem(f"{error.filename} cannot be written ({error.strerror})"), "Make its folder writable"
        ) from None
    return f"Saved to {path}. Services on this device plan this level's tiles with it. A change of the level invalidates it."


def table_of_scales(plans: list[tuple[int, Plan]]) -> Table:
    """Return the plans as a table, finest pixels first: choice, expected time and error, and whether it meets the target."""
    table = table_with_names("pixels", "choice", box=box.SIMPLE_HEAD)
    for name in ("time", "error"):
        table.add_column(name, justify="right")
    table.add_column("target")
    for scale, plan in plans:
        table.add_row(f"{2.0**scale:g} m", *plan_table_cells(plan))
    return table


def rows_of_scales(plans: list[tuple[int, Plan]]) -> list[dict[str, Any]]:
    """Return the plans as values for JSON: one object for each scale, with its whole plan."""
    return [{"pixel_m": 2.0**scale, **plan_facts(plan)} for scale, plan in plans]
