"""Choose a plan (algorithms and settings) by any policy: from a descriptor and a request, or from a scene and a view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from skugga.selector.choices import PlanRequest, PolicyName
from skugga.selector.planner.planner import make_plan
from skugga.shadows.algorithm_settings import NamedReason
from skugga.shadows.plan import Plan
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile
    from skugga.selector.observation import Observation

UNCALIBRATED_REASON = "this device is not calibrated, so fixed rules choose (to get predictions, run skugga calibrate)"
"""Reason in a plan of the policy ``predict`` on a device without a calibration."""


def select(
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None = None,
    policy: PolicyName = "predict",
    device: DeviceProfile | None = None,
    observations: Mapping[str, Sequence[Observation]] | None = None,
) -> Plan:
    """Return the plan of a view by the policy ``rules`` or ``predict``.

    Without a calibration of the device, ``predict`` falls back to ``rules``, and a reason in the plan says so. ``observations``
    holds times and errors of choices that were drawn earlier, by light. They correct the predictions.

    Raises ``InputError`` for wrong input, including the policies ``probe`` and ``measure``, and ``UnsupportedError`` for
    combinations that no algorithm can serve.
    """
    if policy in ("probe", "measure"):
        raise InputError("policy", policy, f"rules, predict ({policy} needs a scene: use skugga select)")
    if policy == "predict" and device is not None:
        from skugga.selector.predict import predicted_plan

        return predicted_plan(descriptor, plan_request, overrides, device, observations=observations)
    plan = make_plan(descriptor, plan_request, overrides)
    if policy == "rules":
        return plan
    return plan.model_copy(update={"reasons": [*plan.reasons, NamedReason(name="policy rules", reason=UNCALIBRATED_REASON)]})


def plan_of_view(
    scene: Scene,
    view: MapView | PerspectiveView,
    name: str = "map",
    overrides: dict[str, Any] | None = None,
    policy: PolicyName = "predict",
    device: DeviceProfile | None = None,
    budget_s: float | None = None,
    observations: Mapping[str, Sequence[Observation]] | None = None,
) -> Plan:
    """Return the plan of a scene's view by any policy.

    ``budget_s`` is the time limit of the policy ``probe``, seconds. ``observations`` holds times and errors of choices that were
    drawn earlier, by light, for the policy ``predict``. Raises the errors of ``select``.
    """
    if policy in ("probe", "measure"):
        from skugga.selector.measure.probe import DEFAULT_BUDGET_S, probed_plan

        budget_s = None if policy == "measure" else budget_s or DEFAULT_BUDGET_S
        return probed_plan(scene, view, name, overrides, device=device, budget_s=budget_s).plan
    return select(describe(scene, view, name), scene.loaded.level, overrides, policy, device, observations)
