"""Rows of a measured view: each row belongs to one distinct plan."""

from __future__ import annotations

from benchmarks.selection.measure import rows_of
from skugga.selector.choices import StandaloneRequest
from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.terrain.level.level import SUN, Shadows
from tests.selector.cost.test_cost_model import make_descriptor


def two_cascade_plan(far_m: float) -> Plan:
    """Return a plan of two maps, of which the nearer one ends at a distance."""
    plan = make_plan(
        make_descriptor(), StandaloneRequest(Shadows(algorithm="shadow_map", map_size=1024, cascades=2), (SUN,)), choices={}
    )
    (kinds,) = (plan.settings[light] for light in plan.settings)
    near, far = next(iter(kinds.values())).cascades
    map_settings = {
        kind: settings.model_copy(update={"cascades": (near.model_copy(update={"far_m": far_m}), far)})
        for kind, settings in kinds.items()
    }
    return plan.model_copy(update={"settings": {SUN: map_settings}})


def test_only_equal_plans_share_a_row():
    """The name of a plan does not contain the distance at which its maps are split."""
    plans = {"shadow_map 1024 x2": two_cascade_plan(32.0), "rules 0.1": two_cascade_plan(8.0), "rules 0.03": two_cascade_plan(32.0)}
    plans["rules 0.01"] = two_cascade_plan(8.0)
    name = "shadow_map-1024-3-16-2cascades"
    other = f"{name} (rules 0.1)"
    assert list(rows_of(plans, SUN).values()) == [name, other, name, other]
