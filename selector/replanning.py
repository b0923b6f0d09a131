"""Plans while a camera moves: new ones only where they are needed or clearly better, and switches that nobody sees.

Settings that follow from the view (the ranges of cascades, the sides of texels, depth steps, effects) are always those of the
present view. Algorithms, map sizes and numbers of cascades are kept as long as they serve. A new choice is taken

- at once, where the old one cannot serve: a kind of casters throws shadows that nothing was chosen for, the view or what is asked
  is of another kind, another of the level's pins holds, an algorithm refuses the view; and where the target is missed by more
  than ``IMMEDIATE_SWITCH``;
- after ``PATIENCE`` plans in a row that are better by a margin: ``SWITCH_TIME_GAIN`` of the time, or ``SWITCH_ERROR_GAIN`` of the
  target. The way back takes as large a margin, so that a camera at a border does not flip; and because expectations are
  uncertain, each further switch takes twice the patience, until other kinds of casters throw shadows.

Two plans that both keep to an error of a few per cent of the cast shadow differ in up to some per cent of the pixels: most of
them lie on edges, where errors do not count. So the old plan is drawn, too, as long as it takes to keep each frame below
``MOST_CHANGED``, and ``mixed_pictures`` mixes the two. How long that is can only be expected beforehand, and far too short;
``Replanner.share`` tells it from the two pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from skugga.selector.choices import Choice, PlanRequest, PolicyName
from skugga.selector.formatting import format_duration, format_list, format_percent
from skugga.selector.planner.planner import make_plan
from skugga.selector.portfolio import tuned_settings
from skugga.selector.select import select
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.truth.metrics import MOST_INTERIOR
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

SWITCH_TIME_GAIN = 0.2
"""Share of the time that a new plan must save ..."""

SWITCH_ERROR_GAIN = 0.1
"""... or share of the target by which the old one must miss it more than the new one ..."""

PATIENCE = 5
"""... in so many plans in a row."""

IMMEDIATE_SWITCH = 0.5
"""Share of the target that is not to be missed for a single plan."""

MOST_CHANGED = 0.002
"""Share of the pixels that a switch may change from one frame to the next."""

SHORTEST, LONGEST = 2, 30
"""Frames that a switch is expected to take, at least and at most: the first has two pictures to go by."""

PlanFunction = Callable[[Descriptor, PlanRequest, dict[str, Any] | None], Plan]
"""A policy: ``skugga.selector.select.select``, or what behaves like it."""


@dataclass(frozen=True)
class PlanTransition:
    """A switch under way: the plan that is left, for the present view, and the share of the pixels that show the new one."""

    plan: Plan
    share: float


@dataclass(frozen=True)
class PlanState:
    """What stands after a plan: the plan, its choices by light, what was asked; how many better plans in a row a switch takes, and
    how many there were; the choices that a switch leaves, with the share of the pixels that showed the new ones a frame ago, and by
    how much it grows with the next. ``why`` other choices were taken with this plan, if they were.
    """

    plan: Plan
    choices: Mapping[str, Choice]
    asked: tuple[object, ...]
    patience: int
    better_for: int = 0
    left: Mapping[str, Choice] | None = None
    shown: float = 0.0
    step: float = 0.0
    handover: PlanTransition | None = None
    why: str | None = None


class Replanner:
    """Plans for one frame after the other of a view that moves.

    ``policy`` and ``device`` are those of ``skugga.selector.select.select``; ``plans`` stands in for it. With the ``state`` of
    another one it goes on from there: a state is a value, which other processes take.

    >>> replanner = Replanner(device=load_profile(renderer, version))           # doctest: +SKIP
    >>> for view in path:                                                       # doctest: +SKIP
    ...     plan = replanner.plan(describe(scene, view, "flight"), level)
    ...     frame = render_frame(scene, view, plan)
    ...     color = frame.color
    ...     if replanner.handover is not None:
    ...         before = render_frame(scene, view, replanner.handover.plan)
    ...         color = mixed_pictures(before.color, color, replanner.share(before.visibilities, frame.visibilities))
    """

    def __init__(
        self,
        policy: PolicyName = "predict",
        device: DeviceProfile | None = None,
        plans: PlanFunction | None = None,
        state: PlanState | None = None,
    ) -> None:
        self._plans: PlanFunction = plans or partial(select, policy=policy, device=device)
        self._standing = state

    @property
    def state(self) -> PlanState | None:
        """What stands after the last plan."""
        return self._standing

    def plan(self, descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None = None) -> Plan:
        """The next frame's plan. Raises as ``skugga.selector.select.select`` does."""
        self._standing = next_state(self._standing, descriptor, plan_request, overrides, self._plans)
        return self._standing.plan

    def share(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> float:
        """The share of the pixels to show the new plan in this frame of a switch, for its pictures by the plan that is left and by
        the new one (``Frame.visibilities``): then no frame changes more than ``MOST_CHANGED`` of the surface's pixels. The switch
        lasts until this has been 1. Called once a frame; 1 where no switch is under way.
        """
        state = self._standing
        if state is None or state.handover is None:
            return 1.0
        share = next_share(before, after, state.shown)
        self._standing = replace(state, step=0.0, handover=replace(state.handover, share=share))
        return share

    @property
    def handover(self) -> PlanTransition | None:
        """The switch that the last plan belongs to, if one is under way."""
        return None if self._standing is None else self._standing.handover

    @property
    def why(self) -> str | None:
        """Why the last plan has other choices than the one before it, where it has."""
        return None if self._standing is None else self._standing.why


def next_state(
    state: PlanState | None,
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None,
    plans: PlanFunction,
) -> PlanState:
    """What stands after the next plan."""
    fresh = plans(descriptor, plan_request, overrides)
    pin = plan_request.shadows.pin_for(descriptor.view, descriptor.sun_altitude_deg)
    request = (descriptor.view_kind, plan_request.shadows, pin, plan_request.effects, overrides or {})
    choices = choices_of(fresh)
    fresh = fresh.model_copy(update={"settings": make_plan(descriptor, plan_request, overrides, choices).settings})
    next_standing = PlanState(fresh, choices, request, PATIENCE)
    if state is None:
        return next_standing
    if state.asked != request:
        return replace(next_standing, why="something else is asked for, or another of the level's pins holds")
    state = replace(state, why=None)
    try:
        kept = make_plan(descriptor, plan_request, overrides, state.choices)
        same_choices = _choices(choices_of(kept)) == _choices(choices)
        kept = fresh if same_choices else _judged(kept, descriptor, plan_request, overrides, plans)
    except UnsupportedError as error:
        return replace(next_standing, why=f"what was chosen cannot serve: {error.allowed}")
    state = replace(state, plan=kept)
    if state.handover is not None and state.left is not None:
        return _going_on(state, state.handover, state.left, descriptor, plan_request, overrides)
    if same_choices:
        return replace(state, choices=_joined(state.choices, choices), better_for=0)
    cast = {(light, kind) for light, kinds in casting(fresh).items() for kind in kinds}
    unpicked = cast - {(light, kind) for light, choice in state.choices.items() for kind in choice.algorithm}
    if not unpicked and not is_better(fresh, kept):
        return replace(state, better_for=0)
    if not unpicked and state.better_for + 1 < state.patience and _miss(kept) - _miss(fresh) <= IMMEDIATE_SWITCH:
        return replace(state, better_for=state.better_for + 1)
    next_standing = replace(next_standing, why=_why(fresh, kept, unpicked, state.better_for + 1))
    next_standing = next_standing if unpicked else replace(next_standing, patience=2 * state.patience)
    if unpicked == cast:  # nothing of it was drawn before: there is nothing to hand over
        return next_standing
    step = 1.0 / max(transition_frames(kept, fresh), SHORTEST)
    return replace(next_standing, left=state.choices, step=step, handover=PlanTransition(kept, step))


def _going_on(
    state: PlanState,
    handover: PlanTransition,
    left: Mapping[str, Choice],
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None,
) -> PlanState:
    """What stands in the next frame of a switch, or at its end."""
    ended = replace(state, left=None, handover=None)
    share = handover.share + state.step
    if share > 1.0 - 1e-9:
        return ended
    try:
        plan = make_plan(descriptor, plan_request, overrides, left)
    except UnsupportedError:  # what is left no longer serves
        return ended
    return replace(state, shown=handover.share, handover=PlanTransition(plan, share))


def is_better(fresh: Plan, kept: Plan) -> bool:
    """Whether a plan is better than another by a margin; where nothing is predicted, what the policy would rather take is."""
    if fresh.predicted is None or kept.predicted is None:
        return True
    if _miss(kept) > _miss(fresh):
        return _miss(kept) - _miss(fresh) > SWITCH_ERROR_GAIN
    return _miss(kept) == _miss(fresh) and fresh.predicted.ms < (1.0 - SWITCH_TIME_GAIN) * kept.predicted.ms


def _why(fresh: Plan, kept: Plan, unpicked: set[tuple[str, CasterKind]], plans_in_a_row: int) -> str:
    """Why a plan is taken instead of the one that was kept."""
    if unpicked:
        return f"shadows of {format_list(sorted({kind for _, kind in unpicked}))}, for which nothing was chosen yet"
    if fresh.predicted is None or kept.predicted is None:
        return f"the rules take it, for {plans_in_a_row} frames in a row"
    expected = [
        f"{format_duration(plan.predicted.ms)} and {format_percent(plan.predicted.wrong_cast)} wrong"
        for plan in (fresh, kept)
        if plan.predicted is not None
    ]
    return f"{expected[0]} expected instead of {expected[1]}, for {plans_in_a_row} frames in a row"


def transition_frames(kept: Plan, fresh: Plan) -> int:
    """The frames that a switch is expected to take. Pixels that two plans differ in are wrong in one of them; how many differ where
    nothing counts as wrong, on edges, is not foreseen.
    """
    predicted = [plan.predicted.wrong if plan.predicted else plan.target.max_error for plan in (kept, fresh)]
    return int(np.clip(np.ceil(sum(predicted) / MOST_CHANGED), 1, LONGEST))


def next_share(before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray], last_share: float) -> float:
    """The share of the pixels to show ``after`` when it was ``last_share`` a frame ago, for the visibilities (rows, cols) of each
    light in the two pictures of a view, NaN where there is no surface: the largest with which no more than ``MOST_CHANGED`` of
    the surface's pixels (one, if that is less) change from shadow to light or back.
    """
    differ = np.logical_or.reduce([(before[light] < 0.5) != (after[light] < 0.5) for light in after])
    there = np.logical_or.reduce([~np.isnan(visibility) for visibility in after.values()])
    order = _order(*differ.shape)
    waiting = np.sort(order[differ & (order >= last_share)])
    most = max(int(MOST_CHANGED * there.sum()), 1)
    return float(waiting[most]) if most < len(waiting) else 1.0


