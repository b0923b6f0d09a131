"""Point truth: each lattice agrees with the whole picture's truth, and all lattices together with the error metrics."""

from __future__ import annotations

import json

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.selector.measure.point_truth import PictureTruth, PointCounts, lattice_offsets, wilson_interval
from skugga.selector.measure.view_truth import TRUTH_SAMPLES_PER_PIXEL
from skugga.shadows.render import render_frame
from skugga.shadows.truth.metrics import error_metrics
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, ray_scene, trace_truth
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.subsampled import subsampled_points, subsampled_view
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [240, 192]}
PLAIN_LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "meshes": [{"generate": "tetrahedra"}],
    "sun": {"azimuth": 200, "altitude": 35}, "views": {"eye": EYE, "map": {"kind": "map", "size": [240, 240]}},
}  # fmt: skip
"""Level: bodies on a plain."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Scene of the level ``PLAIN_LEVEL``."""
    path = tmp_path_factory.mktemp("points") / "level.yaml"
    path.write_text(json.dumps(PLAIN_LEVEL), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def wooded() -> Scene:
    """Scene of a bundled level with trees."""
    return build_scene(load_level(find_level("spatialace")))


def picture_truth(scene: Scene, view) -> PictureTruth:
    """Return the truth of a view at sample points, under the sun."""
    picture = geometry_buffer(scene, view)
    return PictureTruth(scene, picture, find_casters(scene, picture), SUN)


@pytest.mark.parametrize("every", [1, 2, 4, 8])
def test_lattice_offsets_cover_every_pixel_once(every):
    visit_counts = np.zeros((16, 24), int)
    for row, col in lattice_offsets(every):
        visit_counts[row::every, col::every] += 1
    assert (visit_counts == 1).all() and len(lattice_offsets(every)) == every**2


@pytest.mark.parametrize(("level", "name"), [("scene", "eye"), ("scene", "map"), ("wooded", "main")])
def test_lattice_has_the_truth_of_the_whole_picture(gl, request, level, name):
    """A lattice keeps the picture's pixel width.

    With pixels as wide as its spacing, other leaves would be drawn, and some per cent of the points in woods would differ.
    """
    scene = request.getfixturevalue(level)
    view = scene.view(name) if level == "scene" else scene.view(name, size=(240, 192))
    truth = picture_truth(scene, view)
    full_truth = trace_truth(truth.picture, scene, truth.casters, TRUTH_SAMPLES_PER_PIXEL)
    assert truth.spacing_px == 2
    for number in (0, 3):
        lattice = truth.lattice(number)
        for field in ("lit", "attached_shadow_mask", "valid"):
            assert np.array_equal(getattr(lattice.truth, field), lattice.at_points(getattr(full_truth, field)))
        differ = lattice.truth.decidable != lattice.at_points(full_truth.decidable)
        assert differ.mean() < 1e-3


@pytest.mark.parametrize(
    ("level", "altitude"),
    [
        ("jacksboro", 7.0),
        ("jacksboro_wooded", 35.0),
        ("mountain/vinschgau_250m_utm32.tif", 7.0),
        ("urban/bilbao/DEM.tif", 7.0),
    ],
)
def test_lattice_of_a_map_walks_rays_to_the_same_truth(gl, request, tmp_path, level, altitude):
    """Walked and Embree rays agree at every decidable point of real ground with its trees and the ground towards the sun."""
    if level.endswith(".tif"):
        path = tmp_path / "level.yaml"
        source = str(request.getfixturevalue("shared_data") / level)
        path.write_text(json.dumps({"version": 1, "terrain": {"source": source}}), encoding="utf-8")
    else:
        path = find_level(level)
    scene = build_scene(load_level(path)).with_sun(SunSpec(azimuth=237.0, altitude=altitude))
    full = scene.view("map")
    view = full.part(full.rows // 3, full.cols // 3, 200, 280)
    truth = picture_truth(scene, view)
    embree = ray_scene(truth.picture, scene, truth.casters, ALL_CASTER_KINDS)
    assert truth.casters.patches and embree.offset_m == truth.rays.offset_m
    for number in (0, 3):
        lattice_truth = truth.lattice(number).truth
        points = subsampled_points(truth.picture, truth.spacing_px, lattice_offsets(truth.spacing_px)[number])
        expected = trace_truth(points, scene, truth.casters, TRUTH_SAMPLES_PER_PIXEL, rays=embree)
        decidable = lattice_truth.decidable & expected.decidable
        assert np.array_equal(lattice_truth.lit[decidable], expected.lit[decidable])
        assert (lattice_truth.decidable != expected.decidable).mean() < 1e-3
        assert decidable.mean() > 0.5 and 0.02 < expected.lit[decidable].mean() < 0.98


@pytest.mark.parametrize("name", ["eye", "map"])
def test_sum_of_all_lattices_equals_the_error_metrics(gl, scene, name):
    view = scene.view(name)
    truth = picture_truth(scene, view)
    plan = plan_of(scene, view, algorithm="shadow_map", map_size=128, filter=1)
    full_truth = trace_truth(truth.picture, scene, truth.casters, TRUTH_SAMPLES_PER_PIXEL)
    visibility = render_frame(scene, view, plan).visibility
    expected = error_metrics(visibility, full_truth, 1.0)
    dark = np.nan_to_num(visibility, nan=1.0) < 0.5
    total = PointCounts()
    for number in range(truth.lattice_count):
        total += truth.counts(truth.lattice(number), dark, (), 1.0)
    assert total.wrong_cast_count / total.cast_count == pytest.approx(expected.wrong_cast, rel=0.01) and expected.wrong_cast > 0.005
    assert total.interior_count / total.decidable_count == pytest.approx(expected.interior, rel=0.02, abs=2e-5)
    unshadowed_counts = truth.counts(
        truth.lattice(0), np.zeros_like(dark), (), 1.0
    )  # without any shadow, most of the lost shadow is interior
    assert unshadowed_counts.wrong_cast_count == unshadowed_counts.cast_count and unshadowed_counts.interior_count > 10


def test_subsampled_view_keeps_the_pixel_width(scene):
    for name in ("eye", "map"):
        view = scene.view(name)
        subsampled = subsampled_view(view, 4)
        assert subsampled.pixel_share == 0.25
        assert subsampled.shifted(0.5, -0.5).row0 == pytest.approx(view.shifted(0.5, -0.5).row0)
        assert subsampled.part(1, 2, 3, 3).col0 == pytest.approx(view.part(4, 8, 3, 3).col0)
    assert subsampled_view(scene.view("eye"), 4).pixel_tangent == scene.view("eye").pixel_tangent


@pytest.mark.parametrize(
    ("part", "total", "low", "high"),
    [(0, 100, 0.0, 0.0370), (5, 100, 0.0215, 0.1118), (50, 100, 0.4038, 0.5962), (0, 0, 0.0, 1.0), (10, 10, 0.7225, 1.0)],
)
def test_share_interval_matches_published_tables(part, total, low, high):
    """Wilson's score interval without correction (R. Newcombe, Two-sided confidence intervals for the single proportion, 1998)."""
    assert wilson_interval(part, total) == pytest.approx((low, high), abs=1e-4)
