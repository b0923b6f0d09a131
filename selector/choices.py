"""What a policy hands to the planner: for a light, an algorithm per kind of casters and settings, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind, EffectName, Shadows

PolicyName = Literal["rules", "predict", "probe", "measure"]
"""``rules``: what is known beforehand; ``predict``: cost and error models; ``probe``: the same, corrected by some candidates that
were drawn on the scene and held against truth; ``measure``: a probe without a limit of time.
"""


class PlanRequest(Protocol):
    """What is asked of a plan whatever the view: a ``Level`` is one, and so is ``StandaloneRequest``."""

    @property
    def shadows(self) -> Shadows: ...

    @property
    def effects(self) -> Any: ...

    @property
    def light_names(self) -> tuple[str, ...]: ...


@dataclass(frozen=True)
class StandaloneRequest:
    """Wishes without a level, as they come with a descriptor alone. ``effects`` is ``auto`` or on and off by name."""

    shadows: Shadows
    light_names: tuple[str, ...]
    effects: str | Mapping[EffectName, str] = "auto"


@dataclass(frozen=True)
class Choice:
    """A choice for one light. What the level or the request asks for goes before it.

    ``name`` tells it from other choices of the light; ``settings`` are fields of ``Shadows`` (``map_size``, ``cascades``), and
    ``why`` says for each kind of casters what speaks for its algorithm, for each setting what speaks for its value.
    """

    name: str
    algorithm: Mapping[CasterKind, AlgorithmName]
    settings: Mapping[str, Any] = field(default_factory=dict)
    why: Mapping[str, str] = field(default_factory=dict)
