"""Draw options (choices of algorithms) for a light on a scene's view, and compare them with truth at sample points.

The policies ``probe`` and ``measure`` use this.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from functools import cached_property

import numpy as np

from skugga.selector.measure.compare import DrawnBlock, picture_blocks, run_light
from skugga.selector.measure.point_truth import Lattice, PictureTruth, PointCounts, wilson_interval
from skugga.selector.measure.probing import INTERVAL_Z, ErrorMeasurement
from skugga.selector.measure.view_truth import MAX_UNDECIDABLE_SHARE, View
from skugga.selector.options import LightOptions
from skugga.selector.planner.planner import Planner
from skugga.shadows.plan import Step
from skugga.shadows.truth.metrics import COVERAGE_BLOCK_PX, block_shadow_shares
from skugga.shadows.truth.truth import coverage_truth
from skugga.shadows.visibility import with_apparent_sun
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.grid import MapView, blocks_of
from skugga.terrain.scene import Scene

MAX_LATTICE_DOUBLINGS = 4
"""Number of times that the number of lattices (sets of sample points) is doubled: 1, 2, 4, 8, 16.

In pictures of usual size 16 lattices contain all pixels.
"""

COVERAGE_BLOCKS = 16
"""Number of blocks of pixels in the first comparison of coverage. It doubles whenever more sample points are requested."""

DRAW_REPEATS = 2
"""Number of times that an option is drawn, if that takes little time. The least time counts, because other load only adds to it."""

MAX_REPEATED_MS, MAX_WARM_REPEATED_MS = 3000.0, 150.0
"""Maximum milliseconds of a drawing that is repeated.

