"""What accuracy means: an algorithm's visibility against truth, pixel by pixel, on the same points.

`D` are the decidable pixels of the surface. A pixel's class is shadow where visibility is under 0.5. Every figure is defined
for every picture: a share of nothing is 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.truth.truth import Truth
from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal

INTERIOR_PX = 2.0
"""Errors within this of truth's boundary (and within two texel footprints) are the boundary's, not the interior's."""

MOST_INTERIOR = 0.001
"""Share of the decidable pixels that may be wrong inside a shadow or a light: more is failure, not aliasing."""

MIN_PART_PX = 8
"""Size from which a connected part of wrong interior pixels counts as one."""

COVERAGE_BLOCK_PX = 16
"""Side of the blocks that coverage is compared in."""

LEAST_SIGHT = 0.2
"""Share of the cast shadow that a figure has to see before it says anything of a picture: below that the picture is not tested."""

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
_SQUARE = np.ones((3, 3), bool)


@dataclass(frozen=True)
class Errors:
    """Figures of one picture; shares in [0, 1].

    Attributes
    ----------
    wrong
        Share of D whose class is wrong.
    wrong_cast
        Wrong pixels as a share of those that truth or the algorithm puts in cast shadow (attached excluded); 0 without any.
    false_shadow, missed_shadow
        Wrong among truth-lit and among truth-shadowed pixels of D.
    edge_mean, edge_p95, edge_mean_m, edge_p95_m
        Symmetric distance between the class boundaries of shadow components that overlap, in pixels and in
        metres; 0 where there are none.
    interior, interior_parts
        Share of D wrong and farther from truth's boundary than 2 px and two texel footprints; and the number of its
        connected parts of 8 px or more.
    interior_sees
        Share of the true cast shadow that lies so far inside (``SeenShadow``): had all of it been lost, this much would show in
        ``interior``. Coarse texels make it blind: then only ``wrong_cast`` tells.
    boundary
        Share of the surface that is not decidable.
    soft_error
        Mean absolute difference of visibility over the surface, from that of the light as an area where that is known.
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
class SeenShadow:
    """How much of a picture's cast shadow a figure can see, and how much of it is wrong wherever the figure looks.

    Attributes
    ----------
    cast_px
        Decidable pixels in cast shadow by truth (attached excluded); of a figure of edges, their boundary.
    seen_px
        Those that the figure would count, had the whole cast shadow been lost; of edges, those it found a counterpart to.
    wrong_px, either_px
        Decidable pixels that are not attached and wrong, and those that truth or the algorithm puts in cast shadow.
    """

    cast_px: int
    seen_px: int
    wrong_px: int
    either_px: int

    @property
    def sees(self) -> float:
        """Share of the cast shadow that the figure sees; 0 without any."""
        return self.seen_px / self.cast_px if self.cast_px else 0.0

    @property
    def wrong_cast(self) -> float:
        """Wrong pixels as a share of those that truth or the algorithm puts in cast shadow; 0 without any."""
        return self.wrong_px / self.either_px if self.either_px else 0.0


def sight_of(dark: np.ndarray, truth: Truth, looks_at: np.ndarray) -> SeenShadow:
    """What a figure that counts wrong pixels where ``looks_at`` says (rows, cols) sees of a class (rows, cols), True in shadow."""
    known, true_dark = truth.decidable & ~truth.attached, ~truth.lit & truth.there
    dark, cast = dark & truth.there, known & true_dark
    counts = cast, cast & looks_at, known & (dark != true_dark), known & (dark | true_dark)
    return SeenShadow(*(int(np.count_nonzero(each)) for each in counts))


def edge_sight(dark: np.ndarray, truth: Truth) -> SeenShadow:
    """What distances between edges see: the boundary of those components of the cast shadow that the class meets at all."""
    from scipy.ndimage import label

    known, true_dark = truth.there & ~truth.attached, ~truth.lit & truth.there
    everywhere = sight_of(dark, truth, true_dark)
    edge = boundary(true_dark, truth.there) & known
    parts, _ = label(true_dark, structure=_SQUARE)
    met = np.unique(parts[true_dark & dark & truth.there])
    seen = edge & np.isin(parts, met[met > 0])
    return SeenShadow(int(edge.sum()), int(seen.sum()), everywhere.wrong_px, everywhere.either_px)


def far_inside(truth: Truth, texel_footprint_px: float | np.ndarray = 0.0) -> np.ndarray:
    """Where ``interior`` looks (rows, cols): farther from truth's boundary than 2 px and two texel footprints."""
    return _from_edges_px(truth) > np.maximum(INTERIOR_PX, 2.0 * texel_footprint_px)


