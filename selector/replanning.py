"""Plan the frames of a moving camera: keep algorithms as long as they are good enough, and switch without a visible jump.

A choice is the algorithms, map sizes and numbers of cascades for a light. It is kept from frame to frame. All other settings
(ranges of cascades, texel sizes, depth steps, effects) follow from the view of each frame. A new choice is made in two cases.

- At once, if the previous choice cannot be used. This is so if a kind of casters without an algorithm casts shadows, if the request
  or the kind of view changes, if another pin of the level (settings for some views and suns) applies, or if an algorithm cannot
  draw the view. It is also made at once if it reduces a miss of the target by more than ``IMMEDIATE_SWITCH_OVERSHOOT``.
- After ``INITIAL_PATIENCE_FRAMES`` successive frames in which the policy finds a plan that is better by a margin. The margin is
  ``SWITCH_TIME_GAIN`` of the time, or ``SWITCH_ERROR_GAIN`` of the target. A switch back needs the same margin, so that a camera at
  a limit does not alternate between two choices. Because predictions are uncertain, each further switch needs twice as many frames.
  The number is reset if further kinds of casters cast shadows.

Two plans with an error of a few per cent of the cast shadow may differ in some per cent of the pixels. Most of these lie on edges,
where errors do not count. So a switch is a transition over several frames. Each of them is drawn with both plans, and
``mix_pictures`` mixes the two pictures. In each frame at most ``MAX_CHANGED_SHARE`` of the pixels change. The expected number of
frames is too small, so ``Replanner.share`` determines the progress from the two pictures.
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
from skugga.selector.predict import TARGET_MISSED
from skugga.selector.select import select
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

SWITCH_TIME_GAIN = 0.2
"""Minimum share of the time that a new plan saves, if it counts as better."""

SWITCH_ERROR_GAIN = 0.1
"""Minimum difference of the overshoots (excess over a limit, relative to the limit) of two plans of which one is better."""

INITIAL_PATIENCE_FRAMES = 5
"""Number of successive frames with a better plan before the first switch to it."""

IMMEDIATE_SWITCH_OVERSHOOT = 0.5
"""Reduction of the overshoot (excess over a limit, relative to the limit) that leads to an immediate switch."""

MAX_CHANGED_SHARE = 0.002
"""Maximum share of the pixels that a switch changes from one frame to the next."""

MIN_TRANSITION_FRAMES, MAX_TRANSITION_FRAMES = 2, 30
"""Limits of the expected number of frames of a switch. From the first frame on, both pictures give the real number."""

PlanFunction = Callable[[Descriptor, PlanRequest, dict[str, Any] | None], Plan]
"""A function that returns the plan for a descriptor, a request and overrides, such as ``skugga.selector.select.select``."""


@dataclass(frozen=True)
class PlanTransition:
    """The state of a transition from one plan to another in one frame.

    Attributes
    ----------
    plan
        The plan for this frame's view with the previous choices.
    share
        Share of the pixels, in [0, 1], that show the new plan.
    """

    plan: Plan
    share: float


@dataclass(frozen=True)
class PlanState:
    """The state of a ``Replanner`` after a plan.

    Attributes
    ----------
    plan
        The plan of the frame.
    choices
        The algorithms and kept settings of the plan, by light.
    request
        All parts of the request that affect choices. If it changes, new choices are made at once.
    patience
        Number of successive frames with a better plan before the next switch.
    better_count
        Number of successive frames with a better plan so far.
    previous_choices
        The choices before the switch, by light, during a transition; else ``None``.
    previous_share
        Share of the pixels that showed the new choices in the frame before.
    step
        Increase of the share of these pixels with the next frame.
    transition
        The transition of which the frame is part, or ``None``.
    reason
        Why this plan has other choices than that of the frame before, or ``None``.
    """

    plan: Plan
    choices: Mapping[str, Choice]
    request: tuple[object, ...]
    patience: int
    better_count: int = 0
    previous_choices: Mapping[str, Choice] | None = None
    previous_share: float = 0.0
    step: float = 0.0
    transition: PlanTransition | None = None
    reason: str | None = None


class Replanner:
    """Makes the plans of successive frames of a moving camera, and keeps algorithms as long as they are good enough.

    ``policy`` and ``device`` are parameters of ``skugga.selector.select.select``. ``plans`` is a function to use instead of
    ``select``. ``state`` is the state of another replanner to continue from. States are immutable and can be passed to other
    processes.

    >>> replanner = Replanner(device=load_profile(renderer, version))           # doctest: +SKIP
    >>> for view in path:                                                       # doctest: +SKIP
    ...     plan = replanner.plan(describe(scene, view, "flight"), level)
    ...     frame = render_frame(scene, view, plan)
    ...     color = frame.color
    ...     if replanner.transition is not None:
    ...         before = render_frame(scene, view, replanner.transition.plan)
    ...         color = mix_pictures(before.color, color, replanner.share(before.visibilities, frame.visibilities))
    """

    def __init__(
        self,
        policy: PolicyName = "predict",
        device: DeviceProfile | None = None,
        plans: PlanFunction | None = None,
        state: PlanState | None = None,
    ) -> None:
        self._plans: PlanFunction = plans or partial(select, policy=policy, device=device)
        self._state = state

    @property
    def state(self) -> PlanState | None:
        """The state after the last plan; ``None`` before the first one."""
        return self._state

    def plan(self, descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None = None) -> Plan:
        """Return the next frame's plan. Raises the errors of ``skugga.selector.select.select``."""
        self._state = next_state(self._state, descriptor, plan_request, overrides, self._plans)
        return self._state.plan

    def share(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> float:
        """Return the share of the pixels, in [0, 1], that show the new plan in this frame of a transition.

        ``before`` and ``after`` are the visibilities (``Frame.visibilities``) of the frame drawn with the previous and with the new
        plan. With this share, at most ``MAX_CHANGED_SHARE`` of the surface's pixels change in a frame. The transition ends after a
        frame with a share of 1. Call this once per frame. The result is 1 outside of transitions.
        """
        state = self._state
        if state is None or state.transition is None:
            return 1.0
        share = next_share(before, after, state.previous_share)
        self._state = replace(state, step=0.0, transition=replace(state.transition, share=share))
        return share

    @property
    def transition(self) -> PlanTransition | None:
        """The transition of which the last planned frame is part, or ``None``."""
        return None if self._state is None else self._state.transition

    @property
    def reason(self) -> str | None:
        """Why the last plan has other choices than that of the frame before, or ``None``."""
        return None if self._state is None else self._state.reason


def next_state(
    state: PlanState | None,
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None,
    plans: PlanFunction,
) -> PlanState:
    """Plan the next frame, and return the state of the replanner after it.

    ``state`` is the state after the frame before; ``None`` for the first frame. ``plans`` makes the plan that the policy prefers.
    """
    new_plan = plans(descriptor, plan_request, overrides)
    pin = plan_request.shadows.pin_number(descriptor.view, descriptor.sun_altitude_deg)
    request = (descriptor.view_kind, plan_request.shadows, pin, plan_request.effects, overrides or {})
    choices = choices_from_plan(new_plan)
    new_plan = new_plan.model_copy(update={"settings": make_plan(descriptor, plan_request, overrides, choices).settings})
    new_state = PlanState(new_plan, choices, request, INITIAL_PATIENCE_FRAMES)
    if state is None:
        return new_state
    if state.request != request:
        return replace(new_state, reason="the request changed, or another pin of the level applies")
    state = replace(state, reason=None)
    try:
        kept_plan = make_plan(descriptor, plan_request, overrides, state.choices)
        same_choices = _comparable_choices(choices_from_plan(kept_plan)) == _comparable_choices(choices)
        kept_plan = new_plan if same_choices else _with_prediction(kept_plan, descriptor, plan_request, overrides, plans)
    except UnsupportedError as error:
        return replace(new_state, reason=f"the previous choice cannot draw this view: {error.allowed}")
    state = replace(state, plan=kept_plan)
    if state.transition is not None and state.previous_choices is not None:
        return _continue_transition(state, state.transition, state.previous_choices, descriptor, plan_request, overrides)
    if same_choices:
        return replace(state, choices=_merge_choices(state.choices, choices), better_count=0)
    cast = {(light, kind) for light, kinds in casting_kinds(new_plan).items() for kind in kinds}
    without_choice = cast - {(light, kind) for light, choice in state.choices.items() for kind in choice.algorithm}
    if not without_choice and not is_better(new_plan, kept_plan):
        return replace(state, better_count=0)
    if (
        not without_choice
        and state.better_count + 1 < state.patience
        and _relative_overshoot(kept_plan) - _relative_overshoot(new_plan) <= IMMEDIATE_SWITCH_OVERSHOOT
    ):
        return replace(state, better_count=state.better_count + 1)
    new_state = replace(new_state, reason=_switch_reason(new_plan, kept_plan, without_choice, state.better_count + 1))
    new_state = new_state if without_choice else replace(new_state, patience=2 * state.patience)
    if without_choice == cast:  # no shadows were drawn before, so no transition is needed
        return new_state
    step = 1.0 / max(expected_transition_frames(kept_plan, new_plan), MIN_TRANSITION_FRAMES)
    return replace(new_state, previous_choices=state.choices, step=step, transition=PlanTransition(kept_plan, step))


def _continue_transition(
    state: PlanState,
    transition: PlanTransition,
    previous_choices: Mapping[str, Choice],
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None,
) -> PlanState:
    """Return the state in the next frame of a transition, or after its end.

    ``state`` is that of the next frame so far, and ``transition`` that of the frame before. ``previous_choices`` are the choices,
    by light, from which the transition leads away.
    """
    ended = replace(state, previous_choices=None, transition=None)
    share = transition.share + state.step
    if share > 1.0 - 1e-9:
        return ended
    try:
        plan = make_plan(descriptor, plan_request, overrides, previous_choices)
    except UnsupportedError:  # the previous choices cannot draw this view
        return ended
    return replace(state, previous_share=transition.share, transition=PlanTransition(plan, share))


def is_better(new_plan: Plan, kept_plan: Plan) -> bool:
    """Return whether the plan that the policy prefers is better than the kept one by a margin.

    Without predictions of both, it counts as better.
    """
    if new_plan.predicted is None or kept_plan.predicted is None:
        return True
    if _relative_overshoot(kept_plan) > _relative_overshoot(new_plan):
        return _relative_overshoot(kept_plan) - _relative_overshoot(new_plan) > SWITCH_ERROR_GAIN
    return (
        _relative_overshoot(kept_plan) == _relative_overshoot(new_plan)
        and new_plan.predicted.ms < (1.0 - SWITCH_TIME_GAIN) * kept_plan.predicted.ms
    )


def _switch_reason(new_plan: Plan, kept_plan: Plan, without_choice: set[tuple[str, CasterKind]], plans_in_a_row: int) -> str:
    """Return the reason why a new plan replaces the kept one, in words.

    ``without_choice`` holds the lights and kinds of casters that the kept choices do not cover. ``plans_in_a_row`` is the number of
    successive frames in which a new plan was better.
    """
    if without_choice:
        return f"no algorithm was chosen yet for shadows of {format_list(sorted({kind for _, kind in without_choice}))}"
    if new_plan.predicted is None or kept_plan.predicted is None:
        return f"chosen by the rules for {plans_in_a_row} frames in a row"
    expected = [
        f"{format_duration(plan.predicted.ms)} and {format_percent(plan.predicted.wrong_cast)} wrong"
        for plan in (new_plan, kept_plan)
        if plan.predicted is not None
    ]
    return f"expected {expected[0]} instead of {expected[1]}, for {plans_in_a_row} frames in a row"


def expected_transition_frames(kept_plan: Plan, new_plan: Plan) -> int:
    """Return the expected number of frames of a transition between two plans.

    It follows from the number of pixels that differ. They are wrong in one of the plans, so the sum of both errors is used. Pixels
    on edges differ, too, without counting as wrong. Their number is unknown and is ignored.
    """
    predicted = [plan.predicted.wrong if plan.predicted else plan.target.max_error for plan in (kept_plan, new_plan)]
    return int(np.clip(np.ceil(sum(predicted) / MAX_CHANGED_SHARE), 1, MAX_TRANSITION_FRAMES))


def next_share(before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray], last_share: float) -> float:
    """Return the share of the pixels, in [0, 1], that show ``after`` in this frame of a transition.

    ``last_share`` is the share in the frame before. ``before`` and ``after`` are the visibilities (rows, cols) by light in two
    pictures of a view, NaN in pixels without a surface. The result is the largest share for which the number of pixels that change
    between shadow and light stays within a limit. The limit is ``MAX_CHANGED_SHARE`` of the surface's pixels, but at least one
    pixel.
    """
    differ = np.logical_or.reduce([(before[light] < 0.5) != (after[light] < 0.5) for light in after])
    valid = np.logical_or.reduce([~np.isnan(visibility) for visibility in after.values()])
    order = _pixel_order(*differ.shape)
    waiting = np.sort(order[differ & (order >= last_share)])
    max_changed = max(int(MAX_CHANGED_SHARE * valid.sum()), 1)
    return float(waiting[max_changed]) if max_changed < len(waiting) else 1.0


