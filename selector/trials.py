"""Trials of candidates: a plan drawn on the view, or on every n-th pixel of it, and held against truth there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from selector.against_truth import FOGGY, ErrorName, View, ViewTruth, joined_truth, truth_of_view
from selector.picks import Pick
from selector.thinned import ThinTruth, thin_truth, thinned
from selector.winning import Figures
from shadows.plan import Plan, Step
from shadows.render import REFRACTION_PASS, Frame, forget_kept, render_frame
from shadows.truth import Truth
from terrain.camera import PerspectiveView
from terrain.effects.haze import hides_beyond_m
from terrain.geometry import GeometryBuffer
from terrain.grid import BLOCK_PX, MapView
from terrain.level import SUN
from terrain.scene import Scene

PIXELS = 80_000
"""Pixels that candidates are drawn on, about."""

DRAWN, LONG_MS = 2, 1000.0
"""Thinned views are drawn so often, if that takes less than this: the least time counts, since what else a machine does, and what
is made once, only ever adds to it.
"""


@dataclass(frozen=True)
class Candidate:
    """A pick for a light, and the plan that it leads to."""

    light: str
    pick: Pick
    plan: Plan

    @property
    def steps(self) -> list[Step]:
        """What the plan does for the light."""
        return [step for step in self.plan.steps if step.light == self.light]

    @property
    def ladder(self) -> tuple[object, ...]:
        """What candidates have in common that differ in the size of their maps alone."""
        others = {key: value for key, value in self.pick.settings.items() if key != "map_size"}
        return tuple(self.pick.algorithm.items()), tuple(others.items())


@dataclass(frozen=True)
class Trial:
    """A candidate, its figures, the share of all pixels that is ``wrong``, and the standard error of its error.

    ``times_ms`` are those measured at full size, of which the median counts, if there are any.
    """

    candidate: Candidate
    figures: Figures
    wrong: float
    spread: float = 0.0
    times_ms: tuple[float, ...] = ()

    @property
    def timed(self) -> bool:
        return bool(self.times_ms)


def part_of(view: View) -> View:
    """What is measured of a view: all of it, or of a map that is larger than a block the block in its middle."""
    if isinstance(view, PerspectiveView):
        return view
    rows, cols = min(view.rows, BLOCK_PX), min(view.cols, BLOCK_PX)
    return view.part((view.rows - rows) // 2, (view.cols - cols) // 2, rows, cols)


def shadow_ms(frame: Frame, light: str) -> float:
    """Milliseconds of the passes that filled a light's visibility in a frame."""
    return sum(record.ms for record in frame.passes if record.name.startswith(f"{light}/"))


class Probe(Protocol):
    """What candidates are drawn on and held against; ``error`` is the figure that counts."""

    @property
    def error(self) -> ErrorName: ...

    @property
    def pixels(self) -> int: ...

    def trial(self, candidate: Candidate) -> Trial: ...


@dataclass(frozen=True, eq=False)
class ThinProbe:
    """A view with fewer pixels."""

    scene: Scene
    view: View
    truth: ThinTruth
    pixel_m: float
    error: ErrorName = "wrong_cast"

    @property
    def pixels(self) -> int:
        return int(self.truth.truth.lit.size)

    def trial(self, candidate: Candidate) -> Trial:
        """Time at full size goes by two thinned views: what does not go by pixels is the same in both."""
        few, fewer = (thinned(self.view, times * self.truth.every) for times in (1, 2))
        frame, ms = _quickest(self.scene, few, candidate)
        _, less_ms = _quickest(self.scene, fewer, candidate)
        pixels, least, most = (view.rows * view.cols for view in (few, fewer, self.view))
        pixel_ms = np.clip((ms - less_ms) / (pixels - least), 0.0, ms / pixels)
        found = self.truth.errors(frame.visibilities[candidate.light], candidate.steps, self.pixel_m)
        full_ms = float(ms + pixel_ms * (most - pixels))
        return Trial(candidate, Figures(candidate.pick.name, full_ms, found.wrong_cast, found.interior), found.wrong, found.spread)


@dataclass(frozen=True, eq=False)
class WholeProbe:
    """A view with all of its pixels: it is small, or its shadows are too fine for any fewer."""

    scene: Scene
    view: View
    truth: ViewTruth
    pixel_m: float

    @property
    def error(self) -> ErrorName:
        return self.truth.error

    @property
    def pixels(self) -> int:
        return int(self.truth.whole.lit.size)

    def trial(self, candidate: Candidate) -> Trial:
        frame, ms = _quickest(self.scene, self.view, candidate)
        parts = self.truth.cut(frame.visibilities[candidate.light])
        found = self.truth.errors(parts, candidate.steps, self.pixel_m)
        error = self.truth.coverage(parts) if self.error == "coverage" else found.wrong_cast
        figures = Figures(candidate.pick.name, ms, error, found.interior)
        return Trial(candidate, figures, found.wrong, times_ms=(figures.ms,))


def probe_of(scene: Scene, view: View, light: str, plan: Plan, pixel_m: float) -> Probe:
    """What the candidates of a light are held against: truth under the sky that ``plan`` shows, as far as its haze lets one see."""
    part, sky = part_of(view), scene if REFRACTION_PASS in plan.runs else scene.without_refraction
    every = max(round((part.rows * part.cols / PIXELS) ** 0.5), 1)
    if every > 1:
        thin = thin_truth(sky, part, light, every)
        if thin.truth.boundary <= FOGGY:
            return ThinProbe(scene, part, replace(thin, truth=_unhidden(scene, plan, light, thin.buffer, thin.truth)), pixel_m)
    whole = truth_of_view(sky, part, light)
    grounds = [replace(one, truth=_unhidden(scene, plan, light, one.buffer, one.truth)) for one in whole.grounds]
    return WholeProbe(scene, part, replace(whole, grounds=grounds, whole=joined_truth(part, grounds)), pixel_m)


def _unhidden(scene: Scene, plan: Plan, light: str, buffer: GeometryBuffer, truth: Truth) -> Truth:
    """Truth without the points past which nobody looks for the sun (``shadows.render``): haze hides whether it shines there."""
    if "haze" not in plan.runs or light != SUN or isinstance(buffer.view, MapView):
        return truth
    away_m = np.linalg.norm(buffer.position_frame_m - buffer.view.in_frame(buffer.frame)[0], axis=-1)
    near = away_m < hides_beyond_m(scene)
    return replace(truth, decidable=truth.decidable & near, there=truth.there & near)


def _drawn(scene: Scene, view: View, candidate: Candidate) -> Frame:
    forget_kept()  # every cost that a moving sun has is to be paid
    return render_frame(scene, view, candidate.plan)


def _quickest(scene: Scene, view: View, candidate: Candidate) -> tuple[Frame, float]:
    """A candidate's frame, and the least milliseconds of ``DRAWN``."""
    frame = _drawn(scene, view, candidate)
    ms = shadow_ms(frame, candidate.light)
    for _ in range(1, DRAWN if ms < LONG_MS else 1):
        ms = min(ms, shadow_ms(_drawn(scene, view, candidate), candidate.light))
    return frame, ms


def timed(scene: Scene, view: View, trial: Trial, runs: int) -> Trial:
    """A trial with so many times more at full size: the median counts."""
    its = trial.candidate
    times_ms = (*trial.times_ms, *(shadow_ms(_drawn(scene, view, its), its.light) for _ in range(runs)))
    return replace(trial, times_ms=times_ms, figures=replace(trial.figures, ms=float(np.median(times_ms))))
