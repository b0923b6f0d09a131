"""Predict errors of a plan's steps from the descriptor: analytic predictors, with a few fitted constants.

**Maps.** A nearest look-up returns the visibility at a texel's centre instead of the point's own. ``CastBand.differs`` has the
measured frequency of a difference in the scene: for displacements within a texel, for texels of many sizes, by distance from the
eye. The side of a texel follows from the settings. It is the side in light space divided by that of a pixel: a cascade's, or the
light cone's at the lamp's distance (J. Sindholt's equation 1, solved for the texel). Only a part of the differing pixels counts as
wrong: pixels on a shadow's edge are not decidable, and filter taps smooth the stairs. That part, ``counted``, grows with the texel
from 0 to 1. A perspective map's texels follow the picture's pixels: ``perspective`` of them cover a pixel's side if the map has as
many texels as the picture has pixels. They are never larger than those of a uniform map.

**Planar** shadows are right on the ground only: cast shadow on bodies is wrong. **All other algorithms** are exact except for a
constant floor. The floor is high where a perspective view's ground is swept with fewer triangles than its nodes have.

The model includes its uncertainty: the logarithm of an error has a logistic distribution around the expected value, with a fitted
scale. The probability of a missed target follows from it.

`benchmarks/selection` fits the constants to measured views.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from math import log, log2

from pydantic import BaseModel, ConfigDict, Field

from skugga.selector.cost.unmeasured import NO_ERRORS, UnmeasuredError
from skugga.selector.gaussian_estimate import SharedVariance, logistic_probability_over
from skugga.shadows.algorithm import ErrorConstants
from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.truth.metrics import MAX_INTERIOR
from skugga.terrain.cache import MIB, cached
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX, CastBand, Casting
from skugga.terrain.facts.probes import MIN_CAST_SHARE
from skugga.terrain.level.level import CasterKind

ASSUMED_CASTING = Casting(
    share=0.1,
    bands=(
        CastBand(near_m=0.0, share=1.0, cast=0.1, pixel_m=1.0, differs=tuple(min(0.005 * px, 0.1) for px in TEXEL_SIZES_PX)),
    ),
)  # fmt: skip
"""Assumed shadows without facts in the descriptor: a tenth of the visible surface, with an edge every hundred pixels."""

POOLED_SIZES = 3
"""Number of texel sizes that are averaged for each size."""

ERROR_OFFSET, INTERIOR_OFFSET = 1e-3, 1e-5
"""Offsets of errors and interior errors before the logarithm."""

MIN_SPREAD = 0.05
"""Lower bound of the scale of every algorithm."""


def error_groups() -> tuple[str, ...]:
    """Return the groups with fitted constants: algorithms, and kinds of views of an algorithm where they differ."""
    view_groups = [group for algorithm in ALGORITHMS.values() for group in algorithm.error_groups if group != algorithm.name]
    return (*ALGORITHMS, *view_groups)


@dataclass(frozen=True)
class ExpectedErrors:
    """Expected errors as ``skugga.shadows.truth.metrics`` defines them.

    Attributes
    ----------
    wrong
        Share of all pixels, in [0, 1].
    wrong_cast
        Share of the cast shadow, in [0, 1].
    interior
        Interior error, in [0, 1].
    spread
        Scale of the logarithm of ``wrong_cast``.
    interior_spread
        Scale of the logarithm of ``interior``.
    """

    wrong: float
    wrong_cast: float
    interior: float
    spread: float
    interior_spread: float

    def probability_over(self, max_error: float) -> float:
        """Return the probability, in [0, 1], that a picture misses a limit.

        The limits are ``max_error`` for the wrong share of the cast shadow, and ``MAX_INTERIOR`` for the interior error.
        """
        error = logistic_probability_over(log_error(self.wrong_cast) - log_error(max_error), self.spread)
        inside = logistic_probability_over(log_interior(self.interior) - log_interior(MAX_INTERIOR), self.interior_spread)
        return max(error, inside)  # interior errors are errors, too


def log_error(error: float) -> float:
    """Return the logarithm of an error, with an offset."""
    return log(error + ERROR_OFFSET)


def log_interior(interior: float) -> float:
    """Return the logarithm of an interior error, with an offset."""
    return log(interior + INTERIOR_OFFSET)


class SharedErrors(BaseModel):
    """Shares of the models' errors that the candidates of a view have in common."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    error: SharedVariance
    interior: SharedVariance
    time: SharedVariance