def mixed_pictures(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """Two pictures (rows, cols, ...) of one view mixed: an evenly spread ``share`` of the pixels shows ``after``, more and more of
    them the same ones.

    The order of the pixels is that of the R2 sequence (M. Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018).
    """
    order = _order(*before.shape[:2])
    return np.where((order < share).reshape(*order.shape, *(1,) * (before.ndim - 2)), after, before)


def _order(rows: int, cols: int) -> np.ndarray:
    """From which share on a pixel shows what is new, (rows, cols) in [0, 1)."""
    row, col = np.ogrid[:rows, :cols]
    return (row / 1.32471795724474602596 + col / 1.32471795724474602596**2) % 1.0


def casting(plan: Plan) -> dict[str, frozenset[CasterKind]]:
    """The kinds of casters that cast, by light."""
    return {light: frozenset(kind for kind, name in kinds.items() if name != NO_SHADOWS) for light, kinds in plan.algorithm.items()}


def choices_of(plan: Plan) -> dict[str, Choice]:
    """What a plan chose for each light: algorithms, map size and number of cascades, as far as one number holds for all.

    What else a plan resolves from a view may come out otherwise by its choices: where cascades end, if their number was not given.
    """
    choices = {}
    for light, per_kind in plan.algorithm.items():
        algorithm = {kind: name for kind, name in per_kind.items() if name != NO_SHADOWS}
        resolved = [settings.asked_as for settings in plan.settings.get(light, {}).values()]
        found = {key: {asked[key] for asked in resolved if key in asked} for key in tuned_settings()}
        settings = {key: values.pop() for key, values in found.items() if len(values) == 1}
        words = [*dict.fromkeys(algorithm.values()), *map(str, settings.values())]
        why = dict.fromkeys([*algorithm, *settings], "kept: nothing else is better by a margin")
        choices[light] = Choice(" ".join(words), algorithm, settings, why)
    return choices


def _judged(
    kept: Plan, descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None, plans: PlanFunction
) -> Plan:
    """A plan of choices with what the policy expects of it."""
    judged = plans(descriptor, plan_request, {**(overrides or {}), **_as_overrides(choices_of(kept))})
    reasons = [*kept.reasons, *(reasoned for reasoned in judged.reasons if reasoned.name.startswith("target"))]
    expected = {"policy": judged.policy, "predicted": judged.predicted, "target": judged.target, "reasons": reasons}
    return kept.model_copy(update=expected)


def _joined(choices: Mapping[str, Choice], more: Mapping[str, Choice]) -> dict[str, Choice]:
    """Choices that agree on what casts now, joined: what has ceased to cast keeps its choice for when it is back."""
    before = {light: choices.get(light, choice) for light, choice in more.items()}
    return {
        light: replace(
            choice,
            algorithm={**before[light].algorithm, **choice.algorithm},
            settings={**before[light].settings, **choice.settings},
        )
        for light, choice in more.items()
    }  # fmt: skip


def _as_overrides(choices: Mapping[str, Choice]) -> dict[str, Any]:
    """The overrides that lead to choices; a setting that lights differ in is left to the policy."""
    out: dict[str, Any] = {"algorithm": {light: dict(choice.algorithm) for light, choice in choices.items() if choice.algorithm}}
    for key in tuned_settings():
        values = {choice.settings[key] for choice in choices.values() if key in choice.settings}
        if len(values) == 1:
            out[key] = values.pop()
    return out


def _choices(choices: Mapping[str, Choice]) -> dict[str, tuple[dict[CasterKind, AlgorithmName], dict[str, Any]]]:
    return {light: (dict(choice.algorithm), dict(choice.settings)) for light, choice in choices.items()}


def _miss(plan: Plan) -> float:
    """By how much of it a plan is expected to miss its target; one that misses it by what is not told (interior errors) by a
    little.
    """
    if plan.predicted is None:
        return 0.0
    target = plan.target
    over = [(plan.predicted.wrong_cast - target.max_error) / max(target.max_error, MOST_INTERIOR)]
    over += [] if target.max_ms is None else [plan.predicted.ms / target.max_ms - 1.0]
    return max(2.0 * SWITCH_ERROR_GAIN if target.met is False and max(over) <= 0.0 else 0.0, *over)
