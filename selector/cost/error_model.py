"""Predict the errors of a plan's steps from the descriptor (facts of a view): formulas with a few fitted constants.

A step is one call of an algorithm.

**Shadow maps.** A nearest-neighbour look-up returns the visibility at a texel's centre instead of the point's own.
``CastBand.differs`` holds how often the two differ in the scene, by texel size and by distance from the eye. The side of a texel in
pixels follows from the settings. It is the side in light space divided by that of a pixel. For the sun it depends on the cascade,
for a lamp on the width of the light cone at the lamp's distance (J. Sindholt's equation 1, solved for the texel). Only a part of
the differing pixels counts as wrong, since ground truth does not decide pixels on a shadow's edge, and filter taps smooth the edge.
This part, ``counted``, grows with the texel from 0 to its limit. A perspective shadow map (Stamminger and Drettakis 2002,
"Perspective shadow maps") has texels that follow the picture's pixels. ``perspective`` of them cover a pixel's side if the map has
as many texels as the picture has pixels. They are never larger than those of a uniform map.

**Planar** shadows are right on planes only. Cast shadow on bodies counts as wrong, which is an upper bound.

**All other algorithms** are exact except for a constant error, the floor. It is larger for sweeps in a perspective view whose
ground is drawn with fewer triangles.

**Dense woods.** Where most pixels show leaves in light and in shadow, ground truth decides few pixels, and the error is that of
``coverage``: the share of shadow in blocks of pixels. Wrong pixels of both signs cancel out in a block, so it is a fraction of
``wrong_cast``, and has a floor, the noise of truth. Such a view is known by how often visibility differs within half a pixel.

The model includes its uncertainty. The logarithm of an error has a logistic distribution around the expected value, with a fitted
scale. The probability that an error exceeds the requested limit follows from it.

`benchmarks/selection` fits the constants to measured views.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from math import hypot, log, log2

from pydantic import BaseModel, ConfigDict, Field

from skugga.selector.cost.unmeasured import NO_ERRORS_REASON, UnmeasuredError
from skugga.selector.gaussian_estimate import SharedVariance, logistic_probability_over
from skugga.shadows.algorithm import ErrorConstants
from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.terrain.cache import MIB, cached
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX, CastBand, Casting
from skugga.terrain.facts.probes import MIN_CAST_SHADOW_SHARE
from skugga.terrain.level.level import CasterKind

ASSUMED_CASTING = Casting(
    share=0.1,
    bands=(
        CastBand(near_m=0.0, share=1.0, cast=0.1, pixel_m=1.0, differs=tuple(min(0.005 * px, 0.1) for px in TEXEL_SIZES_PX)),
    ),
)  # fmt: skip
"""Assumed shadows without facts in the descriptor: a tenth of the visible surface, with an edge every hundred pixels."""

MIN_POOLED_TEXEL_SIZES = 3
"""Least number of texel sizes of ``CastBand.differs`` that are averaged for each size."""

MIN_POOLED_DIFFERENCE = 0.01
"""Least sum of ``CastBand.differs`` over the averaged sizes. Fewer differing probes do not tell a small share from none."""

DENSE_TEXEL_PX, MIN_DENSE_SHARE = 0.5, 0.118
"""Side of a texel in pixels, and the least share of visible points for which leaves make a look-up differ in a dense wood.

