"""Error metrics of an algorithm's visibility against truth, pixel by pixel, at the same points.

- `D` is the set of decidable pixels of the surface.
- The class of a pixel is shadow if visibility is less than 0.5, and lit otherwise.
- All metrics are defined for all pictures: a share of an empty set is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.truth.truth import Truth
from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal

MIN_INTERIOR_DISTANCE_PX = 2.0
"""Minimum distance of interior errors from truth's boundary, pixels. It is also at least two texel footprints."""

MAX_INTERIOR_SHARE = 0.001
"""Upper bound of the share of decidable pixels that are interior errors. A larger share is a failure, not aliasing."""

MIN_PART_PX = 8
"""Minimum size of a connected part of interior errors that counts."""

COVERAGE_BLOCK_PX = 16
"""Side of the blocks in which coverage is compared."""

MIN_COVERED_SHARE = 0.2
"""Minimum share of the cast shadow that a metric must cover. Below it, the metric does not test the picture."""

_FOUR_NEIGHBOURS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
"""Structuring element of a pixel and its four nearest neighbours."""

_EIGHT_NEIGHBOURS = np.ones((3, 3), bool)
"""Structuring element of a pixel and its eight neighbours."""


@dataclass(frozen=True)
class ErrorMetrics:
    """Error metrics of one picture; shares in [0, 1].

    Attributes
    ----------
    wrong
        Share of D (the decidable pixels of the surface) with the wrong class.
    wrong_cast
        Wrong pixels as a share of the pixels that truth or the algorithm puts in cast shadow (attached shadow excluded); 0 if there
        are none.
    false_shadow, missed_shadow
        Share of wrong pixels among the truly lit, and among the truly shadowed pixels of D.
    edge_mean, edge_p95, edge_mean_m, edge_p95_m
        Mean and 95th percentile of the symmetric distance between the boundaries of overlapping shadow components, in pixels and in
        metres; 0 if there are none.
    interior, interior_parts
        Share of D that is wrong and farther from truth's boundary than 2 px and two texel footprints, and the number of its
        connected parts of 8 px or more.
    interior_sees
        Share of the true cast shadow that ``interior_error_mask`` detects if missed (``MetricCoverage``): it lies that far inside.
        Coarse texels make it small; then only ``wrong_cast`` is conclusive.
    boundary
        Share of the surface that is not decidable.
    soft_error
        Mean absolute error of visibility over the surface, against the visibility of the area light where it is known.
    """

    wrong: float
    wrong_cast: float
    false_shadow: float
    missed_shadow: float
    edge_mean: float
    edge_p95: float
    edge_mean_m: float
    edge_p95_m: float
    interior: float
    interior_parts: int
    interior_sees: float
    boundary: float
    soft_error: float


@dataclass(frozen=True)
class MetricCoverage:
    """The number of pixels in cast shadow that a metric covers, and of wrong pixels in the whole picture.

    Attributes
    ----------
    cast_px
        Decidable pixels in cast shadow by truth (attached shadow excluded). For an edge metric, the boundary of the cast shadow.
    covered_px
        Number of ``cast_px`` that the metric would count if all cast shadow were missed. For an edge metric, those whose shadow
        overlaps a shadow of the algorithm.
    wrong_px
        Decidable pixels outside of attached shadow with the wrong class.
    union_px
        Decidable pixels outside of attached shadow that truth or the algorithm puts in cast shadow.
    """

    cast_px: int
    covered_px: int
    wrong_px: int
    union_px: int

    @property
    def covered_share(self) -> float:
        """Share of the cast shadow that the metric covers; 0 without cast shadow."""
        return self.covered_px / self.cast_px if self.cast_px else 0.0

    @property
    def wrong_cast(self) -> float:
        """Wrong pixels as a share of the pixels that truth or the algorithm puts in cast shadow; 0 without any."""
        return self.wrong_px / self.union_px if self.union_px else 0.0