class HillCurve(BaseModel):
    """Share of the pixels with differing look-ups that are wrong, by texel size.

    It is ``most / (1 + (half_px / texel_px) ** steepness)``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    most: float = Field(gt=0)
    half_px: float = Field(gt=0)
    steepness: float = Field(gt=0)

    def of(self, texel_px: float) -> float:
        return self.most / (1.0 + (self.half_px / max(texel_px, 1e-9)) ** self.steepness)


class ErrorModel(BaseModel):
    """The fitted constants of the error model.

    ``counted`` is by kind of casters. ``perspective`` is the number of a perspective map's texels a pixel's side. ``floor`` is each
    algorithm's share of wrong cast shadow at any resolution. ``interior`` is the share of the wrong pixels that are interior
    errors. ``spread`` and ``interior_spread`` are the scales of both around their expected values. ``time_spread`` is the scale of
    times around those of a calibration. ``shared`` has the shares that the candidates of a view have in common.
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
        """Return the constants of an error group; ``None`` if none were fitted."""
        tables = (self.floor, self.interior, self.spread, self.interior_spread)
        return None if any(group not in table for table in tables) else ErrorConstants(*(table[group] for table in tables))


@cached("process", MIB)
def packaged_model() -> ErrorModel:
    """Return the error model of the package."""
    return ErrorModel.model_validate_json(files("skugga.selector.cost").joinpath("error_model.json").read_text(encoding="utf-8"))


def expected_errors(descriptor: Descriptor, light: str, steps: Sequence[Step], model: ErrorModel | None = None) -> ExpectedErrors:
    """Return the expected errors of all steps of a light together."""
    model = model or packaged_model()
    return combine_errors(descriptor, light, [(step, step_wrong_share(descriptor, light, step, model)) for step in steps], model)


def error_group_of(descriptor: Descriptor, step: Step) -> str:
    """Return the error group of a step."""
    return ALGORITHMS[step.algorithm].error_group(descriptor)


def constants_of(descriptor: Descriptor, step: Step, model: ErrorModel) -> ErrorConstants | None:
    """Return the constants of a step's error group; ``None`` if none were fitted and its algorithm has none."""
    group = error_group_of(descriptor, step)
    return model.constants(group) or ALGORITHMS[step.algorithm].accuracy.constants.get(group)


def step_wrong_share(descriptor: Descriptor, light: str, step: Step, model: ErrorModel) -> float:
    """Return the share of all visible points that a step is expected to get wrong. Raises the errors of ``combine_errors``."""
    floor = _constants(descriptor, step, model).floor * _cast_share(descriptor, light)
    return floor + sum(
        _wrong_share_of_kind(descriptor, light, step, *kind_casting, model)
        for kind_casting in step_castings(descriptor, light, step)
    )


def combine_errors(
    descriptor: Descriptor, light: str, step_shares: Iterable[tuple[Step, float]], model: ErrorModel
) -> ExpectedErrors:
    """Return the errors of steps, each with its wrong share. Raises ``UnmeasuredError`` for a step without constants."""
    wrong_share = interior = spread = interior_spread = 0.0
    for step, step_wrong in step_shares:
        constants = _constants(descriptor, step, model)
        inside = step_wrong * constants.interior
        wrong_share, spread = wrong_share + step_wrong, spread + step_wrong * constants.spread
        interior, interior_spread = interior + inside, interior_spread + inside * constants.interior_spread
    return ExpectedErrors(
        min(wrong_share, 1.0), min(wrong_share / _cast_share(descriptor, light), 1.0), min(interior, 1.0),
        spread / wrong_share if wrong_share > 0.0 else MIN_SPREAD, interior_spread / interior if interior > 0.0 else MIN_SPREAD,
    )  # fmt: skip


