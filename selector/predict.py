"""The policy ``predict``: choose the algorithms and settings whose expected time and error meet a target.

The target is a limit of the error and a limit of the time. Expectations come from models. Observations of choices that were drawn
on the scene correct them, if there are any.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from skugga.selector.choices import Choice, PlanRequest, PolicyName
from skugga.selector.cost.cost_model import frames_at_rest_ms
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel
from skugga.selector.cost.typical_device import model_for_device
from skugga.selector.expected_loss import MAX_MISS_CHANCE_OF_LIKELY_OPTION, least_expected_loss
from skugga.selector.formatting import format_duration, format_percent, format_wrong_share
from skugga.selector.observation import Observation
from skugga.selector.options import MIN_MS, LightOptions, predicted_choices
from skugga.selector.planner.advice import choices_by_rules
from skugga.selector.planner.planner import Planner, planner_of
from skugga.selector.ranking import RankingResult
from skugga.shadows.algorithm_settings import NamedReason
from skugga.shadows.plan import Plan, Predicted, Target
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName

ESTIMATED_TIMES_REASON = "this device is not calibrated, so times are estimates (skugga calibrate measures them)"
"""Reason in a plan of the policy ``predict`` on a device whose time rates are estimates."""

TARGET_MISSED = ": target missed"
"""End of the name of the reason for a missed target; a light's name comes first."""

MAX_OPTIONS = 64
"""Maximum number of options of a light that policies search: the time of a search grows with the third power of it.

The algorithms that come with Skugga have at most 47."""

NO_PREDICTION_REASON = "no prediction is possible, so fixed rules choose"
"""Reason in the plan of a view with a light for which no algorithm can be predicted."""


@dataclass(frozen=True, eq=False)
class PlanOptions:
    """The options (choices of algorithms and settings) for all lights of a view.

    Attributes
    ----------
    planner
        Planner of the view.
    lights
        Options by light, for each light that casts shadows.
    unmeasured
        Reasons why algorithms without predictions are not among the options.
    unsearched
        Names of the choices beyond ``MAX_OPTIONS`` by light, which no policy looks at.
    observed_basis
        Word in reasons for the origin of observed times and errors, such as "measured".
    device
        Calibration that the times are predicted with; ``None``: the plan tells no times of frames at rest.
    """

    planner: Planner
    lights: Mapping[str, LightOptions]
    unmeasured: Mapping[AlgorithmName, str] = field(default_factory=dict)
    unsearched: Mapping[str, Sequence[str]] = field(default_factory=dict)
    observed_basis: str = "measured"
    device: DeviceProfile | None = None

    def basis(self, light: str, option_index: int) -> str:
        """Return the word for the origin of an option's time and errors: ``observed_basis`` or "expected".

        ``option_index`` is the index of the option in ``lights[light].options``.
        """
        return self.observed_basis if option_index in self.lights[light].observations else "expected"

    @property
    def max_error(self) -> float:
        """The requested limit of the error, in [0, 1]."""
        return self.planner.requested_shadows.max_error

    def time_limits_ms(self) -> dict[str, float | None]:
        """Return, by light, the milliseconds of the time limit ``max_ms`` that each light may take; ``None`` without a limit.

        The limit is divided in proportion to the times of the options that would be chosen without it.
        """
        max_ms = self.planner.requested_shadows.max_ms
        if max_ms is None:
            return dict.fromkeys(self.lights)
        unlimited_verdicts = {
            light: least_expected_loss(light_options.forecasts(self.max_error), self.max_error)
            for light, light_options in self.lights.items()
        }
        unlimited_ms = max(sum(verdict.winner.ms for verdict in unlimited_verdicts.values()), 1e-9)
        return {light: max_ms * verdict.winner.ms / unlimited_ms for light, verdict in unlimited_verdicts.items()}


