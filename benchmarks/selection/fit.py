"""Fit the constants of the error model to measured views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from skugga.selector.choices import StandaloneRequest
from skugga.selector.cost.cost_model import predicted_ms
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import (
    ERROR_OFFSET,
    INTERIOR_OFFSET,
    MIN_SPREAD,
    CoverageError,
    ErrorModel,
    ExpectedErrors,
    HillCurve,
    SharedErrors,
    error_group_of,
    error_groups,
    expected_errors,
    log_error,
    log_interior,
    smoothed_differing_shares,
    step_castings,
    texel_px_of,
)
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.selector.planner.planner import planner_of
from skugga.selector.portfolio import portfolio
from skugga.shadows.maps.settings import PerspectiveMapSettings
from skugga.shadows.plan import Step
from skugga.shadows.registry import selectable_algorithms
from skugga.shadows.sweep.sweep import DECIMATED_GROUP
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX
from skugga.terrain.facts.probes import MIN_CAST_SHADOW_SHARE
from skugga.terrain.level.level import SUN, CasterKind, Shadows

Figures = dict[str, Any]
"""A measured view's record, or a row (measured plan) of it, by key."""

MAP_ALGORITHMS = ("shadow_map", "perspective_shadow_map")
EXACT_ALGORITHMS = ("shadow_volume", "hybrid", "sweep", DECIMATED_GROUP)

KINDS: tuple[CasterKind, ...] = ("relief", "meshes", "forest")
"""Kinds of casters in the order of the constants of the fit."""

INITIAL_CONSTANTS = (*(1.0, 4.0, 1.2) * len(KINDS), 1.3, 3e-4, 3e-4)
"""Start values of the fit. They are maximum, half and steepness for each kind of casters; pixels of a perspective map's texels at
the picture's own size; and the error floors of both kinds of maps."""

NARROWEST_PERSPECTIVE = 1e-9
"""A value of ``ErrorModel.perspective`` so small that perspective maps get narrower texels than a uniform map."""

PRIOR_WEIGHT = 0.1
"""Weight of the prior's residuals, which pull the logarithms of constants to those of ``INITIAL_CONSTANTS``."""

MIN_WRONG_SHARE = 5e-4
"""Least share of wrong pixels in rows to which the share of interior ones is fitted."""

USUAL_TIME_SPREAD = 0.2
"""Scale of the logistic distribution of log(measured / expected time) where no calibration is available."""

NO_SHARED_VARIANCE = SharedVariance(view=0.0, family=0.0)
"""Shares of a variance that no two plans have in common."""
INDEPENDENT_ERRORS = SharedErrors(error=NO_SHARED_VARIANCE, interior=NO_SHARED_VARIANCE, time=NO_SHARED_VARIANCE)

INITIAL_COVERAGE = 0.5, 0.01
"""The first guess of ``share`` and ``floor`` of ``CoverageError``."""

MAX_EXPONENT = 700.0
"""The largest argument of the exponential function in float64."""

LOG2_TEXEL_SIZES = np.log2(TEXEL_SIZES_PX)
"""Binary logarithms of the sides of texels in pixels, ``TEXEL_SIZES_PX``."""


@dataclass(frozen=True, eq=False)
class FitCase:
    """A measured plan of a view.

    Attributes
    ----------
    view
        Record of the view.
    descriptor
        Descriptor of the view.
    steps
        The plan's steps for the light.
    row
        The plan's entry in ``view["rows"]``: milliseconds (``ms``) and errors in [0, 1].
    """

    view: Figures
    descriptor: Descriptor
    steps: tuple[Step, ...]
    row: Figures

    @property
    def light(self) -> str:
        """Name of the measured light."""
        return self.view["light"]

    @property
    def error(self) -> float:
        """The measured error that targets limit, a share in [0, 1]."""
        return self.row[self.view["error"]]

    @property
    def algorithms(self) -> frozenset[str]:
        """Names of the algorithms of the steps."""
        return frozenset(step.algorithm for step in self.steps)

    @property
    def error_groups(self) -> frozenset[str]:
        """Names of the steps' error groups: algorithms that share constants of the error model."""
        return frozenset(error_group_of(self.descriptor, step) for step in self.steps)

    def expected(self, model: ErrorModel) -> ExpectedErrors:
        """Return the errors that a model expects of the plan."""
        return expected_errors(self.descriptor, self.light, self.steps, model)

    def expected_ms(self, device: DeviceProfile) -> float:
        """Return the milliseconds that the plan is expected to take on a device."""
        return sum(
            predicted_ms(device, self.descriptor, self.light, step.kinds, step.algorithm, step.settings) for step in self.steps
        )