In measured dense woods, where truth decides less than half of the pixels, the share is 0.120 to 0.200. In all other views with
trees it is at most 0.117."""

ERROR_OFFSET, INTERIOR_OFFSET = 1e-3, 1e-5
"""Offsets that are added to errors and to interior errors before their logarithm is taken, so that 0 is allowed."""

MIN_SPREAD = 0.05
"""Lower bound of every fitted scale, and the scale of an error that is expected to be 0."""


def error_groups() -> tuple[str, ...]:
    """Return the names of the error groups, each with its own fitted constants.

    A group is an algorithm, or an algorithm in certain views if its errors differ there.
    """
    view_groups = [group for algorithm in ALGORITHMS.values() for group in algorithm.error_groups if group != algorithm.name]
    return (*ALGORITHMS, *view_groups)


@dataclass(frozen=True)
class ExpectedErrors:
    """Expected errors as ``skugga.shadows.truth.metrics`` defines them.

    Attributes
    ----------
    wrong
        Wrong share of all pixels, in [0, 1].
    wrong_cast
        Wrong share of the cast shadow, in [0, 1].
    interior
        Share of all pixels that are wrong far from shadow edges, in [0, 1].
    spread
        Scale of the logistic distribution of the logarithm of ``wrong_cast``.
    interior_spread
        Scale of the logistic distribution of the logarithm of ``interior``.
    is_coverage
        Whether ``wrong_cast`` is the error of ``coverage`` instead.
    """

    wrong: float
    wrong_cast: float
    interior: float
    spread: float
    interior_spread: float
    is_coverage: bool = False

    def probability_over(self, max_error: float) -> float:
        """Return the probability, in [0, 1], that the errors of a picture exceed a limit.

        The limits are ``max_error`` for the wrong share of the cast shadow, and ``MAX_INTERIOR_SHARE`` for the interior error.
        """
        error = logistic_probability_over(log_error(self.wrong_cast) - log_error(max_error), self.spread)
        inside = logistic_probability_over(log_interior(self.interior) - log_interior(MAX_INTERIOR_SHARE), self.interior_spread)
        return max(error, inside)  # interior errors are errors, too


def log_error(error: float) -> float:
    """Return the natural logarithm of an error plus ``ERROR_OFFSET``."""
    return log(error + ERROR_OFFSET)


def log_interior(interior: float) -> float:
    """Return the natural logarithm of an interior error plus ``INTERIOR_OFFSET``."""
    return log(interior + INTERIOR_OFFSET)


class SharedErrors(BaseModel):
    """Shares of the variance of the models' deviations that the candidates of a view have in common.

    ``error``, ``interior`` and ``time`` are those for the logarithms of the error, the interior error and the time.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    error: SharedVariance
    interior: SharedVariance
    time: SharedVariance


class HillCurve(BaseModel):
    """Share of wrong pixels among those whose shadow-map look-up differs from their own visibility, by texel size.

    It is ``most / (1 + (half_px / texel_px) ** steepness)``. ``half_px`` is the texel size in pixels with half of the limit
    ``most``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    most: float = Field(gt=0)
    half_px: float = Field(gt=0)
    steepness: float = Field(gt=0)

    def evaluate(self, texel_px: float) -> float:
        """Return the curve's value, in [0, ``most``), for texels with sides of ``texel_px`` pixels."""
        return self.most / (1.0 + (self.half_px / max(texel_px, 1e-9)) ** self.steepness)


class CoverageError(BaseModel):
    """The errors in dense woods.

    That of ``coverage`` is ``hypot(share * wrong_cast, floor)``. The interior error is ``interior`` times that of other views,
    because few pixels are far from all edges. ``spread`` and ``interior_spread`` are the scales of the logistic distributions of
    the logarithms of both.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    share: float = Field(gt=0)
    floor: float = Field(ge=0)
    spread: float = Field(gt=0)
    interior: float = Field(gt=0)
    interior_spread: float = Field(gt=0)


class ErrorModel(BaseModel):
    """The fitted constants of the error model. Those in ``floor`` to ``interior_spread`` are by error group.

    ``counted`` is the share of wrong pixels among those with a differing look-up, by kind of casters. ``perspective`` is the number
    of texels of a perspective shadow map along a pixel's side. ``floor`` is the wrong share of the cast shadow at any resolution.
    ``interior`` is the share of the wrong pixels that are interior errors (far from shadow edges). ``spread`` and
    ``interior_spread`` are the scales of the logistic distributions of the logarithms of error and interior error. ``time_spread``
    is that for times predicted from a calibration. ``shared`` holds the shares of variance that the candidates of a view have in
    common. ``coverage`` is ``None`` if no dense wood was measured: the error is then predicted as in other views.
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
    coverage: CoverageError | None = None

    def constants(self, group: str) -> ErrorConstants | None:
        """Return the constants of an error group; ``None`` if none were fitted."""
        tables = (self.floor, self.interior, self.spread, self.interior_spread)
        return None if any(group not in table for table in tables) else ErrorConstants(*(table[group] for table in tables))


