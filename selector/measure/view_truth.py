"""Ray-traced ground truth of a whole view, and errors of visibilities against it. The accuracy report uses it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from skugga.selector.measure.footprint import texel_footprint_px
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.plan import Step
from skugga.shadows.render import bands_of
from skugga.shadows.truth.cache import cached_truth
from skugga.shadows.truth.metrics import COVERAGE_BLOCK_PX as COVERAGE_PX
from skugga.shadows.truth.metrics import ErrorMetrics, block_shadow_shares, coverage_error, error_metrics
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, AREA_LIGHT_SAMPLES, Truth, area_light_visibility, coverage_truth, ray_scene
from skugga.shadows.visibility import without_hidden_points
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.subsampled import subsampled_points
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView, blocks_of
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

View = MapView | PerspectiveView
"""A view of any kind."""

ErrorName = Literal["wrong_cast", "coverage"]
"""The error that ``max_error`` limits: the wrong share of the cast shadow, or the error of shadow shares in blocks of pixels."""

TRUTH_SAMPLES_PER_PIXEL = 4
"""Number of sub-samples of a pixel. Truth decides between shadow and light only if all of them agree."""

AREA_LIGHT_PIXELS = 40_000
"""Approximate number of evenly spaced pixels of a view for which the true visibility of an area light is computed."""

MAX_UNDECIDABLE_SHARE = 0.5
"""Share of the surface where truth is undecided, above which errors are measured by coverage (shadow shares of pixel blocks)."""


@dataclass(frozen=True, eq=False)
class TruthBlock:
    """Ground truth of one block of a view.

    Attributes
    ----------
    scene
        The scene.
    buffer
        Geometry of the block.
    light
        Name of the light.
    casters
        Casters that reach the block.
    truth
        Truth of the block.
    attached_shadow_mask
        Pixels whose surface faces away from the light, bool (rows, cols).
    row
        First row of the block in the view.
    col
        First column of the block in the view.
    """

    scene: Scene
    buffer: GeometryBuffer
    light: str
    casters: Casters
    truth: Truth
    attached_shadow_mask: np.ndarray
    row: int
    col: int


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Ground truth of a view under a light.

    Attributes
    ----------
    view
        The view.
    blocks
        Truth by block.
    full_truth
        Truth of the whole view.
    true_shares
        True shadow shares of blocks of pixels, one array for each block of the view; empty if coverage is not computed.
    """

    view: View
    blocks: list[TruthBlock]
    full_truth: Truth
    true_shares: Sequence[np.ndarray] = ()

    @cached_property
    def true_visibility(self) -> np.ndarray:
        """True visibility (rows, cols) of the light as an area light, for errors of soft edges. NaN except in every n-th pixel."""
        spacing_px = max(round((self.view.rows * self.view.cols / AREA_LIGHT_PIXELS) ** 0.5), 1)
        return self.assemble([_area_visibility(ground, spacing_px) for ground in self.blocks], np.nan)

    @property
    def error_name(self) -> ErrorName:
        """Name of the error that is compared with the requested limit ``max_error`` in this view."""
        return "coverage" if self.full_truth.undecidable_share > MAX_UNDECIDABLE_SHARE else "wrong_cast"

    def assemble(self, parts: Sequence[np.ndarray], empty: Any) -> np.ndarray:
        """Return one array of the view (rows, cols) from one array for each block. Other pixels have the value ``empty``."""
        return _assemble(self.view, self.blocks, parts, empty)

    def cut(self, visibility: np.ndarray) -> list[np.ndarray]:
        """Cut a visibility of the view (rows, cols) into the arrays of its blocks. Pixels of a block outside the view are NaN."""
        parts = []
        for ground in self.blocks:
            rows, cols = ground.truth.lit.shape
            part = np.full((rows, cols), np.nan, visibility.dtype)
            top, left = max(ground.row, 0), max(ground.col, 0)
            cut = visibility[top : max(ground.row + rows, 0), left : max(ground.col + cols, 0)]
            part[top - ground.row :, left - ground.col :][: cut.shape[0], : cut.shape[1]] = cut
            parts.append(part)
        return parts

    def errors(self, parts: Sequence[np.ndarray], steps: Sequence[Step], pixel_m: float, soft_edges: bool = False) -> ErrorMetrics:
        """Return the errors of visibilities, one array (rows, cols) for each block, against truth.

        The visibilities include attached shadow (surfaces that face away from the light). ``steps`` are the calls of algorithms
        that drew them, and ``pixel_m`` is the side of a pixel, metres. With ``soft_edges``, the reference of ``soft_error`` is an
        area light, which takes more rays; otherwise it is a point light.
        """
        footprints_px = [texels_px(ground, steps, pixel_m) for ground in self.blocks]
        true_visibility = self.true_visibility if soft_edges else None
        return error_metrics(
            self.assemble(parts, np.nan), self.full_truth, pixel_m, self.assemble(footprints_px, 0.0), true_visibility
        )

    def coverage(self, parts: Sequence[np.ndarray]) -> float:
        """Return the error of coverage: the mean difference from truth of the shadow share in blocks of pixels, in [0, 1].

        ``parts`` are visibilities, one array (rows, cols) for each block of the view.
        """
        pairs = zip(self.true_shares, parts, strict=True)
        return float(np.mean([coverage_error(block_shadow_shares(1.0 - part), shares) for shares, part in pairs]))


