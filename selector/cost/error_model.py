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
from math import log, log2

from pydantic import BaseModel, ConfigDict, Field

from skugga.selector.belief import SharedVariance, logistic_chance_over
from skugga.selector.cost.unmeasured import NO_ERRORS, UnmeasuredError
from skugga.shadows.algorithm import ErrorConstants
from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.truth.metrics import MOST_INTERIOR
from skugga.terrain.cache import MIB, cached
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_LADDER_PX, CastBand, Casting
from skugga.terrain.facts.probes import HALF_A_HIT
from skugga.terrain.level.level import CasterKind

UNKNOWN_CASTING = Casting(
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


def error_groups() -> tuple[str, ...]:
    """Everything that errors are told by: algorithms, and where it makes a difference kinds of views of one."""
    more = [group for each in ALGORITHMS.values() for group in each.error_groups if group != each.name]
    return (*ALGORITHMS, *more)


@dataclass(frozen=True)
class ExpectedErrors:
    """Expected shares, as ``skugga.shadows.truth.metrics`` counts them: ``wrong`` of all pixels, ``wrong_cast`` of the cast shadow,
    and ``interior``; ``spread`` and ``interior_spread`` are the scales by which the logarithms of the latter two scatter.
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
        error = logistic_chance_over(log_error(self.wrong_cast) - log_error(max_error), self.spread)
        inside = logistic_chance_over(log_interior(self.interior) - log_interior(MOST_INTERIOR), self.interior_spread)
        return max(error, inside)  # what is wrong inside is wrong besides


def log_error(error: float) -> float:
    """The logarithm by which errors are compared."""
    return log(error + LEAST)


def log_interior(interior: float) -> float:
    """That by which interior errors are."""
    return log(interior + LEAST_INTERIOR)


class SharedErrors(BaseModel):
    """How much of what real figures are off the expected ones is common to the candidates of a view."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    error: SharedVariance
    interior: SharedVariance
    time: SharedVariance


class HillCurve(BaseModel):
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
    and ``interior_spread`` the scales of both about what is expected. ``time_spread`` is that of times about those that a
    calibration expects, and ``shared`` how much of all three the candidates of a view have in common.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    counted: dict[CasterKind, HillCurve]
    perspective: float = Field(gt=0)
    floor: dict[str, float]
    interior: dict[str, float]
    spread: dict[str, float]
    interior_spread: dict[str, float]
    time_spread: float = Field(gt=0)
    shared: SharedErrors

    def constants(self, group: str) -> ErrorConstants | None:
        """Those of an error group; ``None`` where nothing was fitted."""
        tables = (self.floor, self.interior, self.spread, self.interior_spread)
        return None if any(group not in table for table in tables) else ErrorConstants(*(table[group] for table in tables))


@cached("process", MIB)
def packaged_model() -> ErrorModel:
    """The constants that come with the package."""
    return ErrorModel.model_validate_json(files("skugga.selector.cost").joinpath("error_model.json").read_text(encoding="utf-8"))


def expected_errors(descriptor: Descriptor, light: str, steps: Sequence[Step], model: ErrorModel | None = None) -> ExpectedErrors:
    """What the steps of a light are expected to get wrong together."""
    model = model or packaged_model()
    return errors_together(descriptor, light, [(step, wrong_of_step(descriptor, light, step, model)) for step in steps], model)


def error_group_of(descriptor: Descriptor, step: Step) -> str:
    """What a step's errors are told by."""
    return ALGORITHMS[step.algorithm].error_group(descriptor)


def constants_of(descriptor: Descriptor, step: Step, model: ErrorModel) -> ErrorConstants | None:
    """The constants of a step's error group; ``None`` where nothing was fitted, and its algorithm brings none."""
    group = error_group_of(descriptor, step)
    return model.constants(group) or ALGORITHMS[step.algorithm].accuracy.constants.get(group)


def wrong_of_step(descriptor: Descriptor, light: str, step: Step, model: ErrorModel) -> float:
    """The share of all that is seen that a step is expected to get wrong. Raises as ``errors_together`` does."""
    floor = _constants(descriptor, step, model).floor * _cast(descriptor, light)
    return floor + sum(
        _of_kind(descriptor, light, step, *kind_casting, model) for kind_casting in kinds_of_step(descriptor, light, step)
    )


def errors_together(
    descriptor: Descriptor, light: str, wrong_of: Iterable[tuple[Step, float]], model: ErrorModel
) -> ExpectedErrors:
    """The errors of steps, each with the share that it gets wrong. Raises ``UnmeasuredError`` for one without constants."""
    wrong = interior = spread = interior_spread = 0.0
    for step, step_wrong in wrong_of:
        constants = _constants(descriptor, step, model)
        inside = step_wrong * constants.interior
        wrong, spread = wrong + step_wrong, spread + step_wrong * constants.spread
        interior, interior_spread = interior + inside, interior_spread + inside * constants.interior_spread
    return ExpectedErrors(
        min(wrong, 1.0), min(wrong / _cast(descriptor, light), 1.0), min(interior, 1.0),
        spread / wrong if wrong > 0.0 else LEAST_SPREAD, interior_spread / interior if interior > 0.0 else LEAST_SPREAD,
    )  # fmt: skip


def _constants(descriptor: Descriptor, step: Step, model: ErrorModel) -> ErrorConstants:
    found = constants_of(descriptor, step, model)
    if found is None:
        raise UnmeasuredError(step.algorithm, NO_ERRORS)
    return found


def _cast(descriptor: Descriptor, light: str) -> float:
    """The share of what is seen that is taken to lie in cast shadow."""
    facts = descriptor.lights.get(light)
    return max(UNKNOWN_CASTING.share if facts is None else facts.cast_share, HALF_A_HIT)


def kinds_of_step(descriptor: Descriptor, light: str, step: Step) -> list[tuple[CasterKind, Casting]]:
    """What a step's kinds of casters throw on what is seen; ``UNKNOWN_CASTING`` where the descriptor says nothing of the light."""
    casts = descriptor.lights[light].casts if light in descriptor.lights else {}
    return [(kind, casts.get(kind, UNKNOWN_CASTING)) for kind in step.kinds if not casts or kind in casts]


def _of_kind(descriptor: Descriptor, light: str, step: Step, kind: CasterKind, casting: Casting, model: ErrorModel) -> float:
    """The share of all that is seen that one kind's shadows are wrong on."""
    accuracy = ALGORITHMS[step.algorithm].accuracy
    if accuracy.wrong_share is not None:
        return accuracy.wrong_share(casting)
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
    texel_px = ALGORITHMS[step.algorithm].accuracy.texel_px
    return 0.0 if texel_px is None else texel_px(descriptor, light, step.settings, band, perspective)


@cached("process", MIB)
def smoothed_ladder(differs: tuple[float, ...]) -> tuple[float, ...]:
    """``differs`` with less chance in it: what differs grows about as a texel's side does, so each texel's is told by the next
    ``POOLED`` together, of which the larger ones count most of what was seen.
    """
    sides = [sum(TEXEL_LADDER_PX[k : k + POOLED]) for k in range(len(TEXEL_LADDER_PX))]
    window_sums = [sum(differs[k : k + POOLED]) for k in range(len(TEXEL_LADDER_PX))]
    return tuple(
        min(px * part / window_side, 1.0) for px, part, window_side in zip(TEXEL_LADDER_PX, window_sums, sides, strict=True)
    )


def _differs(band: CastBand, texel_px: float) -> float:
    """``differs`` between the texels of the ladder; below the least in proportion."""
    differs = smoothed_ladder(band.differs)
    if texel_px <= TEXEL_LADDER_PX[0]:
        return differs[0] * texel_px / TEXEL_LADDER_PX[0]
    above = bisect(TEXEL_LADDER_PX, texel_px)
    if above == len(TEXEL_LADDER_PX):
        return differs[-1]
    low, high = TEXEL_LADDER_PX[above - 1], TEXEL_LADDER_PX[above]
    share = log2(texel_px / low) / log2(high / low)
    return differs[above - 1] * (1.0 - share) + differs[above] * share