@cached("process", MIB)
def packaged_model() -> ErrorModel:
    """Return the error model with the constants that the package contains."""
    return ErrorModel.model_validate_json(files("skugga.selector.cost").joinpath("error_model.json").read_text(encoding="utf-8"))


def expected_errors(descriptor: Descriptor, light: str, steps: Sequence[Step], model: ErrorModel | None = None) -> ExpectedErrors:
    """Return the expected errors of all steps (calls of algorithms) under a light together."""
    model = model or packaged_model()
    return combine_errors(descriptor, light, [(step, step_wrong_share(descriptor, light, step, model)) for step in steps], model)


def error_group_of(descriptor: Descriptor, step: Step) -> str:
    """Return the name of the error group (views and algorithms with common constants) of a step."""
    return ALGORITHMS[step.algorithm].error_group(descriptor)


def constants_of(descriptor: Descriptor, step: Step, model: ErrorModel) -> ErrorConstants | None:
    """Return the constants of a step's error group; ``None`` if none were fitted and its algorithm has none."""
    group = error_group_of(descriptor, step)
    return model.constants(group) or ALGORITHMS[step.algorithm].accuracy.error_constants.get(group)


def step_wrong_share(descriptor: Descriptor, light: str, step: Step, model: ErrorModel) -> float:
    """Return the expected share of visible points where a step (one call of an algorithm) is wrong.

    Raises the errors of ``combine_errors``.
    """
    floor = _constants(descriptor, step, model).floor * _cast_share(descriptor, light)
    return floor + sum(
        _wrong_share_of_kind(descriptor, light, step, *kind_casting, model)
        for kind_casting in step_castings(descriptor, light, step)
    )


def combine_errors(
    descriptor: Descriptor, light: str, step_shares: Iterable[tuple[Step, float]], model: ErrorModel
) -> ExpectedErrors:
    """Return the expected errors of several steps together.

    ``step_shares`` holds each step and the share of all visible points that it gets wrong. Raises ``UnmeasuredError`` for a step
    without constants.
    """
    wrong_share = interior = spread = interior_spread = 0.0
    for step, step_wrong in step_shares:
        constants = _constants(descriptor, step, model)
        inside = step_wrong * constants.interior
        wrong_share, spread = wrong_share + step_wrong, spread + step_wrong * constants.spread
        interior, interior_spread = interior + inside, interior_spread + inside * constants.interior_spread
    errors = ExpectedErrors(
        min(wrong_share, 1.0), min(wrong_share / _cast_share(descriptor, light), 1.0), min(interior, 1.0),
        spread / wrong_share if wrong_share > 0.0 else MIN_SPREAD, interior_spread / interior if interior > 0.0 else MIN_SPREAD,
    )  # fmt: skip
    coverage = model.coverage
    if coverage is None or not is_dense_wood(descriptor, light):
        return errors
    return ExpectedErrors(
        errors.wrong, min(hypot(coverage.share * errors.wrong_cast, coverage.floor), 1.0),
        min(coverage.interior * errors.interior, 1.0), coverage.spread, coverage.interior_spread, is_coverage=True,
    )  # fmt: skip


def is_dense_wood(descriptor: Descriptor, light: str) -> bool:
    """Return whether most pixels of a view show leaves in light and in shadow, so that its error is that of ``coverage``."""
    casting = descriptor.lights[light].casts.get("forest") if light in descriptor.lights else None
    if casting is None:
        return False
    size = TEXEL_SIZES_PX.index(DENSE_TEXEL_PX)
    return sum(band.share * band.differs[size] for band in casting.bands) >= MIN_DENSE_SHARE


def _constants(descriptor: Descriptor, step: Step, model: ErrorModel) -> ErrorConstants:
    """Return the constants of a step's error group. Raises ``UnmeasuredError`` if there are none."""
    constants = constants_of(descriptor, step, model)
    if constants is None:
        raise UnmeasuredError(step.algorithm, NO_ERRORS_REASON)
    return constants


