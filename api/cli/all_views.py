"""Choices for all of a level's views at once: one table, and one list of pins in the level's file."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from typing import Any

from rich import box
from rich.table import Table

from skugga.api.cli.planning import PlannedView, asking, plan_scene_view, unpinned
from skugga.api.cli.snapshot import scene_and_view
from skugga.api.cli.tables import named_table
from skugga.api.report.plan_text import POLICIES, format_expectation, format_sun, format_view_and_sun
from skugga.selector.formatting import format_duration, format_percent
from skugga.selector.pin import PIN_COMMENT, PINS, pin, pins
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec


def refuse_beside(option: str, view: str, asked: dict[str, object]) -> None:
    """Raise ``InputError`` for options of one view that are given beside one that means many of them."""
    for name, value in ({"view": None if view == "map" else view} | asked).items():
        if value is not None:
            raise InputError(f"--{name}", str(value), f"nothing beside {option}: what is drawn is as the level has it")


def plan_all_views(
    level: LevelSource,
    policy: str,
    overrides: dict[str, Any],
    sun: SunSpec | None,
    seconds: float | None = None,
    ignore_pins: bool = False,
    budget: str | None = None,
) -> list[PlannedView]:
    """Choose for each of a level's views, and for ``map``, the view of its tiles; ``ignore_pins``: as if none had been pinned into
    its file. ``budget`` is for each of them. Raises ``SkuggaError``.
    """
    scene, _ = scene_and_view(level, "map", sun, seconds=seconds)
    if ignore_pins:
        scene = asking(unpinned(scene), {PINS: []})
    names = dict.fromkeys(["map", *scene.loaded.level.views])
    return [plan_scene_view(level.path, scene, scene.view(name), name, policy, overrides, budget) for name in names]


def pin_all(choices: Sequence[PlannedView]) -> str:
    """Pin each view's choice into the level's file; says what was written and where.

    Raises ``LevelError`` for a file that cannot be written, ``InputError`` where nothing casts in any view.
    """
    casting = [choice for choice in choices if _casts(choice.plan)]
    path = choices[0].path
    if not casting:
        raise InputError("--write", "all views", "a sun with a cast shadow in some view")
    chosen = [
        {"view": choice.plan.view, **pins(choice.plan, describe(choice.scene, choice.view, choice.plan.view), _level(choice))}
        for choice in casting
    ]
    policies = dict.fromkeys(POLICIES[choice.plan.policy] for choice in casting)
    why = [f"{PIN_COMMENT.removeprefix('#: ')} on {date.today().isoformat()}, {' and '.join(policies)}."]
    why += [
        f"{format_view_and_sun(each.scene, each.plan)}: {choice_of(each.plan)}. {format_expectation(each.plan)}" for each in casting
    ]
    pin(path, {PINS: chosen}, why)
    return f"Pinned into {path}: {', '.join(f'{each.plan.view} {each.plan.headline}' for each in casting)}."


def table_of(choices: Sequence[PlannedView]) -> Table:
    """The choices as a table: view, sun, choice, what is expected of it, and whether it meets the target."""
    table = named_table("view", "sun", "choice", box=box.SIMPLE_HEAD)
    for name in ("time", "error"):
        table.add_column(name, justify="right")
    table.add_column("target")
    for choice in choices:
        sun = format_sun(choice.scene.sun).removeprefix("the sun ")
        table.add_row(choice.plan.view, sun, *cells_of(choice.plan))
    return table


def rows_of(choices: Sequence[PlannedView]) -> list[dict[str, Any]]:
    """The same as values for JSON, an object a view, with its whole plan."""
    return [
        {
            "view": choice.plan.view,
            "sun": None if (sun := choice.scene.sun) is None else {"azimuth": sun.azimuth_deg, "altitude": sun.altitude_deg},
            **facts_of(choice.plan),
        }
        for choice in choices
    ]


def facts_of(plan: Plan) -> dict[str, Any]:
    """What a row says of a plan, as values for JSON, with the whole plan."""
    predicted = plan.predicted
    return {
        "choice": choice_of(plan),
        "ms": None if predicted is None else predicted.ms,
        "error": None if predicted is None else predicted.wrong_cast,
        "met": plan.target.met,
        "plan": plan.model_dump(mode="json"),
    }


def cells_of(plan: Plan) -> tuple[str, str, str, str]:
    """What a table says of a plan: choice, what is expected of it (time and error), and whether it meets the target."""
    predicted = plan.predicted
    time, error = ("", "") if predicted is None else (format_duration(predicted.ms), format_percent(predicted.wrong_cast))
    met = {True: "met", False: "missed", None: "not predicted"}[plan.target.met] if _casts(plan) else ""
    return choice_of(plan), time, error, met


def choice_of(plan: Plan) -> str:
    """Algorithms, and the settings of maps that are one for all, as ``shadow_map 2048``."""
    if not _casts(plan):
        return NO_SHADOWS
    asked = [step.settings.asked_as.get("map_size") for step in plan.steps if step.settings is not None]
    return " ".join([plan.headline, *(str(size) for size in dict.fromkeys(asked) if size is not None)])


def _casts(plan: Plan) -> bool:
    return any(name != NO_SHADOWS for kinds in plan.algorithm.values() for name in kinds.values())


def _level(choice: PlannedView) -> Any:
    return choice.scene.loaded.level
