"""Plans: executable recipes, keyed by light, then by kind of casters. Each choice has its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, SerializeAsAny, TypeAdapter, ValidationInfo, field_validator
from pydantic_core import CoreSchema

from skugga.shadows.algorithm_settings import AlgorithmSettings, NamedReason
from skugga.shadows.registry import ALGORITHMS, NO_SHADOWS
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import SUN, CasterKind


# The base of the plan's models: immutable, without unknown fields.
class _FrozenModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def settings_type(*names: AlgorithmName) -> Any:
    """Return the union of the settings types of some algorithms, for pydantic; ``AlgorithmSettings`` if none has any."""
    types = [settings for name in names for settings in ALGORITHMS[name].settings_types]
    return reduce(or_, types) if types else AlgorithmSettings


class _SettingsSchema:
    """Annotation that adds the settings types of all algorithms to JSON schemas."""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        """Return the JSON schema of the union of all algorithms' settings types."""
        return handler(TypeAdapter(settings_type(*ALGORITHMS)).core_schema)


class Target(_FrozenModel):
    """The requested limits, and whether the plan is expected to meet them (``None``: not known)."""

    max_error: float
    max_ms: float | None = None
    met: bool | None = None


class Predicted(_FrozenModel):
    """Predicted milliseconds of a block's shadow work, the wrong share of all pixels, and the wrong share of the cast shadow.

    The policy ``measure`` reports measured values, and ``probe`` corrects predictions by test renders. A target limits the share of
    the cast shadow. ``is_estimate`` tells the times of a device that is not calibrated, which may be off by a factor of two. In
    dense woods ``is_coverage`` is true, and ``wrong_cast`` is the error of coverage, which targets limit there. ``is_measured``
    tells that the choices were drawn on this view, and their errors and times measured.

    ``ms`` is the time of a frame that is made anew. ``ms_at_rest`` is that of a frame of a perspective view in which nothing has
    moved since the frame before: its maps and volumes are cached, and their work is not counted. It equals ``ms`` where the
    descriptor says that something moves. It is ``None`` for maps, whose finished blocks are cached.
    """

    ms: float
    wrong: float
    wrong_cast: float
    is_estimate: bool = False
    is_coverage: bool = False
    is_measured: bool = False
    ms_at_rest: float | None = None


@dataclass(frozen=True)
class Step:
    """One call of an algorithm: for a light, and for some kinds of casters together.

    Attributes
    ----------
    light
        The name of the light.
    kinds
        The kinds of casters.
    algorithm
        The name of the algorithm.
    settings
        Its resolved settings; ``None`` if it has none.
    """

    light: str
    kinds: tuple[CasterKind, ...]
    algorithm: AlgorithmName
    settings: AlgorithmSettings | None


class Plan(_FrozenModel):
    """The recipe for the shadows of a view, with the reasons."""

    view: str
    policy: Literal["rules", "predict", "probe", "measure"]
    algorithm: dict[str, dict[CasterKind, AlgorithmName]]
    settings: dict[str, dict[CasterKind, Annotated[SerializeAsAny[AlgorithmSettings], _SettingsSchema()]]]
    effects: list[NamedReason]
    left_out: list[NamedReason]
    rejected: list[NamedReason]
    passes: list[str]
    predicted: Predicted | None = None
    target: Target
    reasons: list[NamedReason]

    @field_validator("settings", mode="before")
    @classmethod
    def _parse_settings(cls, value: Any, info: ValidationInfo) -> Any:
        """Parse settings from text as the settings types of the plan's algorithms."""
        algorithm = info.data.get("algorithm", {})
        return {
            light: {
                kind: kind_settings
                if isinstance(kind_settings, AlgorithmSettings)
                else _validated_settings(algorithm.get(light, {}).get(kind), kind_settings)
                for kind, kind_settings in per_kind.items()
            }
            for light, per_kind in value.items()
        }

    @property
    def effect_names(self) -> frozenset[str]:
        """The names of the effects that run."""
        return frozenset(effect.name for effect in self.effects)

    @property
    def lights(self) -> tuple[str, ...]:
        """The lights whose visibility is filled, in order. A level without lights has the sun, which never shines."""
        return tuple(self.algorithm) or (SUN,)

    @property
    def steps(self) -> list[Step]:
        """The steps that fill visibility, in order."""
        return plan_steps(self.algorithm, self.settings)

    @property
    def casts_shadows(self) -> bool:
        """Whether any step computes cast shadows, by another algorithm than ``none``.

        If not, nothing casts, and no ground beside the picture is searched for casters.
        """
        return any(step.algorithm != NO_SHADOWS for step in self.steps)

    def steps_of_light(self, light: str) -> list[Step]:
        """Return the steps that fill a light's visibility, in order. Steps of the algorithm ``none`` are left out."""
        return [step for step in self.steps if step.light == light and step.algorithm != NO_SHADOWS]

    def without_effect(self, name: str, reason: str) -> Plan:
        """Return the plan without an effect that has a pass of its own, and with ``reason`` for leaving it out."""
        if name not in self.effect_names:
            return self
        return self.model_copy(
            update={
                "effects": [effect for effect in self.effects if effect.name != name],
                "left_out": [*self.left_out, NamedReason(name=name, reason=reason)],
                "passes": [pass_name for pass_name in self.passes if pass_name != name],
            }
        )

    @property
    def algorithms_text(self) -> str:
        """The algorithms in one word or in the spelling of overrides, as ``shadow_map`` or ``relief=sweep,lamp=shadow_map``."""
        names = {name for per_kind in self.algorithm.values() for name in per_kind.values()}
        if len(names) <= 1:
            return names.pop() if names else NO_SHADOWS
        words = []
        for light, per_kind in self.algorithm.items():
            if light != SUN and len(set(per_kind.values())) == 1:
                words.append(f"{light}={next(iter(per_kind.values()))}")
            else:
                words += [f"{kind}={name}" for kind, name in per_kind.items()]
        return ",".join(words)


def plan_steps(
    algorithm: Mapping[str, Mapping[CasterKind, AlgorithmName]], settings: Mapping[str, Mapping[CasterKind, AlgorithmSettings]]
) -> list[Step]:
    """Return the steps for algorithms and settings by light and kind of casters.

    Kinds of casters under one light with the same algorithm and settings form one step.
    """
    steps: list[Step] = []
    for light, per_kind in algorithm.items():
        for kind, name in per_kind.items():
            kind_settings = settings.get(light, {}).get(kind)
            for number, step in enumerate(steps):
                if step.light == light and step.algorithm == name and step.settings == kind_settings:
                    steps[number] = Step(light, (*step.kinds, kind), name, kind_settings)
                    break
            else:
                steps.append(Step(light, (kind,), name, kind_settings))
    return steps


def _validated_settings(name: AlgorithmName | None, value: Any) -> Any:
    """Return a value as settings of an algorithm; unchanged if the algorithm is unknown."""
    return value if name is None else TypeAdapter(settings_type(name)).validate_python(value)
