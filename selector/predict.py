"""The ``predict`` policy: of the portfolio the pick whose expected time and error a target asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from selector.cost.cost_model import predicted_ms
from selector.cost.device_profile import DeviceProfile
from selector.cost.error_model import ErrorModel, Errors, errors_together, fitted, wrong_of_step
from selector.picks import Pick, Wishes
from selector.planner.planner import Planner, planner_of
from selector.portfolio import portfolio
from selector.serves import kinds_of_lights
from selector.wager import LIKELY, Hope, wagered
from selector.winning import Figures, Verdict
from selector.words import duration, percent
from shadows.plan import Plan, Predicted, Reasoned, Step, Target
from shadows.registry import ALGORITHMS
from terrain.facts.descriptor import Descriptor
from terrain.level.level import AlgorithmName, CasterKind


@dataclass(frozen=True)
class Option:
    """A pick of a light with the steps that it comes to, and what is expected of them."""

    pick: Pick
    steps: tuple[Step, ...]
    ms: float
    errors: Errors

    @property
    def algorithms(self) -> frozenset[AlgorithmName]:
        return frozenset(step.algorithm for step in self.steps)

    def hope(self, max_error: float) -> Hope:
        """What there is to hope for of it with a target."""
        figures = Figures(self.pick.name, self.ms, self.errors.wrong_cast, self.errors.interior)
        return Hope(figures, self.errors.chance_over(max_error))


def predicted_plan(
    descriptor: Descriptor,
    wishes: Wishes,
    overrides: dict[str, Any] | None,
    device: DeviceProfile,
    errors: ErrorModel | None = None,
) -> Plan:
    """The plan of the picks with the least expected loss (``selector.wager``): the cheapest that are likely to meet ``max_error``,
    or the most accurate within ``max_ms``; where none is, the nearest, marked as missing the target. ``errors`` are other constants
    than those fitted.

    Raises ``InputError`` and ``UnsupportedError`` as ``choose`` does.
    """
    planner = planner_of(descriptor, wishes, overrides)
    asked = planner.asked
    casting = {light: planner.casting(light) for light in kinds_of_lights(descriptor)}
    options = {light: options_of(planner, light, kinds, device, errors) for light, kinds in casting.items() if kinds}
    hopes = {light: [each.hope(asked.max_error) for each in its] for light, its in options.items()}
    verdicts = {light: wagered(its, asked.max_error) for light, its in hopes.items()}
    needed_ms = sum(verdict.winner.ms for verdict in verdicts.values())
    if asked.max_ms is not None and options:
        shares = {light: asked.max_ms * verdict.winner.ms / max(needed_ms, 1e-9) for light, verdict in verdicts.items()}
        verdicts = {light: wagered(its, asked.max_error, shares[light]) for light, its in hopes.items()}
    taken = {light: next(each for each in its if each.pick.name == verdicts[light].winner.name) for light, its in options.items()}
    picks = {
        light: _with_words(each, options[light], casting[light], verdicts[light], asked.max_error) for light, each in taken.items()
    }
    plan = planner.plan(picks, _rejected(options, taken, asked.max_error))
    return plan.model_copy(
        update={
            "policy": "predict",
            "predicted": Predicted(
                ms=sum(each.ms for each in taken.values()),
                wrong=max((each.errors.wrong for each in taken.values()), default=0.0),
                wrong_cast=max((each.errors.wrong_cast for each in taken.values()), default=0.0),
            ),
            "target": Target(max_error=asked.max_error, max_ms=asked.max_ms, met=all(verdict.met for verdict in verdicts.values())),
            "reasons": [*_missed(verdicts), *plan.reasons],
        }
    )


def options_of(
    planner: Planner, light: str, kinds: Sequence[CasterKind], device: DeviceProfile, errors: ErrorModel | None = None
) -> list[Option]:
    """What can be picked for a light, no two that come to the same steps, with what is expected of each."""
    descriptor, model = planner.descriptor, errors or fitted()
    found: dict[tuple[object, ...], Option] = {}
    known: dict[object, tuple[float, float]] = {}
    for pick in portfolio(descriptor, light, kinds):
        steps = planner.steps(light, pick)
        # Many picks share steps. A planner's equal settings are one, and values are slow to compare.
        keys = tuple((step.algorithm, step.kinds, id(step.settings)) for step in steps)
        if keys in found:
            continue
        for key, step in zip(keys, steps, strict=True):
            if key not in known:
                ms = predicted_ms(device, descriptor, light, step.kinds, step.algorithm, step.settings)
                known[key] = ms, wrong_of_step(descriptor, light, step, model)
        wrong = [(step, known[key][1]) for key, step in zip(keys, steps, strict=True)]
        found[keys] = Option(pick, steps, sum(known[key][0] for key in keys), errors_together(descriptor, light, wrong, model))
    return list(found.values())


def _with_words(taken: Option, options: Sequence[Option], kinds: Sequence[CasterKind], verdict: Verdict, max_error: float) -> Pick:
    """The pick with the reasons for it, in words."""
    its = f"{percent(taken.errors.wrong_cast)} of the cast shadow wrong in {duration(taken.ms)} expected"
    settings = " ".join(f"{key} {value}" for key, value in taken.pick.settings.items())
    if not verdict.met:
        why = f"{its}: nothing is expected to meet the target, and this comes nearest"
    else:
        why = f"{its}, {_chance(taken, max_error)}; "
        others = [each for each in options if each.algorithms != taken.algorithms]
        likely = [each for each in others if each.errors.chance_over(max_error) <= LIKELY]
        beside = min(likely, key=lambda each: each.ms, default=None)
        if beside is None:
            why += f"nothing else is expected to keep to {_limit(max_error)}"
        elif beside.ms >= taken.ms:
            why += f"the fastest other choice within {_limit(max_error)} is {beside.pick.name}, {duration(beside.ms)}"
        else:
            why += f"{beside.pick.name} would take {duration(beside.ms)} {_chance(beside, max_error)}"
    sizes = f"needed for the target ({settings})"
    return replace(taken.pick, why={**dict.fromkeys(kinds, why), **dict.fromkeys(taken.pick.settings, sizes)})


def _chance(option: Option, max_error: float) -> str:
    chance = option.errors.chance_over(max_error)
    return f"with {'hardly a' if chance < 0.01 else f'a {percent(chance)}'} chance of more than {_limit(max_error)}"


def _limit(max_error: float) -> str:
    return f"{100.0 * max_error:g} %"


def _rejected(options: Mapping[str, Sequence[Option]], taken: Mapping[str, Option], max_error: float) -> dict[AlgorithmName, str]:
    """Why algorithms that could serve were not taken: the best that was expected of them."""
    said: dict[AlgorithmName, str] = {}
    for name in ALGORITHMS:
        for light, its in options.items():
            able = [each for each in its if name in each.algorithms]
            if not able or name in taken[light].algorithms:
                continue
            verdict = wagered([each.hope(max_error) for each in able], max_error)
            nearest = next(each for each in able if each.pick.name == verdict.winner.name)
            if verdict.met:
                said[name] = (
                    f"expected: {duration(nearest.ms)} with {nearest.pick.name}, {_chance(nearest, max_error)}; "
                    f"{duration(taken[light].ms)} with the choice"
                )
            else:
                said[name] = f"expected at best: {verdict.missed_by}"
    return said


def _missed(verdicts: Mapping[str, Verdict]) -> list[Reasoned]:
    return [
        Reasoned(name=f"{light}: target missed", reason=f"expected: {verdict.missed_by}")
        for light, verdict in verdicts.items()
        if not verdict.met
    ]
