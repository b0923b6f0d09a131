"""Truth through the whole pipeline: analytic terrain, decidability, noise, and defects that its metrics must detect."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from skugga.selector.candidates import candidates
from skugga.selector.measure.compare import Comparison, compare, false_colours
from skugga.shadows.area_light import sun_disc_directions
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import shadow_map
from skugga.shadows.passes import PassLog
from skugga.shadows.truth import truth
from skugga.shadows.truth.metrics import (
    MAX_INTERIOR_SHARE,
    ErrorMetrics,
    block_shadow_shares,
    coverage_error,
    error_metrics,
    soft_error,
)
from skugga.shadows.truth.truth import Truth, coverage_truth, fill_visibility, jittered_views, simplification_error, trace_truth
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer, map_geometry
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.metrics import soft_truth
from tests.rasters import ENGINEERING
from tests.render import block_at, plan_of, render_points, shadow

ALTITUDE = 10.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Scene of a bundled level of terrain only, under the altitude ``ALTITUDE``."""
    return build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=237, altitude=ALTITUDE))


@pytest.fixture(scope="module")
def view() -> MapView:
    """Map of a part of a block of tiles."""
    return block_at(-84.25, 36.2933, 12).part(313, 300, 256, 256)


def geometry(scene: Scene, view: MapView) -> tuple[GeometryBuffer, Casters]:
    """Return the visible points of a map and the objects that can cast shadow on them."""
    buffer = map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))
    return buffer, find_casters(scene, buffer)


@pytest.fixture(scope="module")
def reference(scene, view) -> Truth:
    """Ray-traced truth of the map."""
    return trace_truth(*_trace_arguments(scene, geometry(scene, view)))


def _trace_arguments(scene: Scene, buffer_and_casters: tuple[GeometryBuffer, Casters]) -> tuple[GeometryBuffer, Scene, Casters]:
    """Return the arguments of ``trace_truth``."""
    return buffer_and_casters[0], scene, buffer_and_casters[1]


def visibility(scene: Scene, view: MapView, bias_scale: float = 1.0, patches: bool = True) -> np.ndarray:
    """Return the sun's visibility (rows, cols) by a shadow map, with attached shadow.

    Without ``patches`` only the view's own ground casts.
    """
    buffer, casters = geometry(scene, view)
    if not patches:
        casters = Casters((), casters.reach)
    settings = plan_of(scene, view, map_size=4096, filter=1).settings["sun"]["relief"]
    settings = settings.model_copy(update={"bias_scale": bias_scale})
    filled = shadow_map.fill_visibility(receivers_of(buffer, scene, "sun"), scene, "sun", ("relief",), casters, settings, PassLog())
    filled[attached_shadow_mask(buffer, scene)] = 0.0
    return filled


@pytest.fixture(scope="module")
def baseline(scene, view, reference) -> ErrorMetrics:
    """Errors of a shadow map with the usual settings."""
    return error_metrics(visibility(scene, view), reference, 30.0)


def test_shadow_map_is_near_truth(gl, baseline):
    """This is the baseline of the defects below."""
    assert (
        baseline.wrong < 0.005
        and baseline.wrong_cast < 0.03
        and baseline.interior < MAX_INTERIOR_SHARE
        and baseline.edge_p95 <= 2.0
    )
    assert baseline.boundary < 0.15


def test_wrong_bias_raises_false_shadow(gl, scene, view, reference, baseline):
    metrics = error_metrics(visibility(scene, view, bias_scale=50.0), reference, 30.0)
    assert metrics.false_shadow > 20 * max(baseline.false_shadow, 1e-3)
    metrics = error_metrics(visibility(scene, view, bias_scale=0.0), reference, 30.0)
    assert metrics.false_shadow > 5 * max(baseline.false_shadow, 1e-3)


def test_sun_wrong_by_one_degree_displaces_edges(gl, scene, view, reference, baseline):
    wrong_sun_scene = scene.with_sun(SunSpec(azimuth=237, altitude=ALTITUDE + 1.0))
    metrics = error_metrics(visibility(wrong_sun_scene, view), reference, 30.0)
    assert metrics.edge_mean > baseline.edge_mean + 0.3 and metrics.wrong_cast > 3 * baseline.wrong_cast


def test_mirrored_azimuth_raises_false_and_missed_shadow(gl, scene, view, reference, baseline):
    mirrored_scene = scene.with_sun(SunSpec(azimuth=360 - 237, altitude=ALTITUDE))
    metrics = error_metrics(visibility(mirrored_scene, view), reference, 30.0)
    assert metrics.false_shadow > 0.1 and metrics.missed_shadow > 0.1 and metrics.interior > 0.05


