"""Error metrics on examples that are small enough for hand calculation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skugga.shadows.truth.metrics import (
    MIN_COVERED_SHARE,
    block_shadow_shares,
    coverage_error,
    distance_to_edges_px,
    edge_distances,
    edge_metric_coverage,
    edge_test_region,
    error_metrics,
    interior_error_mask,
    interior_region,
    is_far_from_edges,
    metric_coverage,
    shadow_boundary_mask,
    soft_error,
)
from skugga.shadows.truth.truth import Truth
from tests.metrics import flicker
from tests.shadows.truth import faults


def truth(lit, attached=None, decidable=None, valid=None) -> Truth:
    """Return truth from masks (rows, cols). By default no pixel has attached shadow, and all are decidable and valid."""
    lit = np.asarray(lit, bool)
    all_pixels = np.ones(lit.shape, bool)
    return Truth(
        lit,
        ~all_pixels if attached is None else np.asarray(attached, bool),
        all_pixels if decidable is None else np.asarray(decidable, bool),
        all_pixels if valid is None else np.asarray(valid, bool),
    )


def pixel_row(text: str) -> np.ndarray:
    """Return one row: 1 is lit, 0 is shadow."""
    return np.array([[float(c) for c in text]])


def test_error_metrics_shares_of_wrong_pixels():
    """Of ten decidable pixels, truth has four in shadow, one of them attached. One pixel is wrongly lit, one wrongly dark."""
    reference = truth(pixel_row("1111110000"), attached=pixel_row("0000000001"))
    metrics = error_metrics(pixel_row("1111101000"), reference, pixel_m=10.0)
    assert metrics.wrong == 2 / 10
    assert metrics.false_shadow == 1 / 6 and metrics.missed_shadow == 1 / 4
    # Pixels 5, 6, 7 and 8 are in cast shadow in either picture (9 is attached); two of them are wrong.
    assert metrics.wrong_cast == 2 / 4
    assert metrics.boundary == 0.0


def test_error_metrics_ignore_boundary_pixels():
    reference = truth(pixel_row("1111110000"), decidable=pixel_row("1111100111"))
    metrics = error_metrics(pixel_row("1111101000"), reference, pixel_m=1.0)
    assert metrics.wrong == metrics.wrong_cast == metrics.false_shadow == metrics.missed_shadow == 0.0
    assert metrics.boundary == pytest.approx(2 / 10)


def test_truth_cast_is_the_share_of_the_surface():
    """Of eight pixels that show a surface, three are in shadow, one of them attached. Pixels off the surface do not count."""
    reference = truth(pixel_row("1111100000"), attached=pixel_row("0000000100"), valid=pixel_row("1111111100"))
    assert reference.cast_share == 2 / 8
    assert truth(pixel_row("00"), valid=pixel_row("00")).cast_share == 0.0


def test_error_metrics_count_one_half_as_lit():
    assert error_metrics(np.array([[0.5, 0.49]]), truth([[1, 0]]), 1.0).wrong == 0.0


def test_boundary_is_shadow_pixels_beside_lit_ones():
    dark = np.array([[0, 0, 0, 0], [0, 1, 1, 1], [0, 1, 1, 1], [0, 1, 1, 1]], bool)
    expected = np.array([[0, 0, 0, 0], [0, 1, 1, 1], [0, 1, 0, 0], [0, 1, 0, 0]], bool)
    np.testing.assert_array_equal(shadow_boundary_mask(dark, np.ones((4, 4), bool)), expected)
    no_surface_above = np.ones((4, 4), bool)
    no_surface_above[0] = False
    assert shadow_boundary_mask(dark, no_surface_above)[1].tolist() == [False, True, False, False]


def test_edge_distances_of_a_displaced_edge():
    """A straight edge moves by 3 px, so every distance is 3, both ways."""
    reference, rendered = np.zeros((10, 20), bool), np.zeros((10, 20), bool)
    reference[:, 8:], rendered[:, 11:] = True, True
    all_pixels = np.ones((10, 20), bool)
    distances = edge_distances(rendered, reference, all_pixels)
    assert distances.size == 20 and (distances == 3.0).all()
    metrics = error_metrics((~rendered).astype(float), truth(~reference), pixel_m=30.0)
    assert (metrics.edge_mean, metrics.edge_p95, metrics.edge_mean_m, metrics.edge_p95_m) == (3.0, 3.0, 90.0, 90.0)


def test_edge_distances_of_edges_that_mostly_agree():
    """One row of twenty has its edge 10 px off. Of 40 distances two are about 10, and the others 0."""
    reference, rendered = np.zeros((20, 40), bool), np.zeros((20, 40), bool)
    reference[:, 10:], rendered[:, 10:] = True, True
    rendered[0, 10:20] = False
    distances = np.sort(edge_distances(rendered, reference, np.ones((20, 40), bool)))
    # The notch's own pixels: its floor at column 20 (row 0), and the row below it, columns 10 to 19, which is now an edge, too.
    assert (distances == 0).sum() == 38 and distances[-1] == pytest.approx(np.hypot(1, 9), abs=1.1)


def test_lost_and_invented_components_count_as_interior():
    reference, rendered = np.zeros((30, 60), bool), np.zeros((30, 60), bool)
    reference[5:25, 5:25] = True  # lost
    rendered[5:25, 35:55] = True  # invented
    metrics = error_metrics((~rendered).astype(float), truth(~reference), pixel_m=1.0)
    assert metrics.edge_mean == metrics.edge_p95 == 0.0
    assert metrics.interior_parts == 2
    # Pixels farther than 2 px from truth's boundary: the lost square's inner 20 - 2 * 2 - ... pixels, and all invented ones.
    assert metrics.interior == pytest.approx((16 * 16 + 400) / 1800, abs=16 * 4 / 1800)


def test_interior_excludes_pixels_near_the_boundary():
    reference = np.zeros((20, 20), bool)
    reference[:, 10:] = True
    wrong_mask = np.zeros((20, 20), bool)
    wrong_mask[:, 8:12] = True
    all_pixels = np.ones((20, 20), bool)
    assert not interior_error_mask(wrong_mask, reference, all_pixels, 2.0).any()
    wrong_mask[4, 3] = True
    assert interior_error_mask(wrong_mask, reference, all_pixels, 2.0).sum() == 1
    assert not interior_error_mask(wrong_mask, reference, all_pixels, 7.0).any()  # within two footprints of a coarse texel
    assert (
        interior_error_mask(wrong_mask, np.zeros((20, 20), bool), all_pixels, 2.0).sum() == wrong_mask.sum()
    )  # truth has no boundary


def test_interior_parts_have_at_least_eight_pixels():
    reference, rendered = np.zeros((40, 40), bool), np.zeros((40, 40), bool)
    rendered[5, 5:12] = True  # seven pixels
    rendered[20, 5:13] = True  # eight
    assert error_metrics((~rendered).astype(float), truth(~reference), 1.0).interior_parts == 1


def test_coverage_error_compares_shares_in_blocks():
    """The two blocks have shares 1/4 against 1/2, and 1 against 1. An incomplete block does not count."""
    share, reference = np.zeros((16, 35)), np.zeros((16, 35))
    share[:4, :16], reference[:8, :16] = 1.0, 1.0
    share[:, 16:32] = reference[:, 16:32] = 1.0
    reference[:, 32:] = 1.0
    assert coverage_error(block_shadow_shares(share), block_shadow_shares(reference)) == pytest.approx((0.25 + 0.0) / 2)
    share[:, 16:32] = np.nan  # a block without surface does not count
    reference[:, 16:32] = np.nan
    assert coverage_error(block_shadow_shares(share), block_shadow_shares(reference)) == pytest.approx(0.25)


def test_soft_error_is_the_mean_difference():
    assert soft_error(np.array([[0.0, 0.5, np.nan]]), np.array([[0.25, 0.5, 0.0]])) == pytest.approx(0.125)


def test_flicker_counts_changes_without_a_change_of_truth():
    dark, after = pixel_row("0011").astype(bool), pixel_row("0110").astype(bool)
    reference, real_after = pixel_row("0011").astype(bool), pixel_row("0111").astype(bool)
    # Points 1 and 3 change; truth changes at point 1, too. All points but the first are comparable, and 2 of them steady.
    assert flicker(dark, after, reference, real_after, pixel_row("0111").astype(bool)) == 1 / 2


@pytest.mark.parametrize("dark", [True, False])
def test_metrics_are_finite_without_surface_light_or_shadow(dark):
    no_pixels = np.zeros((20, 20), bool)
    for reference in (
        Truth(no_pixels, no_pixels, no_pixels, no_pixels),
        truth(np.full((20, 20), not dark)),
        truth(np.full((20, 20), not dark), decidable=no_pixels),
    ):
        metrics = error_metrics(np.full((20, 20), 0.0 if dark else 1.0), reference, 1.0)
        assert all(np.isfinite(value) for value in vars(metrics).values())
        assert metrics.wrong == 0.0 and metrics.interior == 0.0
    assert coverage_error(*[block_shadow_shares(np.full((20, 20), np.nan))] * 2) == 0.0
    assert soft_error(np.full((2, 2), np.nan), np.full((2, 2), np.nan)) == 0.0


# -- deliberate faults


FAULT_OF_METRIC = {
    "wrong": "acne: 2 % of the pixels dark, others in each frame",
    "wrong_cast": "all cast shadow lost, texels of 40 px",
    "false_shadow": "a shadow invented",
    "missed_shadow": "a thin caster lost: the pole",
    "edge_mean": "shifted by 1 px",
    "edge_p95": "shifted by 6 px",
    "interior": "a caster missing: the tree",
    "interior_parts": "light leaks into the house's shadow",
    "interior_sees": "all cast shadow lost, texels of 40 px",
    "coverage": "a caster missing: the tree",
    "flicker": "shimmer: 1 px to and fro",
    "soft_error": "a penumbra 10 px wide",
}
"""A fault that each metric must detect."""

UNDETECTABLE_FAULTS = {
    "interior": ("shifted by 1 px", "a thin caster lost: the pole", "all cast shadow lost, texels of 40 px"),
    "wrong_cast": ("a turned-away slope lit", "shimmer: 1 px to and fro"),
    "false_shadow": ("a caster missing: the tree", "all cast shadow lost, texels of 40 px"),
    "missed_shadow": ("a shadow invented",),
    "edge_mean": ("a caster missing: the tree", "a shadow invented"),
    "edge_p95": ("a caster missing: the tree", "a shadow invented", "all cast shadow lost, texels of 40 px"),
    "flicker": ("all cast shadow lost, texels of 40 px",),
}
"""Faults that a metric cannot detect, by its definition."""


@pytest.mark.parametrize("metric", faults.METRICS)
def test_metric_detects_its_fault(metric):
    clean, faulty = faults.figures("none"), faults.figures(FAULT_OF_METRIC[metric])
    if metric == "interior_sees":
        assert faulty[metric] < MIN_COVERED_SHARE < clean[metric]
    else:
        assert faulty[metric] > 2.0 * clean[metric] and faulty[metric] > 0.0


@pytest.mark.parametrize("fault", [fault for fault in faults.FAULTS if fault != "none"])
def test_wrong_or_flicker_detects_every_fault(fault):
    clean, faulty = (faults.figures(name) for name in ("none", fault))
    assert faulty["wrong"] > clean["wrong"] or faulty["flicker"] > clean["flicker"]


@pytest.mark.parametrize(
    ("metric", "fault"), [(metric, fault) for metric, fault_names in UNDETECTABLE_FAULTS.items() for fault in fault_names]
)
def test_metric_stays_zero_under_undetectable_faults(metric, fault):
    assert faults.figures(fault)[metric] == faults.figures("none")[metric] == 0.0


def test_docs_contain_the_table_of_faults():
    report = Path("docs/reports/metrics.md").read_text(encoding="utf-8")
    assert faults.table() in report, "python -m tests.shadows.truth.faults --into ..."


def test_metric_coverage_by_hand():
    """Of a shadow of 12 x 12 px, all counts from its edge on.

    Farther than two pixels from the boundary are 12 - 2 * 3 = 6 by 6 px; farther than two texels of two pixels, 12 - 2 * 5 = 2 by 2
    px.
    """
    reference = np.zeros((30, 30), bool)
    reference[8:20, 8:20] = True
    reference_truth = truth(~reference)
    no_shadow = np.zeros_like(reference)
    coverage = metric_coverage(no_shadow, reference_truth, np.ones_like(reference))
    assert (coverage.cast_px, coverage.covered_px, coverage.wrong_px, coverage.union_px) == (144, 144, 144, 144)
    assert (coverage.covered_share, coverage.wrong_cast) == (1.0, 1.0)
    assert metric_coverage(no_shadow, reference_truth, interior_region(reference_truth)).covered_px == 6 * 6
    assert metric_coverage(reference, reference_truth, interior_region(reference_truth, 2.0)).covered_px == 2 * 2
    assert metric_coverage(reference, reference_truth, interior_region(reference_truth, 100.0)).covered_share == 0.0
    attached_truth = truth(~reference, attached=reference)
    assert (
        metric_coverage(no_shadow, attached_truth, np.ones_like(reference)).covered_share
        == metric_coverage(no_shadow, attached_truth, np.ones_like(reference)).wrong_cast
        == 0.0
    )
    assert error_metrics((~no_shadow).astype(float), reference_truth, 1.0, 100.0).interior_sees == 0.0


def test_edge_metric_coverage_counts_overlapping_components():
    reference, rendered = np.zeros((30, 60), bool), np.zeros((30, 60), bool)
    reference[5:15, 5:15] = reference[5:15, 35:45] = True
    rendered[5:15, 7:17] = True
    coverage = edge_metric_coverage(rendered, truth(~reference))
    assert coverage.covered_share == 0.5 and coverage.wrong_cast == pytest.approx((20 + 20 + 100) / 220)
    assert edge_metric_coverage(np.zeros_like(reference), truth(~reference)).covered_share == 0.0


@pytest.mark.parametrize("shape", [(40, 60), (1, 30), (25, 2)])
def test_far_from_edges_depends_only_on_the_test_region(shape):
    """The shapes are blots and holes.

    Pixels beyond ``edge_test_region`` do not matter, and the result agrees with all distances.
    """
    rng = np.random.default_rng(4)
    valid = rng.random(shape) < 0.97
    dark = np.zeros(shape, bool)
    for row, col in zip(rng.integers(0, shape[0], 3), rng.integers(0, shape[1], 3), strict=True):
        dark[row : row + 9, col : col + 7] = True
    dark &= valid
    row, col = np.nonzero(valid)
    for distance in (0.5, 2.0, 3.7, 8.0, 1000.0):
        is_far = distance_to_edges_px(dark, valid)[row, col] > distance
        assert np.array_equal(is_far_from_edges(dark, valid, row, col, np.full(len(row), distance)), is_far)
        for k in range(0, len(row), 97):
            single_pixel = row[k : k + 1], col[k : k + 1], np.array([distance])
            outside_region = ~edge_test_region(*single_pixel, shape) & valid
            assert is_far_from_edges(dark ^ outside_region, valid, *single_pixel)[0] == is_far[k]
    assert is_far_from_edges(valid & False, valid, row, col, np.full(len(row), 5.0)).all()
