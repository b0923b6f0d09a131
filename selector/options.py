"""The options (choices of algorithms and settings) for a light, with estimates of their times and errors.

Observations of some options correct the estimates of all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import exp, log

from skugga.selector.choices import Choice
from skugga.selector.cost.cost_model import predicted_ms
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import (
    ERROR_OFFSET,
    INTERIOR_OFFSET,
    ErrorModel,
    ExpectedErrors,
    combine_errors,
    log_error,
    log_interior,
    packaged_model,
    step_wrong_share,
)
from skugga.selector.cost.unmeasured import UnmeasuredError
from skugga.selector.expected_loss import Forecast
from skugga.selector.gaussian_estimate import GaussianEstimate
from skugga.selector.observation import Observation
from skugga.selector.planner.planner import SETTING_NAMES, Planner
from skugga.selector.portfolio import portfolio
from skugga.selector.ranking import CandidateFigures
from skugga.shadows.plan import Step
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind, Shadows

HARD_EDGES = ("filter", 1)
"""The shadow setting, and its value, that leave shadow edges unfiltered."""

MIN_MS = 1e-6
"""Lower bound in milliseconds of a time before its logarithm is taken."""


@dataclass(frozen=True)
class PredictedChoice:
    """A choice of algorithms and settings for a light, with its predicted time and errors.

    Attributes
    ----------
    choice
        The choice.
    steps
        The steps of the choice: calls of algorithms, each for some kinds of casters.
    ms
        Expected time, milliseconds.
    errors
        Expected errors.
    """

    choice: Choice
    steps: tuple[Step, ...]
    ms: float
    errors: ExpectedErrors

    @property
    def algorithms(self) -> frozenset[AlgorithmName]:
        """The names of the algorithms of all steps."""
        return frozenset(step.algorithm for step in self.steps)

    @property
    def algorithm_family(self) -> tuple[tuple[object, ...], ...]:
        """The algorithms, each with its kinds of casters. Choices with the same family differ only in their settings."""
        return tuple((step.algorithm, step.kinds) for step in self.steps)


@dataclass(frozen=True, eq=False)
class LightOptions:
    """The options (choices of algorithms and settings) for a light, with estimates of their times and errors.

    Attributes
    ----------
    options
        The options. The number of an option is its index in this tuple.
    error
        Joint distribution of the logarithms of the options' errors.
    interior
        Joint distribution of the logarithms of their interior errors (wrong pixels far from shadow edges).
    time
        Joint distribution of the logarithms of their times.
    observations
        Observations by number of the option.
    refused
        Numbers of the options that their algorithms refused to draw.
    """

    options: tuple[PredictedChoice, ...]
    error: GaussianEstimate
    interior: GaussianEstimate
    time: GaussianEstimate
    observations: Mapping[int, Observation] = field(default_factory=dict)
    refused: frozenset[int] = frozenset()

    @classmethod
    def expected(cls, options: Sequence[PredictedChoice], model: ErrorModel | None = None) -> LightOptions:
        """Return the options with the distributions that the models predict, before any observation."""
        model = model or packaged_model()
        families, errors, shared = (
            [option.algorithm_family for option in options],
            [option.errors for option in options],
            model.shared,
        )
        return cls(
            tuple(options),
            GaussianEstimate.prior(
                [log_error(prediction.wrong_cast) for prediction in errors],
                [prediction.spread for prediction in errors],
                families,
                shared.error,
            ),
            GaussianEstimate.prior(
                [log_interior(prediction.interior) for prediction in errors],
                [prediction.interior_spread for prediction in errors],
                families,
                shared.interior,
            ),
            GaussianEstimate.prior(
                [log(max(option.ms, MIN_MS)) for option in options], [model.time_spread] * len(options), families, shared.time
            ),
        )

    def with_observations(self, observations: Iterable[Observation]) -> LightOptions:
        """Return the options with estimates that observations correct.

        ``self.observations`` then holds the last observation of each option. Observations of choices that are not options are
        ignored.
        """
        numbers = {option.choice.name: number for number, option in enumerate(self.options)}
        posterior = self
        for observation in observations:
            if observation.choice in numbers:
                option_index = numbers[observation.choice]
                posterior = replace(
                    posterior,
                    error=posterior.error.after_observation(option_index, log_error(observation.error), observation.error_noise),
                    interior=posterior.interior.after_observation(
                        option_index, log_interior(observation.interior), observation.interior_noise
                    ),
                    time=posterior.time.after_observation(option_index, log(max(observation.ms, MIN_MS)), observation.ms_noise),
                    observations={**posterior.observations, option_index: observation},
                )
        return posterior

    def figures(self, option_index: int) -> CandidateFigures:
        """Return the expected time and errors of the option with the number ``option_index``, an index of ``options``."""
        error, interior = exp(self.error.mean[option_index]) - ERROR_OFFSET, exp(self.interior.mean[option_index]) - INTERIOR_OFFSET
        return CandidateFigures(
            self.options[option_index].choice.name,
            exp(self.time.mean[option_index]),
            min(max(error, 0.0), 1.0),
            min(max(interior, 0.0), 1.0),
        )

    def wrong(self, option_index: int) -> float:
        """Return the expected share, in [0, 1], of all pixels that are wrong with the option number ``option_index``."""
        errors = self.options[option_index].errors
        return (
            min(errors.wrong * self.figures(option_index).error / errors.wrong_cast, 1.0)
            if errors.wrong_cast > 0.0
            else errors.wrong
        )

    def miss_chance(self, option_index: int, max_error: float) -> float:
        """Return the probability, in [0, 1], that an option exceeds an error limit.

        The limits are ``max_error`` for the error and ``MAX_INTERIOR_SHARE`` for the interior error.
        """
        error = self.error.probability_over(option_index, log_error(max_error))
        inside = self.interior.probability_over(option_index, log_interior(MAX_INTERIOR_SHARE))
        return max(error, inside)  # interior errors are errors, too

    def forecast(self, option_index: int, max_error: float) -> Forecast:
        """Return the forecast of an option: its time and errors, and its probability of an error over the limit."""
        return Forecast(self.figures(option_index), self.miss_chance(option_index, max_error), self.time.scale(option_index))

    def forecasts(self, max_error: float) -> list[Forecast]:
        """Return the forecasts of all options that are not refused."""
        return [self.forecast(option_index, max_error) for option_index in self.numbers]

    @property
    def numbers(self) -> list[int]:
        """The numbers of the options that are not refused."""
        return [option_index for option_index in range(len(self.options)) if option_index not in self.refused]

    def number(self, name: str) -> int:
        """Return the number of the option whose choice has the given name."""
        return next(option_index for option_index, option in enumerate(self.options) if option.choice.name == name)


def predicted_choices(
    planner: Planner,
    light: str,
    kinds: Sequence[CasterKind],
    device: DeviceProfile,
    errors: ErrorModel | None = None,
    unmeasured: dict[AlgorithmName, str] | None = None,
) -> list[PredictedChoice]:
    """Return the options for a light and some kinds of casters, with their predicted times and errors.

    No two of them have the same steps. Options that ignore a requested setting are left out if others do not ignore it. So are
    options with an algorithm that cannot be predicted. The reasons are added to ``unmeasured`` by algorithm.
    """
    descriptor, model = planner.descriptor, errors or packaged_model()
    options: dict[tuple[object, ...], PredictedChoice] = {}
    predictions: dict[object, tuple[float, float]] = {}
    for choice in portfolio(descriptor, light, kinds, planner.requested_shadows):
        steps = planner.steps(light, choice)
        # Many choices share steps. A planner returns equal settings as one object, and comparing values is slow.
        keys = tuple((step.algorithm, step.kinds, id(step.settings)) for step in steps)
        if keys in options:
            continue
        try:
            for key, step in zip(keys, steps, strict=True):
                if key not in predictions:
                    ms = predicted_ms(device, descriptor, light, step.kinds, step.algorithm, step.settings)
                    predictions[key] = ms, step_wrong_share(descriptor, light, step, model)
        except UnmeasuredError as error:
            if unmeasured is not None:
                unmeasured[error.algorithm] = error.reason
            continue
        wrong_shares = [(step, predictions[key][1]) for key, step in zip(keys, steps, strict=True)]
        options[keys] = PredictedChoice(
            choice, steps, sum(predictions[key][0] for key in keys), combine_errors(descriptor, light, wrong_shares, model)
        )
    return _with_requested_settings(list(options.values()), planner.requested_shadows)


def _with_requested_settings(options: list[PredictedChoice], shadows: Shadows) -> list[PredictedChoice]:
    """Return the options that serve most of the requested settings, such as a map size. Each counts once for a kind of casters."""
    requested_settings = {
        key: value
        for key in SETTING_NAMES
        if (value := getattr(shadows, key)) != "auto" and (key, value) != HARD_EDGES  # every algorithm has hard edges
    }
    served_counts = [
        sum(
            len(step.kinds)
            for step in option.steps
            for key, value in requested_settings.items()
            if step.settings is not None and step.settings.as_overrides.get(key) == value
        )
        for option in options
    ]
    return [option for option, count in zip(options, served_counts, strict=True) if count == max(served_counts)]
