"""Smooth edges of shadows in perspective views: coverage of pixels, what stays hard, and what a moving sun changes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from skugga.selector.select import plan_of_view
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

SUBPIXELS = 8


@pytest.fixture(scope="module")
def posts(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return a floor with thin posts whose long shadows run across a low view, so that far pixels cover several of them."""
    folder = Path(tmp_path_factory.mktemp("posts"))
    write_geotiff(folder / "floor.tif", np.zeros((64, 64), np.float32), ENGINEERING, -320.0, 320.0, 10.0)
    trimesh.creation.box((0.7, 0.7, 14.0)).export(folder / "post.obj")
    keys = {
        "version": 1, "terrain": {"source": "floor.tif"}, "sun": {"azimuth": 250.0, "altitude": 24.0},
        "meshes": [{"source": "post.obj", "at": [-30.0, north]} for north in range(0, 140, 4)],
        "views": {"low": {"kind": "perspective", "eye": [60, -40, 12], "target": [-15, 40, 0], "fov": 40, "size": [160, 96]}},
    }  # fmt: skip
    (folder / "level.yaml").write_text(json.dumps(keys), encoding="utf-8")
    return build_scene(load_level(folder / "level.yaml"))


def draw(scene: Scene, view: PerspectiveView, **overrides: object) -> Frame:
    return render_frame(scene, view, plan_of_view(scene, view, "low", overrides))


def pixel_means(values: np.ndarray) -> np.ndarray:
    rows, cols = values.shape
    return values.reshape(rows // SUBPIXELS, SUBPIXELS, cols // SUBPIXELS, SUBPIXELS).mean(axis=(1, 3))


def test_pixels_show_the_share_of_light_on_what_they_cover(gl, posts: Scene):
    """Truth is the mean over 64 times as many pixels, each by rays."""
    view = posts.view("low")
    assert isinstance(view, PerspectiveView)
    finer = draw(posts, view.finer(SUBPIXELS), algorithm="truth")
    truth, covers_ground = pixel_means(finer.visibility), np.isfinite(pixel_means(finer.height_m))
    frame = draw(posts, view, algorithm="shadow_map", map_size=4096, cascades=4, filter=1)
    shown = next(iter(frame.shown_visibilities.values()))
    ground = covers_ground & (frame.height_m < 0.01) & (pixel_means(finer.height_m) < 0.01)
    is_edge = ground & (truth > 0.02) & (truth < 0.98)
    assert is_edge.sum() > 200
    smooth_error, hard_error = (np.abs(values[is_edge] - truth[is_edge]).mean() for values in (shown, frame.visibility))
    assert smooth_error < 0.13 and smooth_error < 0.35 * hard_error  # 0.110 and 0.367
    assert np.abs(shown[ground] - truth[ground]).mean() < 0.5 * np.abs(frame.visibility[ground] - truth[ground]).mean()


def test_masks_keep_each_pixel_s_own_point(gl, posts: Scene):
    view = posts.view("low")
    frame = draw(posts, view, algorithm="shadow_map", filter=1)
    assert set(np.unique(frame.visibility[frame.valid])) <= {0.0, 1.0}
    points = render_frame(
        posts, view, plan_of_view(posts, view, "low", {"algorithm": "shadow_map", "filter": 1}), pixel_sampling="points"
    )
    np.testing.assert_array_equal(frame.visibility, points.visibility)
    np.testing.assert_array_equal(points.visibility, next(iter(points.shown_visibilities.values())))


def test_pixels_away_from_edges_do_not_change(gl, posts: Scene):
    frame = draw(posts, posts.view("low"), algorithm="shadow_map", filter=1)
    shown = next(iter(frame.shown_visibilities.values()))
    hard = np.where(frame.valid, frame.visibility, 1.0)
    padded = np.pad(hard, 1, mode="edge")
    neighbours = np.stack([padded[i : i + hard.shape[0], j : j + hard.shape[1]] for i in range(3) for j in range(3)])
    is_even = frame.valid & (neighbours.min(axis=0) == neighbours.max(axis=0))
    np.testing.assert_array_equal(shown[is_even], frame.visibility[is_even])


def test_algorithms_that_count_in_pixels_keep_hard_edges(gl, posts: Scene):
    frame = draw(posts, posts.view("low"), algorithm="shadow_volume")
    np.testing.assert_array_equal(frame.visibility, next(iter(frame.shown_visibilities.values())))


def test_moving_sun_changes_pixels_little_by_little(gl, posts: Scene):
    """Under a sun that moves by a hundredth of a degree a frame, pixels change in small steps instead of all at once."""
    shown, hard = [], []
    for step in range(6):
        scene = posts.with_sun(SunSpec(azimuth=250.0 + 0.01 * step, altitude=24.0))
        frame = draw(replace(scene), scene.view("low"), algorithm="shadow_map", map_size=4096, cascades=4, filter=1)
        ground = frame.valid & (frame.height_m < 0.01)
        shown.append(np.where(ground, next(iter(frame.shown_visibilities.values())), 1.0))
        hard.append(np.where(ground, frame.visibility, 1.0))
    # Squares count large steps: a pixel that gets darker by a ninth nine times adds a ninth of one that turns dark at once.
    flicker, hard_flicker = (float((np.diff(np.stack(values), axis=0) ** 2).mean()) for values in (shown, hard))
    assert 0.0 < flicker < 0.3 * hard_flicker