def predicted_plan(
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None,
    device: DeviceProfile,
    errors: ErrorModel | None = None,
    observations: Mapping[str, Sequence[Observation]] | None = None,
) -> Plan:
    """Return the plan of the choices with the least expected loss (``skugga.selector.expected_loss``).

    For each light this is the fastest choice that is likely to meet the limits ``max_error`` and ``max_ms``. If no choice is, it is
    the most accurate one within ``max_ms``. If there is none either, it is the one that exceeds the limits least. In the last two
    cases the plan states that it misses the target.

    Parameters
    ----------
    descriptor
        Facts of the view.
    plan_request
        The level, or a ``StandaloneRequest``.
    overrides
        Fields of ``Shadows`` that the request sets.
    device
        Calibration of the device.
    errors
        Error model to use instead of the packaged one.
    observations
        Observed times and errors of choices, by light.

    Raises
    ------
    InputError
        An override is wrong.
    UnsupportedError
        An override cannot be served.
    """
    expected = plan_options(planner_of(descriptor, plan_request, overrides), device, model_for_device(device, errors))
    reasons = [NamedReason(name="policy predict", reason=ESTIMATED_TIMES_REASON)] if device.is_estimate else []
    if not observations:
        return _with_basis(plan_from_options(expected, "predict", reasons), device)
    corrected = {
        light: light_options.with_observations(observations.get(light, ())) for light, light_options in expected.lights.items()
    }
    options = replace(expected, lights=corrected, observed_basis="probed")
    return _with_basis(plan_from_options(options, "predict", [*reasons, *_observation_reasons(expected, options)]), device)


def _with_basis(plan: Plan, device: DeviceProfile) -> Plan:
    """Return a plan whose prediction tells whether the device was calibrated."""
    if plan.predicted is None or not device.is_estimate:
        return plan
    return plan.model_copy(update={"predicted": plan.predicted.model_copy(update={"is_estimate": True})})


def _observation_reasons(before: PlanOptions, after: PlanOptions) -> list[NamedReason]:
    """Return reasons that list the observations of choices, and tell how these changed the choice.

    ``before`` are the options without, ``after`` those with the observations.
    """
    reasons: list[NamedReason] = []
    if not all(light_options.numbers for light_options in after.lights.values()):
        return reasons
    for light, light_options in after.lights.items():
        if not light_options.observations:
            continue
        observation_texts = [
            f"{observation.choice} {format_percent(observation.error)} wrong in {format_duration(observation.ms)}"
            for observation in light_options.observations.values()
        ]
        name_before, name_after = (
            options.lights[light].options[_winner_number(options, light)].choice.name for options in (before, after)
        )
        verdict = (
            f"the choice remains {name_after}"
            if name_before == name_after
            else f"the choice is {name_after} instead of {name_before}"
        )
        reasons.append(
            NamedReason(name=f"{light}: probe", reason=f"maps like this one were probed: {', '.join(observation_texts)}; {verdict}")
        )
    return reasons


def _winner_number(options: PlanOptions, light: str) -> int:
    """Return the number of a light's option with the least expected loss: its index in ``LightOptions.options``."""
    light_options, max_error = options.lights[light], options.max_error
    return light_options.number(
        least_expected_loss(light_options.forecasts(max_error), max_error, options.time_limits_ms()[light]).winner.name
    )


def plan_options(planner: Planner, device: DeviceProfile, errors: ErrorModel | None = None) -> PlanOptions:
    """Return the options for all lights of a view, with predicted times and errors, before any observation."""
    unmeasured: dict[AlgorithmName, str] = {}
    lights, unsearched = {}, {}
    for light in planner.lights:
        if kinds := planner.casting_kinds(light):
            options = predicted_choices(planner, light, kinds, device, errors, unmeasured)
            lights[light] = LightOptions.expected(options[:MAX_OPTIONS], errors)
            if len(options) > MAX_OPTIONS:
                unsearched[light] = [option.choice.name for option in options[MAX_OPTIONS:]]
    return PlanOptions(planner, lights, unmeasured, unsearched, device=device)


