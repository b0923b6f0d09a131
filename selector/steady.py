"""Plans while a camera moves: new ones only where they are needed or clearly better, and switches that nobody sees.

Settings that follow from the view (the ranges of cascades, the sides of texels, depth steps, effects) are always those of the
present view. Algorithms, map sizes and numbers of cascades are kept as long as they serve. A new choice is taken

- at once, where the old one cannot serve: other kinds of casters or lights cast shadows, the view or what is asked is of another
  kind, an algorithm refuses the view; and where the target is missed by more than ``AT_ONCE``;
- after ``PATIENCE`` plans in a row that are better by a margin: ``GAIN`` of the time, or ``MISSED`` of the target. What is then
  left must be worse by as much again before there is a way back, so that a camera at a border does not flip.

Two plans that both keep to an error of a few per cent of the cast shadow differ in some tenths of a per cent of the pixels. So a
switch takes as many frames as keep each below ``MOST_CHANGED``: the old plan is drawn too, and ``handed_over`` mixes the two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from selector.picks import Pick, PolicyName, Wishes
from selector.rules import choose
from selector.select import select
from shadows.plan import Plan
from terrain.descriptor import Descriptor
from terrain.errors import UnsupportedError

if TYPE_CHECKING:
    from selector.device_profile import DeviceProfile

GAIN = 0.2
"""Share of the time that a new plan must save ..."""

MISSED = 0.1
"""... or share of the target by which the old one must miss it more than the new one ..."""

PATIENCE = 5
"""... in so many plans in a row."""

AT_ONCE = 0.5
"""Share of the target that is not to be missed for a single plan."""

MOST_CHANGED = 0.002
"""Share of the pixels that a switch may change from one frame to the next."""

LONGEST = 30
"""Frames that a switch takes at most."""

Plans = Callable[[Descriptor, Wishes, dict[str, Any] | None], Plan]
"""A policy: ``selector.select.select``, or what behaves like it."""


@dataclass(frozen=True)
class Handover:
    """A switch under way: the plan that is left, for the present view, and the share of the pixels that show the new one."""

    plan: Plan
    share: float


@dataclass(frozen=True)
class Standing:
    """What stands after a plan: the plan, its picks by light, what was asked, how many plans in a row another was better, and a
    switch's old picks with the number of its frames and of those that are done.
    """

    plan: Plan
    picks: Mapping[str, Pick]
    asked: tuple[object, ...]
    better_for: int = 0
    left: Mapping[str, Pick] | None = None
    frames: int = 1
    done: int = 1
    handover: Handover | None = None


class Director:
    """Plans for one frame after the other of a view that moves.

    ``policy`` and ``device`` are those of ``selector.select.select``; ``plans`` stands in for it.

    >>> director = Director(device=load_profile(renderer, version))             # doctest: +SKIP
    >>> for view in path:                                                       # doctest: +SKIP
    ...     plan = director.plan(describe(scene, view, "flight"), level)
    ...     color = render_frame(scene, view, plan).color
    ...     if director.handover is not None:
    ...         before = render_frame(scene, view, director.handover.plan).color
    ...         color = handed_over(before, color, director.handover.share)
    """

    def __init__(self, policy: PolicyName = "predict", device: DeviceProfile | None = None, plans: Plans | None = None) -> None:
        self._plans: Plans = plans or partial(select, policy=policy, device=device)
        self._standing: Standing | None = None

    def plan(self, descriptor: Descriptor, wishes: Wishes, overrides: dict[str, Any] | None = None) -> Plan:
        """The next frame's plan. Raises as ``selector.select.select`` does."""
        self._standing = following(self._standing, descriptor, wishes, overrides, self._plans)
        return self._standing.plan

    @property
    def handover(self) -> Handover | None:
        """The switch that the last plan belongs to, if one is under way."""
        return None if self._standing is None else self._standing.handover


def following(
    standing: Standing | None, descriptor: Descriptor, wishes: Wishes, overrides: dict[str, Any] | None, plans: Plans
) -> Standing:
    """What stands after the next plan."""
    fresh = plans(descriptor, wishes, overrides)
    asked = (descriptor.view_kind, wishes.shadows, wishes.effects, overrides or {})
    picks = picks_of(fresh)
    taken = Standing(fresh.model_copy(update={"settings": choose(descriptor, wishes, overrides, picks).settings}), picks, asked)
    if standing is None or standing.asked != asked or casting(standing.plan) != casting(fresh):
        return taken
    kept, alike = taken.plan, _choices(picks) == _choices(standing.picks)
    if not alike:
        try:
            kept = _again(standing.picks, descriptor, wishes, overrides, plans)
        except UnsupportedError:
            return taken
    if standing.done < standing.frames and standing.left is not None:
        try:
            left = choose(descriptor, wishes, overrides, standing.left)
        except UnsupportedError:  # what is left no longer serves: the switch ends here
            return replace(standing, plan=kept, left=None, frames=1, done=1, handover=None)
        done = standing.done + 1
        handover = Handover(left, done / standing.frames) if done < standing.frames else None
        return replace(standing, plan=kept, done=done, handover=handover)
    standing = replace(standing, plan=kept, left=None, frames=1, done=1, handover=None)
    if alike or not better(fresh, kept):
        return replace(standing, better_for=0)
    if standing.better_for + 1 < PATIENCE and _miss(kept) - _miss(fresh) <= AT_ONCE:
        return replace(standing, better_for=standing.better_for + 1)
    frames = frames_of_switch(kept, fresh)
    handover = Handover(kept, 1.0 / frames) if frames > 1 else None
    return replace(taken, left=standing.picks, frames=frames, done=1, handover=handover)


