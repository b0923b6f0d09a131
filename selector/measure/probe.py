"""Plan a view by the policies ``probe`` and ``measure``, which draw candidates and compare them with ground truth.

The plan's reasons list the drawn candidates and their results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from skugga.selector.choices import PlanRequest, PolicyName
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel
from skugga.selector.cost.typical_device import model_for_device, typical_device
from skugga.selector.formatting import format_duration, format_percent
from skugga.selector.measure.probing import ErrorMeasurement, LightProbe, leader_of, probe_options
from skugga.selector.measure.scene_prober import MAX_REPEATED_MS, MAX_WARM_REPEATED_MS, ProbedPictures, SceneProber
from skugga.selector.measure.view_truth import View
from skugga.selector.observation import Observation
from skugga.selector.planner.planner import make_plan, planner_of
from skugga.selector.predict import PlanOptions, plan_from_options, plan_options
from skugga.shadows.algorithm_settings import NamedReason
from skugga.shadows.plan import Plan
from skugga.terrain.describe import describe
from skugga.terrain.scene import Scene

DEFAULT_BUDGET_S = 10.0
"""Default time limit of a probe of one view in seconds.

A probe ends as soon as no other candidate is expected to be better, in half of the views after about a second. In a wooded view of
more than a million pixels geometry, truth, and the first drawing alone take three seconds: a shorter limit would allow one drawing.
"""

UNCALIBRATED_PROBE_REASON = "this device is not calibrated, so times are those of a typical one, corrected by the candidates drawn"
"""Reason in the plan of a probe on a device without a calibration or an estimate of its rates."""

ESTIMATED_PROBE_REASON = "this device is not calibrated, so times are estimates, corrected by the candidates drawn"
"""Reason in the plan of a probe on a device whose time rates are estimates."""


@dataclass(frozen=True, eq=False)
class ProbedView:
    """A plan, and the observed times and errors of drawn choices that led to it.

    Attributes
    ----------
    plan
        The plan.
    observations
        Observations by light.
    """

    plan: Plan
    observations: Mapping[str, tuple[Observation, ...]]


def probed_plan(
    scene: Scene,
    view: View,
    name: str = "map",
    overrides: dict[str, Any] | None = None,
    *,
    device: DeviceProfile | None = None,
    budget_s: float | None = DEFAULT_BUDGET_S,
    plan_request: PlanRequest | None = None,
    errors: ErrorModel | None = None,
    on_step: Callable[[int], None] = lambda drawn: None,
) -> ProbedView:
    """Return the plan of a scene's view, with choices of algorithms that were tested on the view itself.

    The plan keeps all settings of the level and the request, and chooses only the rest. Without a calibration, times are those of
    a typical device until some candidates are timed. If no candidate meets the target (the limits of error and time), the plan uses
    the one that comes nearest. It states by how much that exceeds a limit.

    Parameters
    ----------
    scene
        The scene.
    view
        The view.
    name
        Name of the view.
    overrides
        Fields of ``Shadows`` that the request sets.
    device
        Calibration of the device.
    budget_s
        Time limit, seconds. ``None`` means no limit, which is the policy ``measure``.
    plan_request
        Request to use instead of the scene's level.
    errors
        Error model to use instead of the packaged one.
    on_step
        Called as ``on_step(drawn)`` after each candidate, with the number of drawn candidates.

    Raises
    ------
    InputError
        An override is wrong.
    UnsupportedError
        An override cannot be served.
    """
    plan_request = plan_request or scene.loaded.level
    descriptor = describe(scene, view, name, "points")
    model = model_for_device(device, errors)
    options = plan_options(planner_of(descriptor, plan_request, overrides), device or typical_device(), model)
    pictures = ProbedPictures(scene, view, make_plan(descriptor, plan_request, overrides, choices={}).effect_names)
    probes: dict[str, LightProbe] = {}
    for number, (light, light_options) in enumerate(options.lights.items()):
        if not light_options.numbers:
            continue
        left_s = None
        if budget_s is not None:
            left_s = (budget_s - sum(probe.seconds for probe in probes.values())) / (len(options.lights) - number)
        repeated_ms = MAX_REPEATED_MS if budget_s is None else MAX_WARM_REPEATED_MS
        prober = SceneProber(pictures, options.planner, light, light_options, repeated_ms)
        probes[light] = probe_options(light_options, prober, options.max_error, options.time_limits_ms()[light], left_s, on_step)
        options = replace(options, lights={**options.lights, light: probes[light].options})
    policy: PolicyName = "measure" if budget_s is None else "probe"
    basis = UNCALIBRATED_PROBE_REASON if device is None else ESTIMATED_PROBE_REASON if device.is_estimate else None
    reasons = [] if basis is None else [NamedReason(name=f"policy {policy}", reason=basis)]
    reasons += [reason for light, probe in probes.items() for reason in _reasons(options, light, probe)]
    plan = plan_from_options(options, policy, reasons)
    return ProbedView(plan, {light: tuple(probe.options.observations.values()) for light, probe in probes.items()})


def _reasons(options: PlanOptions, light: str, probe: LightProbe) -> list[NamedReason]:
    """Return reasons that list the drawn candidates for a light, their results, and how these changed the choice."""
    light_options, reasons = probe.options, []
    expected = {option.choice.name: option for option in light_options.options}
    for option_index, (ms, measurement) in probe.drawn.items():
        name = light_options.options[option_index].choice.name
        before = f"expected: {format_percent(expected[name].errors.wrong_cast)} in {format_duration(expected[name].ms)}"
        reasons.append(
            NamedReason(name=f"{light}: probed {name}", reason=f"{_errors_text(measurement)} in {format_duration(ms)} ({before})")
        )
    return [*reasons, NamedReason(name=f"{light}: probe", reason=_result_text(options, light, probe))]


def _errors_text(measurement: ErrorMeasurement) -> str:
    """Return the errors of a drawn candidate in words."""
    text = f"{format_percent(measurement.error)} wrong"
    if measurement.high > measurement.low:
        text += f" ({format_percent(measurement.low)} to {format_percent(measurement.high)} with 95 % confidence)"
    return (
        f"{text} of {measurement.points} points in cast shadow, {format_percent(measurement.interior)} of all "
        f"points wrong far from edges"
    )


def _result_text(options: PlanOptions, light: str, probe: LightProbe) -> str:
    """Return the result of a probe (the test of candidates for one light) in words."""
    light_options, max_error = probe.options, options.max_error
    drawn_count = len(probe.drawn)
    text = (
        f"{drawn_count} of {len(light_options.options)} candidates drawn and compared with truth in "
        f"{format_duration(1000.0 * probe.seconds)}: "
    )
    if not light_options.numbers:
        return text + "no candidate can draw this view"
    leader = leader_of(light_options, max_error, options.time_limits_ms()[light])
    name_before, name_after = (light_options.options[option_index].choice.name for option_index in (probe.initial_leader, leader))
    text += (
        f"the choice remains {name_after}" if name_before == name_after else f"the choice is {name_after} instead of {name_before}"
    )
    chance = light_options.miss_chance(leader, max_error)
    limit = format_percent(max_error)
    if leader not in probe.drawn:
        sure = "more than 99 %" if chance < 0.01 else format_percent(1.0 - chance)
        return f"{text}; no time was left to draw it: it stays within {limit} with a chance of {sure}"
    if probe.confirmed:
        outcome = "it stays within" if chance <= 0.5 else "it misses"
        return f"{text}; {outcome} {limit}, and no other candidate is expected to be better"
    return f"{text}; the time budget ended before all candidates that may be better were drawn"