def mix_pictures(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """Mix two pictures (rows, cols, ...) of one view: an evenly spread ``share`` of the pixels shows ``after``.

    With a larger share, further pixels show ``after``, and all earlier ones still do. The pixels are ordered by the R2 sequence (M.
    Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018). All other pixels show ``before``.
    """
    order = _pixel_order(*before.shape[:2])
    return np.where((order < share).reshape(*order.shape, *(1,) * (before.ndim - 2)), after, before)


def _pixel_order(rows: int, cols: int) -> np.ndarray:
    """Return, for each pixel, the share above which it shows the new picture: (rows, cols) in [0, 1)."""
    row, col = np.ogrid[:rows, :cols]
    return (row / 1.32471795724474602596 + col / 1.32471795724474602596**2) % 1.0


def casting_kinds(plan: Plan) -> dict[str, frozenset[CasterKind]]:
    """Return the kinds of casters for which a plan has a shadow algorithm, by light."""
    return {light: frozenset(kind for kind, name in kinds.items() if name != NO_SHADOWS) for light, kinds in plan.algorithm.items()}


def choices_from_plan(plan: Plan) -> dict[str, Choice]:
    """Return the choices of a plan by light: its algorithms, and the settings that policies vary, such as the map size.

    A setting is included if it has one value for all kinds of casters. All other settings are computed anew when a plan is made
    from the choices, and may differ: for example the ranges of cascades.
    """
    choices = {}
    for light, per_kind in plan.algorithm.items():
        algorithm = {kind: name for kind, name in per_kind.items() if name != NO_SHADOWS}
        resolved = [settings.as_overrides for settings in plan.settings.get(light, {}).values()]
        values_by_key = {key: {overrides[key] for overrides in resolved if key in overrides} for key in tuned_settings()}
        settings = {key: values.pop() for key, values in values_by_key.items() if len(values) == 1}
        words = [*dict.fromkeys(algorithm.values()), *map(str, settings.values())]
        reason = dict.fromkeys([*algorithm, *settings], "kept: no other choice is clearly better")
        choices[light] = Choice(" ".join(words), algorithm, settings, reason)
    return choices


def _with_prediction(
    kept_plan: Plan, descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None, plans: PlanFunction
) -> Plan:
    """Return the kept plan with the time and errors that the policy predicts for it."""
    judged = plans(descriptor, plan_request, {**(overrides or {}), **_as_overrides(choices_from_plan(kept_plan))})
    missed = [reasoned for reasoned in judged.reasons if reasoned.name.endswith(TARGET_MISSED)]
    reasons = [*missed, *(reasoned for reasoned in kept_plan.reasons if not reasoned.name.endswith(TARGET_MISSED))]
    expected = {"policy": judged.policy, "predicted": judged.predicted, "target": judged.target, "reasons": reasons}
    return kept_plan.model_copy(update=expected)


def _merge_choices(choices: Mapping[str, Choice], new_choices: Mapping[str, Choice]) -> dict[str, Choice]:
    """Merge two choices for each light that agree on the kinds of casters that cast shadows now.

    Kinds that cast no shadows any more keep their algorithm from ``choices``. ``choices`` are those so far, and ``new_choices``
    those of the present frame, by light.
    """
    before = {light: choices.get(light, choice) for light, choice in new_choices.items()}
    return {
        light: replace(
            choice,
            algorithm={**before[light].algorithm, **choice.algorithm},
            settings={**before[light].settings, **choice.settings},
        )
        for light, choice in new_choices.items()
    }  # fmt: skip


def _as_overrides(choices: Mapping[str, Choice]) -> dict[str, Any]:
    """Return fields of ``Shadows`` that make a plan use the choices.

    A setting with different values for different lights is left out, so the policy decides on it.
    """
    overrides: dict[str, Any] = {
        "algorithm": {light: dict(choice.algorithm) for light, choice in choices.items() if choice.algorithm}
    }
    for key in tuned_settings():
        values = {choice.settings[key] for choice in choices.values() if key in choice.settings}
        if len(values) == 1:
            overrides[key] = values.pop()
    return overrides


def _comparable_choices(choices: Mapping[str, Choice]) -> dict[str, tuple[dict[CasterKind, AlgorithmName], dict[str, Any]]]:
    """Return choices by light as their algorithms by kind of casters and their settings, without names and reasons.

    Two results are equal exactly if the choices use the same algorithms and settings.
    """
    return {light: (dict(choice.algorithm), dict(choice.settings)) for light, choice in choices.items()}


def _relative_overshoot(plan: Plan) -> float:
    """Return the larger excess of a plan's expected error and time over its limit, relative to the limit; at least 0.

    If the plan misses its target for another reason, the result is twice ``SWITCH_ERROR_GAIN``. Without predictions it is 0.
    """
    if plan.predicted is None:
        return 0.0
    target = plan.target
    over = [(plan.predicted.wrong_cast - target.max_error) / max(target.max_error, MAX_INTERIOR_SHARE)]
    over += [] if target.max_ms is None else [plan.predicted.ms / target.max_ms - 1.0]
    return max(2.0 * SWITCH_ERROR_GAIN if target.met is False and max(over) <= 0.0 else 0.0, *over)
