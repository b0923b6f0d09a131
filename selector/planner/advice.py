"""The policy ``rules``: choose algorithms by fixed rules over the descriptor (facts of a view), each with its source."""

from __future__ import annotations

from collections.abc import Iterable

from skugga.selector.choices import Choice
from skugga.selector.planner.advice_rules import RULES, RuleInput
from skugga.shadows.registry import FALLBACK_ALGORITHM, can_serve
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import Shadows

NO_RULE_REASON = "default: no rule applies, and a shadow map serves every view, light and kind of casters"
"""Reason for ``FALLBACK_ALGORITHM`` where no rule applies."""


def choices_by_rules(descriptor: Descriptor, shadows: Shadows, lights: Iterable[str]) -> dict[str, Choice]:
    """Return the choices of the fixed rules by light, for the names of lights in ``lights``.

    For each kind of casters the first rule that applies decides. The reason is that of the rule, with its source.
    """
    choices = {}
    for light in lights:
        algorithms = {kind: _first_applicable_rule(RuleInput(descriptor, light, kind, shadows)) for kind in descriptor.casters}
        choices[light] = Choice(
            "rules",
            {kind: name for kind, (name, _) in algorithms.items()},
            reason={kind: reason for kind, (_, reason) in algorithms.items()},
        )
    return choices


def _first_applicable_rule(case: RuleInput) -> tuple[AlgorithmName, str]:
    """Return the algorithm and the reason of the first rule that applies.

    Rules are skipped if their algorithm cannot draw the case. If no rule applies, the algorithm is ``FALLBACK_ALGORITHM``.
    """
    for rule in RULES:
        if (
            can_serve(rule.algorithm, case.descriptor, case.light, case.kind, case.requested_shadows)
            and (reason := rule.reason_for(case)) is not None
        ):
            return rule.algorithm, f"{reason} ({rule.source})"
    return FALLBACK_ALGORITHM, NO_RULE_REASON
