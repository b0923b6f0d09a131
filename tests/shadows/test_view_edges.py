"""Smooth edges of shadows in perspective views: coverage of pixels, what stays hard, and what a moving sun changes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from skugga.selector.select import plan_of_view
from skugga.shadows import view_edges
from skugga.shadows.maps import shadow_map
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import clear_caches
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
    reach = 1 + sum(view_edges.GROWTH_PX)
    neighbourhoods = np.lib.stride_tricks.sliding_window_view(np.pad(hard, reach, mode="edge"), (2 * reach + 1,) * 2)
    is_even = frame.valid & (neighbourhoods.min(axis=(2, 3)) == neighbourhoods.max(axis=(2, 3)))
    np.testing.assert_array_equal(shown[is_even], frame.visibility[is_even])


@pytest.mark.parametrize("overrides", [{"cascades": 3}, {"filter": "sun"}], ids=str)
def test_samples_are_looked_up_in_the_maps_of_the_pixels(gl, posts: Scene, monkeypatch, overrides):
    """No map is drawn again for samples; with maps of their own, only samples at the rim of a map change."""
    view = posts.view("low")
    plan = plan_of_view(posts, view, "low", {"algorithm": "shadow_map", "map_size": 1024, **overrides})
    clear_caches("light")
    points = render_frame(posts, view, plan, pixel_sampling="points")
    clear_caches("light")
    frame = render_frame(posts, view, plan)
    texels, texels_of_points = (sum(record.map_texels for record in drawn.passes) for drawn in (frame, points))
    assert texels == texels_of_points > 0
    with monkeypatch.context() as patch:
        patch.setattr(shadow_map, "SUN", "")  # only the sun's maps serve samples
        with_own_maps = render_frame(posts, view, plan)
    shown, shown_by_own_maps = (next(iter(drawn.shown_visibilities.values())) for drawn in (frame, with_own_maps))
    is_edge = np.isfinite(shown) & (shown != frame.visibility)
    assert is_edge.sum() > 200
    assert np.mean(shown[is_edge] != shown_by_own_maps[is_edge]) < 0.01


@pytest.mark.parametrize("algorithm", ["shadow_volume", "hybrid", "planar"])
def test_algorithms_that_count_in_pixels_count_in_finer_ones_at_edges(gl, posts: Scene, algorithm: str):
    """Truth is the mean over 16 times as many pixels by the same algorithm. The points themselves are a coarser picture."""
    view = posts.view("low")
    assert isinstance(view, PerspectiveView)
    algorithms = {"meshes": algorithm, "relief": "none"} if algorithm == "planar" else algorithm
    frame = draw(posts, view, algorithm=algorithms)
    finer = draw(posts, view.finer(4), algorithm=algorithms)
    shown = next(iter(frame.shown_visibilities.values()))
    truth, height_m = (
        values.reshape(view.rows, 4, view.cols, 4).mean(axis=(1, 3)) for values in (finer.visibility, finer.height_m)
    )
    ground = np.isfinite(height_m) & (height_m < 0.01) & frame.valid & (frame.height_m < 0.01)
    is_edge = ground & (truth > 0.02) & (truth < 0.98)
    assert is_edge.sum() > 200
    smooth_error, hard_error = (np.abs(values[is_edge] - truth[is_edge]).mean() for values in (shown, frame.visibility))
    assert smooth_error < 0.6 * hard_error
    assert len(np.unique(shown[ground])) > 4


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


def test_thin_strips_of_shadow_do_not_break_into_dashes(gl, tmp_path: Path):
    """The shadow of a wire is a quarter of a pixel wide and crosses rows slowly, so it misses most pixels' own points."""
    write_geotiff(tmp_path / "floor.tif", np.zeros((64, 64), np.float32), ENGINEERING, -320.0, 320.0, 10.0)
    wire = trimesh.creation.box((120.0, 0.3, 0.3)).apply_translation((0.0, 0.0, 20.0))
    post = trimesh.creation.box((0.5, 0.5, 19.5)).apply_translation((59.0, 0.0, 9.75))
    trimesh.util.concatenate([wire, post]).export(tmp_path / "wire.obj")
    keys = {
        "version": 1, "terrain": {"source": "floor.tif"}, "sun": {"azimuth": 180.0, "altitude": 60.0},
        "meshes": [{"source": "wire.obj", "at": [0.0, 0.0], "turn": 3.0}],
        "views": {"low": {"kind": "perspective", "eye": [0, -40, 12], "target": [0, 12, 0], "fov": 40, "size": [160, 96]}},
    }  # fmt: skip
    (tmp_path / "level.yaml").write_text(json.dumps(keys), encoding="utf-8")
    scene = build_scene(load_level(tmp_path / "level.yaml"))
    view = scene.view("low")
    assert isinstance(view, PerspectiveView)
    truth = pixel_means(draw(scene, view.finer(SUBPIXELS), algorithm="truth").visibility)
    frame = draw(scene, view, algorithm="truth")
    shown = next(iter(frame.shown_visibilities.values()))
    columns = slice(20, 140)
    darkness, own, smooth = (
        (1.0 - np.nan_to_num(values, nan=1.0)).sum(axis=0)[columns] for values in (truth, frame.visibility, shown)
    )
    assert (0.2 < darkness).all() and (darkness < 0.5).all()
    assert (own > 0).mean() < 0.4  # 0.24
    assert (smooth > 0.05).mean() > 0.85  # 0.90; without growth 0.4
    assert np.abs(smooth - darkness).mean() < 0.1  # 0.066; the own points' 0.36
