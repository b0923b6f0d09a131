"""Make the plan of a view from a descriptor (facts of the view), a request, and the choices of any policy.

A plan has the algorithm and the settings for each light and kind of casters, with reasons. The request and the level may set some
of them. The choices decide on the rest.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from pydantic_core import PydanticCustomError

from skugga.selector.choices import Choice, PlanRequest
from skugga.selector.formatting import format_list
from skugga.selector.planner.advice import choices_by_rules
from skugga.selector.planner.shadow_request import ShadowRequest, resolve_shadow_request
from skugga.shadows.algorithm_settings import AlgorithmSettings, NamedReason, SettingsRequest
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan, Step, Target, plan_steps
from skugga.shadows.registry import ALGORITHMS, FALLBACK_ALGORITHM, NO_SHADOWS, algorithms_serving
from skugga.shadows.render import pass_names_of
from skugga.shadows.requirements import FALLBACK_REQUIREMENT, Requirement, is_area_light, requirements_of
from skugga.terrain.effects import EFFECTS
from skugga.terrain.effects.cast_shadows import sun_caster_verdict, sun_verdict
from skugga.terrain.errors import InputError, UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import (
    SUN,
    AlgorithmOverride,
    CasterKind,
    EffectName,
    Shadows,
    ShadowSettings,
    expand_override,
    override_text,
)

SETTING_NAMES = tuple(key for key in ShadowSettings.model_fields if key != "algorithm")
"""Shadow settings that a request may set besides the algorithm and the target."""


def make_plan(
    descriptor: Descriptor,
    plan_request: PlanRequest,
    overrides: dict[str, Any] | None = None,
    choices: Mapping[str, Choice] | None = None,
    rejected: Mapping[AlgorithmName, str] | None = None,
) -> Plan:
    """Return the plan of a view.

    Parameters
    ----------
    descriptor
        Facts of the view.
    plan_request
        The level, or a ``StandaloneRequest``.
    overrides
        Fields of ``Shadows`` that the request sets. They take precedence over the level's pins (settings for some views and suns).
        Pins take precedence over the level's own ``shadows``.
    choices
        Choices by light for everything that the request and the level leave open. ``None``: the choices of the policy ``rules``.
    rejected
        Reasons against algorithms that the plan does not use. For an algorithm without a reason the plan names the preferred one.

    Raises
    ------
    InputError
        An override is wrong.
    UnsupportedError
        An override cannot be served.
    """
    planner = planner_of(descriptor, plan_request, overrides)
    return planner.plan(
        choices_by_rules(descriptor, planner.requested_shadows, planner.lights) if choices is None else choices, rejected or {}
    )


def planner_of(descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None = None) -> Planner:
    """Return the planner of a view, which makes plans for different choices. Raises the errors of ``make_plan``."""
    request = resolve_shadow_request(descriptor, plan_request, overrides)
    shadows = request.shadows
    effects, left_out = _effects_to_run(descriptor, plan_request, shadows)
    try:
        algorithm_override = expand_override(shadows.algorithm, plan_request.light_names)
    except PydanticCustomError as error:
        raise InputError("algorithm", override_text(shadows.algorithm), error.message()) from None
    forced = frozenset(name for name in EFFECTS if _requested_effect(plan_request, name) == "on")
    return Planner(descriptor, request, effects, left_out, algorithm_override, forced)


SUPERSAMPLING_REASON = (
    "pixels are larger than the data's cells: each shows the mean visibility of {side} x {side} sub-pixel samples"
)
"""Reason for supersampling; ``side`` is the number of samples along a pixel's side."""


