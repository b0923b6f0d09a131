"""Pictures of trees: mip levels keep coverage and colour, and outlines look like trees."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, gaussian_filter

from skugga.terrain.errors import InputError
from skugga.terrain.trees import foliage as module
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, TREE_VARIANTS, Foliage, coverage_mips, foliage
from skugga.terrain.trees.foliage_paint import WhorledTree

WHORLED_VARIANTS = [i for i, (_, model) in enumerate(module._VARIANT_MODELS) if isinstance(model, WhorledTree)]
SIDE_VIEW_LAYERS = range(0, 2 * len(TREE_VARIANTS), 2)
LAYERS = range(2 * len(TREE_VARIANTS))


def bilinear_matrix(n: int, points: int = 4) -> np.ndarray:
    """Return the matrix (points * n, n) that samples n texels at the centres of ``points`` parts of each, clamped to the edge."""
    texel_positions = np.clip((np.arange(points * n) + 0.5) / points - 0.5, 0.0, n - 1.0)
    return np.maximum(1.0 - np.abs(texel_positions[:, None] - np.arange(n)), 0.0)


def coverage(rgba: np.ndarray, threshold: float = ALPHA_THRESHOLD) -> float:
    """Return the share of a picture (rows, cols, 4) whose interpolated alpha is at least ``threshold``."""
    alpha = rgba[..., 3] / 255.0
    return float((bilinear_matrix(alpha.shape[0]) @ alpha @ bilinear_matrix(alpha.shape[1]).T >= threshold).mean())


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Return linear colours in [0, 1] of sRGB values from 0 to 255."""
    value = srgb / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def opaque_mask(rgba: np.ndarray) -> np.ndarray:
    """Return the mask of texels that the alpha test keeps (rows, cols)."""
    return rgba[..., 3] >= 255 * ALPHA_THRESHOLD


def pattern(kind: str, size: int = 64) -> np.ndarray:
    """Return a field from which any quantile cuts out the requested coverage."""
    rng = np.random.default_rng(7)
    y, x = np.indices((size, size)) - (size - 1) / 2
    fields = {
        "noise": rng.random((size, size)),
        "fine blobs": gaussian_filter(rng.random((size, size)), 2, mode="wrap"),
        "coarse blobs": gaussian_filter(rng.random((size, size)), 12, mode="wrap"),
        "disc": np.hypot(x, y),
        "half": x + 1e-3 * y,
        "stripes": np.mod(x, 16) + 1e-3 * y,
        "dots": np.hypot(np.mod(x, 16) - 8, np.mod(y, 16) - 8),
    }
    return fields[kind]


def cut_out_picture(field: np.ndarray, share: float) -> np.ndarray:
    """Return a picture (rows, cols, 4) that is opaque where ``field`` is among its smallest values; ``share`` is their share."""
    alpha = np.where(field <= np.quantile(field, share), 255, 0).astype(np.uint8)
    return np.dstack([np.full(alpha.shape, 80, np.uint8)] * 3 + [alpha])


@pytest.fixture(scope="module")
def pictures() -> Foliage:
    """Pictures of the leaves."""
    return foliage()


@pytest.mark.parametrize("kind", ["noise", "fine blobs", "coarse blobs", "disc", "half", "stripes", "dots"])
@pytest.mark.parametrize("share", np.arange(1, 10) / 10)
def test_mips_keep_coverage(kind: str, share: float) -> None:
    mip_levels = coverage_mips(cut_out_picture(pattern(kind), share), ALPHA_THRESHOLD)
    assert [level.shape[0] for level in mip_levels] == [64, 32, 16, 8, 4]
    assert coverage(mip_levels[0]) == pytest.approx(share, abs=0.06)  # bilinear magnification moves the edges slightly
    for level in mip_levels[1:-1]:
        assert coverage(level) == pytest.approx(coverage(mip_levels[0]), abs=0.02)


def test_plain_means_do_not_keep_coverage() -> None:
    """Plain means lose coverage, so the test above can fail."""
    alpha = cut_out_picture(pattern("fine blobs"), 0.2)[..., 3] / 255.0
    mean = alpha.reshape(8, 8, 8, 8).mean(axis=(1, 3))
    assert coverage(np.dstack([255 * mean] * 4)) < 0.05 < coverage(np.dstack([255 * alpha] * 4))


