"""Alpha-tested casters: needed where any tree is drawn, and recorded where an algorithm handles foliage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from pyogrio import raw

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.tree_instances import map_draws_trees, tree_instances_in_map
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING


@pytest.fixture
def make_tree_scene(write_raster, make_scene, tmp_path: Path):
    """Return a factory of scenes with one tree of 4 m in the middle of a floor of 2 km."""
    raster = write_raster(np.zeros((40, 40), np.float32), ENGINEERING, -1000.0, 1000.0, 50.0)
    tree = shapely.to_wkb(np.array([shapely.Point(0.0, 0.0)], object))
    raw.write(tmp_path / "tree.gpkg", tree, [np.array([4.0])], ["height"], geometry_type="Point", crs=ENGINEERING)

    def make(**keys) -> Scene:
        return make_scene(raster, 180.0, 30.0, forest=[{"source": "tree.gpkg", "height": "height", "species": "broadleaf"}], **keys)

    return make


def eye_view(north_m: float, height_m: float) -> dict:
    """Return the keys of a view to the north from a height above the ground, metres."""
    return {"kind": "perspective", "eye": [0.0, north_m, height_m], "target": [0.0, north_m + 1.0, 0.0], "size": [64, 48]}


def test_a_tree_too_small_to_be_drawn_needs_no_alpha_test(gl, make_tree_scene):
    scene = make_tree_scene()
    wide_view, close_view = (scene.view(bounds=(-m, -m, m, m), size=(64, 64)) for m in (900.0, 30.0))
    assert "alpha_test" in make_plan(describe(scene, close_view), scene.loaded.level).effect_names
    plan = make_plan(describe(scene, wide_view), scene.loaded.level)
    assert "no tree is large enough to be drawn" in {item.reason for item in plan.left_out}
    assert plan.effect_names.isdisjoint({"alpha_test", "cast_shadows"})


@pytest.mark.parametrize("pixel_m", [0.2, 1.0, 2.0, 5.0, 20.0, 60.0])
def test_map_draws_trees_agrees_with_tree_instances(make_tree_scene, pixel_m: float):
    scene = make_tree_scene()
    view = scene.view(bounds=(-50.0, -50.0, 50.0, 50.0), size=(20, 20))
    frame = scene.world.frame_near(view.grid.crs, *view.centre)
    instances = tree_instances_in_map(scene.objects, frame, pixel_m)
    assert instances is not None and map_draws_trees(scene.objects.trees, pixel_m) == (len(instances) > 0)


@pytest.mark.parametrize("lights", [{}, {"lamp": {"kind": "omni", "position": [0.0, 0.0, 300.0]}}], ids=["sun", "lamp"])
@pytest.mark.parametrize("height_m", [20.0, 20000.0])
def test_a_view_without_drawn_trees_is_described(gl, make_tree_scene, lights: dict, height_m: float):
    """From far up every tree is thinned out, so the stand is empty."""
    scene = make_tree_scene(lights=lights, views={"eye": eye_view(10.0, height_m)})
    view = scene.view("eye")
    frame = render_frame(scene, view, make_plan(describe(scene, view, "eye"), scene.loaded.level))
    assert frame.effects == frame.plan.effect_names
    assert ("alpha_test" in frame.effects) <= (height_m < 1000.0)


def test_a_window_without_tree_shade_records_its_plan(gl, make_tree_scene):
    scene = make_tree_scene()
    view = scene.view(bounds=(700.0, 700.0, 760.0, 760.0), size=(64, 64))
    frame = render_frame(scene, view, make_plan(describe(scene, view), scene.loaded.level))
    assert "alpha_test" in frame.plan.effect_names and frame.effects == frame.plan.effect_names