@dataclass(frozen=True, eq=False)
class Planner:
    """Makes plans of one view for different choices of algorithms and settings.

    Attributes
    ----------
    descriptor
        Facts of the view.
    request
        Combined shadow settings of the request and the level.
    effects
        Effects that the scene needs, with reasons.
    left_out
        Effects that are left out, with reasons.
    algorithm_override
        Algorithms that the request or the level sets, by light and kind of casters.
    forced_effects
        Effects that the level forces on.
    """

    descriptor: Descriptor
    request: ShadowRequest
    effects: list[NamedReason]
    left_out: list[NamedReason]
    algorithm_override: AlgorithmOverride
    forced_effects: frozenset[EffectName]
    # Caches, filled on demand: settings and reasons by light, algorithm and open settings; algorithms by kind of casters, by light
    # and choice; and one object for equal settings.
    _resolved_settings: dict[tuple[object, ...], tuple[AlgorithmSettings | None, list[NamedReason]]] = field(default_factory=dict)
    _combinations: dict[tuple[object, ...], dict[CasterKind, AlgorithmName]] = field(default_factory=dict)
    _interned_settings: dict[AlgorithmSettings | None, AlgorithmSettings | None] = field(default_factory=dict)

    @cached_property
    def lights(self) -> tuple[str, ...]:
        """The lights to plan for: the sun and the lamps.

        In a perspective view lamps that do not reach the view are left out, unless the level forces the effect ``lamps`` on. In a
        map view all lamps are included, because the plan may be used for other maps of the same scale.
        """
        return tuple(light for light in self.descriptor.light_kinds if light not in self._unreached_lamps)

    @cached_property
    def _unreached_lamps(self) -> dict[str, None]:
        """The names of the lamps that are left out, as the keys of a dictionary, in order."""
        if self.descriptor.view_kind == "map":
            return {}
        return dict.fromkeys(lamp.name for lamp in self.descriptor.lamps if not lamp.reaches and "lamps" not in self.forced_effects)

    @property
    def requested_shadows(self) -> Shadows:
        """The combined shadow settings of the request and the level."""
        return self.request.shadows

    def casting_kinds(self, light: str) -> list[CasterKind]:
        """Return the kinds of casters that cast shadows under a light, as far as the descriptor tells."""
        return [assignment.kind for assignment in self._assignments(light, None) if assignment.algorithm != NO_SHADOWS]

    def steps(self, light: str, choice: Choice) -> tuple[Step, ...]:
        """Return the steps (calls of algorithms) that a choice leads to for a light. Raises the errors of ``make_plan``."""
        combination = (light, *choice.algorithm.items())
        if combination not in self._combinations:
            self._combinations[combination] = {
                assignment.kind: assignment.algorithm
                for assignment in self._assignments(light, choice)
                if assignment.algorithm != NO_SHADOWS
            }
        algorithm = self._combinations[combination]
        of_name = {name: self._resolve(light, name, choice)[0] for name in dict.fromkeys(algorithm.values())}
        settings = {
            kind: algorithm_settings for kind, name in algorithm.items() if (algorithm_settings := of_name[name]) is not None
        }
        return tuple(plan_steps({light: algorithm}, {light: settings}))

    def plan(self, choices: Mapping[str, Choice], rejected: Mapping[AlgorithmName, str]) -> Plan:
        """Return the plan for choices by light. ``rejected`` and the errors raised are those of ``make_plan``."""
        descriptor, shadows, requester = self.descriptor, self.requested_shadows, self.request.requester("algorithm")
        assignments = [assignment for light in self.lights for assignment in self._assignments(light, choices.get(light))]
        reasons = [
            NamedReason(name=f"{assignment.light}/{assignment.kind}: {assignment.algorithm}", reason=assignment.reason)
            for assignment in assignments
        ]
        algorithm: dict[str, dict[CasterKind, AlgorithmName]] = {}
        settings: dict[str, dict[CasterKind, AlgorithmSettings]] = {}
        reported = set()
        for assignment in assignments:
            algorithm.setdefault(assignment.light, {})[assignment.kind] = assignment.algorithm
            kind_settings, setting_reasons = self._settings(assignment.light, assignment.algorithm, choices.get(assignment.light))
            if (assignment.light, assignment.algorithm) not in reported:
                reasons += setting_reasons
                reported.add((assignment.light, assignment.algorithm))
            if kind_settings is not None:
                settings.setdefault(assignment.light, {})[assignment.kind] = kind_settings
        if self._unreached_lamps:
            dark = format_list(list(self._unreached_lamps))
            reasons.append(NamedReason(name="lamps left out", reason=f"no light from {dark} reaches the view"))
        reasons += _requested_setting_reasons(self.request, settings, reasons)
        if descriptor.pieces > 1 and settings:
            reasons.append(NamedReason(name="supersampling", reason=SUPERSAMPLING_REASON.format(side=descriptor.pieces)))
        effects, left_out = _without_idle_effects(self.effects, self.left_out, algorithm, settings)
        used_algorithms = {assignment.algorithm for assignment in assignments}
        no_shadows_reason = self._left_out_reasons.get("cast_shadows")
        plan = Plan(
            view=descriptor.view, policy="rules", algorithm=algorithm, settings=settings, effects=effects, left_out=left_out,
            rejected=[
                NamedReason(name=name, reason=no_shadows_reason or _rejection_reason(name, assignments, requester, rejected))
                for name in ALGORITHMS if name not in used_algorithms
            ],
            passes=[], target=Target(max_error=shadows.max_error, max_ms=shadows.max_ms), reasons=reasons,
        )  # fmt: skip
        passes = [
            name for step in plan.steps for name in PassLog.pass_names(step.light, step.kinds, ALGORITHMS[step.algorithm].passes)
        ]
        return plan.model_copy(update={"passes": pass_names_of(plan.effect_names, passes)})

    @cached_property
    def _left_out_reasons(self) -> dict[str, str]:
        """The reasons for the effects that are left out, by name of the effect."""
        return {effect.name: effect.reason for effect in self.left_out}

    def _assignments(self, light: str, choice: Choice | None) -> list[_Assignment]:
        """Return the algorithm for each kind of casters under a light, in the order of the descriptor's casters.

        ``choice`` decides what the request and the level leave open; without it, ``FALLBACK_ALGORITHM`` does. Raises
        ``UnsupportedError`` if an algorithm cannot serve its casters.
        """
        kind_of_light, assignments = self.descriptor.light_kinds[light], []
        left_out_reasons = self._left_out_reasons
        for caster in self.descriptor.casters:
            requested, requirements = (
                self.algorithm_override.get(light, {}).get(caster),
                requirements_of(self.descriptor, kind_of_light, caster, self._is_area_light(light)),
            )
            name, reason, is_chosen_by_policy = _choose_algorithm(
                self.descriptor, light, caster, requested, self.request, left_out_reasons, self.forced_effects, choice
            )
            requested_algorithm, fallback_reason = name, _fallback_reason(name, requirements)
            if fallback_reason is not None:
                name, reason = (
                    FALLBACK_ALGORITHM,
                    f"{self.request.requester('algorithm')} sets {requested_algorithm}, but {fallback_reason}",
                )
            _check_served(name, light, caster, requirements, self.request)
            assignments.append(_Assignment(light, caster, name, reason, is_chosen_by_policy, requirements, requested_algorithm))
        return assignments

    def _is_area_light(self, light: str) -> bool:
        """Return whether a light is drawn as an area light. The sun is not if the effect ``soft_edges`` is left out."""
        return is_area_light(self.descriptor, light, self.requested_shadows) and not (
            light == SUN and "soft_edges" in self._left_out_reasons
        )

    def _open_settings(self, choice: Choice | None) -> dict[str, Any]:
        """Return the settings of a choice that the level and the request leave open."""
        return {
            key: value
            for key, value in (choice.settings if choice else {}).items()
            if getattr(self.requested_shadows, key) == "auto"
        }

    def _resolve(
        self, light: str, name: AlgorithmName, choice: Choice | None
    ) -> tuple[AlgorithmSettings | None, list[NamedReason]]:
        """Return the settings of an algorithm, or ``None``, and the reasons for those that the choice does not set.

        Results are cached.
        """
        open_settings = self._open_settings(choice)
        key = (light, name, *open_settings.items())
        if key not in self._resolved_settings:
            shadows, hard_edges_reason = (
                self.requested_shadows.model_copy(update=open_settings),
                self._left_out_reasons.get("soft_edges"),
            )
            settings, reasons = ALGORITHMS[name].resolve_settings(
                SettingsRequest(self.descriptor, light, shadows, hard_edges_reason)
            )
            self._resolved_settings[key] = (
                self._interned_settings.setdefault(settings, settings),
                reasons,
            )  # equal settings share an object
        return self._resolved_settings[key]

    def _settings(
        self, light: str, name: AlgorithmName, choice: Choice | None
    ) -> tuple[AlgorithmSettings | None, list[NamedReason]]:
        """Return the settings of an algorithm, or ``None``, and the reasons for all of them."""
        open_settings = self._open_settings(choice)
        settings, reasons = self._resolve(light, name, choice)
        chosen = [
            NamedReason(name=f"{key} {value}", reason=choice.reason[key])
            for key, value in open_settings.items()
            if choice and key in choice.reason
        ]
        used_keys = {} if settings is None else settings.as_overrides
        return settings, [*(reasoned for reasoned in chosen if reasoned.name.split()[0] in used_keys), *reasons]