def test_exaggeration_of_2_percent_displaces_edges(gl, view, reference, baseline, scene):
    level = scene.loaded.level.model_copy(update={"terrain": scene.loaded.level.terrain.model_copy(update={"exaggeration": 1.02})})
    exaggerated_scene = build_scene(scene.loaded.model_copy(update={"level": level})).with_sun(
        SunSpec(azimuth=237, altitude=ALTITUDE)
    )
    metrics = error_metrics(visibility(exaggerated_scene, view), reference, 30.0)
    assert metrics.edge_mean > baseline.edge_mean and metrics.wrong_cast > 1.5 * baseline.wrong_cast


def test_dropped_caster_raises_interior_and_its_parts(gl, write_raster, make_scene):
    """A ridge outside the view casts its shadow into it. Without the outside patches that shadow is lost."""
    heights = np.zeros((100, 300), np.float32)
    heights[:, 40:45] = 300.0
    ridge = make_scene(write_raster(heights, ENGINEERING, 0, 1000, 10.0), 270, 12)
    view = ridge.view(bounds=(1000, 200, 2200, 800), size=(240, 120))
    reference = trace_truth(*_trace_arguments(ridge, geometry(ridge, view)))
    assert 0.2 < (~reference.lit).mean() < 0.9
    with_patches = error_metrics(visibility(ridge, view), reference, 5.0)
    without_patches = error_metrics(visibility(ridge, view, patches=False), reference, 5.0)
    assert with_patches.interior == 0.0 and with_patches.missed_shadow < 0.01
    assert without_patches.interior > 0.2 and without_patches.interior_parts >= 1 and without_patches.missed_shadow > 0.9


@pytest.mark.parametrize("azimuth", [270.0, pytest.param(90.0, marks=pytest.mark.long)])
def test_truth_of_a_wall_matches_the_closed_form(write_raster, make_scene, azimuth):
    """A 30 m wall's shadow at 30 degrees ends within a pixel (0.1 m) and a node of the grid (0.06 m) of h / tan(a)."""
    heights = np.zeros((21, 201), np.float32)
    heights[:, 99:102] = 30.0  # the top reaches from x = 99.5 to 101.5
    wall = make_scene(write_raster(heights, ENGINEERING, 0, 21.0, 1.0), azimuth, 30.0)
    view = wall.view(bounds=(20, 9, 180, 11), size=(1600, 20))
    frame = render_points(wall, view, algorithm="truth")
    x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
    dark = shadow(frame)[:, (x < 98) | (x > 103)]
    outside = x[(x < 98) | (x > 103)]
    end = (101.5 if azimuth == 270.0 else 99.5) + (1 if azimuth == 270.0 else -1) * 30.0 / np.tan(np.radians(30.0))
    ends = [(outside[row].max() if azimuth == 270.0 else outside[row].min()) for row in dark]
    np.testing.assert_allclose(ends, end, atol=0.17)


def test_truth_is_decidable_away_from_edges(reference):
    """Boundary pixels lie at edges: each has a pixel of the other class within two pixels."""
    from scipy.ndimage import binary_dilation

    near_edge = binary_dilation(reference.lit, iterations=2) & binary_dilation(~reference.lit, iterations=2)
    undecided = reference.valid & ~reference.decidable
    assert undecided.any() and (undecided & ~near_edge).sum() <= 0.02 * undecided.sum() + 0.002 * reference.valid.sum()


def test_truth_with_more_samples_decides_fewer_pixels(scene, view, reference):
    finer = trace_truth(*_trace_arguments(scene, geometry(scene, view)), sample_count=16)
    np.testing.assert_array_equal(finer.lit, reference.lit)
    assert finer.undecidable_share >= reference.undecidable_share - 0.01
    with pytest.raises(ValueError, match="square"):
        jittered_views(view, 5)


@pytest.fixture(scope="module")
def comparison(scene) -> Iterator[Comparison]:
    """Return every row measured once: times do not matter here."""
    x, y = scene.view().centre
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skugga.selector.measure.compare.TIMING_REPEATS", 0)
        yield compare(scene, scene.view(bounds=(x - 2000, y - 2000, x + 2000, y + 2000), size=(125, 125)))