def metric_coverage(shadow_mask: np.ndarray, truth: Truth, region: np.ndarray) -> MetricCoverage:
    """Return how much cast shadow lies in the mask of a metric, and how many pixels of the whole picture are wrong.

    ``shadow_mask`` (rows, cols) is the algorithm's class, True in shadow. ``region`` (rows, cols) is the mask of the pixels that
    the metric covers.
    """
    comparable, true_dark = truth.decidable & ~truth.attached_shadow_mask, ~truth.lit & truth.valid
    shadow_mask, cast = shadow_mask & truth.valid, comparable & true_dark
    counts = cast, cast & region, comparable & (shadow_mask != true_dark), comparable & (shadow_mask | true_dark)
    return MetricCoverage(*(int(np.count_nonzero(mask)) for mask in counts))


def edge_metric_coverage(shadow_mask: np.ndarray, truth: Truth) -> MetricCoverage:
    """Return how much of the true shadow's boundary the edge metric covers.

    It covers the boundary of the components of true shadow that the algorithm's shadow ``shadow_mask`` (rows, cols) overlaps.
    """
    from scipy.ndimage import label

    comparable, true_dark = truth.valid & ~truth.attached_shadow_mask, ~truth.lit & truth.valid
    picture_coverage = metric_coverage(shadow_mask, truth, true_dark)
    edge = shadow_boundary_mask(true_dark, truth.valid) & comparable
    parts, _ = label(true_dark, structure=_EIGHT_NEIGHBOURS)
    overlapping = np.unique(parts[true_dark & shadow_mask & truth.valid])
    matched_edge = edge & np.isin(parts, overlapping[overlapping > 0])
    return MetricCoverage(int(edge.sum()), int(matched_edge.sum()), picture_coverage.wrong_px, picture_coverage.union_px)


def interior_region(truth: Truth, texel_footprint_px: float | np.ndarray = 0.0) -> np.ndarray:
    """Return the mask (rows, cols) of the pixels that the metric ``interior_error_mask`` covers.

    They are farther from truth's boundary than 2 px and two texel footprints. ``texel_footprint_px`` is that of ``error_metrics``.
    """
    return _distance_to_edges_px(truth) > np.maximum(MIN_INTERIOR_DISTANCE_PX, 2.0 * texel_footprint_px)


def error_metrics(
    visibility: np.ndarray,
    truth: Truth,
    pixel_m: float,
    texel_footprint_px: float | np.ndarray = 0.0,
    true_visibility: np.ndarray | None = None,
) -> ErrorMetrics:
    """Return the error metrics of a visibility against truth.

    Parameters
    ----------
    visibility
        Visibility (rows, cols) in [0, 1], attached shadow included.
    truth
        The truth at the same points.
    pixel_m
        Side of a pixel on the receiver, metres.
    texel_footprint_px
        Side of the algorithm's texels in pixels: a number, or one for each pixel (rows, cols); 0 without texels.
    true_visibility
        Visibility (rows, cols) of the area light, NaN where unknown; ``None``: a point light.
    """
    from scipy.ndimage import label

    if true_visibility is None:
        true_visibility = np.where(truth.valid, truth.lit, np.nan)
    decidable = truth.decidable
    dark = (np.nan_to_num(visibility, nan=1.0) < 0.5) & truth.valid
    true_dark = ~truth.lit & truth.valid
    wrong_mask = decidable & (dark != true_dark)
    cast = decidable & (dark | true_dark) & ~truth.attached_shadow_mask
    distances = edge_distances(dark, true_dark, truth.valid)
    region = interior_region(truth, texel_footprint_px)
    interior_mask = wrong_mask & region
    parts, count = label(interior_mask, structure=_EIGHT_NEIGHBOURS)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    mean, p95 = (float(distances.mean()), float(np.quantile(distances, 0.95))) if distances.size else (0.0, 0.0)
    return ErrorMetrics(
        wrong=_share_of_mask(wrong_mask, decidable),
        wrong_cast=_share_of_mask(wrong_mask & ~truth.attached_shadow_mask, cast),
        false_shadow=_share_of_mask(wrong_mask & truth.lit, decidable & truth.lit),
        missed_shadow=_share_of_mask(wrong_mask & true_dark, decidable & true_dark),
        edge_mean=mean,
        edge_p95=p95,
        edge_mean_m=mean * pixel_m,
        edge_p95_m=p95 * pixel_m,
        interior=_share_of_mask(interior_mask, decidable),
        interior_parts=int((sizes >= MIN_PART_PX).sum()),
        interior_sees=metric_coverage(dark, truth, region).covered_share,
        boundary=truth.undecidable_share,
        soft_error=soft_error(visibility, true_visibility),
    )