@dataclass(frozen=True)
class _Assignment:
    """The algorithm of a kind of casters under a light.

    Attributes
    ----------
    light
        Name of the light.
    kind
        Kind of casters.
    algorithm
        The algorithm.
    reason
        The reason for it.
    is_chosen_by_policy
        Whether the policy chose it, and not the request, the level or a lack of shadows.
    requirements
        Requirements that the algorithm must meet.
    requested_algorithm
        The algorithm that was chosen or requested. It differs from ``algorithm`` if that is a fallback.
    """

    light: str
    kind: CasterKind
    algorithm: AlgorithmName
    reason: str
    is_chosen_by_policy: bool
    requirements: tuple[Requirement, ...]
    requested_algorithm: AlgorithmName


def _effects_to_run(
    descriptor: Descriptor, plan_request: PlanRequest, shadows: Shadows
) -> tuple[list[NamedReason], list[NamedReason]]:
    """Return the effects that are used and those that are left out, each with a reason."""
    effects: list[NamedReason] = []
    left_out: list[NamedReason] = []
    for name, effect in EFFECTS.items():
        verdict = effect.verdict(name, descriptor)
        requested = _requested_effect(plan_request, name)
        runs, reason = verdict.is_needed, verdict.reason
        if requested != "auto":
            runs, reason = requested == "on", f"forced {requested} by the level ({verdict.reason})"
        elif name == "soft_edges" and shadows.filter != "auto":
            runs, reason = shadows.filter != 1, f"filter {shadows.filter} is set ({verdict.reason})"
        missing_needs = [other for other in left_out if other.name in effect.required_effects]
        if runs and missing_needs:
            runs, reason = False, f"needs {missing_needs[0].name}, which is left out: {missing_needs[0].reason}"
        (effects if runs else left_out).append(NamedReason(name=name, reason=reason))
    return effects, left_out


