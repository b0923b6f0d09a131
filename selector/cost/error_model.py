"""Expected errors of a plan's steps, from the descriptor alone: analytic predictors first, a few fitted constants second.

**Maps.** A nearest look-up asks for the visibility of a texel's centre in place of the point's own. How often the two differ is
measured in the scene: ``CastBand.differs`` has it for displacements anywhere within a texel, for texels of many sizes, by distance
from the eye. What a texel covers follows from the settings: its side in light space (a cascade's, or the cone's at the lamp's
distance, in J. Sindholt's equation 1 the other way round) over a pixel's. Of what differs only a part counts as wrong: pixels that
a shadow's edge crosses are not decidable, and taps smooth the stairs. That part, ``counted``, grows with the texel from 0 to 1.
A perspective map's texels follow the picture's pixels, ``perspective`` of them to one along a side where it has as many texels as
the picture has pixels, and are never larger than a uniform map's would be.

**Planar** shadows are right on the ground and nowhere else: wrong is what lies in cast shadow on bodies. **Everything else** is
exact but for a floor, which is a high one where a perspective view's ground is swept with fewer triangles than its nodes make.

How far off all this is, is part of it: the logarithm of an error scatters about what is expected with a logistic distribution,
whose scale is fitted, too, and from which the chance follows that a target is missed.

The constants are fitted to measured views by `benchmarks/selection`.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from math import exp, log, log2, radians, sqrt, tan
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from selector.cost.task import is_decimated
from shadows.plan import LampMapSettings, PerspectiveMapSettings, ShadowMapSettings, Step
from shadows.registry import ALGORITHMS
from shadows.truth.metrics import MOST_INTERIOR
from terrain.cache import MIB, kept
from terrain.facts.descriptor import Descriptor
from terrain.facts.parts import TEXEL_LADDER_PX, CastBand, Casting
from terrain.facts.probes import PROBES
from terrain.level.level import SUN, AlgorithmName, CasterKind

UNKNOWN = Casting(
    share=0.1,
    bands=(
        CastBand(near_m=0.0, share=1.0, cast=0.1, pixel_m=1.0, differs=tuple(min(0.005 * px, 0.1) for px in TEXEL_LADDER_PX)),
    ),
)  # fmt: skip
"""What is taken of shadows of which a descriptor says nothing: a tenth of what is seen, with an edge a hundred pixels apart."""

POOLED = 3
"""Sizes of texels that tell of one of them together."""

LEAST, LEAST_INTERIOR = 1e-3, 1e-5
"""Errors are compared by their logarithms, from these ones on."""

LEAST_SPREAD = 0.05
"""No algorithm is surer than this."""

HALF_A_HIT = 0.5 / PROBES
"""What no probe was hit by may be there all the same: half a probe's share."""


DECIMATED: Literal["sweep of decimated ground"] = "sweep of decimated ground"

Manner = AlgorithmName | Literal["sweep of decimated ground"]
"""What errors are told by: an algorithm, or a sweep of ground of which the drawn triangles leave out nodes."""

MANNERS: tuple[Manner, ...] = (*ALGORITHMS, DECIMATED)


@dataclass(frozen=True)
class Errors:
    """Expected shares, as ``shadows.truth.metrics`` counts them: ``wrong`` of all pixels, ``wrong_cast`` of the cast shadow, and
    ``interior``; ``spread`` and ``interior_spread`` are the scales by which the logarithms of the latter two scatter.
    """

    wrong: float
    wrong_cast: float
    interior: float
    spread: float
    interior_spread: float

    def chance_over(self, max_error: float) -> float:
        """How likely it is that a picture has more than ``max_error`` of its cast shadow wrong, or more than ``MOST_INTERIOR``
        inside of shadows and lights, in [0, 1].
        """
        error = _chance_over((self.wrong_cast + LEAST) / (max_error + LEAST), self.spread)
        inside = _chance_over((self.interior + LEAST_INTERIOR) / (MOST_INTERIOR + LEAST_INTERIOR), self.interior_spread)
        return max(error, inside)  # what is wrong inside is wrong besides


def _chance_over(ratio: float, scale: float) -> float:
    return 1.0 / (1.0 + exp(-max(min(log(ratio) / scale, 50.0), -50.0)))


class Counted(BaseModel):
    """The part of what differs that is wrong: ``most / (1 + (half_px / texel_px) ** steepness)``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    most: float = Field(gt=0)
    half_px: float = Field(gt=0)
    steepness: float = Field(gt=0)

    def of(self, texel_px: float) -> float:
        return self.most / (1.0 + (self.half_px / max(texel_px, 1e-9)) ** self.steepness)


class ErrorModel(BaseModel):
    """The fitted constants.

    ``counted`` is by kind of casters, ``perspective`` the texels of a perspective map to a pixel's side, ``floor`` what each
    algorithm gets wrong of the cast shadow however fine it is, ``interior`` which share of what is wrong lies inside, ``spread``
    and ``interior_spread`` the scales of both about what is expected.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    counted: dict[CasterKind, Counted]
    perspective: float = Field(gt=0)
    floor: dict[Manner, float]
    interior: dict[Manner, float]
    spread: dict[Manner, float]
    interior_spread: dict[Manner, float]


@kept("process", MIB)
def fitted() -> ErrorModel:
    """The constants that come with the package."""
    return ErrorModel.model_validate_json(files("selector.cost").joinpath("error_model.json").read_text(encoding="utf-8"))


def expected_errors(descriptor: Descriptor, light: str, steps: Sequence[Step], model: ErrorModel | None = None) -> Errors:
    """What the steps of a light are expected to get wrong together."""
    model = model or fitted()
    return errors_together(descriptor, light, [(step, wrong_of_step(descriptor, light, step, model)) for step in steps], model)


