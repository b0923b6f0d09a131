"""Pictures (impostors) on a tree's crossed quads: side view and top view of each variant, with mip levels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.errors import InputError
from skugga.terrain.srgb import linear_of_srgb, srgb_of_linear
from skugga.terrain.trees.cached_pictures import cached_pictures
from skugga.terrain.trees.foliage_paint import ClumpedTree, WhorledTree, paint

ALPHA_THRESHOLD = 0.5  # alpha test: points with at least this alpha are opaque
TEXTURE_PX = 256
SMALLEST_MIP_PX = 4
COVERAGE_SAMPLES_PER_AXIS = 4  # sampling points per texel and axis for measuring coverage
DITHER_AMPLITUDES = (0.0, 0.125, 0.5, 2.0)  # amplitudes of the dither, relative to alpha, tried in this order
COVERAGE_TOLERANCE = 0.004  # accepted difference of coverage


@dataclass(frozen=True)
class TreeVariant:
    """A kind of tree.

    Attributes
    ----------
    name
        Common name.
    species
        "conifer" or "broadleaf".
    crown_quad_height
        Height of the horizontal crown quad, as a share of the tree's height.
    crown_to_height
        Crown diameter over tree height in the painted pictures.
    """

    name: str
    species: str
    crown_quad_height: float
    crown_to_height: float


@dataclass(frozen=True, eq=False)
class Foliage:
    """The pictures of all variants.

    Attributes
    ----------
    mip_levels
        Mip levels, each uint8 (2 * variants, s, s, 4) with s = 256, 128 ... 4: sRGB albedo and alpha, not premultiplied. Layer
        2 * variant is the side view: row 0 at the tree's top, the stem's foot in the middle of the last row. Layer
        2 * variant + 1 is the top view. Clamp to the edge when sampling.
    """

    mip_levels: tuple[np.ndarray, ...]


_VARIANT_MODELS: tuple[tuple[TreeVariant, WhorledTree | ClumpedTree], ...] = (
    (
        TreeVariant("spruce", "conifer", 0.2, 0.3),
        WhorledTree(
            crown_radius=0.15,
            crown_base=0.07,
            whorl_count=40,
            branches_per_whorl=8,
            lowest_branch_slope=-0.1,
            highest_branch_slope=0.7,
            branch_sag=0.5,
            tip_upturn=0.35,
            twig_droop=0.9,
            missing_share=0.12,
            outline_exponent=0.95,
            twig_length=0.036,
            twig_spacing=0.0055,
            twig_half_width=0.0021,
            stem_radius=0.009,
            needle_albedo=(0.06, 0.098, 0.044),
            bark_albedo=(0.11, 0.085, 0.065),
        ),
    ),
    (
        TreeVariant("fir", "conifer", 0.2, 0.36),
        WhorledTree(
            crown_radius=0.18,
            crown_base=0.04,
            whorl_count=36,
            branches_per_whorl=9,
            lowest_branch_slope=0.0,
            highest_branch_slope=0.45,
            branch_sag=0.15,
            tip_upturn=0.12,
            twig_droop=0.1,
            missing_share=0.06,
            outline_exponent=0.75,
            twig_length=0.042,
            twig_spacing=0.0055,
            twig_half_width=0.0026,
            stem_radius=0.0105,
            needle_albedo=(0.056, 0.097, 0.052),
            bark_albedo=(0.13, 0.12, 0.105),
        ),
    ),
    (
        TreeVariant("larch", "conifer", 0.25, 0.34),
        WhorledTree(
            crown_radius=0.17,
            crown_base=0.14,
            whorl_count=28,
            branches_per_whorl=6,
            lowest_branch_slope=0.1,
            highest_branch_slope=0.6,
            branch_sag=0.5,
            tip_upturn=0.4,
            twig_droop=0.9,
            missing_share=0.2,
            outline_exponent=0.75,
            twig_length=0.034,
            twig_spacing=0.007,
            twig_half_width=0.0019,
            stem_radius=0.0095,
            needle_albedo=(0.08, 0.118, 0.045),
            bark_albedo=(0.13, 0.095, 0.075),
        ),
    ),
    (
        TreeVariant("pine", "conifer", 0.7, 0.4),
        ClumpedTree(
            crown_radius=0.2,
            crown_base=0.5,
            widest_height=0.45,
            outline_exponent=2.0,
            clump_count=34,
            clump_radius=0.06,
            min_clump_distance=0.3,
            clump_flatness=0.5,
            sprig_droop=0.0,
            sprigs_per_clump=20,
            leaves_per_sprig=22,
            leaf_size=(0.013, 0.0012),
            lowest_limb_height=0.5,
            stem_radius=0.011,
            leaf_albedo=(0.068, 0.106, 0.051),
            bark_albedo=(0.14, 0.1, 0.075),
            limb_albedo=(0.22, 0.115, 0.065),
        ),
    ),
    (
        TreeVariant("oak", "broadleaf", 0.5, 0.9),
        ClumpedTree(
            crown_radius=0.45,
            crown_base=0.16,
            widest_height=0.42,
            outline_exponent=2.3,
            clump_count=75,
            clump_radius=0.115,
            min_clump_distance=0.25,
            clump_flatness=0.7,
            sprig_droop=0.1,
            sprigs_per_clump=24,
            leaves_per_sprig=19,
            leaf_size=(0.011, 0.0034),
            lowest_limb_height=0.17,
            stem_radius=0.026,
            leaf_albedo=(0.073, 0.112, 0.04),
            bark_albedo=(0.12, 0.1, 0.08),
            limb_albedo=(0.09, 0.075, 0.06),
        ),
    ),
    (
        TreeVariant("beech", "broadleaf", 0.5, 0.62),
        ClumpedTree(
            crown_radius=0.31,
            crown_base=0.12,
            widest_height=0.45,
            outline_exponent=2.0,
            clump_count=80,
            clump_radius=0.095,
            min_clump_distance=0.2,
            clump_flatness=0.6,
            sprig_droop=0.15,
            sprigs_per_clump=24,
            leaves_per_sprig=14,
            leaf_size=(0.009, 0.003),
            lowest_limb_height=0.16,
            stem_radius=0.019,
            leaf_albedo=(0.07, 0.115, 0.04),
            bark_albedo=(0.17, 0.165, 0.15),
            limb_albedo=(0.13, 0.125, 0.11),
        ),
    ),
    (
        TreeVariant("birch", "broadleaf", 0.5, 0.42),
        ClumpedTree(
            crown_radius=0.21,
            crown_base=0.16,
            widest_height=0.38,
            outline_exponent=1.8,
            clump_count=80,
            clump_radius=0.06,
            min_clump_distance=0.2,
            clump_flatness=0.9,
            sprig_droop=0.9,
            sprigs_per_clump=20,
            leaves_per_sprig=12,
            leaf_size=(0.0075, 0.0022),
            lowest_limb_height=0.22,
            stem_radius=0.011,
            leaf_albedo=(0.08, 0.12, 0.042),
            bark_albedo=(0.5, 0.48, 0.44),
            limb_albedo=(0.2, 0.17, 0.15),
        ),
    ),
    (
        TreeVariant("maple", "broadleaf", 0.5, 0.72),
        ClumpedTree(
            crown_radius=0.36,
            crown_base=0.2,
            widest_height=0.45,
            outline_exponent=2.1,
            clump_count=70,
            clump_radius=0.1,
            min_clump_distance=0.2,
            clump_flatness=0.8,
            sprig_droop=0.05,
            sprigs_per_clump=24,
            leaves_per_sprig=13,
            leaf_size=(0.011, 0.004),
            lowest_limb_height=0.2,
            stem_radius=0.018,
            leaf_albedo=(0.077, 0.116, 0.038),
            bark_albedo=(0.12, 0.105, 0.09),
            limb_albedo=(0.09, 0.08, 0.07),
        ),
    ),
)
TREE_VARIANTS: tuple[TreeVariant, ...] = tuple(variant for variant, _ in _VARIANT_MODELS)


PAINTER_FILES = tuple(Path(__file__).parent / name for name in ("foliage.py", "foliage_paint.py", "../srgb.py"))
"""Source files that determine the pictures (part of the cache key)."""

OUTLINE_GRID_SIDE_CELLS = 16
"""Cells along a side of the grid from which a picture's outline is derived."""