def test_noise_floor_is_far_below_the_errors(gl, comparison, baseline):
    assert comparison.noise_floor < baseline.wrong_cast / 3
    assert 0.0 < comparison.simplification_share < 0.1


def test_sun_disc_has_the_suns_size_and_centre():
    to_sun = np.array([0.3, -0.4, 0.5]) / np.linalg.norm([0.3, -0.4, 0.5])
    directions = sun_disc_directions(to_sun, 400)
    angles = np.degrees(np.arccos(np.clip(directions @ to_sun, -1, 1)))
    assert 0.25 < angles.max() <= 0.2651 and np.allclose(directions.mean(axis=0), to_sun, atol=1e-3)
    assert (angles < 0.265 / 2**0.5).mean() == pytest.approx(0.5, abs=0.02)  # equal areas


def test_soft_truth_is_soft_only_at_edges(scene, view, reference):
    buffer, casters = geometry(scene, view)
    soft = soft_truth(buffer, scene, casters, samples=16)
    assert ((soft > 0) & (soft < 1)).mean() > 0.005
    hard = fill_visibility(buffer, scene, "sun", ("relief",), casters, truth.TruthSettings(), PassLog())
    assert soft_error(np.where(buffer.valid, hard, np.nan), soft) < 0.1
    assert ((soft < 0.5) == ~reference.lit)[reference.decidable].mean() > 0.97


def test_coverage_error_of_truth_is_small(scene, view, reference):
    buffer, casters = geometry(scene, view)
    shares = coverage_truth(buffer, scene, casters, 16)
    assert np.isfinite(shares).sum() == 256
    hard = np.where(reference.valid, (~reference.lit).astype(float), np.nan)
    assert coverage_error(block_shadow_shares(hard), shares) < 0.02
    assert coverage_error(block_shadow_shares(1.0 - hard), shares) > 0.3


@pytest.mark.long
def test_surface_error_of_simplified_ground(scene):
    """A grid of the raster's own resolution loses little. One with nodes eight times coarser loses much."""
    results = {}
    for zoom in (9, 13):
        block = block_at(-84.25, 36.2933, zoom)
        buffer, casters = geometry(scene, block)
        results[zoom] = simplification_error(buffer, scene, casters)
    assert results[13] < 0.02 < results[9]


def test_compare_lists_candidates_and_marks_the_pareto_front(gl, comparison):
    names = [row.figures["algorithm"]["sun"]["relief"] for row in comparison.rows]
    assert names.count("shadow_map") >= 8 and names.count("none") == 1 and "truth" not in names
    for row in comparison.rows:
        assert set(row.figures) >= {
            "algorithm", "settings", "wrong", "wrong_cast", "false_shadow", "missed_shadow", "edge_mean", "edge_p95", "interior",
            "interior_parts", "coverage", "boundary", "ms_median", "ms_p95", "bytes", "counters", "pareto",
        }  # fmt: skip
    front = [row.figures for row in comparison.rows if row.figures["pareto"]]
    best = min(row.figures["wrong_cast"] for row in comparison.rows)
    assert any(figures["wrong_cast"] == best for figures in front)
    maps = [row for row in comparison.rows if row.figures["algorithm"]["sun"]["relief"] == "shadow_map"]
    sizes = {row.figures["settings"]["sun"]["relief"]["map_size"]: row for row in maps}
    assert sizes[512].figures["wrong"] > sizes[4096].figures["wrong"]
    assert sizes[512].figures["counters"]["map_texels"] < sizes[4096].figures["counters"]["map_texels"]
    picture = false_colours(np.zeros((125, 125)), sizes[512])
    assert (picture == (214, 30, 30)).all(axis=-1).sum() == sizes[512].false_shadow.sum()
    assert (picture == (30, 70, 214)).all(axis=-1).sum() == sizes[512].missed_shadow.sum() > 0


@pytest.mark.parametrize(
    ("place", "sun", "words"),
    [
        ((10.0, 50.0), (237, 10), "no surface"),
        ((-84.25, 36.2933), (237, -5), "sun is down"),
    ],
)
def test_compare_remarks_on_a_view_without_comparison(gl, scene, place, sun, words):
    relit_scene = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    block = block_at(*place, 12)
    comparison = compare(relit_scene, block)
    assert any(words in remark for remark in comparison.remarks)
    for row in comparison.rows:
        assert all(np.isfinite(value) for value in row.figures.values() if isinstance(value, float))


def test_candidates_number_at_most_forty(scene, view):
    assert 5 <= len(list(candidates(scene, view))) <= 40
