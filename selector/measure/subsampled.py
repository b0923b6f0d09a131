"""The truth of views with fewer pixels (``terrain.gbuffer.subsampled``), and what is held against it.

A pixel of a subsampled view is a pixel of the full view: as wide, and as far from the edges of shadows. So the shares of pixels
that are wrong are the full view's but for chance. Were the pixels n times as wide instead, truth would not tell their class
anywhere near an edge, which is where algorithms err: with every fourth pixel, a shadow map of a thousand boxes would have 0.6 %
wrong for 2.7 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from selector.measure.footprint import texel_footprint_px
from selector.measure.view_truth import ViewTruth
from shadows.plan import Step
from shadows.truth.metrics import INTERIOR_PX, from_edges_px
from shadows.truth.truth import Truth
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gbuffer.picture import geometry_of
from terrain.gbuffer.subsampled import subsampled_view
from terrain.geo.camera import PerspectiveView
from terrain.scene import Scene


@dataclass(frozen=True)
class EstimatedErrors:
    """Figures of ``shadows.truth.metrics.Errors``; ``spread`` is the standard error of ``wrong_cast``."""

    wrong: float
    wrong_cast: float
    interior: float
    spread: float


@dataclass(frozen=True, eq=False)
class SubsampledTruth:
    """Truth in every ``every``-th pixel of a view. ``edge_px`` is how far the nearest edge of shadow is, pixels of the full view
    (rows, cols).
    """

    scene: Scene
    buffer: GeometryBuffer
    every: int
    truth: Truth
    edge_px: np.ndarray

    def errors(self, visibility: np.ndarray, steps: Sequence[Step], pixel_m: float) -> EstimatedErrors:
        """The full view's figures, estimated from a subsampled view's visibility (rows, cols) that a plan's steps filled.

        ``pixel_m`` is a pixel's side in the full view.
        """
        truth = self.truth
        dark, true_dark = (np.nan_to_num(visibility, nan=1.0) < 0.5) & truth.there, ~truth.lit & truth.there
        wrong = truth.decidable & (dark != true_dark)
        cast = truth.decidable & (dark | true_dark) & ~truth.attached
        wider = self.every if isinstance(self.buffer.view, PerspectiveView) else 1
        drawing: Sequence[Step | None] = steps or [None]
        texels_px = np.max([texel_footprint_px(self.scene, step, self.buffer, pixel_m) for step in drawing], axis=0)
        inside = wrong & (self.edge_px > np.maximum(INTERIOR_PX, 2.0 * wider * texels_px))
        share, spread = _share(wrong & cast, cast), 0.0
        if self.every > 1:
            spread = float(np.sqrt(share * (1.0 - share) / max(int(np.count_nonzero(cast)), 1)))
        return EstimatedErrors(_share(wrong, truth.decidable), share, _share(inside, truth.decidable), spread)


def subsampled_truth(view_truth: ViewTruth, every: int) -> SubsampledTruth:
    """The truth of every ``every``-th pixel of a view (of a block, if it is a map): what it is in the full view."""
    full_truth, scene = view_truth.whole, view_truth.grounds[0].scene
    edge_px = from_edges_px(~full_truth.lit & full_truth.there, full_truth.there)
    truth = Truth(
        *(classes[::every, ::every] for classes in (full_truth.lit, full_truth.attached, full_truth.decidable, full_truth.there))
    )
    return SubsampledTruth(
        scene, geometry_of(scene, subsampled_view(view_truth.view, every)), every, truth, edge_px[::every, ::every]
    )


def _share(part: np.ndarray, total: np.ndarray) -> float:
    return float(np.count_nonzero(part) / max(int(np.count_nonzero(total)), 1))