def request_of(descriptor: Descriptor, shadows: Shadows | None = None) -> StandaloneRequest:
    """Return a planning request for a descriptor alone, without a level file.

    ``shadows`` holds the target; ``None`` is the default target.
    """
    return StandaloneRequest(shadows or Shadows(), (SUN, *(lamp.name for lamp in descriptor.lamps)))


def cases_of(view: Figures) -> list[FitCase]:
    """Return the measured plans of a view's choices, each plan once.

    A view without cast shadow gives an empty list, because errors are shares of cast shadow.
    """
    if view["error"] == "wrong":
        return []
    descriptor, light = Descriptor.model_validate(view["descriptor"]), view["light"]
    planner = planner_of(descriptor, request_of(descriptor))
    case_by_name: dict[str, FitCase] = {}
    for choice in portfolio(descriptor, light, planner.casting_kinds(light), planner.requested_shadows):
        name = view["picks"].get(choice.name)
        if name in view["rows"] and name not in case_by_name:
            case_by_name[name] = FitCase(view, descriptor, planner.steps(light, choice), view["rows"][name])
    return list(case_by_name.values())


def fit_model(cases: Sequence[FitCase], device: DeviceProfile | None = None) -> ErrorModel:
    """Return the error model whose constants fit measured plans.

    If ``device`` is the calibration of the device that measured them, constants for times are fitted too. Views whose errors are
    measured by coverage give only the constants of coverage, which depend on all other constants.
    """
    coverage_cases = [case for case in cases if case.view["error"] == "coverage"]
    cases = [case for case in cases if case.view["error"] != "coverage"]
    mapped = [
        case for case in cases if case.algorithms & set(MAP_ALGORITHMS) and not case.error_groups & {"planar", DECIMATED_GROUP}
    ]
    terms, measured = _Terms(mapped), np.log(np.array([case.error for case in mapped]) + ERROR_OFFSET)

    def deviations(logarithms: np.ndarray) -> np.ndarray:
        prior_residuals = PRIOR_WEIGHT * (
            logarithms - np.log(INITIAL_CONSTANTS)
        )  # constants without measurements stay where they are
        return np.concatenate([np.log(terms.expected(np.exp(logarithms)) + ERROR_OFFSET) - measured, prior_residuals])

    solution = least_squares(deviations, np.log(INITIAL_CONSTANTS), loss="soft_l1", bounds=(np.log(1e-5), np.log(1e3)))
    model = _model(np.exp(solution.x))
    by_itself = {name: [case.error for case in cases if case.error_groups == {name}] for name in EXACT_ALGORITHMS}
    floors = {
        name: float(np.exp(np.mean(np.log(np.array(own_shares) + ERROR_OFFSET))) - ERROR_OFFSET)
        for name, own_shares in by_itself.items()
        if own_shares
    }
    model = model.model_copy(update={"floor": model.floor | floors})
    inside, spread, inside_spread = {}, {}, {}
    for name in error_groups():
        with_it = [(case, case.expected(model)) for case in cases if name in case.error_groups]
        spread[name] = _scale([(case.error + ERROR_OFFSET) / (expected.wrong_cast + ERROR_OFFSET) for case, expected in with_it])
        interior_rows = [
            (case.row["interior"], expected.wrong) for case, expected in with_it if case.row["wrong"] > MIN_WRONG_SHARE
        ]
        shares = [(interior + INTERIOR_OFFSET) / (wrong_share + INTERIOR_OFFSET) for interior, wrong_share in interior_rows]
        inside[name] = float(np.exp(np.mean(np.log(shares)))) if shares else 0.0
        inside_spread[name] = _scale(np.array(shares) / inside[name] if shares else [])
    constants = {"floor": model.floor, "interior": inside, "spread": spread, "interior_spread": inside_spread}
    unmeasured = _unmeasured_groups(cases)
    model = model.model_copy(
        update={key: {name: x for name, x in values.items() if name not in unmeasured} for key, values in constants.items()}
    )
    errors = _Deviations.from_cases(
        cases,
        lambda case, expected_errors: (log_error(case.error) - log_error(expected_errors.wrong_cast)) / expected_errors.spread,
        model,
    )
    interiors = _Deviations.from_cases(
        cases,
        lambda case, expected_errors: (
            (log_interior(case.row["interior"]) - log_interior(expected_errors.interior)) / expected_errors.interior_spread
        ),
        model,
    )
    shared = model.shared.model_copy(update={"error": errors.shared, "interior": interiors.shared})
    if device is not None:
        times = _Deviations.from_cases(cases, lambda case, expected_errors: log(case.row["ms"] / case.expected_ms(device)), model)
        shared = shared.model_copy(update={"time": times.shared})
        model = model.model_copy(update={"time_spread": max(_scale(np.exp(times.deviations)), MIN_SPREAD)})
    return model.model_copy(update={"shared": shared, "coverage": _coverage_error(coverage_cases, model)})


