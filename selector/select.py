"""Policies behind one interface: a descriptor and a request, or a scene and a view, -> ``Plan``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from selector.choices import PlanRequest, PolicyName
from selector.planner.planner import make_plan
from shadows.algorithm import Reasoned
from shadows.plan import Plan
from terrain.describe import describe
from terrain.errors import InputError
from terrain.facts.descriptor import Descriptor
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView
from terrain.scene import Scene

if TYPE_CHECKING:
    from selector.cost.device_profile import DeviceProfile
    from selector.seen import Seen

UNCALIBRATED = "this device is not calibrated, so fixed rules choose (to get predictions, run skugga calibrate)"


def select(
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None = None,
    policy: PolicyName = "predict",
    device: DeviceProfile | None = None,
    seen: Mapping[str, Sequence[Seen]] | None = None,
) -> Plan:
    """The plan of a view by the policy ``rules`` or ``predict``; without a device's calibration ``predict`` falls back to
    ``rules``, and the plan says so. ``seen`` is what was seen of choices before, by light.

    Raises ``InputError`` for what is wrong, ``measure`` among it, and ``UnsupportedError`` for what cannot be served.
    """
    if policy in ("probe", "measure"):
        raise InputError("policy", policy, f"rules, predict; {policy} needs the scene itself (skugga select)")
    if policy == "predict" and device is not None:
        from selector.predict import predicted_plan

        return predicted_plan(descriptor, plan_request, overrides, device, seen=seen)
    plan = make_plan(descriptor, plan_request, overrides)
    if policy == "rules":
        return plan
    return plan.model_copy(update={"reasons": [*plan.reasons, Reasoned(name="policy rules", reason=UNCALIBRATED)]})


def plan_of_view(
    scene: Scene,
    view: MapView | PerspectiveView,
    name: str = "map",
    overrides: dict[str, Any] | None = None,
    policy: PolicyName = "predict",
    device: DeviceProfile | None = None,
    budget_s: float | None = None,
    seen: Mapping[str, Sequence[Seen]] | None = None,
) -> Plan:
    """The plan of a scene's view by any policy; ``budget_s`` is the time of the policy ``probe``, seconds, and ``seen`` what was
    seen of choices before, by light, of which ``predict`` makes use. Raises as ``select`` does.
    """
    if policy in ("probe", "measure"):
        from selector.measure.probe import DEFAULT_BUDGET_S, probed_plan

        budget_s = None if policy == "measure" else budget_s or DEFAULT_BUDGET_S
        return probed_plan(scene, view, name, overrides, device=device, budget_s=budget_s).plan
    return select(describe(scene, view, name), scene.loaded.level, overrides, policy, device, seen)