def errors_of(
    visibility: np.ndarray,
    truth: Truth,
    pixel_m: float,
    texel_footprint_px: float | np.ndarray = 0.0,
    true_visibility: np.ndarray | None = None,
) -> Errors:
    """Hold a visibility (rows, cols) in [0, 1], attached shadow included, against truth.

    ``pixel_m`` is a pixel's side on the receiver; ``texel_footprint_px`` that of an algorithm's texel in pixels, if it has any:
    one number, or one a pixel (rows, cols). ``true_visibility`` (rows, cols) is that of the light as an area, NaN where it is not
    known; ``None``: the light is a point.
    """
    from scipy.ndimage import label

    if true_visibility is None:
        true_visibility = np.where(truth.there, truth.lit, np.nan)
    decidable = truth.decidable
    dark = (np.nan_to_num(visibility, nan=1.0) < 0.5) & truth.there
    true_dark = ~truth.lit & truth.there
    wrong = decidable & (dark != true_dark)
    cast = decidable & (dark | true_dark) & ~truth.attached
    distances = edge_distances(dark, true_dark, truth.there)
    looks_at = far_inside(truth, texel_footprint_px)
    inside = wrong & looks_at
    parts, count = label(inside, structure=_SQUARE)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    mean, p95 = (float(distances.mean()), float(np.quantile(distances, 0.95))) if distances.size else (0.0, 0.0)
    return Errors(
        wrong=_share(wrong, decidable),
        wrong_cast=_share(wrong & ~truth.attached, cast),
        false_shadow=_share(wrong & truth.lit, decidable & truth.lit),
        missed_shadow=_share(wrong & true_dark, decidable & true_dark),
        edge_mean=mean,
        edge_p95=p95,
        edge_mean_m=mean * pixel_m,
        edge_p95_m=p95 * pixel_m,
        interior=_share(inside, decidable),
        interior_parts=int((sizes >= MIN_PART_PX).sum()),
        interior_sees=sight_of(dark, truth, looks_at).sees,
        boundary=truth.boundary,
        soft_error=soft_error(visibility, true_visibility),
    )