def _coverage_error(cases: Sequence[FitCase], model: ErrorModel) -> CoverageError | None:
    """Return the constants of dense woods that fit the plans measured there; ``None`` if ``cases`` is empty.

    ``model`` has the other constants.
    """
    if not cases:
        return None
    expected = [case.expected(model) for case in cases]
    wrong_cast, interior = (np.array([getattr(errors, name) for errors in expected]) for name in ("wrong_cast", "interior"))
    coverage, measured_interior = np.array([(case.error, case.row["interior"]) for case in cases]).T
    ratios = (measured_interior + INTERIOR_OFFSET) / (interior + INTERIOR_OFFSET)
    factor = float(np.exp(np.mean(np.log(ratios))))

    def deviations(logarithms: np.ndarray) -> np.ndarray:
        share, floor = np.exp(logarithms)
        return np.log((np.hypot(share * wrong_cast, floor) + ERROR_OFFSET) / (coverage + ERROR_OFFSET))

    solution = least_squares(deviations, np.log(INITIAL_COVERAGE), loss="soft_l1").x
    share, floor = np.exp(solution)
    return CoverageError(
        share=share,
        floor=floor,
        spread=_scale(np.exp(deviations(solution))),
        interior=factor,
        interior_spread=_scale(ratios / factor),
    )


@dataclass(frozen=True, eq=False)
class _Deviations:
    """Differences between logarithms of a measured and an expected quantity (an error or a time), for n plans.

    Attributes
    ----------
    deviations
        Measured minus expected logarithm, float (n,), without unit. Differences of errors are divided by their expected spread.
    view_index
        Index of each plan's view, int (n,), in the order of first appearance.
    family_index
        Index of each plan's family, int (n,). Plans of a family have the same algorithms for the same caster kinds.
    """

    deviations: np.ndarray
    view_index: np.ndarray
    family_index: np.ndarray

    @classmethod
    def from_cases(
        cls, cases: Sequence[FitCase], deviation_of: Callable[[FitCase, ExpectedErrors], float], model: ErrorModel
    ) -> _Deviations:
        """Return the deviations of measured plans.

        ``deviation_of`` returns the deviation of a plan from the plan and the errors that ``model`` expects of it.
        """
        views: dict[int, int] = {}
        families: dict[object, int] = {}
        rows = [
            (
                deviation_of(case, case.expected(model)),
                views.setdefault(id(case.view), len(views)),
                families.setdefault(tuple((step.algorithm, step.kinds) for step in case.steps), len(families)),
            )
            for case in cases
        ]
        values, view, family = zip(*rows, strict=True)
        return cls(np.array(values), np.array(view), np.array(family))

    @property
    def shared(self) -> SharedVariance:
        """The shares of the variance that plans of a view have in common, and that those of the same family have in common besides.

        They follow from mean products of the deviations of two plans of a view. Each view has the same weight.
        """
        variance, other, same_family = [], [], []
        for number in np.unique(self.view_index):
            in_view = self.view_index == number
            deviations, family = self.deviations[in_view], self.family_index[in_view]
            products, alike = np.outer(deviations, deviations), family[:, None] == family
            off_diagonal = ~np.eye(len(deviations), dtype=bool)
            variance.append(np.mean(deviations**2))
            other += [np.mean(products[~alike])] if (~alike).any() else []
            same_family += [np.mean(products[alike & off_diagonal])] if (alike & off_diagonal).any() else []
        view = float(np.clip(np.mean(other) / np.mean(variance), 0.0, 1.0)) if other else 0.0
        family_covariance = float(np.clip(np.mean(same_family) / np.mean(variance), view, 1.0)) if same_family else view
        return SharedVariance(view=view, family=family_covariance - view)