def plan_from_options(options: PlanOptions, policy: PolicyName, reasons: Sequence[NamedReason] = ()) -> Plan:
    """Return the plan of the options with the least expected loss, with reasons. ``reasons`` are appended to them.

    If a light has no option, the plan is that of the policy ``rules``.
    """
    planner, max_error = options.planner, options.max_error
    if not all(light_options.numbers for light_options in options.lights.values()):
        return _rules_plan(options)
    verdicts = {
        light: least_expected_loss(options.lights[light].forecasts(max_error), max_error, share_ms)
        for light, share_ms in options.time_limits_ms().items()
    }
    winners = {light: options.lights[light].number(verdict.winner.name) for light, verdict in verdicts.items()}
    choices = {light: _with_reasons(options, light, option_index, verdicts[light]) for light, option_index in winners.items()}
    plan = planner.plan(choices, dict(options.unmeasured) | _rejection_reasons(options, winners))
    winning_options = [(options.lights[light], option_index) for light, option_index in winners.items()]
    return plan.model_copy(
        update={
            "policy": policy,
            "predicted": Predicted(
                ms=sum(light_options.figures(option_index).ms for light_options, option_index in winning_options),
                wrong=max((light_options.wrong(option_index) for light_options, option_index in winning_options), default=0.0),
                wrong_cast=max(
                    (light_options.figures(option_index).error for light_options, option_index in winning_options), default=0.0
                ),
                is_coverage=any(
                    light_options.options[option_index].errors.is_coverage for light_options, option_index in winning_options
                ),
                is_measured=policy in ("probe", "measure")
                and all(option_index in light_options.observations for light_options, option_index in winning_options),
                ms_at_rest=_ms_at_rest(options, winners),
            ),
            "target": Target(
                max_error=max_error,
                max_ms=planner.requested_shadows.max_ms,
                met=all(verdict.meets_target for verdict in verdicts.values()),
            ),
            "reasons": [*_missed_reasons(options, winners, verdicts), *plan.reasons, *reasons, *_unsearched_reasons(options)],
        }
    )


def _ms_at_rest(options: PlanOptions, winners: Mapping[str, int]) -> float | None:
    """Return the expected milliseconds of a frame of a perspective view in which nothing has moved since the frame before.

    ``winners`` holds the number of the chosen option by light. Observed times of frames made anew are scaled by the share of the
    work that the cost model expects to remain. ``None`` for maps.
    """
    descriptor = options.planner.descriptor
    if options.device is None or descriptor.view_kind == "map":
        return None
    chosen = {light: options.lights[light].options[option_index] for light, option_index in winners.items()}
    rest_ms = frames_at_rest_ms(options.device, descriptor, [step for option in chosen.values() for step in option.steps])
    return sum(
        options.lights[light].figures(winners[light]).ms * (rest_ms.get(light, 0.0) / max(option.ms, MIN_MS))
        for light, option in chosen.items()
    )


def _unsearched_reasons(options: PlanOptions) -> list[NamedReason]:
    """Return a reason for each light with more choices than policies search."""
    return [
        NamedReason(
            name=f"{light}: search",
            reason=f"{MAX_OPTIONS} of {MAX_OPTIONS + len(names)} choices were searched; not searched: {', '.join(names)}",
        )
        for light, names in options.unsearched.items()
    ]


def _rules_plan(options: PlanOptions) -> Plan:
    """Return the plan of the policy ``rules``, for a view with a light without any option that can be predicted."""
    planner = options.planner
    plan = planner.plan(choices_by_rules(planner.descriptor, planner.requested_shadows, planner.lights), options.unmeasured)
    reason = "; ".join(f"{name}: {reason}" for name, reason in options.unmeasured.items())
    return plan.model_copy(
        update={"reasons": [*plan.reasons, NamedReason(name="policy rules", reason=f"{NO_PREDICTION_REASON}: {reason}")]}
    )