@cached("process", 256 * MIB)
def foliage() -> Foliage:
    """Return the pictures of ``TREE_VARIANTS``, painted once. They are the same on each machine."""
    return Foliage(cached_pictures(_paint_variants, PAINTER_FILES))


def _paint_variants() -> tuple[np.ndarray, ...]:
    """Return the ``mip_levels`` of ``Foliage``: the textures of all variants, painted anew."""
    layers = [
        coverage_mips(_texture(view, has_stem), ALPHA_THRESHOLD)
        for seed, (_, model) in enumerate(_VARIANT_MODELS)
        for view, has_stem in zip(paint(model, seed, TEXTURE_PX), (True, False), strict=True)
    ]
    return tuple(np.stack(level) for level in zip(*layers, strict=True))


@cached("process", MIB)
def leaf_outlines() -> np.ndarray:
    """Return a convex polygon round the opaque texels of each picture: corners float64 (2 * variants, k, 2).

    Coordinates in [0, 1] go right and up from the lower left corner. Polygons with fewer than k corners repeat their last one. A
    polygon may be too large by one cell, a sixteenth of the picture.
    """
    from scipy.spatial import ConvexHull

    alpha = foliage().mip_levels[0][..., 3]
    layers, side, _ = alpha.shape
    cells = (
        alpha.reshape(layers, OUTLINE_GRID_SIDE_CELLS, side // OUTLINE_GRID_SIDE_CELLS, OUTLINE_GRID_SIDE_CELLS, -1).max(
            axis=(2, 4)
        )
        >= ALPHA_THRESHOLD * 255
    )
    outlines = []
    for is_opaque in cells:
        row, col = np.nonzero(is_opaque)
        ends = [(col + dx, OUTLINE_GRID_SIDE_CELLS - row - dy) for dx in (0, 1) for dy in (0, 1)]
        corners = np.concatenate([np.stack(end, axis=1) for end in ends]) / OUTLINE_GRID_SIDE_CELLS
        outlines.append(corners[ConvexHull(corners).vertices])
    max_corners = max(map(len, outlines))
    return np.stack([np.pad(outline, ((0, max_corners - len(outline)), (0, 0)), mode="edge") for outline in outlines])


