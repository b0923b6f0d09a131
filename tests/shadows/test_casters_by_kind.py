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
from skugga.terrain.ground.generated_ground import ENGINEERING
from skugga.terrain.level.level import SUN, SunSpec, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of, render_points

KINDS = ("relief", "meshes", "forest")


@pytest.fixture(scope="module")
def village() -> Scene:
    """Return a bundled level with woods and houses, under a sun so low that its ridges shade the village, too."""
    return build_scene(load_level("configs/jacksboro_wooded.yaml")).with_sun(SunSpec(azimuth=320, altitude=5))


def view_of(scene: Scene):
    return scene.view("village", size=(192, 154))


@pytest.fixture(scope="module")
def buffer(village) -> GeometryBuffer:
    return geometry_buffer(village, view_of(village))


@lru_cache(maxsize=8)
def truth(scene: Scene, buffer: GeometryBuffer, kinds: tuple[str, ...]):
    return trace_truth(buffer, scene, find_casters(scene, buffer), kinds=kinds)


def alone(name: str, kind: str) -> dict[str, str]:
    """Return an override by which only one kind casts."""
    return {other: name if other == kind else "none" for other in KINDS}


def test_village_has_casters_of_all_kinds(gl, village, buffer):
    assert village.objects.kinds == KINDS and {RELIEF, MESHES, FOREST} <= set(np.unique(buffer.kind))
    for kind in KINDS:
        one = truth(village, buffer, (kind,))
        assert 0.01 < (~one.lit & ~one.attached & one.valid).sum() / one.valid.sum() < 0.5


def test_truths_of_kinds_multiply(gl, village, buffer):
    """The product is exact where all truths are decidable: whatever blocks a ray to the sun is of one of the kinds."""
    whole, single = truth(village, buffer, KINDS), [truth(village, buffer, (kind,)) for kind in KINDS]
    product = np.logical_and.reduce([one.lit for one in single])
    decidable = np.logical_and.reduce([whole.decidable, *(one.decidable for one in single)])
    assert decidable.sum() > 0.7 * buffer.valid.sum()
    np.testing.assert_array_equal(product[decidable], whole.lit[decidable])
    # the offset of a ray's start depends on the extent of its casters, which differs by kind
    assert (product != whole.lit)[whole.decidable].mean() <= 1e-3
    for left_out in range(3):
        fewer = np.logical_and.reduce([one.lit for number, one in enumerate(single) if number != left_out])
        assert (fewer != whole.lit)[decidable].mean() > 0.005, "each kind is needed"


@pytest.mark.parametrize(("taps", "sure"), [(1, True), (3, False)])
def test_shadow_maps_of_kinds_multiply(gl, village, taps, sure):
    """With one tap the product is exact: the map of all casters holds the nearest depth of the kinds.

    With n taps, of which shares a, b and c are lit past each kind, the lit share is between max(0, a + b + c - 2) and min(a, b, c)
    (M. Frechet, 1935), and so is the product. They differ by 2 / (3 sqrt 3) = 0.385 at most, and only where penumbrae of kinds
    overlap.
    """
    view = view_of(village)
    whole = render_points(village, view, algorithm="shadow_map", map_size=1024, filter=taps)
    single = [render_points(village, view, algorithm=alone("shadow_map", kind), map_size=1024, filter=taps) for kind in KINDS]
    valid = whole.valid
    shares = [frame.visibility[valid].astype(np.float64) for frame in single]
    product, together = np.prod(shares, axis=0), whole.visibility[valid]
    if sure:
        np.testing.assert_array_equal(product, together)
    partial = [(0.0 < share) & (share < 1.0) for share in shares]
    overlap = np.sum(partial, axis=0) > 1
    np.testing.assert_allclose(product[~overlap], together[~overlap], atol=1e-5)
    assert (together >= np.maximum(np.sum(shares, axis=0) - 2.0, 0.0) - 1e-5).all()
    assert (together <= np.min(shares, axis=0) + 1e-5).all()
    assert np.abs(product - together).max() <= 2.0 / 27.0**0.5 and ((product < 0.5) != (together < 0.5)).mean() < 1e-3


def test_kinds_with_one_algorithm_share_passes(gl, village):
    """The override is ``relief=truth,meshes=shadow_map,forest=truth``. The picture is the product of both algorithms."""
    view = view_of(village)
    names = {"relief": "truth", "meshes": "shadow_map", "forest": "truth"}
    frame = render_points(village, view, algorithm=names, map_size=512)
    assert frame.plan.algorithm == {SUN: names} and Plan.model_validate_json(frame.plan.model_dump_json()) == frame.plan
    assert [name for name in frame.plan.passes if "/" in name] == [
        *PassLog.named(SUN, ("relief", "forest"), ("rays",)), *PassLog.named(SUN, ("meshes",), ("depth map", "visibility")),
    ]  # fmt: skip
    parts = [
        render_points(village, view, algorithm={**names, "meshes": "none"}, map_size=512).visibility,
        render_points(village, view, algorithm=alone("shadow_map", "meshes"), map_size=512).visibility,
    ]
    np.testing.assert_array_equal(frame.visibility, parts[0] * parts[1])


def test_planar_visibilities_of_kinds_multiply(gl, tmp_path):
    """On a flat floor, the stencil gives the shadows of a figure and of trees, together and separately."""
    feet = shapely.to_wkb(np.array([shapely.Point(*at) for at in ((-12, 4), (6, -9), (10, 8), (-5, -14))], object))
    pyogrio.raw.write(tmp_path / "trees.gpkg", feet, [], [], geometry_type="Point", crs=ENGINEERING)
    level = {
        "version": 1, "terrain": {"flat": {"size": [80, 80], "cells": [40, 40]}}, "sun": {"azimuth": 230, "altitude": 28},
        "meshes": [{"generate": "tetrahedra"}], "forest": [{"source": "trees.gpkg", "height": [7, 9]}],
    }  # fmt: skip
    (tmp_path / "floor.yaml").write_text(json.dumps(level), encoding="utf-8")
    scene = build_scene(load_level(tmp_path / "floor.yaml"))
    view = scene.view(bounds=(-30, -30, 30, 30), size=(230, 230))
    together = render_points(scene, view, algorithm="planar").visibility
    single = {kind: render_points(scene, view, algorithm=alone("planar", kind)).visibility for kind in KINDS}
    assert (single["relief"] == 1.0)[np.isfinite(together)].mean() > 0.9  # only attached shadow is dark
    assert all((single[kind] < single["relief"]).sum() > 50 for kind in ("meshes", "forest"))
    np.testing.assert_array_equal(np.prod(list(single.values()), axis=0), together)
    assert plan_of(scene, view, algorithm={"meshes": "planar"}).headline == "relief=none,meshes=planar,forest=shadow_map"
