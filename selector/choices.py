"""Value types that a policy (a method of choosing) passes to the planner: algorithms, settings and reasons for one light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind, EffectName, Shadows

PolicyName = Literal["rules", "predict", "probe", "measure"]
"""The policies: methods of choosing algorithms and settings.

- ``rules``: fixed rules over the descriptor, the facts of a view.
- ``predict``: models predict the time and the error of each choice.
- ``probe``: ``predict``, but some candidates are drawn on the scene and compared with ground truth to correct the predictions.
- ``measure``: ``probe`` without a time limit.
"""


class PlanRequest(Protocol):
    """The part of a request that does not depend on the view. ``Level`` and ``StandaloneRequest`` implement it."""

    @property
    def shadows(self) -> Shadows:
        """The requested shadow settings."""

    @property
    def effects(self) -> Any:
        """``auto``, or ``on`` or ``off`` by the name of an effect."""

    @property
    def light_names(self) -> tuple[str, ...]:
        """The names of the lights."""


@dataclass(frozen=True)
class StandaloneRequest:
    """A request for a plan without a level file.

    Attributes
    ----------
    shadows
        Requested shadow settings.
    light_names
        Names of the lights.
    effects
        ``auto``, or ``on`` or ``off`` by the name of an effect.
    """

    shadows: Shadows
    light_names: tuple[str, ...]
    effects: str | Mapping[EffectName, str] = "auto"


@dataclass(frozen=True)
class Choice:
    """Algorithms and settings for one light, chosen by a policy. Settings of the level or the request take precedence.

    Attributes
    ----------
    name
        Name of the choice, unique for a light.
    algorithm
        Algorithm by kind of casters.
    settings
        Values by field of ``Shadows``, such as ``map_size`` or ``cascades``.
    reason
        Reasons for the algorithms by kind of casters, and for the settings by field.
    """

    name: str
    algorithm: Mapping[CasterKind, AlgorithmName]
    settings: Mapping[str, Any] = field(default_factory=dict)
    reason: Mapping[str, str] = field(default_factory=dict)