@pytest.mark.parametrize("threshold", [0.2, 0.8])
def test_mips_keep_coverage_at_other_thresholds(threshold: float) -> None:
    mip_levels = coverage_mips(cut_out_picture(pattern("fine blobs"), 0.4), threshold)
    for level in mip_levels[1:-1]:
        assert coverage(level, threshold) == pytest.approx(coverage(mip_levels[0], threshold), abs=0.02)


@pytest.mark.parametrize("alpha", [0, 255])
def test_empty_and_full_pictures_keep_their_coverage(alpha: int) -> None:
    mip_levels = coverage_mips(np.full((32, 64, 4), alpha, np.uint8), ALPHA_THRESHOLD)
    assert [level.shape for level in mip_levels] == [(32, 64, 4), (16, 32, 4), (8, 16, 4), (4, 8, 4)]
    assert {coverage(level) for level in mip_levels} == {alpha / 255.0}


def test_mips_do_not_change_opaque_texels_of_level_0() -> None:
    rgba = np.random.default_rng(3).integers(0, 256, (64, 64, 4), dtype=np.uint8)
    level = coverage_mips(rgba, ALPHA_THRESHOLD)[0]
    assert np.array_equal(level[..., 3], rgba[..., 3])
    assert np.array_equal(level[rgba[..., 3] > 0], rgba[rgba[..., 3] > 0])


def test_no_colour_leaks_from_transparent_texels() -> None:
    rgba = np.zeros((64, 64, 4), np.uint8)  # transparent black
    rgba[pattern("disc", 64) < 20] = (180, 60, 20, 255)
    for level in coverage_mips(rgba, ALPHA_THRESHOLD):
        assert (level[..., :3] == (180, 60, 20)).all()


def test_mips_average_in_linear_light() -> None:
    rgba = np.full((8, 8, 4), 255, np.uint8)
    rgba[::2, :, :3] = 0
    assert (coverage_mips(rgba, ALPHA_THRESHOLD)[1][..., :3] == 188).all()  # half the light, not half the code value


@pytest.mark.parametrize("shape", [(6, 8, 4), (2, 4, 4), (8, 8, 3), (8, 8)])
def test_picture_of_another_shape_is_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="powers of two"):
        coverage_mips(np.zeros(shape, np.uint8), ALPHA_THRESHOLD)


@pytest.mark.parametrize("threshold", [0.0, 1.0, float("nan")])
def test_threshold_outside_alpha_is_rejected(threshold: float) -> None:
    with pytest.raises(InputError, match="threshold"):
        coverage_mips(np.zeros((8, 8, 4), np.uint8), threshold)


def test_tree_variants_cover_both_species() -> None:
    assert len({variant.name for variant in TREE_VARIANTS}) == len(TREE_VARIANTS)
    assert sum(variant.species == "conifer" for variant in TREE_VARIANTS) >= 4
    assert sum(variant.species == "broadleaf" for variant in TREE_VARIANTS) >= 4
    assert {variant.species for variant in TREE_VARIANTS} == {"conifer", "broadleaf"}
    assert all(0.0 < variant.crown_quad_height < 1.0 and 0.1 < variant.crown_to_height < 1.2 for variant in TREE_VARIANTS)


def test_tree_variants_have_the_proportions_of_their_models() -> None:
    assert all(variant.crown_to_height == pytest.approx(2.0 * model.crown_radius) for variant, model in module._VARIANT_MODELS)


def test_foliage_has_a_full_mip_chain(pictures: Foliage) -> None:
    sizes = [256, 128, 64, 32, 16, 8, 4]
    assert [level.shape for level in pictures.mip_levels] == [(2 * len(TREE_VARIANTS), s, s, 4) for s in sizes]
    assert all(level.dtype == np.uint8 for level in pictures.mip_levels)


def test_foliage_is_reproducible(pictures: Foliage) -> None:
    def digest(foliage_arrays: Foliage) -> str:
        return hashlib.sha256(b"".join(level.tobytes() for level in foliage_arrays.mip_levels)).hexdigest()

    assert digest(foliage.__wrapped__()) == digest(pictures)
    assert foliage() is pictures


def test_layers_are_different_pictures(pictures: Foliage) -> None:
    assert len({layer.tobytes() for layer in pictures.mip_levels[0]}) == 2 * len(TREE_VARIANTS)


@pytest.mark.parametrize("layer", LAYERS)
def test_tree_mips_keep_coverage(pictures: Foliage, layer: int) -> None:
    for level in pictures.mip_levels[1:-1]:
        assert coverage(level[layer]) == pytest.approx(coverage(pictures.mip_levels[0][layer]), abs=0.02)