def wrong_of_step(descriptor: Descriptor, light: str, step: Step, model: ErrorModel) -> float:
    """The share of all that is seen that a step is expected to get wrong."""
    floor = model.floor[manner_of(descriptor, step)] * _cast(descriptor, light)
    return floor + sum(_of_kind(descriptor, light, step, *of, model) for of in kinds_of_step(descriptor, light, step))


def errors_together(descriptor: Descriptor, light: str, wrong_of: Iterable[tuple[Step, float]], model: ErrorModel) -> Errors:
    """The errors of steps, each with the share that it gets wrong."""
    wrong = interior = spread = interior_spread = 0.0
    for step, its in wrong_of:
        manner = manner_of(descriptor, step)
        inside = its * model.interior[manner]
        wrong, spread = wrong + its, spread + its * model.spread[manner]
        interior, interior_spread = interior + inside, interior_spread + inside * model.interior_spread[manner]
    return Errors(
        min(wrong, 1.0), min(wrong / _cast(descriptor, light), 1.0), min(interior, 1.0),
        spread / wrong if wrong > 0.0 else LEAST_SPREAD, interior_spread / interior if interior > 0.0 else LEAST_SPREAD,
    )  # fmt: skip


def _cast(descriptor: Descriptor, light: str) -> float:
    """The share of what is seen that is taken to lie in cast shadow."""
    facts = descriptor.lights.get(light)
    return max(UNKNOWN.share if facts is None else facts.cast_share, HALF_A_HIT)


def manner_of(descriptor: Descriptor, step: Step) -> Manner:
    """What a step's errors are told by: its algorithm, and for a sweep whether the ground is decimated."""
    return DECIMATED if step.algorithm == "sweep" and is_decimated(descriptor) else step.algorithm


def kinds_of_step(descriptor: Descriptor, light: str, step: Step) -> list[tuple[CasterKind, Casting]]:
    """What a step's kinds of casters throw on what is seen; ``UNKNOWN`` where the descriptor says nothing of the light."""
    casts = descriptor.lights[light].casts if light in descriptor.lights else {}
    return [(kind, casts.get(kind, UNKNOWN)) for kind in step.kinds if not casts or kind in casts]


def _of_kind(descriptor: Descriptor, light: str, step: Step, kind: CasterKind, casting: Casting, model: ErrorModel) -> float:
    """The share of all that is seen that one kind's shadows are wrong on."""
    if step.algorithm == "planar":
        return casting.share if casting.on_bodies is None else max(casting.on_bodies, HALF_A_HIT)
    wrong = 0.0
    for band in casting.bands:
        texel_px = texel_px_of(descriptor, light, step, band, model.perspective)
        if texel_px > 0.0:
            wrong += band.share * _differs(band, texel_px) * model.counted[kind].of(texel_px)
    return wrong


def texel_px_of(descriptor: Descriptor, light: str, step: Step, band: CastBand, perspective: float) -> float:
    """A texel's side in a band in pixels, across the light (the geometric mean of both sides); 0 without texels. ``perspective`` is
    ``ErrorModel.perspective``.
    """
    settings = step.settings
    if isinstance(settings, ShadowMapSettings):
        ends = (cascade.far_m for cascade in settings.cascades[:-1])
        number = sum(1 for end in ends if end is not None and band.near_m >= end * (1.0 - 1e-9))
        right, up = settings.cascades[number].texel_m
        return sqrt(right * up) / band.pixel_m
    if isinstance(settings, LampMapSettings):
        return _uniform_px(descriptor, light, band) / settings.map_size
    if isinstance(settings, PerspectiveMapSettings):
        seen_px = perspective * sqrt(descriptor.rows * descriptor.cols)
        return min(seen_px, _uniform_px(descriptor, light, band)) / settings.map_size
    return 0.0


def _uniform_px(descriptor: Descriptor, light: str, band: CastBand) -> float:
    """What one uniform map of the light covers along a side, in pixels of a band."""
    lamp = next((lamp for lamp in descriptor.lamps if lamp.name == light), None)
    if light == SUN or lamp is None:
        right, up, _ = descriptor.receivers_light_m or (band.pixel_m, band.pixel_m, 0.0)
        return sqrt(right * up) / band.pixel_m
    tangent = 1.0 if lamp.kind == "omni" else tan(radians(lamp.cutoff_deg))
    return 2.0 * tangent * (band.light_m or lamp.reference_m) / band.pixel_m


@kept("process", MIB)
def pooled(differs: tuple[float, ...]) -> tuple[float, ...]:
    """``differs`` with less chance in it: what differs grows about as a texel's side does, so each texel's is told by the next
    ``POOLED`` together, of which the larger ones count most of what was seen.
    """
    sides = [sum(TEXEL_LADDER_PX[k : k + POOLED]) for k in range(len(TEXEL_LADDER_PX))]
    seen = [sum(differs[k : k + POOLED]) for k in range(len(TEXEL_LADDER_PX))]
    return tuple(min(px * part / whole, 1.0) for px, part, whole in zip(TEXEL_LADDER_PX, seen, sides, strict=True))


def _differs(band: CastBand, texel_px: float) -> float:
    """``differs`` between the texels of the ladder; below the least in proportion."""
    differs = pooled(band.differs)
    if texel_px <= TEXEL_LADDER_PX[0]:
        return differs[0] * texel_px / TEXEL_LADDER_PX[0]
    above = bisect(TEXEL_LADDER_PX, texel_px)
    if above == len(TEXEL_LADDER_PX):
        return differs[-1]
    low, high = TEXEL_LADDER_PX[above - 1], TEXEL_LADDER_PX[above]
    share = log2(texel_px / low) / log2(high / low)
    return differs[above - 1] * (1.0 - share) + differs[above] * share
