"""The ``predict`` policy: of the portfolio the choice whose expected time and error a target asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from selector.choices import Choice, PlanRequest
from selector.cost.cost_model import predicted_ms
from selector.cost.device_profile import DeviceProfile
from selector.cost.error_model import ErrorModel, ExpectedErrors, errors_together, packaged_model, wrong_of_step
from selector.cost.unmeasured import UnmeasuredError
from selector.expected_loss import LIKELY_MISS_CHANCE, Forecast, least_expected_loss
from selector.formatting import format_duration, format_percent
from selector.planner.advice import choices_by_rules
from selector.planner.planner import Planner, planner_of
from selector.portfolio import portfolio
from selector.ranking import CandidateFigures, RankingResult
from shadows.algorithm import Reasoned
from shadows.plan import Plan, Predicted, Step, Target
from shadows.registry import ALGORITHMS
from terrain.facts.descriptor import Descriptor
from terrain.level.algorithm_names import AlgorithmName
from terrain.level.level import CasterKind

NOT_PREDICTED = "nothing can be predicted, so the rules decide"


@dataclass(frozen=True)
class PredictedChoice:
    """A choice for a light with the steps that it comes to, and what is expected of them."""

    choice: Choice
    steps: tuple[Step, ...]
    ms: float
    errors: ExpectedErrors

    @property
    def algorithms(self) -> frozenset[AlgorithmName]:
        return frozenset(step.algorithm for step in self.steps)

    def forecast(self, max_error: float) -> Forecast:
        """What there is to hope for of it with a target."""
        figures = CandidateFigures(self.choice.name, self.ms, self.errors.wrong_cast, self.errors.interior)
        return Forecast(figures, self.errors.chance_over(max_error))


def predicted_plan(
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None,
    device: DeviceProfile,
    errors: ErrorModel | None = None,
) -> Plan:
    """The plan of the choices with the least expected loss (``selector.expected_loss``): the cheapest that are likely to meet
    ``max_error``, or the most accurate within ``max_ms``; where none is, the nearest, marked as missing the target. ``errors`` are
    other constants than those fitted.

    Raises ``InputError`` and ``UnsupportedError`` as ``make_plan`` does.
    """
    planner = planner_of(descriptor, plan_request, overrides)
    shadows = planner.asked
    casting = {light: planner.casting(light) for light in descriptor.light_kinds}
    unmeasured: dict[AlgorithmName, str] = {}
    options = {
        light: predicted_choices(planner, light, kinds, device, errors, unmeasured) for light, kinds in casting.items() if kinds
    }
    if not all(options.values()):
        return _by_rules(planner, unmeasured)
    forecasts = {
        light: [option.forecast(shadows.max_error) for option in light_options] for light, light_options in options.items()
    }
    verdicts = {light: least_expected_loss(light_options, shadows.max_error) for light, light_options in forecasts.items()}
    needed_ms = sum(verdict.winner.ms for verdict in verdicts.values())
    if shadows.max_ms is not None and options:
        shares = {light: shadows.max_ms * verdict.winner.ms / max(needed_ms, 1e-9) for light, verdict in verdicts.items()}
        verdicts = {
            light: least_expected_loss(light_options, shadows.max_error, shares[light])
            for light, light_options in forecasts.items()
        }
    winners = {
        light: next(option for option in light_options if option.choice.name == verdicts[light].winner.name)
        for light, light_options in options.items()
    }
    choices = {
        light: _with_words(option, options[light], casting[light], verdicts[light], shadows.max_error)
        for light, option in winners.items()
    }
    plan = planner.plan(choices, unmeasured | _rejected(options, winners, shadows.max_error))
    return plan.model_copy(
        update={
            "policy": "predict",
            "predicted": Predicted(
                ms=sum(option.ms for option in winners.values()),
                wrong=max((option.errors.wrong for option in winners.values()), default=0.0),
                wrong_cast=max((option.errors.wrong_cast for option in winners.values()), default=0.0),
            ),
            "target": Target(
                max_error=shadows.max_error, max_ms=shadows.max_ms, met=all(verdict.met for verdict in verdicts.values())
            ),
            "reasons": [*_missed(verdicts), *plan.reasons],
        }
    )


def _by_rules(planner: Planner, unmeasured: Mapping[AlgorithmName, str]) -> Plan:
    """The plan of the rules, where for some light nothing that can be taken has been measured."""
    plan = planner.plan(choices_by_rules(planner.descriptor, planner.asked), unmeasured)
    why = "; ".join(f"{name}: {why}" for name, why in unmeasured.items())
    return plan.model_copy(update={"reasons": [*plan.reasons, Reasoned(name="policy rules", reason=f"{NOT_PREDICTED}: {why}")]})


def predicted_choices(
    planner: Planner,
    light: str,
    kinds: Sequence[CasterKind],
    device: DeviceProfile,
    errors: ErrorModel | None = None,
    unmeasured: dict[AlgorithmName, str] | None = None,
) -> list[PredictedChoice]:
    """What can be chosen for a light, no two that come to the same steps, with what is expected of each.

    An algorithm of which nothing can be expected is left out, and put into ``unmeasured`` with the reason.
    """
    descriptor, model = planner.descriptor, errors or packaged_model()
    options: dict[tuple[object, ...], PredictedChoice] = {}
    known: dict[object, tuple[float, float]] = {}
    for choice in portfolio(descriptor, light, kinds, planner.asked):
        steps = planner.steps(light, choice)
        # Many picks share steps. A planner's equal settings are one, and values are slow to compare.
        keys = tuple((step.algorithm, step.kinds, id(step.settings)) for step in steps)
        if keys in options:
            continue
        try:
            for key, step in zip(keys, steps, strict=True):
                if key not in known:
                    ms = predicted_ms(device, descriptor, light, step.kinds, step.algorithm, step.settings)
                    known[key] = ms, wrong_of_step(descriptor, light, step, model)
        except UnmeasuredError as error:
            if unmeasured is not None:
                unmeasured[error.algorithm] = error.why
            continue
        wrong = [(step, known[key][1]) for key, step in zip(keys, steps, strict=True)]
        options[keys] = PredictedChoice(
            choice, steps, sum(known[key][0] for key in keys), errors_together(descriptor, light, wrong, model)
        )
    return list(options.values())


def _with_words(
    winner: PredictedChoice,
    options: Sequence[PredictedChoice],
    kinds: Sequence[CasterKind],
    verdict: RankingResult,
    max_error: float,
) -> Choice:
    """The choice with the reasons for it."""
    expectation = f"{format_percent(winner.errors.wrong_cast)} of the cast shadow wrong in {format_duration(winner.ms)} expected"
    settings = " ".join(f"{key} {value}" for key, value in winner.choice.settings.items())
    if not verdict.met:
        why = f"{expectation}: nothing is expected to meet the target, and this comes nearest"
    else:
        why = f"{expectation}, {_chance(winner, max_error)}; "
        others = [option for option in options if option.algorithms != winner.algorithms]
        likely = [option for option in others if option.errors.chance_over(max_error) <= LIKELY_MISS_CHANCE]
        beside = min(likely, key=lambda option: option.ms, default=None)
        if beside is None:
            why += f"nothing else is expected to keep to {_limit(max_error)}"
        elif beside.ms >= winner.ms:
            why += f"the fastest other choice within {_limit(max_error)} is {beside.choice.name}, {format_duration(beside.ms)}"
        else:
            why += f"{beside.choice.name} would take {format_duration(beside.ms)} {_chance(beside, max_error)}"
    sizes = f"needed for the target ({settings})"
    return replace(winner.choice, why={**dict.fromkeys(kinds, why), **dict.fromkeys(winner.choice.settings, sizes)})


def _chance(option: PredictedChoice, max_error: float) -> str:
    chance = option.errors.chance_over(max_error)
    return f"with {'hardly a' if chance < 0.01 else f'a {format_percent(chance)}'} chance of more than {_limit(max_error)}"


def _limit(max_error: float) -> str:
    return f"{100.0 * max_error:g} %"


def _rejected(
    options: Mapping[str, Sequence[PredictedChoice]], winners: Mapping[str, PredictedChoice], max_error: float
) -> dict[AlgorithmName, str]:
    """Why algorithms that could serve were not taken: the best that was expected of them."""
    reasons: dict[AlgorithmName, str] = {}
    for name in ALGORITHMS:
        for light, light_options in options.items():
            candidates = [option for option in light_options if name in option.algorithms]
            if not candidates or name in winners[light].algorithms:
                continue
            verdict = least_expected_loss([option.forecast(max_error) for option in candidates], max_error)
            nearest = next(option for option in candidates if option.choice.name == verdict.winner.name)
            if verdict.met:
                reasons[name] = (
                    f"expected: {format_duration(nearest.ms)} with {nearest.choice.name}, {_chance(nearest, max_error)}; "
                    f"{format_duration(winners[light].ms)} with the choice"
                )
            else:
                reasons[name] = f"expected at best: {verdict.missed_by}"
    return reasons


def _missed(verdicts: Mapping[str, RankingResult]) -> list[Reasoned]:
    return [
        Reasoned(name=f"{light}: target missed", reason=f"expected: {verdict.missed_by}")
        for light, verdict in verdicts.items()
        if not verdict.met
    ]
