"""``skugga select``: plan a view of a level by a policy, and pin the choice into the level file.

To pin a choice is to write it into the level file, which then fixes the algorithms of that view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any, cast, get_args

from skugga.api.cli.snapshot import scene_and_view
from skugga.api.cli.times import read_duration
from skugga.api.device_calibration import calibration_for
from skugga.api.report.plan_text import POLICY_PHRASES, format_choices, format_expectation, format_heading, format_view_and_sun
from skugga.selector.choices import PolicyName
from skugga.selector.pin import PIN_COMMENT, default_values, pin, pinned_keys, pins
from skugga.selector.planner.planner import make_plan as choose_by_rules
from skugga.selector.select import plan_of_view
from skugga.shadows.plan import Plan
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError, UnsupportedError
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import LevelShadows
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A plan with its context.

    Attributes
    ----------
    path
        The level file.
    scene, view
        The scene and the view of the plan.
    plan
        The plan.
    """

    path: Path
    scene: Scene
    view: MapView | PerspectiveView
    plan: Plan

    @property
    def heading(self) -> str:
        """Heading of the plan: level, view, sun and policy."""
        return format_heading(self.scene, self.plan)


def plan_level_view(
    level: LevelSource,
    view: str,
    policy: str,
    overrides: dict[str, Any],
    sun: SunSpec | None,
    size: tuple[int, int] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
    seconds: float | None = None,
    ignore_pin: bool = False,
    budget: str | None = None,
) -> PlannedView:
    """Plan a view of a level.

    ``policy`` names the policy that chooses. ``overrides`` replace settings of the level's ``shadows``. ``size`` is (width,
    height) in pixels. ``bounds`` are west, south, east and north in units of ``crs``. ``seconds`` is a reading of the level's
    clock. ``ignore_pin`` ignores the choice that the level file fixes for the view. ``budget`` is the time of the policy
    ``probe`` as text, such as 3s. Raises ``SkuggaError``.
    """
    scene, view_value = scene_and_view(level, view, sun, size, bounds, crs, seconds)
    if ignore_pin:
        scene = without_pins(scene)
    return plan_scene_view(level.path, scene, view_value, view, policy, overrides, budget)


def plan_scene_view(
    level_path: Path,
    scene: Scene,
    view: MapView | PerspectiveView,
    view_name: str,
    policy: str,
    overrides: dict[str, Any],
    budget: str | None = None,
) -> PlannedView:
    """Plan a view of a scene whose level file is ``level_path``. The other parameters are those of ``plan_level_view``.

    ``view_name`` is the view's name in the plan. Raises ``SkuggaError``.
    """
    if policy not in get_args(PolicyName):
        raise InputError("--policy", policy, ", ".join(get_args(PolicyName)))
    if budget is not None and policy != "probe":
        raise InputError.conflict("--budget", f"--policy {policy}", "Use --policy probe, whose time it limits")
    budget_s = None if budget is None else read_duration("--budget", budget).total_seconds()
    device = calibration_for(scene.loaded.level.shadows, overrides, shows_times=True) if policy != "rules" else None
    plan = plan_of_view(scene, view, view_name, overrides, cast(PolicyName, policy), device, budget_s)
    return PlannedView(level_path, scene, view, plan)


def pin_plan(planned_view: PlannedView) -> str:
    """Write the choice for a view into the level file, and return a message that says what was written and where.

    Raises ``LevelError`` if the file cannot be written, ``UnsupportedError`` if another view of the level does not support the
    choice, ``InputError`` if the view has no shadow caster.
    """
    scene, plan = planned_view.scene, planned_view.plan
    level = scene.loaded.level
    new_pins = pins(plan, describe(scene, planned_view.view, plan.view), level)
    pinned_scene = with_shadow_settings(scene, new_pins)
    for name in level.views:
        _check_supported(pinned_scene, name, plan)
    pin(planned_view.path, new_pins, _pin_comment(planned_view))
    settings = "".join(f", {key} {value}" for key, value in new_pins.items() if key != "algorithm")
    return f"Pinned into {planned_view.path}: algorithm {plan.algorithms_text}{settings}."


def write_descriptor(planned_view: PlannedView, path: Path) -> None:
    """Write the descriptor of a view, which is the input of the choice, as JSON."""
    descriptor = describe(planned_view.scene, planned_view.view, planned_view.plan.view)
    write_atomically(path, descriptor.model_dump_json(indent=2) + "\n")


def without_pins(scene: Scene) -> Scene:
    """Return a scene with default values for the shadow settings that ``skugga select`` has written into the level file."""
    return with_shadow_settings(scene, default_values(pinned_keys(scene.loaded.path)))


def with_shadow_settings(scene: Scene, changes: dict[str, Any]) -> Scene:
    """Return a scene with changed shadow settings: ``changes`` has the new values by keys of ``shadows``."""
    level = scene.loaded.level
    shadows = LevelShadows.model_validate({**level.shadows.model_dump(exclude_unset=True), **changes})
    loaded = scene.loaded.model_copy(update={"level": level.model_copy(update={"shadows": shadows})})
    return replace(scene, loaded=loaded)


def _check_supported(scene: Scene, name: str, plan: Plan) -> None:
    """Raise ``UnsupportedError`` if the view ``name`` of the scene cannot be drawn with the settings of ``scene``.

    ``plan`` is the choice for another view, which is to be pinned; the error names its algorithms.
    """
    try:
        choose_by_rules(describe(scene, scene.view(name), name), scene.loaded.level)
    except UnsupportedError as error:
        reason = f"view {name} of the level cannot be drawn with {error.value}: {error.allowed}"
        raise UnsupportedError("--write", plan.algorithms_text, reason) from None


def _pin_comment(planned_view: PlannedView) -> list[str]:
    """Return the comment lines that stand above a pinned choice in the level file.

    The first line begins with ``PIN_COMMENT``, by which a later run finds the pinned settings.
    """
    plan = planned_view.plan
    return [
        f"{PIN_COMMENT.removeprefix('#: ')} on {date.today().isoformat()}, {POLICY_PHRASES[plan.policy]}.",
        f"{format_view_and_sun(planned_view.scene, plan)}.",
        *format_choices(plan),
        format_expectation(plan),
    ]