def truth_of_view(
    scene: Scene, view: View, light: str, samples: int = TRUTH_SAMPLES_PER_PIXEL, effects: Collection[str] = frozenset()
) -> ViewTruth:
    """Compute the ground truth of a view under a light, block by block (map) or band by band of rows (perspective view).

    ``samples`` is the number of sub-samples of a pixel, a square number. ``effects`` are the names of the effects in use. With
    haze, points so far away that it hides their shadows are left out (``skugga.shadows.visibility``).
    """
    parts = blocks_of(view) if isinstance(view, MapView) else bands_of(view)
    view_truth = truth_of_parts(scene, view, parts, light, samples, effects)
    shares = [coverage_truth(block.buffer, scene, block.casters, COVERAGE_PX, light=light) for block in view_truth.blocks]
    return replace(view_truth, true_shares=shares)


def truth_of_parts(
    scene: Scene,
    view: View,
    parts: Sequence[tuple[View, int, int]],
    light: str,
    samples: int = TRUTH_SAMPLES_PER_PIXEL,
    effects: Collection[str] = frozenset(),
) -> ViewTruth:
    """Compute the ground truth of a view from ``parts`` of it: views, each with the row and column of its first pixel in the view.

    ``ViewTruth.true_shares`` is not computed. The other parameters are those of ``truth_of_view``.
    """
    blocks = [_truth_block(scene, light, part, row, col, samples, effects) for part, row, col in parts]
    return ViewTruth(view, blocks, _joined_truth(view, blocks))


def _joined_truth(view: View, blocks: Sequence[TruthBlock]) -> Truth:
    """Join the truth of blocks to that of the whole view."""
    fields = ("lit", "attached_shadow_mask", "decidable", "valid")
    return Truth(*(_assemble(view, blocks, [getattr(ground.truth, field) for ground in blocks], False) for field in fields))


def texels_px(ground: TruthBlock, steps: Sequence[Step], pixel_m: float) -> np.ndarray:
    """Return the side of the largest shadow-map texel of several steps at each point of a block, in pixels (rows, cols)."""
    drawing: Sequence[Step | None] = steps or [None]
    return np.max([texel_footprint_px(ground.scene, step, ground.buffer, pixel_m) for step in drawing], axis=0)


def _truth_block(scene: Scene, light: str, block: View, row: int, col: int, samples: int, effects: Collection[str]) -> TruthBlock:
    """Return the ground truth of one block of a view, whose first pixel lies at ``row`` and ``col`` of the view.

    The other parameters are those of ``truth_of_view``. Points that an effect hides are not valid in the result.
    """
    full_buffer = geometry_buffer(scene, block)
    casters = find_casters(scene, full_buffer)
    truth, buffer = (
        cached_truth(full_buffer, scene, casters, samples, light),
        without_hidden_points(full_buffer, scene, light, effects),
    )
    if buffer is not full_buffer:
        truth = replace(truth, decidable=truth.decidable & buffer.valid, valid=truth.valid & buffer.valid)
    return TruthBlock(scene, buffer, light, casters, truth, attached_shadow_mask(buffer, scene, light), row, col)


def _area_visibility(ground: TruthBlock, spacing_px: int) -> np.ndarray:
    """Return the true visibility of the light as an area light, in every n-th pixel of a block: float32 (rows, cols).

    n is ``spacing_px``. All other pixels, and pixels without a surface, are NaN.
    """
    out = np.full(ground.truth.lit.shape, np.nan, np.float32)
    if ground.light == SUN and not ground.scene.sun_is_up:
        out[ground.truth.valid] = 0.0
    elif ground.truth.valid.any():
        points = subsampled_points(ground.buffer, spacing_px)
        rays = ray_scene(ground.buffer, ground.scene, ground.casters, ALL_CASTER_KINDS)
        visibility = area_light_visibility(points, ground.scene, ground.light, rays, AREA_LIGHT_SAMPLES)
        out[::spacing_px, ::spacing_px] = np.where(points.valid, visibility, np.nan)
    return out


def _assemble(view: View, blocks: Sequence[TruthBlock], parts: Sequence[np.ndarray], empty: Any) -> np.ndarray:
    """Return one array of the view (rows, cols) from ``parts``, one array for each of its blocks.

    Pixels outside of all blocks have the value ``empty``. Pixels of a block outside of the view are ignored.
    """
    assembled = np.full((view.rows, view.cols), empty, dtype=np.asarray(parts[0]).dtype)
    for ground, part in zip(blocks, parts, strict=True):
        rows, cols = part.shape
        top, left = max(ground.row, 0), max(ground.col, 0)
        bottom, right = min(ground.row + rows, view.rows), min(ground.col + cols, view.cols)
        assembled[top:bottom, left:right] = part[top - ground.row : bottom - ground.row, left - ground.col : right - ground.col]
    return assembled
