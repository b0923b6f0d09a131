"""Value types that a policy passes to the planner: algorithms by kind of casters, settings and reasons for one light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind, EffectName, Shadows

PolicyName = Literal["rules", "predict", "probe", "measure"]
"""The policies.

- ``rules``: fixed rules over the descriptor.
- ``predict``: cost and error models.
- ``probe``: ``predict``, corrected by drawing some candidates on the scene and comparing them with ground truth.
- ``measure``: ``probe`` without a time limit.
"""


class PlanRequest(Protocol):
    """The part of a request that does not depend on the view. ``Level`` and ``StandaloneRequest`` implement it."""

    @property
    def shadows(self) -> Shadows: ...

    @property
    def effects(self) -> Any: ...

    @property
    def light_names(self) -> tuple[str, ...]: ...


@dataclass(frozen=True)
class StandaloneRequest:
    """A request without a level, for a descriptor alone. ``effects`` is ``auto``, or ``on`` and ``off`` by name."""

    shadows: Shadows
    light_names: tuple[str, ...]
    effects: str | Mapping[EffectName, str] = "auto"


@dataclass(frozen=True)
class Choice:
    """A policy's choice for one light. Settings of the level or the request override it.

    Attributes
    ----------
    name
        Unique among the choices for a light.
    algorithm
        Algorithm by kind of casters.
    settings
        Fields of ``Shadows`` by name (``map_size``, ``cascades``).
    reason
        Reasons: for algorithms by kind of casters, for settings by field.
    """

    name: str
    algorithm: Mapping[CasterKind, AlgorithmName]
    settings: Mapping[str, Any] = field(default_factory=dict)
    reason: Mapping[str, str] = field(default_factory=dict)