def coverage_mips(rgba: np.ndarray, threshold: float) -> tuple[np.ndarray, ...]:
    """Return alpha-tested mip levels that all cover the same share of the picture as the first level.

    With averaged alpha an alpha-tested picture thins out or closes up with distance. So each level's alpha is scaled until its
    coverage, the share of points at or above the threshold, equals that of level 0 (I. Castano, "Computing alpha mipmaps", 2010).
    The points are a 4 x 4 grid in each texel, sampled bilinearly and clamped to the edge, as on a graphics card.

    A fine regular pattern averages to an even alpha, where scaling covers all points or none. A fixed dither is then added to the
    alpha.

    Colours are means in linear light weighted by alpha. Texels without alpha take the colour of their surroundings.

    Parameters
    ----------
    rgba
        uint8 (h, w, 4), sRGB colour and alpha, not premultiplied. Sides are powers of two, at least 4.
    threshold
        Threshold of the alpha test, in (0, 1).

    Returns
    -------
    Levels uint8 (h, w, 4), (h/2, w/2, 4) ... down to a shorter side of 4. Level 0 keeps the alpha of ``rgba``.

    Raises
    ------
    InputError
        If the picture or the threshold is not as described.
    """
    rgba = np.asarray(rgba)
    sides = rgba.shape[:2]
    if rgba.dtype != np.uint8 or rgba.ndim != 3 or rgba.shape[2] != 4 or any(n < SMALLEST_MIP_PX or n & (n - 1) for n in sides):
        raise InputError("rgba", f"{rgba.dtype} {rgba.shape}", "uint8 (h, w, 4) with h and w powers of two, at least 4")
    if not 0.0 < threshold < 1.0:
        raise InputError("threshold", threshold, "numbers above 0 and below 1")

    alpha = [rgba[..., 3] / 255.0]
    light = [linear_of_srgb(rgba[..., :3] / 255.0) * alpha[0][..., None]]
    while min(alpha[-1].shape) > SMALLEST_MIP_PX:
        alpha.append(_downsample(alpha[-1]))
        light.append(_downsample(light[-1]))
    target_coverage = _coverage(rgba[..., 3], threshold * 255.0)
    alpha_levels = [rgba[..., 3]] + [_match_coverage(level, target_coverage, threshold) for level in alpha[1:]]
    colours = (_to_bytes(srgb_of_linear(colour)) for colour in _fill_transparent(light, alpha))
    return tuple(np.dstack([colour, level]) for colour, level in zip(colours, alpha_levels, strict=True))