def _cast_share(descriptor: Descriptor, light: str) -> float:
    """Return the share of the visible surface in cast shadow, an assumed one if unknown; at least ``MIN_CAST_SHADOW_SHARE``."""
    facts = descriptor.lights.get(light)
    return max(ASSUMED_CASTING.share if facts is None else facts.cast_share, MIN_CAST_SHADOW_SHARE)


def step_castings(descriptor: Descriptor, light: str, step: Step) -> list[tuple[CasterKind, Casting]]:
    """Return the kinds of casters whose shadows a plan's step draws, each with the facts about these shadows.

    The facts are ``ASSUMED_CASTING`` if the descriptor has no facts about the light.
    """
    casts = descriptor.lights[light].casts if light in descriptor.lights else {}
    return [(kind, casts.get(kind, ASSUMED_CASTING)) for kind in step.kinds if not casts or kind in casts]


def _wrong_share_of_kind(
    descriptor: Descriptor, light: str, step: Step, kind: CasterKind, casting: Casting, model: ErrorModel
) -> float:
    """Return the expected share of visible points where the shadows of one kind of casters are wrong."""
    accuracy = ALGORITHMS[step.algorithm].accuracy
    if accuracy.wrong_share is not None:
        return accuracy.wrong_share(casting)
    wrong_share = 0.0
    for band in casting.bands:
        texel_px = texel_px_of(descriptor, light, step, band, model.perspective)
        if texel_px > 0.0:
            wrong_share += band.share * _interpolated_difference(band, texel_px) * model.counted[kind].evaluate(texel_px)
    return wrong_share


def texel_px_of(descriptor: Descriptor, light: str, step: Step, band: CastBand, perspective: float) -> float:
    """Return the side of a step's shadow-map texel in a band of distances, in pixels; 0 for an algorithm without texels.

    It is the geometric mean of the texel's two sides, perpendicular to the light. ``perspective`` is ``ErrorModel.perspective``.
    """
    texel_px = ALGORITHMS[step.algorithm].accuracy.texel_px
    return 0.0 if texel_px is None else texel_px(descriptor, light, step.settings, band, perspective)


@cached("process", MIB)
def smoothed_differing_shares(differs: tuple[float, ...]) -> tuple[float, ...]:
    """Return the values of ``CastBand.differs`` with less sampling noise, one for each of ``TEXEL_SIZES_PX``.

    A value is the share of points whose shadow-map look-up differs. It grows about in proportion to the texel's side. So each value
    is estimated from this texel size and the next larger ones together: from ``MIN_POOLED_TEXEL_SIZES`` sizes, or from as many
    more as it takes until ``MIN_POOLED_DIFFERENCE`` of the probes differ. Larger texels give more observations of a difference.
    """
    shares = []
    for first, px in enumerate(TEXEL_SIZES_PX):
        end = first + MIN_POOLED_TEXEL_SIZES
        while end < len(TEXEL_SIZES_PX) and sum(differs[first:end]) < MIN_POOLED_DIFFERENCE:
            end += 1
        shares.append(min(px * sum(differs[first:end]) / sum(TEXEL_SIZES_PX[first:end]), 1.0))
    return tuple(shares)


def _interpolated_difference(band: CastBand, texel_px: float) -> float:
    """Return the share of a band's points whose shadow-map look-up differs, for texels of ``texel_px`` pixels a side.

    It is interpolated between ``TEXEL_SIZES_PX``. Below the smallest size it is proportional to the texel's side.
    """
    differs = smoothed_differing_shares(band.differs)
    if texel_px <= TEXEL_SIZES_PX[0]:
        return differs[0] * texel_px / TEXEL_SIZES_PX[0]
    above = bisect(TEXEL_SIZES_PX, texel_px)
    if above == len(TEXEL_SIZES_PX):
        return differs[-1]
    low, high = TEXEL_SIZES_PX[above - 1], TEXEL_SIZES_PX[above]
    share = log2(texel_px / low) / log2(high / low)
    return differs[above - 1] * (1.0 - share) + differs[above] * share