def edge_distances(dark: np.ndarray, true_dark: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Distances in pixels, both ways, between the boundaries of overlapping shadow components of two pictures.

    A component that meets none of the other picture was lost or invented: it counts in ``interior``, not here.
    """
    from scipy.ndimage import label
    from scipy.spatial import KDTree

    edges = []
    for near, far in ((dark, true_dark), (true_dark, dark)):
        parts, _ = label(near, structure=_SQUARE)
        shared = np.unique(parts[far & near])
        edges.append(boundary(np.isin(parts, shared[shared > 0]), there))
    if not (edges[0].any() and edges[1].any()):
        return np.zeros(0)
    near, far = (np.argwhere(edge) for edge in edges)
    return np.concatenate([KDTree(b).query(a)[0] for a, b in ((near, far), (far, near))])


def boundary(dark: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Shadow pixels beside a lit one (of the four neighbours); the borders of surface and picture are no boundary."""
    from scipy.ndimage import binary_dilation

    return dark & binary_dilation(there & ~dark, structure=_CROSS)


def interior(wrong: np.ndarray, true_dark: np.ndarray, there: np.ndarray, distance_px: float | np.ndarray) -> np.ndarray:
    """Wrong pixels farther than a distance from truth's boundary: all of them where truth has none."""
    return wrong & (from_edges_px(true_dark, there) > distance_px)


def from_edges_px(dark: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Each pixel's distance (rows, cols) to the nearest one on either side of a shadow's boundary; infinite without any."""
    from scipy.ndimage import distance_transform_edt

    edge = boundary(dark, there) | boundary(there & ~dark, there)
    return distance_transform_edt(~edge) if edge.any() else np.full(dark.shape, np.inf)


def seen_from(row: np.ndarray, col: np.ndarray, distance_px: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Which pixels of a picture, bool of a shape, decide whether a shadow's boundary runs within distances (n,) of pixels (n,)."""
    out = np.zeros(shape, bool)
    _mark_round(row, col, distance_px, out)
    return out


def far_from_edges(dark: np.ndarray, there: np.ndarray, row: np.ndarray, col: np.ndarray, distance_px: np.ndarray) -> np.ndarray:
    """Which pixels (n,) lie farther than distances (n,) from both sides of a shadow's boundary (``from_edges_px``): bool (n,), of
    the classes ``seen_from`` there alone.
    """
    return _far_from_edges(dark, there, row, col, distance_px)


@compiled
def _mark_round(row, col, distance, out):
    rows, cols = out.shape
    for n in range(len(row)):
        reach = int(min(distance[n], rows + cols)) + 1
        for i in range(max(row[n] - reach, 0), min(row[n] + reach + 1, rows)):
            for j in range(max(col[n] - reach, 0), min(col[n] + reach + 1, cols)):
                out[i, j] = True


@compiled
def _far_from_edges(dark, there, row, col, distance):
    rows, cols = dark.shape
    out = np.ones(len(row), np.bool_)
    for n in range(len(row)):
        reach = int(min(distance[n], rows + cols))
        for i in range(max(row[n] - reach, 0), min(row[n] + reach + 1, rows)):
            for j in range(max(col[n] - reach, 0), min(col[n] + reach + 1, cols)):
                near = (i - row[n]) ** 2 + (j - col[n]) ** 2 <= distance[n] * distance[n]
                if near and there[i, j] and _is_edge(dark, there, i, j):
                    out[n] = False
                    break
            if not out[n]:
                break
    return out


@internal
def _is_edge(dark, there, i, j):
    """Whether one of the four pixels beside one is of the other class."""
    rows, cols = dark.shape
    own = dark[i, j]
    return (
        (i > 0 and there[i - 1, j] and dark[i - 1, j] != own)
        or (i + 1 < rows and there[i + 1, j] and dark[i + 1, j] != own)
        or (j > 0 and there[i, j - 1] and dark[i, j - 1] != own)
        or (j + 1 < cols and there[i, j + 1] and dark[i, j + 1] != own)
    )


@cached("light", 512 * MIB)
def _from_edges_px(truth: Truth) -> np.ndarray:
    """The distances from the edges of a truth that many pictures are held against."""
    return from_edges_px(~truth.lit & truth.there, truth.there)


def block_shares(shadow_share: np.ndarray) -> np.ndarray:
    """Means of whole 16 x 16 px blocks of a picture (rows, cols); NaN where a block has no surface.

    Rows and columns at the end that fill no block are left out.
    """
    rows, cols = (size // COVERAGE_BLOCK_PX * COVERAGE_BLOCK_PX for size in shadow_share.shape)
    blocks = shadow_share[:rows, :cols].reshape(
        rows // COVERAGE_BLOCK_PX, COVERAGE_BLOCK_PX, cols // COVERAGE_BLOCK_PX, COVERAGE_BLOCK_PX
    )
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def coverage_error(share: np.ndarray, true_share: np.ndarray) -> float:
    """Mean difference of the shadow shares of blocks (any shape), in [0, 1]; NaN blocks do not count."""
    difference = np.abs(share - true_share)
    return float(np.nanmean(difference)) if np.isfinite(difference).any() else 0.0


def soft_error(visibility: np.ndarray, true_visibility: np.ndarray) -> float:
    """Mean absolute difference of visibilities in [0, 1] over the surface, as far as both are known (NaN: not)."""
    difference = np.abs(visibility - true_visibility)
    return float(np.nanmean(difference)) if np.isfinite(difference).any() else 0.0


def _share(part: np.ndarray, reference: np.ndarray) -> float:
    total = int(np.count_nonzero(reference))
    return float(np.count_nonzero(part & reference) / total) if total else 0.0
