"""Trials of candidates: a plan drawn on the view, or on every n-th pixel of it, and held against truth there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from selector.choices import Choice
from selector.measure.subsampled import SubsampledTruth, subsampled_truth
from selector.measure.view_truth import ErrorName, View, ViewTruth, truth_of_parts, truth_of_view
from selector.ranking import CandidateFigures
from shadows.plan import Plan, Step
from shadows.render import Frame, bands_of, render_frame
from shadows.visibility import with_apparent_sun
from terrain.cache import clear_caches
from terrain.gbuffer.subsampled import subsampled_view
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import BLOCK_PX, MapView, blocks_of
from terrain.scene import Scene

TRIAL_PIXELS = 80_000
"""Pixels that candidates are drawn on, about."""

DRAWN, LONG_MS = 2, 1000.0
"""Candidates are drawn so often, if that takes less than this: the least time counts, since what else a machine does, and what is
made once, only ever adds to it.
"""


@dataclass(frozen=True)
class Candidate:
    """A choice for a light, and the plan that it leads to."""

    light: str
    choice: Choice
    plan: Plan

    @property
    def steps(self) -> list[Step]:
        """What the plan fills for the light."""
        return self.plan.steps_under(self.light)

    @property
    def ladder(self) -> tuple[object, ...]:
        """What candidates have in common that differ in the size of their maps alone."""
        others = {key: value for key, value in self.choice.settings.items() if key != "map_size"}
        return tuple(self.choice.algorithm.items()), tuple(others.items())


@dataclass(frozen=True)
class Trial:
    """A candidate, its figures, the share of all pixels that is ``wrong``, and the standard error of its error.

    ``times_ms`` are those measured on all pixels, of which the median counts; where there are none, figures come from few pixels.
    """

    candidate: Candidate
    figures: CandidateFigures
    wrong: float
    spread: float = 0.0
    times_ms: tuple[float, ...] = ()

    @property
    def at_full_resolution(self) -> bool:
        """Whether it was drawn on all pixels."""
        return bool(self.times_ms)


def part_of(view: View) -> View:
    """What is measured of a view: all of it, or of a map that is larger than a block the block in its middle."""
    if isinstance(view, PerspectiveView):
        return view
    rows, cols = min(view.rows, BLOCK_PX), min(view.cols, BLOCK_PX)
    return view.part((view.rows - rows) // 2, (view.cols - cols) // 2, rows, cols)


def _pixels(view: View) -> float:
    """Pixels that a view is drawn with; of a map's blocks, which may reach beyond it, in the mean."""
    parts = [part for part, _, _ in blocks_of(view)] if isinstance(view, MapView) else [view]
    return sum(part.rows * part.cols for part in parts) / len(parts)


def shadow_ms(frame: Frame, light: str) -> float:
    """Milliseconds of the passes that filled a light's visibility in a frame; of a map's blocks in the mean."""
    blocks = len(blocks_of(frame.view)) if isinstance(frame.view, MapView) else 1
    return sum(record.ms for record in frame.passes if record.name.startswith(f"{light}/")) / blocks


@dataclass(frozen=True, eq=False)
class TrialView:
    """What a light's candidates are drawn on and held against: a view with its truth, and subsampled where it has many pixels."""

    scene: Scene
    truth: ViewTruth
    pixel_m: float
    subsampled: SubsampledTruth | None = None

    @property
    def error(self) -> ErrorName:
        """The figure that counts."""
        return self.truth.error

    @property
    def pixels(self) -> int:
        """On how many pixels a candidate is tried."""
        return int((self.truth.whole if self.subsampled is None else self.subsampled.truth).lit.size)

    def trial(self, candidate: Candidate) -> Trial:
        """A candidate on few pixels. Time on all of them goes by two subsampled views: what pixels do not change is alike in
        both.
        """
        if self.subsampled is None:
            return self.full_resolution_trial(candidate)
        view = self.truth.view
        coarse_view, coarser_view = (subsampled_view(view, times * self.subsampled.every) for times in (1, 2))
        frame, ms = _quickest(self.scene, coarse_view, candidate)
        _, less_ms = _quickest(self.scene, coarser_view, candidate)
        pixels, least, most = map(_pixels, (coarse_view, coarser_view, view))
        pixel_ms = np.clip((ms - less_ms) / (pixels - least), 0.0, ms / pixels)
        errors = self.subsampled.errors(frame.visibilities[candidate.light], candidate.steps, self.pixel_m)
        full_ms = float(ms + pixel_ms * (most - pixels))
        return Trial(
            candidate,
            CandidateFigures(candidate.choice.name, full_ms, errors.wrong_cast, errors.interior),
            errors.wrong,
            errors.spread,
        )

    def full_resolution_trial(self, candidate: Candidate) -> Trial:
        """A candidate on all pixels."""
        frame, ms = _quickest(self.scene, self.truth.view, candidate)
        parts = self.truth.cut(frame.visibilities[candidate.light])
        found = self.truth.errors(parts, candidate.steps, self.pixel_m)
        error = self.truth.coverage(parts) if self.error == "coverage" else found.wrong_cast
        return Trial(candidate, CandidateFigures(candidate.choice.name, ms, error, found.interior), found.wrong, times_ms=(ms,))

    def timed(self, trial: Trial, runs: int) -> Trial:
        """A trial on all pixels with so many times more: the median counts."""
        candidate = trial.candidate
        drawn = (_drawn(self.scene, self.truth.view, candidate) for _ in range(runs))
        times_ms = (*trial.times_ms, *(shadow_ms(frame, candidate.light) for frame in drawn))
        return replace(trial, times_ms=times_ms, figures=replace(trial.figures, ms=float(np.median(times_ms))))


def trial_view_of(scene: Scene, view: View, light: str, plan: Plan, pixel_m: float) -> TrialView:
    """What the candidates of a light are held against: truth under the sky that ``plan`` shows, as far as its haze lets one see."""
    part, sky = part_of(view), with_apparent_sun(scene, plan.runs)
    every = max(round((part.rows * part.cols / TRIAL_PIXELS) ** 0.5), 1)
    if every > 1:
        parts = [(part, 0, 0)] if isinstance(part, MapView) else bands_of(part)
        truth = truth_of_parts(sky, part, parts, light, effects=plan.runs)
        if truth.error == "wrong_cast":
            return TrialView(scene, truth, pixel_m, subsampled_truth(truth, every))
    return TrialView(scene, truth_of_view(sky, part, light, effects=plan.runs), pixel_m)


def _drawn(scene: Scene, view: View, candidate: Candidate) -> Frame:
    clear_caches("light")  # every cost that a moving sun has is to be paid
    return render_frame(scene, view, candidate.plan, pixels_show="points")


def _quickest(scene: Scene, view: View, candidate: Candidate) -> tuple[Frame, float]:
    """A candidate's frame, and the least milliseconds of ``DRAWN``."""
    frame = _drawn(scene, view, candidate)
    ms = shadow_ms(frame, candidate.light)
    for _ in range(1, DRAWN if ms < LONG_MS else 1):
        ms = min(ms, shadow_ms(_drawn(scene, view, candidate), candidate.light))
    return frame, ms