def _requested_effect(plan_request: PlanRequest, name: EffectName) -> str:
    """Return whether a request wants an effect: ``auto``, ``on`` or ``off``."""
    return "auto" if plan_request.effects == "auto" else plan_request.effects.get(name, "auto")


def _without_idle_effects(
    effects: list[NamedReason],
    left_out: list[NamedReason],
    algorithm: dict[str, dict[CasterKind, AlgorithmName]],
    settings: dict[str, dict[CasterKind, AlgorithmSettings]],
) -> tuple[list[NamedReason], list[NamedReason]]:
    """Return the effects that are used and those that are left out, each with a reason, given the chosen algorithms.

    Effects that have nothing to do with these algorithms are moved from ``effects`` to ``left_out``.
    """
    casting = {kind for per_kind in algorithm.values() for kind, name in per_kind.items() if name != NO_SHADOWS}
    sun = algorithm.get(SUN, {})
    filtered = any(getattr(kind_settings, "filter", 1) != 1 for kind_settings in settings.get(SUN, {}).values())
    idle_reasons = {}
    if not casting:
        idle_reasons["cast_shadows"] = "no caster has a shadow algorithm"
    if "forest" not in casting:
        idle_reasons["alpha_test"] = "no algorithm draws shadows of foliage"
    if not filtered:
        idle_reasons["soft_edges"] = f"not simulated: {_hard_edges_text(sun, settings.get(SUN, {}))}"
    if "relief" not in casting:
        idle_reasons["outside_casters"] = "no algorithm draws shadows of the ground"
    stopped = [
        NamedReason(
            name=effect.name,
            reason=f"called for ({effect.reason}), but {idle_reasons[effect.name]}"
            if effect.name == "soft_edges"
            else f"{idle_reasons[effect.name]} ({effect.reason})",
        )
        for effect in effects
        if effect.name in idle_reasons
    ]
    order: list[str] = list(EFFECTS)
    return (
        [effect for effect in effects if effect.name not in idle_reasons],
        sorted([*left_out, *stopped], key=lambda effect: order.index(effect.name)),
    )


