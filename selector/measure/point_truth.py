"""Ground truth at sample points of a picture, and comparison of shadows with it.

A probe (a test of candidates within a time limit) cannot afford ray-traced truth in all pixels. So truth is computed at some
pixels, the points, with the sub-samples of a whole pixel. The points are added in lattices of every n-th row and column. Each new
lattice lies between the earlier ones, and their order is always the same. To find whether a wrong point is near a shadow edge, one
ray is traced for each pixel around it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import sqrt

import numpy as np

from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.measure.probing import INTERVAL_Z
from skugga.selector.measure.view_truth import TRUTH_SAMPLES_PER_PIXEL
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.plan import Step
from skugga.shadows.truth.metrics import MIN_INTERIOR_DISTANCE_PX, edge_test_region, is_far_from_edges
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, Truth, lit_mask, ray_scene, sample_nodes, trace_truth
from skugga.shadows.visibility import without_hidden_points
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.gbuffer.geometry import GeometryBuffer, MapNodes
from skugga.terrain.gbuffer.subsampled import subsampled_points
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

MIN_LATTICE_POINTS = 10_000
"""Minimum number of points of a lattice. The maximum is just below four times this number."""


@dataclass(frozen=True)
class PointCounts:
    """Numbers of sample points, from the comparison of a picture with truth.

    Attributes
    ----------
    decidable_count
        Points for which truth decides between shadow and light.
    wrong_count
        Decidable points that are wrong in the picture.
    cast_count
        Decidable points that are in cast shadow, in truth or in the picture.
    wrong_cast_count
        Points in cast shadow that are wrong in the picture.
    interior_count
        Wrong points that are far from shadow edges.
    """

    decidable_count: int = 0
    wrong_count: int = 0
    cast_count: int = 0
    wrong_cast_count: int = 0
    interior_count: int = 0

    def __add__(self, other: PointCounts) -> PointCounts:
        """Return the sums of both objects' counts."""
        return PointCounts(*(a + b for a, b in zip(self.as_tuple, other.as_tuple, strict=True)))

    @property
    def as_tuple(self) -> tuple[int, ...]:
        """The counts in the order of the fields."""
        return self.decidable_count, self.wrong_count, self.cast_count, self.wrong_cast_count, self.interior_count


def wilson_interval(part: int, total: int, z: float = INTERVAL_Z) -> tuple[float, float]:
    """Return the lower and upper limit of the Wilson score interval of a share, for ``part`` of ``total`` observations.

    ``z`` is the number of standard errors to either side. Without observations the interval is 0 to 1. The source is E. B. Wilson,
    Probable inference, the law of succession, and statistical inference, 1927.
    """
    if total == 0:
        return 0.0, 1.0
    p = part / total
    middle = (p + z * z / (2 * total)) / (1 + z * z / total)
    half = z / (1 + z * z / total) * sqrt(p * (1 - p) / total + z * z / (4 * total * total))
    return max(0.0, middle - half), min(1.0, middle + half)


def lattice_offsets(spacing_px: int) -> list[tuple[int, int]]:
    """Return the first row and column of each lattice with a point every ``spacing_px`` pixels, a power of two.

    The lattices are in the order in which they are used: each one is as far as possible from the earlier ones.
    """
    offsets, half = [(0, 0)], spacing_px // 2
    while half >= 1:
        offsets += [(row + dr, col + dc) for dr, dc in ((half, half), (0, half), (half, 0)) for row, col in list(offsets)]
        half //= 2
    return offsets


