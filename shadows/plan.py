"""Plans: recipes that can be executed, keyed by light, then caster kind; each choice with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from terrain.level.level import SUN, AlgorithmName, CasterKind


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Reasoned(_Value):
    """A name with the reason why it is listed."""

    name: str
    reason: str


MapFit = Literal["stable", "tight"]
"""Where a sun's map lies: on a fixed lattice, so that texels never move against the ground, or close round the receivers."""

MapBias = Literal["receiver_plane", "normal_offset", "polygon_offset"]
"""What keeps a surface from shading itself, as ``shadows.maps.shadow_map`` says."""

Culling = Literal["none", "front"]
"""Faces of closed casters that are left out of a map."""


class Cascade(_Value):
    """One of a sun's maps: for what lies up to ``far_m`` from the eye and beyond the cascade before (``None``: for all the rest).

    ``texel_m`` are the sides of a texel in light space (right, up), ``depth_step_m`` the metres between two depths that the map
    can tell apart.
    """

    far_m: float | None
    texel_m: tuple[float, float]
    depth_step_m: float = Field(gt=0)


class ShadowMapSettings(_Value):
    """Settings of a sun's shadow map, resolved: one for all blocks of a (level, zoom, sun).

    ``map_size`` are the texels a side of each of the ``cascades``, from the nearest on (one in map views), ``filter`` the taps a
    side, or ``sun`` for the penumbra of the sun's disc. ``bias_scale`` multiplies the derived offset (1 is right; less shows acne).
    """

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: Literal[1, 2, 3, 5, "sun"]
    fit: MapFit = "stable"
    bias: MapBias = "receiver_plane"
    culling: Culling = "none"
    cascades: tuple[Cascade, ...] = Field(min_length=1, max_length=4)
    bias_scale: float = Field(default=1.0, ge=0)


class LampMapSettings(_Value):
    """Settings of a spot's shadow map, or of each of an omni light's six: texels a side, bits of depth, taps a side."""

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: Literal[1, 2, 3, 5]
    bias: MapBias = "receiver_plane"
    culling: Culling = "none"
    bias_scale: float = Field(default=1.0, ge=0)


class PerspectiveMapSettings(_Value):
    """Settings of a perspective shadow map: texels a side, bits of depth, taps a side.

    It is fitted closely, compared on triangles that are known, and drawn whole: these are no choices of its own.
    """

    bias: ClassVar[MapBias] = "receiver_plane"
    culling: ClassVar[Culling] = "none"

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: Literal[1, 2, 3, 5]
    bias_scale: float = Field(default=1.0, ge=0)


class VolumeSettings(_Value):
    """Settings of shadow volumes: both sides of the volumes in one pass or in one each, and what is counted: ``auto`` takes
    z-pass for casters whose volume provably misses the near plane and z-fail for the others.
    """

    stencil: Literal["one_pass", "two_pass"] = "one_pass"
    counting: Literal["auto", "z_fail"] = "auto"


class HybridSettings(VolumeSettings):
    """Settings of the hybrid: its map, how the pixels are found in which volumes decide (``original``: Chan and Durand's
    comparison of two by two texels), and those of its volumes.
    """

    map: ShadowMapSettings | LampMapSettings
    mask: Literal["conservative", "original"] = "conservative"


class SweepSettings(_Value):
    """Settings of the line sweep: lines per column of the ground's grid, and whether the sun is a point or its disc."""

    lines: int = Field(default=8, ge=1, le=16)
    filter: Literal[1, "sun"] = 1


class TruthSettings(_Value):
    """Settings of ray-traced truth: directions over the sun's disc (1: its middle alone)."""

    sun_samples: int = Field(default=1, ge=1, le=1024)


Settings = (
    ShadowMapSettings | LampMapSettings | PerspectiveMapSettings | HybridSettings | VolumeSettings | SweepSettings | TruthSettings
)


class Target(_Value):
    """What was asked, and whether the plan is expected to meet it (``None``: not known)."""

    max_error: float
    max_ms: float | None = None
    met: bool | None = None


class Predicted(_Value):
    """Expected (under ``measure``: measured) milliseconds of a block's shadow work, the share of all pixels that is wrong, and the
    share of the cast shadow, which a target counts.
    """

    ms: float
    wrong: float
    wrong_cast: float


@dataclass(frozen=True)
class Step:
    """One call of an algorithm: for a light, for some kinds of casters together."""

    light: str
    kinds: tuple[CasterKind, ...]
    algorithm: AlgorithmName
    settings: Settings | None


class Plan(_Value):
    """What will be done for a view, and why."""

    view: str
    policy: Literal["rules", "predict", "measure"]
    algorithm: dict[str, dict[CasterKind, AlgorithmName]]
    settings: dict[str, dict[CasterKind, Settings]]
    effects: list[Reasoned]
    left_out: list[Reasoned]
    rejected: list[Reasoned]
    passes: list[str]
    predicted: Predicted | None = None
    target: Target
    reasons: list[Reasoned]

    @property
    def runs(self) -> frozenset[str]:
        """The names of the effects that run."""
        return frozenset(effect.name for effect in self.effects)

    @property
    def lights(self) -> tuple[str, ...]:
        """The lights whose visibility is filled, in order; a level without any has the sun's, which is nowhere."""
        return tuple(self.algorithm) or (SUN,)

    @property
    def steps(self) -> list[Step]:
        """What is to be filled, in order."""
        return steps_of(self.algorithm, self.settings)

    def steps_under(self, light: str) -> list[Step]:
        """What is to be filled for a light, in order; ``none`` fills nothing."""
        return [step for step in self.steps if step.light == light and step.algorithm != "none"]

    @property
    def headline(self) -> str:
        """The algorithms in one word or in the spelling of overrides, as ``shadow_map`` or ``relief=sweep,lamp=shadow_map``."""
        names = {name for per_kind in self.algorithm.values() for name in per_kind.values()}
        if len(names) <= 1:
            return names.pop() if names else "none"
        words = []
        for light, per_kind in self.algorithm.items():
            if light != SUN and len(set(per_kind.values())) == 1:
                words.append(f"{light}={next(iter(per_kind.values()))}")
            else:
                words += [f"{kind}={name}" for kind, name in per_kind.items()]
        return ",".join(words)


def steps_of(
    algorithm: Mapping[str, Mapping[CasterKind, AlgorithmName]], settings: Mapping[str, Mapping[CasterKind, Settings]]
) -> list[Step]:
    """The steps of algorithms and settings by light and kind of casters: kinds of one light that share both go together."""
    steps: list[Step] = []
    for light, per_kind in algorithm.items():
        for kind, name in per_kind.items():
            its = settings.get(light, {}).get(kind)
            for number, step in enumerate(steps):
                if step.light == light and step.algorithm == name and step.settings == its:
                    steps[number] = Step(light, (*step.kinds, kind), name, its)
                    break
            else:
                steps.append(Step(light, (kind,), name, its))
    return steps