@pytest.mark.parametrize("layer", LAYERS)
def test_outermost_texels_are_transparent(pictures: Foliage, layer: int) -> None:
    alpha = pictures.mip_levels[0][layer, ..., 3]
    assert not alpha[0].any() and not alpha[:, 0].any() and not alpha[:, -1].any()
    foot = np.flatnonzero(alpha[-1])
    if layer in SIDE_VIEW_LAYERS:
        assert np.abs(foot - 127.5).max() < 20  # the stem
    else:
        assert foot.size == 0


@pytest.mark.parametrize("layer", SIDE_VIEW_LAYERS)
def test_stem_reaches_from_the_last_row_to_the_top(pictures: Foliage, layer: int) -> None:
    is_opaque = opaque_mask(pictures.mip_levels[0][layer])
    assert is_opaque[-1, 127:129].all()
    assert is_opaque[1:].any(axis=1).all() and is_opaque[1].any()


@pytest.mark.parametrize("layer", LAYERS)
def test_crown_spans_the_width(pictures: Foliage, layer: int) -> None:
    is_opaque = opaque_mask(pictures.mip_levels[0][layer])
    spans = [np.ptp(np.flatnonzero(row)) + 1 for row in is_opaque if row.any()]
    assert max(spans) >= 0.9 * 256
    if layer not in SIDE_VIEW_LAYERS:
        assert np.ptp(np.flatnonzero(is_opaque.any(axis=1))) + 1 >= 0.9 * 256


@pytest.mark.parametrize("variant", WHORLED_VARIANTS)
def test_whorled_conifer_narrows_upwards(pictures: Foliage, variant: int) -> None:
    width = opaque_mask(pictures.mip_levels[0][2 * variant]).sum(axis=1)
    thirds = [band.mean() for band in np.array_split(width[1:230], 3)]
    assert 1.5 * thirds[0] < thirds[1] and 1.15 * thirds[1] < thirds[2]


@pytest.mark.parametrize("variant", range(len(TREE_VARIANTS)))
def test_crown_is_closed_inside_and_open_at_the_rim(pictures: Foliage, variant: int) -> None:
    is_opaque = opaque_mask(pictures.mip_levels[0][2 * variant + 1])
    y, x = np.indices(is_opaque.shape) - 127.5
    radius = np.hypot(x, y) / 128.0
    assert is_opaque[radius < 0.5].mean() > 0.8
    assert 0.02 < is_opaque[(radius > 0.85) & (radius < 1.0)].mean() < 0.75
    assert not is_opaque[radius > 1.0].any()


@pytest.mark.parametrize("layer", LAYERS)
def test_foliage_colour_is_an_albedo_of_leaves(pictures: Foliage, layer: int) -> None:
    rgba = pictures.mip_levels[0][layer]
    red, green, blue = linear_from_srgb(rgba[opaque_mask(rgba)][:, :3]).mean(axis=0)
    assert 0.03 < green < 0.15
    assert blue < red < green


@pytest.mark.parametrize("layer", LAYERS)
def test_tree_mips_keep_colour(pictures: Foliage, layer: int) -> None:
    expected = linear_from_srgb(pictures.mip_levels[0][layer][opaque_mask(pictures.mip_levels[0][layer])][:, :3]).mean(axis=0)
    for level in pictures.mip_levels[1:-1]:
        mean = linear_from_srgb(level[layer][opaque_mask(level[layer])][:, :3]).mean(axis=0)
        assert mean == pytest.approx(expected, rel=0.13)


@pytest.mark.parametrize("layer", LAYERS)
def test_transparent_texels_near_a_tree_have_its_colour(pictures: Foliage, layer: int) -> None:
    for level in pictures.mip_levels[:3]:
        rgba = level[layer]
        near = binary_dilation(opaque_mask(rgba), iterations=2) & (rgba[..., 3] == 0)
        weight = rgba[..., 3:] / 255.0
        light, share = (gaussian_filter(values, (1.5, 1.5, 0)) for values in (linear_from_srgb(rgba[..., :3]) * weight, weight))
        ratio = linear_from_srgb(rgba[near][:, :3]).sum(axis=1) / (light[near] / share[near]).sum(axis=1)
        assert np.abs(ratio - 1.0).mean() < 0.2