def _constants(descriptor: Descriptor, step: Step, model: ErrorModel) -> ErrorConstants:
    constants = constants_of(descriptor, step, model)
    if constants is None:
        raise UnmeasuredError(step.algorithm, NO_ERRORS)
    return constants


def _cast_share(descriptor: Descriptor, light: str) -> float:
    """Return the share of the visible surface in cast shadow, or an assumption about it."""
    facts = descriptor.lights.get(light)
    return max(ASSUMED_CASTING.share if facts is None else facts.cast_share, MIN_CAST_SHARE)


def step_castings(descriptor: Descriptor, light: str, step: Step) -> list[tuple[CasterKind, Casting]]:
    """Return the shadows of a step's kinds of casters; ``ASSUMED_CASTING`` if the descriptor has no facts of the light."""
    casts = descriptor.lights[light].casts if light in descriptor.lights else {}
    return [(kind, casts.get(kind, ASSUMED_CASTING)) for kind in step.kinds if not casts or kind in casts]


def _wrong_share_of_kind(
    descriptor: Descriptor, light: str, step: Step, kind: CasterKind, casting: Casting, model: ErrorModel
) -> float:
    """Return the share of all visible points where one kind's shadows are wrong."""
    accuracy = ALGORITHMS[step.algorithm].accuracy
    if accuracy.wrong_share is not None:
        return accuracy.wrong_share(casting)
    wrong_share = 0.0
    for band in casting.bands:
        texel_px = texel_px_of(descriptor, light, step, band, model.perspective)
        if texel_px > 0.0:
            wrong_share += band.share * _interpolated_difference(band, texel_px) * model.counted[kind].of(texel_px)
    return wrong_share


def texel_px_of(descriptor: Descriptor, light: str, step: Step, band: CastBand, perspective: float) -> float:
    """Return a texel's side in a band in pixels, across the light: the geometric mean of both sides. It is 0 without texels.

    ``perspective`` is ``ErrorModel.perspective``.
    """
    texel_px = ALGORITHMS[step.algorithm].accuracy.texel_px
    return 0.0 if texel_px is None else texel_px(descriptor, light, step.settings, band, perspective)


@cached("process", MIB)
def smoothed_ladder(differs: tuple[float, ...]) -> tuple[float, ...]:
    """Return ``differs`` with less noise.

    The differing share grows about in proportion to a texel's side. So each value is estimated from the next ``POOLED_SIZES`` sizes
    together; the larger ones have most of the observations.
    """
    sides = [sum(TEXEL_SIZES_PX[k : k + POOLED_SIZES]) for k in range(len(TEXEL_SIZES_PX))]
    window_sums = [sum(differs[k : k + POOLED_SIZES]) for k in range(len(TEXEL_SIZES_PX))]
    return tuple(
        min(px * part / window_side, 1.0) for px, part, window_side in zip(TEXEL_SIZES_PX, window_sums, sides, strict=True)
    )


def _interpolated_difference(band: CastBand, texel_px: float) -> float:
    """Interpolate ``differs`` between the texel sizes of the ladder. Below the smallest size it is proportional."""
    differs = smoothed_ladder(band.differs)
    if texel_px <= TEXEL_SIZES_PX[0]:
        return differs[0] * texel_px / TEXEL_SIZES_PX[0]
    above = bisect(TEXEL_SIZES_PX, texel_px)
    if above == len(TEXEL_SIZES_PX):
        return differs[-1]
    low, high = TEXEL_SIZES_PX[above - 1], TEXEL_SIZES_PX[above]
    share = log2(texel_px / low) / log2(high / low)
    return differs[above - 1] * (1.0 - share) + differs[above] * share