def _hard_edges_text(algorithm: dict[CasterKind, AlgorithmName], settings: dict[CasterKind, AlgorithmSettings]) -> str:
    """Return why no algorithm of the sun's shadows softens edges, although the scene calls for it."""
    casting = {kind: name for kind, name in algorithm.items() if name != NO_SHADOWS}
    if not casting:
        return "no caster has a shadow algorithm under the sun"
    parts = [
        f"{name} for {' and '.join(kind for kind in casting if casting[kind] == name)}" for name in dict.fromkeys(casting.values())
    ]
    text = f"{format_list(parts)} {'draws' if len(parts) == 1 else 'draw'} hard edges with these settings"
    can_filter = all(hasattr(settings.get(kind), "filter") for kind in casting)
    return f"{text}; the filter sun softens them" if can_filter else text


def _choose_algorithm(
    descriptor: Descriptor,
    light: str,
    caster: CasterKind,
    requested: AlgorithmName | None,
    request: ShadowRequest,
    left_out_reasons: dict[str, str],
    forced: Collection[EffectName],
    choice: Choice | None,
) -> tuple[AlgorithmName, str, bool]:
    """Return the algorithm for a light and a kind of casters, the reason, and whether the policy chose it.

    ``requested`` is the algorithm that the request or the level sets, if any. ``left_out_reasons`` has a reason for each effect
    that is left out. ``forced`` holds the effects that the level forces on. ``choice`` is the policy's choice; ``None``:
    ``FALLBACK_ALGORITHM``. ``caster`` is the kind of casters.
    """
    needed_effects = {"cast_shadows", "alpha_test"} if caster == "forest" else {"cast_shadows"}
    for effect in sorted(needed_effects | ({"lamps"} if light != SUN else set())):
        if effect in left_out_reasons:
            return NO_SHADOWS, left_out_reasons[effect], False
    if light == SUN and (descriptor.highest_sun_deg is None or (descriptor.lamps and not sun_verdict(descriptor).is_needed)):
        return NO_SHADOWS, sun_verdict(descriptor).reason, False
    if requested is not None:
        return requested, request.reason_for("algorithm"), False
    if caster == "relief" and descriptor.relief_m <= 0.0:
        return NO_SHADOWS, "flat ground casts no shadow", False
    if light == SUN and not needed_effects & set(forced) and not sun_caster_verdict(descriptor, caster).is_needed:
        return NO_SHADOWS, sun_caster_verdict(descriptor, caster).reason, False
    if light != SUN and "lamps" not in forced and not next(lamp for lamp in descriptor.lamps if lamp.name == light).reaches:
        return NO_SHADOWS, f"no light from {light} reaches the view", False
    if choice is None or caster not in choice.algorithm:
        return FALLBACK_ALGORITHM, "serves every view, light and kind of casters", True
    return choice.algorithm[caster], choice.reason.get(caster, choice.name), True