@dataclass(frozen=True, eq=False)
class Lattice:
    """Ground truth at the points of one lattice of a picture: every n-th row and column from a first pixel on.

    Attributes
    ----------
    buffer
        Geometry of the points.
    first_pixel
        Row and column of the first point.
    spacing_px
        Distance of neighbouring points, pixels.
    truth
        Truth at the points.
    """

    buffer: GeometryBuffer
    first_pixel: tuple[int, int]
    spacing_px: int
    truth: Truth

    def at_points(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the whole picture (rows, cols) at the points of the lattice, (m, n)."""
        return values[self.first_pixel[0] :: self.spacing_px, self.first_pixel[1] :: self.spacing_px]


class PictureTruth:
    """Ground truth of a picture under a light, lattice by lattice.

    ``effects`` are the names of the effects in use. With haze, points so far away that it hides their shadows are not counted.
    """

    def __init__(
        self, scene: Scene, picture: GeometryBuffer, casters: Casters, light: str, effects: Collection[str] = frozenset()
    ) -> None:
        self.scene, self.picture, self.light, self.casters = scene, picture, light, casters
        self._effects = effects
        self.spacing_px = 1
        rows, cols = picture.valid.shape
        while rows * cols / (2 * self.spacing_px) ** 2 >= MIN_LATTICE_POINTS:
            self.spacing_px *= 2
        self.attached_shadow_mask = attached_shadow_mask(picture, scene, light)
        self._traced, self._dark = np.zeros((rows, cols), bool), np.zeros((rows, cols), bool)

    @property
    def lattice_count(self) -> int:
        """The number of lattices that together contain all pixels."""
        return self.spacing_px**2

    def prepare(self) -> None:
        """Build the data that all lattices share, so that the time of the first lattice excludes it."""
        _ = self.rays, self.nodes

    def lattice(self, number: int) -> Lattice:
        """Compute truth at the points of the lattice with index ``number``."""
        first_pixel = lattice_offsets(self.spacing_px)[number]
        full = subsampled_points(self.picture, self.spacing_px, first_pixel)
        truth = trace_truth(full, self.scene, self.casters, TRUTH_SAMPLES_PER_PIXEL, self.light, rays=self.rays, nodes=self.nodes)
        buffer = without_hidden_points(full, self.scene, self.light, self._effects)
        if buffer is not full:
            truth = replace(truth, decidable=truth.decidable & buffer.valid, valid=truth.valid & buffer.valid)
        return Lattice(buffer, first_pixel, self.spacing_px, truth)

    @cached_property
    def rays(self) -> RayScene:
        """The casters for ray tracing. For a map under the sun the rays are few, so they walk the ground's cells without a BVH."""
        traverse_sheets = isinstance(self.picture.view, MapView) and self.light == SUN
        return ray_scene(self.picture, self.scene, self.casters, ALL_CASTER_KINDS, traverse_sheets)

    @cached_property
    def nodes(self) -> MapNodes | None:
        """The ground nodes that the sub-samples of all lattices of a map share; ``None`` if they share none."""
        return sample_nodes(self.picture, self.scene, TRUTH_SAMPLES_PER_PIXEL)

    def counts(self, lattice: Lattice, dark: np.ndarray, steps: Sequence[Step], pixel_m: float) -> PointCounts:
        """Compare a picture with truth at the points of a lattice, and return the numbers of points.

        ``dark`` bool (rows, cols) is True in shadow, including surfaces that face away from the light. ``steps`` are the calls of
        algorithms that drew the picture, and ``pixel_m`` is the side of a pixel, metres.
        """
        truth = lattice.truth
        dark, true_dark = lattice.at_points(dark) & truth.valid, ~truth.lit & truth.valid
        is_wrong = truth.decidable & (dark != true_dark)
        cast = truth.decidable & (dark | true_dark) & ~truth.attached_shadow_mask
        decidable_count, wrong_count, cast_count, wrong_cast_count = (
            int(np.count_nonzero(mask)) for mask in (truth.decidable, is_wrong, cast, is_wrong & cast)
        )
        interior_count = self._count_interior(lattice, is_wrong, steps, pixel_m)
        return PointCounts(decidable_count, wrong_count, cast_count, wrong_cast_count, interior_count)

    def _count_interior(self, lattice: Lattice, is_wrong: np.ndarray, steps: Sequence[Step], pixel_m: float) -> int:
        """Return the number of wrong points that are far from the edges of true shadows.

        ``is_wrong`` is a mask of the lattice's points.
        """
        if not is_wrong.any():
            return 0
        drawing: Sequence[Step | None] = steps or [None]
        texel_px = np.max([texel_footprint_px(self.scene, step, lattice.buffer, pixel_m) for step in drawing], axis=0)
        distance_px = np.maximum(MIN_INTERIOR_DISTANCE_PX, 2.0 * texel_px[is_wrong]).astype(np.float64)
        row, col = (
            first + lattice.spacing_px * index for first, index in zip(lattice.first_pixel, np.nonzero(is_wrong), strict=True)
        )
        self._trace(edge_test_region(row, col, distance_px, self.picture.valid.shape))
        return int(np.count_nonzero(is_far_from_edges(self._dark, self.picture.valid, row, col, distance_px)))

    def _trace(self, pixels: np.ndarray) -> None:
        """Trace one ray for each pixel in the mask ``pixels`` (rows, cols), and store whether it is dark."""
        new = pixels & self.picture.valid & ~self._traced
        if new.any():
            self._dark |= new & ~lit_mask(self.picture, self.scene, self.light, self.rays, receiver_mask=new)
            self._traced |= new
