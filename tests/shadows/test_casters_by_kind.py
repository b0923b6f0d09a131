"""Algorithms per caster kind: the visibilities of the kinds multiply to that of all casters."""

from __future__ import annotations

import json
from functools import lru_cache

import numpy as np
import pyogrio
import pytest
import shapely

from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.truth.truth import trace_truth
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.level.level import SUN, SunSpec, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of, render_points

KINDS = ("relief", "meshes", "forest")


@pytest.fixture(scope="module")
def village() -> Scene:
    """Return a bundled level with woods and houses, under a sun so low that its ridges shade the village, too."""
    return build_scene(load_level("configs/jacksboro_wooded.yaml")).with_sun(SunSpec(azimuth=320, altitude=5))


def view_of(scene: Scene):
    """Return a perspective view of the village."""
    return scene.view("village", size=(192, 154))


@pytest.fixture(scope="module")
def buffer(village) -> GeometryBuffer:
    """Visible points of the village."""
    return geometry_buffer(village, view_of(village))


@lru_cache(maxsize=8)
def truth(scene: Scene, buffer: GeometryBuffer, kinds: tuple[str, ...]):
    """Return ray-traced truth of the shadows that these kinds of casters cast."""
    return trace_truth(buffer, scene, find_casters(scene, buffer), kinds=kinds)


def single_kind_override(algorithm: str, kind: str) -> dict[str, str]:
    """Return an override by which only one kind casts."""
    return {other: algorithm if other == kind else "none" for other in KINDS}


def test_village_has_casters_of_all_kinds(gl, village, buffer):
    assert village.objects.caster_kinds == KINDS and {RELIEF, MESHES, FOREST} <= set(np.unique(buffer.surface_kind))
    for kind in KINDS:
        kind_truth = truth(village, buffer, (kind,))
        assert 0.01 < (~kind_truth.lit & ~kind_truth.attached_shadow_mask & kind_truth.valid).sum() / kind_truth.valid.sum() < 0.5


def test_truths_of_kinds_multiply(gl, village, buffer):
    """The product is exact where all truths are decidable: whatever blocks a ray to the sun is of one of the kinds."""
    combined, kind_truths = truth(village, buffer, KINDS), [truth(village, buffer, (kind,)) for kind in KINDS]
    product = np.logical_and.reduce([kind_truth.lit for kind_truth in kind_truths])
    decidable = np.logical_and.reduce([combined.decidable, *(kind_truth.decidable for kind_truth in kind_truths)])
    assert decidable.sum() > 0.7 * buffer.valid.sum()
    np.testing.assert_array_equal(product[decidable], combined.lit[decidable])
    # the offset of a ray's start depends on the extent of its casters, which differs by kind
    assert (product != combined.lit)[combined.decidable].mean() <= 1e-3
    for omitted_number in range(3):
        product_without_kind = np.logical_and.reduce(
            [kind_truth.lit for number, kind_truth in enumerate(kind_truths) if number != omitted_number]
        )
        assert (product_without_kind != combined.lit)[decidable].mean() > 0.005, "each kind is needed"


