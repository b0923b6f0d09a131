"""Plan all views of a level: print one table, or pin all choices into the level file.

A pin is a choice of shadow algorithms that the level file fixes for a view.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from typing import Any

from rich import box
from rich.table import Table

from skugga.api.cli.planning import PlannedView, plan_scene_view, with_shadow_settings, without_pins
from skugga.api.cli.snapshot import scene_and_view
from skugga.api.cli.tables import table_with_names
from skugga.api.report.plan_text import POLICY_PHRASES, format_expectation, format_sun, format_view_and_sun
from skugga.selector.formatting import format_duration, format_percent
from skugga.selector.pin import PIN_COMMENT, PINS, pin, pins
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec


def check_conflicts(option: str, view: str, other_options: dict[str, object]) -> None:
    """Raise ``InputError`` for options of a single view that are combined with an option for many views.

    ``option`` is the flag of the option for many views. ``view`` is the requested view. ``other_options`` are the values of further
    options of a single view by name, without dashes; ``None`` for an unused one.
    """
    for name, value in ({"view": None if view == "map" else view} | other_options).items():
        if value is not None:
            raise InputError.conflict(f"--{name}", option, f"Leave out --{name}: the views are those of the level file")


def plan_all_views(
    level: LevelSource,
    policy: str,
    overrides: dict[str, Any],
    sun: SunSpec | None,
    seconds: float | None = None,
    ignore_pins: bool = False,
    budget: str | None = None,
) -> list[PlannedView]:
    """Plan each view of a level, and ``map``, the view of its tiles.

    ``policy`` names the policy that chooses. ``overrides`` replace settings of the level's ``shadows``. ``seconds`` is a
    reading of the level's clock. ``ignore_pins`` ignores the choices that the level file fixes. ``budget`` is the time of
    each probe as text, such as 3s. Raises ``SkuggaError``.
    """
    scene, _ = scene_and_view(level, "map", sun, seconds=seconds)
    if ignore_pins:
        scene = with_shadow_settings(without_pins(scene), {PINS: []})
    names = dict.fromkeys(["map", *scene.loaded.level.views])
    return [plan_scene_view(level.path, scene, scene.view(name), name, policy, overrides, budget) for name in names]


def pin_all_views(planned_views: Sequence[PlannedView]) -> str:
    """Write the choice of each view into the level file, and return a message that says what was written and where.

    Raises ``LevelError`` if the file cannot be written, ``InputError`` if no view has a shadow caster.
    """
    casting = [choice for choice in planned_views if _casts_shadows(choice.plan)]
    path = planned_views[0].path
    if not casting:
        raise InputError(
            "--write", Problem("no view has a cast shadow, so no choice can be pinned"), "Choose a sun that casts shadows"
        )
    chosen = [
        {"view": choice.plan.view, **pins(choice.plan, describe(choice.scene, choice.view, choice.plan.view), _level_spec(choice))}
        for choice in casting
    ]
    policies = dict.fromkeys(POLICY_PHRASES[choice.plan.policy] for choice in casting)
    comment_lines = [f"{PIN_COMMENT.removeprefix('#: ')} on {date.today().isoformat()}, {' and '.join(policies)}."]
    comment_lines += [
        (
            f"{format_view_and_sun(planned_view.scene, planned_view.plan)}: "
            f"{algorithms_label(planned_view.plan)}. {format_expectation(planned_view.plan)}"
        )
        for planned_view in casting
    ]
    pin(path, {PINS: chosen}, comment_lines)
    pinned_views = ", ".join(f"{planned_view.plan.view} {planned_view.plan.algorithms_text}" for planned_view in casting)
    return f"Pinned into {path}: {pinned_views}."


def choices_table(planned_views: Sequence[PlannedView]) -> Table:
    """Return the choices as a table: view, sun, choice, expected time and error, and whether it meets the target."""
    table = table_with_names("view", "sun", "choice", box=box.SIMPLE_HEAD)
    for name in ("time", "error"):
        table.add_column(name, justify="right")
    table.add_column("target")
    for choice in planned_views:
        sun = format_sun(choice.scene.sun).removeprefix("the sun ")
        table.add_row(choice.plan.view, sun, *plan_table_cells(choice.plan))
    return table


def json_rows(planned_views: Sequence[PlannedView]) -> list[dict[str, Any]]:
    """Return the choices as values for JSON: one object for each view, with its whole plan."""
    return [
        {
            "view": choice.plan.view,
            "sun": None if (sun := choice.scene.sun) is None else {"azimuth": sun.azimuth_deg, "altitude": sun.altitude_deg},
            **plan_facts(choice.plan),
        }
        for choice in planned_views
    ]


def plan_facts(plan: Plan) -> dict[str, Any]:
    """Return the cells of a plan's table row as values for JSON, with the whole plan."""
    predicted = plan.predicted
    return {
        "choice": algorithms_label(plan),
        "ms": None if predicted is None else predicted.ms,
        "ms_at_rest": None if predicted is None else predicted.ms_at_rest,
        "error": None if predicted is None else predicted.wrong_cast,
        "met": plan.target.met,
        "plan": plan.model_dump(mode="json"),
    }


def plan_table_cells(plan: Plan) -> tuple[str, str, str, str]:
    """Return the four cells of a plan's table row: choice, expected time, expected error, and whether it meets the target."""
    predicted = plan.predicted
    time, error = ("", "") if predicted is None else (format_duration(predicted.ms), format_percent(predicted.wrong_cast))
    met = {True: "met", False: "missed", None: "not predicted"}[plan.target.met] if _casts_shadows(plan) else ""
    return algorithms_label(plan), time, error, met


def algorithms_label(plan: Plan) -> str:
    """Return the algorithms of a plan and its requested map sizes, such as ``shadow_map 2048``."""
    if not _casts_shadows(plan):
        return NO_SHADOWS
    map_sizes = [step.settings.as_overrides.get("map_size") for step in plan.steps if step.settings is not None]
    return " ".join([plan.algorithms_text, *(str(size) for size in dict.fromkeys(map_sizes) if size is not None)])


def _casts_shadows(plan: Plan) -> bool:
    """Return whether a plan draws cast shadows from any light and any kind of caster."""
    return any(name != NO_SHADOWS for kinds in plan.algorithm.values() for name in kinds.values())


def _level_spec(planned_view: PlannedView) -> Any:
    """Return the parsed level file of a planned view."""
    return planned_view.scene.loaded.level