def edge_distances(shadow_mask: np.ndarray, true_shadow_mask: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the distances (n,), in pixels, between the boundaries of shadow components that overlap in both pictures.

    They run from each boundary pixel of one picture to the nearest one of the other, in both directions. A component without
    overlap in the other picture is missed or false shadow. It counts in ``interior_error_mask``, not here. ``shadow_mask`` and
    ``true_shadow_mask`` (rows, cols) are the classes by the algorithm and by truth, True in shadow. ``valid`` is the mask of the
    surface.
    """
    from scipy.ndimage import label
    from scipy.spatial import KDTree

    edges = []
    for first, second in ((shadow_mask, true_shadow_mask), (true_shadow_mask, shadow_mask)):
        parts, _ = label(first, structure=_EIGHT_NEIGHBOURS)
        shared = np.unique(parts[second & first])
        edges.append(shadow_boundary_mask(np.isin(parts, shared[shared > 0]), valid))
    if not (edges[0].any() and edges[1].any()):
        return np.zeros(0)
    first, second = (np.argwhere(edge) for edge in edges)
    return np.concatenate([KDTree(b).query(a)[0] for a, b in ((first, second), (second, first))])


def shadow_boundary_mask(shadow_mask: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the mask of shadow pixels with a lit 4-neighbour. Borders of the surface and the picture are no boundary.

    ``shadow_mask`` (rows, cols) is True in shadow, and ``valid`` is the mask of the surface.
    """
    from scipy.ndimage import binary_dilation

    return shadow_mask & binary_dilation(valid & ~shadow_mask, structure=_FOUR_NEIGHBOURS)


def interior_error_mask(
    wrong_mask: np.ndarray, true_shadow_mask: np.ndarray, valid: np.ndarray, distance_px: float | np.ndarray
) -> np.ndarray:
    """Return the mask of wrong pixels farther than a distance from truth's boundary; all of them if truth has no boundary.

    ``wrong_mask``, ``true_shadow_mask`` and ``valid`` (rows, cols) are the masks of wrong pixels, of true shadow and of the
    surface. The distance ``distance_px`` is a number, or one for each pixel.
    """
    return wrong_mask & (distance_to_edges_px(true_shadow_mask, valid) > distance_px)


def distance_to_edges_px(shadow_mask: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return each pixel's distance (rows, cols) to the nearest pixel at either side of a shadow boundary; infinite without any.

    ``shadow_mask`` (rows, cols) is True in shadow, and ``valid`` is the mask of the surface.
    """
    from scipy.ndimage import distance_transform_edt

    edge = shadow_boundary_mask(shadow_mask, valid) | shadow_boundary_mask(valid & ~shadow_mask, valid)
    return distance_transform_edt(~edge) if edge.any() else np.full(shadow_mask.shape, np.inf)


def edge_test_region(row: np.ndarray, col: np.ndarray, distance_px: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the mask of the pixels whose classes ``is_far_from_edges`` reads, bool of the given ``shape``.

    ``row``, ``col`` and ``distance_px`` (n,) are those of ``is_far_from_edges``.
    """
    out = np.zeros(shape, bool)
    _mark_squares(row, col, distance_px, out)
    return out


def is_far_from_edges(
    shadow_mask: np.ndarray, valid: np.ndarray, row: np.ndarray, col: np.ndarray, distance_px: np.ndarray
) -> np.ndarray:
    """Return which pixels lie farther from both sides of any shadow boundary than given distances, bool (n,).

    ``row``, ``col`` and ``distance_px`` (n,) are the pixels and their distances. Distances are as in ``distance_to_edges_px``. The
    function reads only the classes in the mask of ``edge_test_region``. ``shadow_mask`` (rows, cols) is True in shadow, and
    ``valid`` is the mask of the surface.
    """
    return _compute_far_from_edges(shadow_mask, valid, row, col, distance_px)


@compiled
def _mark_squares(row, col, distance_px, out):
    """Mark in ``out`` (rows, cols) a square round each of the pixels ``row``, ``col`` (n,) that reaches its distance.

    ``distance_px`` (n,) are the distances.
    """
    rows, cols = out.shape
    for n in range(len(row)):
        reach = int(min(distance_px[n], rows + cols)) + 1
        for i in range(max(row[n] - reach, 0), min(row[n] + reach + 1, rows)):
            for j in range(max(col[n] - reach, 0), min(col[n] + reach + 1, cols)):
                out[i, j] = True


@compiled
def _compute_far_from_edges(shadow_mask, valid, row, col, distance_px):
    """Return the result of ``is_far_from_edges`` for the same arguments."""
    rows, cols = shadow_mask.shape
    out = np.ones(len(row), np.bool_)
    for n in range(len(row)):
        reach = int(min(distance_px[n], rows + cols))
        for i in range(max(row[n] - reach, 0), min(row[n] + reach + 1, rows)):
            for j in range(max(col[n] - reach, 0), min(col[n] + reach + 1, cols)):
                near = (i - row[n]) ** 2 + (j - col[n]) ** 2 <= distance_px[n] * distance_px[n]
                if near and valid[i, j] and _is_edge(shadow_mask, valid, i, j):
                    out[n] = False
                    break
            if not out[n]:
                break
    return out


@internal
def _is_edge(shadow_mask, valid, i, j):
    """Return whether a 4-neighbour of the pixel at row ``i`` and column ``j`` has the other class.

    ``shadow_mask`` and ``valid`` are those of ``is_far_from_edges``.
    """
    rows, cols = shadow_mask.shape
    centre = shadow_mask[i, j]
    return (
        (i > 0 and valid[i - 1, j] and shadow_mask[i - 1, j] != centre)
        or (i + 1 < rows and valid[i + 1, j] and shadow_mask[i + 1, j] != centre)
        or (j > 0 and valid[i, j - 1] and shadow_mask[i, j - 1] != centre)
        or (j + 1 < cols and valid[i, j + 1] and shadow_mask[i, j + 1] != centre)
    )


@cached("light", 512 * MIB)
def _distance_to_edges_px(truth: Truth) -> np.ndarray:
    """Return ``distance_to_edges_px`` of a truth, cached because many pictures are compared with it."""
    return distance_to_edges_px(~truth.lit & truth.valid, truth.valid)


def block_shadow_shares(shadow_share: np.ndarray) -> np.ndarray:
    """Return the means of 16 x 16 px blocks of ``shadow_share`` (rows, cols), NaN for blocks without surface.

    Incomplete blocks at the last rows and columns are left out.
    """
    rows, cols = (size // COVERAGE_BLOCK_PX * COVERAGE_BLOCK_PX for size in shadow_share.shape)
    blocks = shadow_share[:rows, :cols].reshape(
        rows // COVERAGE_BLOCK_PX, COVERAGE_BLOCK_PX, cols // COVERAGE_BLOCK_PX, COVERAGE_BLOCK_PX
    )
    valid = np.isfinite(blocks)
    count = valid.sum(axis=(1, 3))
    total = np.where(valid, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def coverage_error(share: np.ndarray, true_share: np.ndarray) -> float:
    """Return the mean absolute difference of blocks' shadow shares (any shape), in [0, 1]. NaN blocks do not count."""
    difference = np.abs(share - true_share)
    return float(np.nanmean(difference)) if np.isfinite(difference).any() else 0.0


def soft_error(visibility: np.ndarray, true_visibility: np.ndarray) -> float:
    """Return the mean absolute difference of visibilities in [0, 1]. Pixels with NaN in either do not count."""
    difference = np.abs(visibility - true_visibility)
    return float(np.nanmean(difference)) if np.isfinite(difference).any() else 0.0


def _share_of_mask(mask: np.ndarray, reference_mask: np.ndarray) -> float:
    """Return the share of the pixels in ``reference_mask`` that are in ``mask`` as well; 0 without any."""
    total = int(np.count_nonzero(reference_mask))
    return float(np.count_nonzero(mask & reference_mask) / total) if total else 0.0
