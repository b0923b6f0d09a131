"""Effects: one file each, with the predicate that says whether a scene calls for it, and why (or why not)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from terrain.descriptor import Descriptor
from terrain.effects import cast_shadows
from terrain.effects.verdict import Verdict
from terrain.level import EffectName


@dataclass(frozen=True)
class Effect:
    """An effect's name and its predicate over the descriptor."""

    name: EffectName
    called_for: Callable[[Descriptor], Verdict]


EFFECTS: dict[EffectName, Effect] = {"cast_shadows": Effect("cast_shadows", cast_shadows.called_for)}