def better(fresh: Plan, kept: Plan) -> bool:
    """Whether a plan is better than another by a margin; where nothing is predicted, what the policy would rather take is."""
    if fresh.predicted is None or kept.predicted is None:
        return True
    if _miss(kept) > _miss(fresh):
        return _miss(kept) - _miss(fresh) > MISSED
    return _miss(kept) == _miss(fresh) and fresh.predicted.ms < (1.0 - GAIN) * kept.predicted.ms


def frames_of_switch(kept: Plan, fresh: Plan) -> int:
    """The frames that a switch takes. Pixels that two plans differ in are wrong in one of them."""
    predicted = [plan.predicted.wrong if plan.predicted else plan.target.max_error for plan in (kept, fresh)]
    return int(np.clip(np.ceil(sum(predicted) / MOST_CHANGED), 1, LONGEST))


def handed_over(before: np.ndarray, after: np.ndarray, share: float) -> np.ndarray:
    """Two pictures (rows, cols, ...) of one view mixed: an evenly spread ``share`` of the pixels shows ``after``, more and more of
    them the same ones.

    The order of the pixels is that of the R2 sequence (M. Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018).
    """
    row, col = np.ogrid[: before.shape[0], : before.shape[1]]
    order = (row / 1.32471795724474602596 + col / 1.32471795724474602596**2) % 1.0
    return np.where((order < share).reshape(*order.shape, *(1,) * (before.ndim - 2)), after, before)


def casting(plan: Plan) -> dict[str, frozenset[str]]:
    """The kinds of casters that cast, by light."""
    return {light: frozenset(kind for kind, name in its.items() if name != "none") for light, its in plan.algorithm.items()}


def picks_of(plan: Plan) -> dict[str, Pick]:
    """What a plan chose for each light: algorithms, map size and number of cascades, as far as one number holds for all.

    What else a plan resolves from a view may come out otherwise by its picks: where cascades end, if their number was not given.
    """
    picks = {}
    for light, per_kind in plan.algorithm.items():
        algorithm = {kind: name for kind, name in per_kind.items() if name != "none"}
        resolved = [getattr(its, "map", its) for its in plan.settings.get(light, {}).values()]
        found = {
            "map_size": {its.map_size for its in resolved if hasattr(its, "map_size")},
            "cascades": {len(its.cascades) for its in resolved if hasattr(its, "cascades")},
        }
        settings = {key: values.pop() for key, values in found.items() if len(values) == 1}
        words = [*dict.fromkeys(algorithm.values()), *map(str, settings.values())]
        why = dict.fromkeys([*algorithm, *settings], "kept: nothing else is better by a margin")
        picks[light] = Pick(" ".join(words), algorithm, settings, why)
    return picks


def _again(
    picks: Mapping[str, Pick], descriptor: Descriptor, wishes: Wishes, overrides: dict[str, Any] | None, plans: Plans
) -> Plan:
    """The plan of picks for a view, with what the policy expects of it."""
    plan = choose(descriptor, wishes, overrides, picks)
    judged = plans(descriptor, wishes, {**(overrides or {}), **_as_overrides(picks)})
    reasons = [*plan.reasons, *(one for one in judged.reasons if one.name.startswith("target"))]
    expected = {"policy": judged.policy, "predicted": judged.predicted, "target": judged.target, "reasons": reasons}
    return plan.model_copy(update=expected)


def _as_overrides(picks: Mapping[str, Pick]) -> dict[str, Any]:
    """The overrides that lead to picks; a setting that lights differ in is left to the policy."""
    out: dict[str, Any] = {"algorithm": {light: dict(pick.algorithm) for light, pick in picks.items() if pick.algorithm}}
    for key in ("map_size", "cascades"):
        values = {pick.settings[key] for pick in picks.values() if key in pick.settings}
        if len(values) == 1:
            out[key] = values.pop()
    return out


def _choices(picks: Mapping[str, Pick]) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    return {light: (dict(pick.algorithm), dict(pick.settings)) for light, pick in picks.items()}


def _miss(plan: Plan) -> float:
    """By how much of it a plan is expected to miss its target; one that misses it by what is not told (interior errors) by a
    little.
    """
    if plan.predicted is None:
        return 0.0
    target = plan.target
    over = [plan.predicted.wrong_cast / target.max_error - 1.0]
    over += [] if target.max_ms is None else [plan.predicted.ms / target.max_ms - 1.0]
    return max(2.0 * MISSED if target.met is False and max(over) <= 0.0 else 0.0, *over)