def _fallback_reason(name: AlgorithmName, requirements: tuple[Requirement, ...]) -> str | None:
    """Return the reason why ``FALLBACK_ALGORITHM`` replaces an algorithm.

    ``None`` means that the algorithm meets ``requirements``, or that it fails to meet one for which there is no fallback.
    """
    other_requirements = [requirement for requirement in requirements if requirement != FALLBACK_REQUIREMENT]
    return None if ALGORITHMS[name].refusal_reason(other_requirements) else ALGORITHMS[name].refusal_reason(requirements)


def _check_served(
    name: AlgorithmName, light: str, caster: CasterKind, requirements: tuple[Requirement, ...], request: ShadowRequest
) -> None:
    """Raise ``UnsupportedError`` if an algorithm does not meet ``requirements``.

    The message names the algorithms that do. ``caster`` is the kind of casters that it is used for.
    """
    reason = ALGORITHMS[name].refusal_reason(requirements)
    if reason is not None:
        value, allowed = (
            f"{name} for {caster} under {light}",
            f"{reason}; algorithms that can: {', '.join(algorithms_serving(requirements))}",
        )
        raise UnsupportedError(request.key_path("algorithm"), value, allowed)


def _rejection_reason(
    name: AlgorithmName, assignments: list[_Assignment], requester: str, rejected: Mapping[AlgorithmName, str]
) -> str:
    """Return why an algorithm is not used: a requirement that it does not meet, the policy's reason, or the preferred algorithm.

    ``requester`` is the source of the algorithms that are set, in words. ``rejected`` holds the policy's reasons.
    """
    policy_assignments = [assignment for assignment in assignments if assignment.is_chosen_by_policy]
    if not ALGORITHMS[name].is_selectable:
        return ALGORITHMS[name].description
    if any(assignment.requested_algorithm == name for assignment in assignments):
        return ALGORITHMS[name].refusals[FALLBACK_REQUIREMENT]
    if not policy_assignments:
        return f"{requester} sets {', '.join(sorted({assignment.requested_algorithm for assignment in assignments}))}"
    if name == NO_SHADOWS:
        return "the view has casters and light, so shadows are drawn"
    if name in rejected:
        return rejected[name]
    if len(policy_assignments) == 1:
        return (
            ALGORITHMS[name].refusal_reason(policy_assignments[0].requirements)
            or f"{policy_assignments[0].algorithm} was preferred: {policy_assignments[0].reason}"
        )
    kinds_by_reason: dict[str, list[str]] = {}
    for assignment in policy_assignments:
        reason = ALGORITHMS[name].refusal_reason(assignment.requirements) or f"{assignment.algorithm} was preferred"
        kinds_by_reason.setdefault(reason, []).append(
            assignment.kind if assignment.light == SUN else f"{assignment.kind} under {assignment.light}"
        )
    return "; ".join(
        f"for {' and '.join(parts)}: {reason}" if len(kinds_by_reason) > 1 else reason for reason, parts in kinds_by_reason.items()
    )


def _requested_setting_reasons(
    request: ShadowRequest,
    settings: dict[str, dict[CasterKind, AlgorithmSettings]],
    given_reasons: list[NamedReason],
) -> list[NamedReason]:
    """Return a reason for each setting that the request or the level sets: who set it, and whether a used algorithm has it.

    Settings in ``given_reasons`` have a reason already and are left out.
    """
    resolved = [kind_settings for per_kind in settings.values() for kind_settings in per_kind.values()]
    reported = {reasoned.name.rpartition(": ")[2] for reasoned in given_reasons}
    reasons = []
    for key in SETTING_NAMES:
        value = getattr(request.shadows, key)
        name = f"{key} {value}"
        if value != "auto" and name not in reported:
            reason = request.reason_for(key)
            if not any(resolved_settings.as_overrides.get(key) == value for resolved_settings in resolved):
                reason += ", without effect: no chosen algorithm has this setting"
            reasons.append(NamedReason(name=name, reason=reason))
    return reasons