The first drawing with an algorithm contains work that later ones share (geometry, compiled shaders), so it is repeated up to the
larger limit, and whatever it took if it was expected to take less. Later drawings are repeated up to the smaller limit: 5 % of a
probe's default time.
"""


class ProbedPictures:
    """The geometry of the probed part of a view, which all lights share.

    The probed part is the whole view, or the block of a map that covers most of it. ``effects`` are the names of the effects in
    use.
    """

    def __init__(self, scene: Scene, view: View, effects: Collection[str]) -> None:
        self.scene, self.view = with_apparent_sun(scene, effects), probed_part(view)
        self.effects = effects

    @cached_property
    def blocks(self) -> list[DrawnBlock]:
        """The geometry and the casters of each block of the probed part of the view.

        They are the single block of a map, or the bands of rows of a perspective view.
        """
        if isinstance(self.view, MapView):
            ((picture, casters),) = picture_blocks(self.scene, self.view)
            return [(picture, casters)]
        return picture_blocks(self.scene, self.view)


def probed_part(view: View) -> View:
    """Return the part of a view on which options are drawn: all of it, or the block of a map that covers most of it."""
    if not isinstance(view, MapView):
        return view

    def common_pixels(part: tuple[View, int, int]) -> int:
        block, row, col = part
        rows = min(row + block.rows, view.rows) - max(row, 0)
        return rows * (min(col + block.cols, view.cols) - max(col, 0))

    return max(blocks_of(view), key=common_pixels)[0]


class SceneProber:
    """Implementation of ``skugga.selector.measure.probing.OptionProber`` for the options of a light on a scene's view.

    ``warm_repeated_ms`` is the maximum time of a drawing that is repeated although its algorithms have drawn the scene before.
    """

    def __init__(
        self,
        pictures: ProbedPictures,
        planner: Planner,
        light: str,
        options: LightOptions,
        warm_repeated_ms: float = MAX_WARM_REPEATED_MS,
    ) -> None:
        self._start_s = time.perf_counter()
        self._warm_repeated_ms = warm_repeated_ms
        self._pictures, self._planner, self._light, self._options = pictures, planner, light, options
        self._pixel_m = planner.descriptor.pixel_m
        self._doublings = 0
        self._lattices: list[list[Lattice]] = []
        self._points_s = self._coverage_s = 0.0
        self._dark: dict[int, list[np.ndarray]] = {}
        self._parts: dict[int, list[np.ndarray]] = {}
        self._steps: dict[int, Sequence[Step]] = {}
        self._counted: dict[tuple[int, int, int], PointCounts] = {}
        self._shares: list[np.ndarray] = []

    def elapsed_s(self) -> float:
        """Return the seconds since this object was made."""
        return time.perf_counter() - self._start_s

    def draw_s(self, option_index: int, ms: float) -> float:
        """Return the expected seconds to draw an option of which one drawing takes ``ms`` milliseconds."""
        return draw_count(ms, is_warm(self._options, option_index, self._parts), self._warm_repeated_ms) * ms / 1000.0

    def draw(self, option_index: int) -> float | None:
        """Draw an option and return its time in milliseconds; ``None`` if its algorithm cannot draw the view."""
        plan = self._planner.plan({self._light: self._options.options[option_index].choice}, {})
        try:
            run = run_light(self._pictures.scene, self._pictures.blocks, plan, self._light)
        except UnsupportedError:
            return None
        ms = run.times[0]
        drawn_before = is_warm(self._options, option_index, self._parts)
        one_ms = ms if drawn_before else min(ms, self._options.options[option_index].ms)
        for _ in range(1, draw_count(one_ms, drawn_before, self._warm_repeated_ms)):
            ms = min(ms, run_light(self._pictures.scene, self._pictures.blocks, plan, self._light).times[0])
        self._parts[option_index], self._steps[option_index] = run.parts, plan.steps_of_light(self._light)
        for truth, part in zip(self._truths, run.parts, strict=True):
            part[truth.attached_shadow_mask] = 0.0
            part[~truth.picture.valid] = np.nan
        self._dark[option_index] = [np.nan_to_num(part, nan=1.0) < 0.5 for part in run.parts]
        return ms

    @cached_property
    def _truths(self) -> list[PictureTruth]:
        """Ground truth under the light, one for each block of the probed part."""
        pictures = self._pictures
        return [
            PictureTruth(pictures.scene, picture.pixel_buffer, casters, self._light, pictures.effects)
            for picture, casters in pictures.blocks
        ]

    @property
    def uses_coverage(self) -> bool:
        """Whether truth is undecided at so many points that the error is the difference of shadow shares in blocks of pixels."""
        counts = [lattice.truth for picture_lattices in self._lattices_so_far() for lattice in picture_lattices]
        surface, decided = (sum(int(getattr(truth, name).sum()) for truth in counts) for name in ("valid", "decidable"))
        return decided < (1.0 - MAX_UNDECIDABLE_SHARE) * surface

    def _lattices_so_far(self) -> list[list[Lattice]]:
        """Return the lattices of sample points that are in use, by picture. Missing ones are computed."""
        while len(self._lattices) < len(self._truths):
            self._lattices.append([])
        for truth, picture_lattices in zip(self._truths, self._lattices, strict=True):
            truth.prepare()
            while len(picture_lattices) < min(2**self._doublings, truth.lattice_count):
                start = time.perf_counter()
                picture_lattices.append(truth.lattice(len(picture_lattices)))
                self._points_s = time.perf_counter() - start
        return self._lattices

    def measurement(self, option_index: int) -> ErrorMeasurement:
        """Return the errors of a drawn option against truth, at all sample points that were requested so far."""
        total = PointCounts()
        for number, picture_lattices in enumerate(self._lattices_so_far()):
            for index, lattice in enumerate(picture_lattices):
                key = (option_index, number, index)
                if key not in self._counted:
                    dark = self._dark[option_index][number]
                    self._counted[key] = self._truths[number].counts(lattice, dark, self._steps[option_index], self._pixel_m)
                total += self._counted[key]
        return (
            self._coverage_measurement(option_index, total)
            if self.uses_coverage
            else measurement_from_counts(total, self._is_complete)
        )

    def _coverage_measurement(self, option_index: int, total: PointCounts) -> ErrorMeasurement:
        """Return the errors of a drawn option, with the error of coverage.

        It is the mean difference from truth of the shadow share in blocks of pixels. ``total`` are the counts of the sample points,
        which give the interior error.
        """
        blocks = COVERAGE_BLOCKS * 2**self._doublings
        if not self._shares:
            start = time.perf_counter()
            self._shares = [
                coverage_truth(
                    truth.picture, truth.scene, truth.casters, COVERAGE_BLOCK_PX, blocks, light=self._light, rays=truth.rays
                )
                for truth in self._truths
            ]
            self._coverage_s = time.perf_counter() - start
        share_errors = np.concatenate([
            np.abs(block_shadow_shares(1.0 - part) - shares).ravel()
            for part, shares in zip(self._parts[option_index], self._shares, strict=True)
        ])  # fmt: skip
        share_errors = share_errors[np.isfinite(share_errors)]
        mean, half = (
            (float(share_errors.mean()), INTERVAL_Z * float(share_errors.std()) / max(len(share_errors), 1) ** 0.5)
            if len(share_errors)
            else (0.0, 1.0)
        )
        half = 0.0 if self._doublings == MAX_LATTICE_DOUBLINGS else half
        from_counts = measurement_from_counts(total, self._is_complete)
        return ErrorMeasurement(
            mean,
            max(mean - half, 0.0),
            min(mean + half, 1.0),
            from_counts.interior,
            from_counts.interior_low,
            from_counts.interior_high,
            len(share_errors),
        )

    @property
    def _is_complete(self) -> bool:
        """Whether the lattices in use contain all pixels of every block."""
        return all(
            len(picture_lattices) == truth.lattice_count
            for picture_lattices, truth in zip(self._lattices_so_far(), self._truths, strict=True)
        )

    def add_points_s(self) -> float | None:
        """Return the expected seconds to compute truth at more points; ``None`` if it is known at all points."""
        if self._doublings == MAX_LATTICE_DOUBLINGS or (self._is_complete and not self.uses_coverage):
            return None
        return self._points_s * 2**self._doublings * len(self._truths) + 2.0 * self._coverage_s

    def add_points(self) -> None:
        """Request truth at more sample points for the following measurements."""
        self._doublings += 1
        self._shares = []


def is_warm(options: LightOptions, option_index: int, drawn: Collection[int]) -> bool:
    """Return whether the algorithms of option ``option_index``, each for the same kinds of casters, have drawn the scene before.

    ``drawn`` holds the numbers of the options that were drawn.
    """
    return options.options[option_index].algorithm_family in {options.options[number].algorithm_family for number in drawn}


def draw_count(ms: float, is_warm: bool, warm_repeated_ms: float = MAX_WARM_REPEATED_MS) -> int:
    """Return how often an option is drawn to measure its time.

    ``ms`` is the expected time of one drawing in milliseconds. ``is_warm`` tells whether its algorithms have drawn the scene
    before. ``warm_repeated_ms`` is the maximum time of a drawing that is repeated then.
    """
    return DRAW_REPEATS if ms < (warm_repeated_ms if is_warm else MAX_REPEATED_MS) else 1


def measurement_from_counts(counts: PointCounts, is_complete: bool) -> ErrorMeasurement:
    """Return the errors that follow from numbers of sample points.

    ``is_complete`` tells whether the sample contains all pixels. Then the confidence intervals have no width.
    """
    error, interior = counts.wrong_cast_count / max(counts.cast_count, 1), counts.interior_count / max(counts.decidable_count, 1)
    if is_complete:
        return ErrorMeasurement(error, error, error, interior, interior, interior, counts.cast_count)
    low, high = wilson_interval(counts.wrong_cast_count, counts.cast_count)
    interior_low, interior_high = wilson_interval(counts.interior_count, counts.decidable_count)
    return ErrorMeasurement(error, low, high, interior, interior_low, interior_high, counts.cast_count)
