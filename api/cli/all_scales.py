"""Probes of a level's maps at all scales: one table, and what services on this device make plans of tiles by."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.table import Table

from skugga.api.cli.all_views import cells_of, facts_of
from skugga.api.cli.tables import named_table
from skugga.api.cli.times import duration_of
from skugga.api.device_calibration import calibration
from skugga.api.file_stamps import file_stamps, level_version, watched_files
from skugga.api.map_probing import probe_maps
from skugga.selector.kept_probes import save_probes
from skugga.selector.map_probes import PROBED_FOR, MapProbes
from skugga.selector.measure.probe import DEFAULT_BUDGET_S, ProbedView
from skugga.shadows.plan import Plan
from skugga.terrain.errors import InputError, LevelError
from skugga.terrain.gl import device as gl
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene


def probe_all_scales(
    level: LevelSource, policy: str, overrides: dict[str, Any], sun: SunSpec | None, budget: str | None, write: bool
) -> tuple[list[tuple[int, Plan]], str | None]:
    """The plans of a level's maps by scale (pixels of ``2 ** scale`` metres), and where what was probed is kept; ``budget``,
    as 3s, is for each of them. Raises ``SkuggaError``.
    """
    if policy != "probe":
        raise InputError("--policy", policy, "probe beside --all-scales")
    for name, value in overrides.items():
        if value is not None and name not in PROBED_FOR:
            raise InputError(
                f"--{name.replace('_', '-')}", value, "nothing beside --all-scales: tiles are drawn as the level has it"
            )
    budget_s = DEFAULT_BUDGET_S if budget is None else duration_of("--budget", budget).total_seconds()
    loaded = load_level(level)
    stamps = file_stamps(watched_files(loaded))  # before they are read, as a service does
    scene = build_scene(loaded).with_sun(sun)
    plans: list[tuple[int, Plan]] = []

    def note(scale: int, probed: ProbedView) -> None:
        plans.append((scale, probed.plan))

    try:
        found = probe_maps(scene, calibration(), overrides, budget_s, note)
    finally:
        scene.close()
    return plans, _kept(level_version(loaded, stamps), found) if write else None


def _kept(version: str, found: MapProbes) -> str:
    renderer, driver = gl.renderer_and_version()
    try:
        path = save_probes(renderer, driver, version, found)
    except OSError as error:
        raise LevelError("--write", str(error.filename), f"a folder that can be written ({error.strerror})") from None
    return f"Kept in {path}: services on this device make plans of this level's tiles by it. A change of the level begins anew."


def table_of_scales(plans: list[tuple[int, Plan]]) -> Table:
    """The plans as a table, finest pixels first: choice, what is expected of it, and whether it meets the target."""
    table = named_table("pixels", "choice", box=box.SIMPLE_HEAD)
    for name in ("time", "error"):
        table.add_column(name, justify="right")
    table.add_column("target")
    for scale, plan in plans:
        table.add_row(f"{2.0**scale:g} m", *cells_of(plan))
    return table


def rows_of_scales(plans: list[tuple[int, Plan]]) -> list[dict[str, Any]]:
    """The same as values for JSON, an object a scale, with its whole plan."""
    return [{"pixel_m": 2.0**scale, **facts_of(plan)} for scale, plan in plans]
