"""Write the reference of effects from their records and the docstrings of their predicates: a section for each effect."""

from __future__ import annotations

import inspect
import re

from scripts.markdown_tables import code, escape, table
from skugga.terrain.effects import EFFECTS, SWITCHES
from skugga.terrain.effects.effect import Effect


def effect_conditions(name: str, effect: Effect) -> tuple[str, str]:
    """Return where an effect is needed and where it is left out: the paragraphs of its predicate's docstring that say so.

    Raises
    ------
    ValueError
        If the docstring lacks one of the paragraphs.
    """
    docstring = " ".join((inspect.getdoc(effect.judge) or "").split())
    match = re.search(r" Needed: (.+?) Left out: (.+)$", docstring)
    if match is None:
        raise ValueError(f"{name}: the predicate's docstring has no paragraphs 'Needed: ...' and 'Left out: ...'.")
    return match[1], match[2]


def effects_page() -> str:
    """Return the page of all effects in the order in which they run within a stage."""
    parts = [
        "# Effects and their thresholds\n\nWhere each effect runs and where it is left out, from the predicates that decide. "
        "[Effects](../effects.md) says how levels set them. The predicates' modules derive the thresholds; a step is 1 of 255.\n"
    ]
    for name, effect in EFFECTS.items():
        needed, left_out = effect_conditions(name, effect)
        rows = [
            ("needed", escape(needed)),
            ("left out", escape(left_out)),
            ("changes", escape(SWITCHES[name]) if name in SWITCHES else f"the stage {code(effect.stage)}"),
            ("needs the effects", ", ".join(code(item) for item in effect.required_effects) or "none"),
            ("module", code(f"terrain/effects/{name}.py")),
        ]
        description = effect.description[0].upper() + effect.description[1:]
        parts.append(f"## {name}\n\n{escape(description)}.\n\n{table(('', ''), rows)}")
    return "\n".join(parts)