class _Terms:
    """The expected errors of ``skugga.selector.cost.error_model``, split into terms that can be summed for many sets of constants.

    Each step of a plan has a term for each band of distance of each caster kind. Arrays have one entry for each of the n terms.
    """

    def __init__(self, cases: Sequence[FitCase]) -> None:
        rows: list[tuple[float, ...]] = []
        differs: list[tuple[float, ...]] = []
        self._maps = np.array([[float(name in case.algorithms) for name in MAP_ALGORITHMS] for case in cases])
        self._count = len(cases)
        for number, case in enumerate(cases):
            cast = max(case.descriptor.lights[case.light].cast_share, MIN_CAST_SHADOW_SHARE)
            for step in case.steps:
                for kind, casting in step_castings(case.descriptor, case.light, step):
                    for band in casting.bands:
                        follows = isinstance(step.settings, PerspectiveMapSettings)
                        fixed, narrow = (
                            texel_px_of(case.descriptor, case.light, step, band, px) for px in (1e9, NARROWEST_PERSPECTIVE)
                        )
                        if fixed > 0.0:
                            rows.append(
                                (
                                    number,
                                    KINDS.index(kind),
                                    band.share / cast,
                                    fixed,
                                    narrow / NARROWEST_PERSPECTIVE if follows else np.inf,
                                )
                            )
                            differs.append(smoothed_differing_shares(band.differs))
        columns = (np.array(column) for column in zip(*rows, strict=True))
        case_index, kind_index, self._share, self._max_texel_px, self._texel_px_factor = columns
        self._case_index, self._kind_index = case_index.astype(int), kind_index.astype(int)
        self._differs = np.array(differs)

    def expected(self, x: np.ndarray) -> np.ndarray:
        """Return the expected error ``wrong_cast`` of each plan, in [0, 1], for constants in the order of ``INITIAL_CONSTANTS``."""
        counts, perspective, floors = np.reshape(x[:-3], (len(KINDS), 3)), x[-3], x[-2:]
        texel = np.minimum(self._max_texel_px, perspective * self._texel_px_factor)
        histogram_index = np.clip(
            np.interp(np.log2(np.maximum(texel, 1e-9)), LOG2_TEXEL_SIZES, np.arange(len(LOG2_TEXEL_SIZES))),
            0,
            len(LOG2_TEXEL_SIZES) - 1,
        )
        low = np.minimum(histogram_index.astype(int), len(LOG2_TEXEL_SIZES) - 2)
        first, second = (np.take_along_axis(self._differs, (low + k)[:, None], axis=1)[:, 0] for k in (0, 1))
        differs = first + (second - first) * (histogram_index - low)
        differs = np.where(texel <= TEXEL_SIZES_PX[0], self._differs[:, 0] * texel / TEXEL_SIZES_PX[0], differs)
        maximum, half, steepness = counts[self._kind_index].T
        # The search tries steep curves, whose powers would overflow.
        powers = np.exp(np.minimum(steepness * np.log(half / np.maximum(texel, 1e-9)), MAX_EXPONENT))
        responses = maximum / (1.0 + powers)
        total = np.bincount(self._case_index, self._share * differs * responses, minlength=self._count)
        return np.minimum(total + self._maps @ floors, 1.0)


def _unmeasured_groups(cases: Sequence[FitCase]) -> set[str]:
    """Return the error groups of algorithms that can be chosen but have no case: no constants say how large their errors are."""
    measured = set().union(*(case.error_groups for case in cases))
    return {group for algorithm in selectable_algorithms() for group in algorithm.error_groups} - measured


def _model(x: np.ndarray) -> ErrorModel:
    """Return the error model with constants ``x`` in the order of ``INITIAL_CONSTANTS``. Its other constants are not fitted yet."""
    values = np.reshape(x[:-3], (len(KINDS), 3)).tolist()
    curves = {kind: HillCurve(most=a, half_px=b, steepness=c) for kind, (a, b, c) in zip(KINDS, values, strict=True)}
    floor = {name: x[-2 + MAP_ALGORITHMS.index(name)] if name in MAP_ALGORITHMS else 0.0 for name in error_groups()}
    zeros = dict.fromkeys(error_groups(), 0.0)
    return ErrorModel(
        counted=curves,
        perspective=x[-3],
        floor=floor,
        interior=zeros,
        spread=zeros,
        interior_spread=zeros,
        time_spread=USUAL_TIME_SPREAD,
        shared=INDEPENDENT_ERRORS,
    )  # type: ignore[arg-type]


def _scale(ratios: Sequence[float]) -> float:
    """Return the scale of a logistic distribution that fits the logarithms of some ratios.

    Both have the same central interval of nine tenths.
    """
    deviations = float(np.quantile(np.abs(np.log(ratios)), 0.9)) if len(ratios) else 0.0
    return float(max(deviations / np.log(19.0), MIN_SPREAD))