def _with_reasons(options: PlanOptions, light: str, option_index: int, verdict: RankingResult) -> Choice:
    """Return the choice of a light's option number ``option_index``, with the reasons for it. ``verdict`` is its ranking."""
    light_options, max_error = options.lights[light], options.max_error
    winner, figures = light_options.options[option_index], light_options.figures(option_index)
    error = format_wrong_share(figures.error, winner.errors.is_coverage)
    expectation = f"{options.basis(light, option_index)}: {error} in {format_duration(figures.ms)}"
    settings = " ".join(f"{key} {value}" for key, value in winner.choice.settings.items())
    if not verdict.meets_target:
        reason = f"{expectation}; no choice is expected to meet the target, and this one comes nearest"
    else:
        reason = f"{expectation}, {_chance_text(light_options, option_index, max_error)}; "
        other_numbers = [
            number for number in light_options.numbers if light_options.options[number].algorithms != winner.algorithms
        ]
        likely = [
            number for number in other_numbers if light_options.miss_chance(number, max_error) <= MAX_MISS_CHANCE_OF_LIKELY_OPTION
        ]
        fastest_other = min(likely, key=lambda number: light_options.figures(number).ms, default=None)
        if fastest_other is None:
            reason += f"no other algorithm is expected to stay within {_limit_text(max_error)}"
        elif (ms := light_options.figures(fastest_other).ms) >= figures.ms:
            reason += (
                f"the fastest other algorithm within {_limit_text(max_error)} is "
                f"{light_options.options[fastest_other].choice.name}, {format_duration(ms)}"
            )
        else:
            reason += (
                f"{light_options.options[fastest_other].choice.name} would take {format_duration(ms)} "
                f"{_chance_text(light_options, fastest_other, max_error)}"
            )
    setting_reason = f"chosen for the target ({settings})"
    kinds = options.planner.casting_kinds(light)
    return replace(winner.choice, reason={**dict.fromkeys(kinds, reason), **dict.fromkeys(winner.choice.settings, setting_reason)})


def _chance_text(light_options: LightOptions, option_index: int, max_error: float) -> str:
    """Return, in words, the probability that an option's error exceeds ``max_error``."""
    chance = light_options.miss_chance(option_index, max_error)
    return (
        f"with {'less than a 1 %' if chance < 0.01 else f'a {format_percent(chance)}'} chance of an error "
        f"over {_limit_text(max_error)}"
    )


def _limit_text(max_error: float) -> str:
    """Return a limit of the error, a share in [0, 1], as a percentage."""
    return f"{100.0 * max_error:g} %"


def _rejection_reasons(options: PlanOptions, winners: Mapping[str, int]) -> dict[AlgorithmName, str]:
    """Return why algorithms that could draw the view are not used: the best expected or observed result of each.

    ``winners`` holds the number of the chosen option for each light. An algorithm that the search leaves out has the reason for
    that.
    """
    reasons: dict[AlgorithmName, str] = {}
    max_error, planner = options.max_error, options.planner
    for name, algorithm in ALGORITHMS.items():
        kinds = {kind for light in options.lights for kind in planner.casting_kinds(light)}
        if any(algorithm.search.is_excluded(planner.descriptor, kind) for kind in kinds):
            reasons[name] = algorithm.search.exclusion_reason
        for light, light_options in options.lights.items():
            numbers = [number for number in light_options.numbers if name in light_options.options[number].algorithms]
            if not numbers or name in light_options.options[winners[light]].algorithms:
                continue
            verdict = least_expected_loss([light_options.forecast(number, max_error) for number in numbers], max_error)
            nearest = light_options.number(verdict.winner.name)
            basis = options.basis(light, nearest)
            if verdict.meets_target:
                reasons[name] = (
                    f"{basis}: {format_duration(verdict.winner.ms)} with {verdict.winner.name}, "
                    f"{_chance_text(light_options, nearest, max_error)}; "
                    f"the choice takes {format_duration(light_options.figures(winners[light]).ms)}"
                )
            else:
                reasons[name] = f"{basis} at best: {verdict.missed_by}"
    return reasons


def _missed_reasons(options: PlanOptions, winners: Mapping[str, int], verdicts: Mapping[str, RankingResult]) -> list[NamedReason]:
    """Return a reason, in words, for each light whose chosen option misses its target.

    ``winners`` holds the number of the chosen option by light, ``verdicts`` the result of its ranking.
    """
    return [
        NamedReason(
            name=f"{light}{TARGET_MISSED}",
            reason=f"{options.basis(light, winners[light])}: {verdict.missed_by}",
        )
        for light, verdict in verdicts.items()
        if not verdict.meets_target
    ]