def _texture(view: np.ndarray, has_stem: bool) -> np.ndarray:
    """Convert a painted view to bytes and clear its border texels. With ``has_stem`` the stem keeps its foot on the last row."""
    alpha = view[..., 3].copy()
    foot = alpha[-1].copy()
    alpha[[0, -1]] = 0.0
    alpha[:, [0, -1]] = 0.0
    if has_stem:
        alpha[-1, 1:-1] = foot[1:-1]
    return np.dstack([_to_bytes(srgb_of_linear(view[..., :3])), _to_bytes(alpha)])


def _match_coverage(alpha: np.ndarray, target_coverage: float, threshold: float) -> np.ndarray:
    """Return alpha as uint8, scaled so that its coverage is nearest to ``target_coverage``, with a dither if needed."""
    best, error = _to_bytes(alpha), np.inf
    row, column = np.indices(alpha.shape)
    # Ordered dither for any size: the R2 sequence (M. Roberts, 2018).
    dither_pattern = (0.7548776662466927 * column + 0.5698402909980532 * row) % 1.0 - 0.5
    for dither in DITHER_AMPLITUDES:
        dithered_alpha = alpha * np.maximum(1.0 + dither * dither_pattern, 0.0)
        low, high = -10.0, 10.0  # octaves of the scale
        for _ in range(18):
            middle = 0.5 * (low + high)
            scaled = _to_bytes(np.minimum(dithered_alpha * 2.0**middle, 1.0))
            share = _coverage(scaled, threshold * 255.0)
            if abs(share - target_coverage) < error:
                best, error = scaled, abs(share - target_coverage)
            low, high = (middle, high) if share < target_coverage else (low, middle)
        if error <= COVERAGE_TOLERANCE:
            break
    return best


@compiled
def _coverage(alpha, threshold):
    """Return the share of points at which bilinear alpha is at least ``threshold``.

    The points are ``COVERAGE_SAMPLES_PER_AXIS`` squared in each texel.
    """
    height, width = alpha.shape
    covered = 0
    for i in range(height * COVERAGE_SAMPLES_PER_AXIS):
        y = (i + 0.5) / COVERAGE_SAMPLES_PER_AXIS - 0.5
        i0 = int(np.floor(y))
        v = y - i0
        above, below = alpha[max(i0, 0)], alpha[min(i0 + 1, height - 1)]
        for j in range(width):
            for k in range(COVERAGE_SAMPLES_PER_AXIS):
                x = (k + 0.5) / COVERAGE_SAMPLES_PER_AXIS - 0.5
                j0 = j - 1 if x < 0.0 else j
                u = x - (j0 - j)
                a, b = max(j0, 0), min(j0 + 1, width - 1)
                upper = above[a] + u * (float(above[b]) - above[a])
                lower = below[a] + u * (float(below[b]) - below[a])
                covered += upper + v * (lower - upper) >= threshold
    return covered / (height * width * COVERAGE_SAMPLES_PER_AXIS * COVERAGE_SAMPLES_PER_AXIS)


def _fill_transparent(light: list[np.ndarray], alpha: list[np.ndarray]) -> list[np.ndarray]:
    """Return the linear colours of all levels, coarsest last. Texels without alpha take the colour of the next coarser level."""
    weight = alpha[-1].sum()
    coarser = np.broadcast_to(light[-1].sum(axis=(0, 1)) / weight if weight else np.zeros(3), light[-1].shape)
    colours = []
    for level, (premultiplied, share) in enumerate(zip(light[::-1], alpha[::-1], strict=True)):
        surroundings = coarser if level == 0 else np.repeat(np.repeat(coarser, 2, axis=0), 2, axis=1)
        is_transparent = share[..., None] == 0.0
        coarser = np.where(is_transparent, surroundings, premultiplied / np.where(is_transparent, 1.0, share[..., None]))
        colours.append(coarser)
    return colours[::-1]


def _downsample(values: np.ndarray) -> np.ndarray:
    """Return the means (h / 2, w / 2, ...) of 2 x 2 texels of values (h, w, ...)."""
    return 0.25 * (values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2])


def _to_bytes(values: np.ndarray) -> np.ndarray:
    """Return values in [0, 1] as uint8 from 0 to 255."""
    return np.round(values * 255.0).astype(np.uint8)