@pytest.mark.parametrize(("taps", "is_exact"), [(1, True), (3, False)])
def test_shadow_maps_of_kinds_multiply(gl, village, taps, is_exact):
    """With one tap the product is exact: the map of all casters holds the nearest depth of the kinds.

    With n taps, of which shares a, b and c are lit past each kind, the lit share is between max(0, a + b + c - 2) and min(a, b, c)
    (M. Frechet, 1935), and so is the product. They differ by 2 / (3 sqrt 3) = 0.385 at most, and only where penumbrae of kinds
    overlap.
    """
    view = view_of(village)
    combined = render_points(village, view, algorithm="shadow_map", map_size=1024, filter=taps)
    kind_frames = [
        render_points(village, view, algorithm=single_kind_override("shadow_map", kind), map_size=1024, filter=taps)
        for kind in KINDS
    ]
    valid = combined.valid
    shares = [frame.visibility[valid].astype(np.float64) for frame in kind_frames]
    product, combined_visibility = np.prod(shares, axis=0), combined.visibility[valid]
    if is_exact:
        np.testing.assert_array_equal(product, combined_visibility)
    in_penumbra = [(0.0 < share) & (share < 1.0) for share in shares]
    overlap = np.sum(in_penumbra, axis=0) > 1
    np.testing.assert_allclose(product[~overlap], combined_visibility[~overlap], atol=1e-5)
    assert (combined_visibility >= np.maximum(np.sum(shares, axis=0) - 2.0, 0.0) - 1e-5).all()
    assert (combined_visibility <= np.min(shares, axis=0) + 1e-5).all()
    assert (
        np.abs(product - combined_visibility).max() <= 2.0 / 27.0**0.5
        and ((product < 0.5) != (combined_visibility < 0.5)).mean() < 1e-3
    )


def test_kinds_with_one_algorithm_share_passes(gl, village):
    """The override is ``relief=truth,meshes=shadow_map,forest=truth``. The picture is the product of both algorithms."""
    view = view_of(village)
    names = {"relief": "truth", "meshes": "shadow_map", "forest": "truth"}
    frame = render_points(village, view, algorithm=names, map_size=512)
    assert frame.plan.algorithm == {SUN: names} and Plan.model_validate_json(frame.plan.model_dump_json()) == frame.plan
    assert [name for name in frame.plan.passes if "/" in name] == [
        *PassLog.pass_names(SUN, ("relief", "forest"), ("rays",)),
        *PassLog.pass_names(SUN, ("meshes",), ("depth map", "visibility")),
    ]
    parts = [
        render_points(village, view, algorithm={**names, "meshes": "none"}, map_size=512).visibility,
        render_points(village, view, algorithm=single_kind_override("shadow_map", "meshes"), map_size=512).visibility,
    ]
    np.testing.assert_array_equal(frame.visibility, parts[0] * parts[1])


def test_planar_visibilities_of_kinds_multiply(gl, tmp_path):
    """On a flat floor, the stencil gives the shadows of a figure and of trees, together and separately."""
    tree_points = shapely.to_wkb(np.array([shapely.Point(*at) for at in ((-12, 4), (6, -9), (10, 8), (-5, -14))], object))
    pyogrio.raw.write(tmp_path / "trees.gpkg", tree_points, [], [], geometry_type="Point", crs=ENGINEERING_CRS_WKT)
    level = {
        "version": 1, "terrain": {"flat": {"size": [80, 80], "cells": [40, 40]}}, "sun": {"azimuth": 230, "altitude": 28},
        "meshes": [{"generate": "tetrahedra"}], "forest": [{"source": "trees.gpkg", "height": [7, 9]}],
    }  # fmt: skip
    (tmp_path / "floor.yaml").write_text(json.dumps(level), encoding="utf-8")
    scene = build_scene(load_level(tmp_path / "floor.yaml"))
    view = scene.view(bounds=(-30, -30, 30, 30), size=(230, 230))
    combined = render_points(scene, view, algorithm="planar").visibility
    visibility_by_kind = {
        kind: render_points(scene, view, algorithm=single_kind_override("planar", kind)).visibility for kind in KINDS
    }
    assert (visibility_by_kind["relief"] == 1.0)[np.isfinite(combined)].mean() > 0.9  # only attached shadow is dark
    assert all((visibility_by_kind[kind] < visibility_by_kind["relief"]).sum() > 50 for kind in ("meshes", "forest"))
    np.testing.assert_array_equal(np.prod(list(visibility_by_kind.values()), axis=0), combined)
    assert plan_of(scene, view, algorithm={"meshes": "planar"}).algorithms_text == "relief=none,meshes=planar,forest=shadow_map"
