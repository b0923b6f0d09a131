"""Detail of near ground: fixed to the ground, faded out where pixels cannot show it, and only on bare ground."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.terrain.describe import describe
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.ground_detail import (
    EFFECT,
    GROUND_WAVES,
    MAX_INVISIBLE_ALBEDO_CHANGE,
    apply_ground_detail,
    has_natural_ground,
    max_albedo_change,
    max_code_steps,
)
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.geo.camera import look_at
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.srgb import srgb_of_linear

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Scene of low hills with views from near, from far and to the sky."""
    views = {
        "eye": {"kind": "perspective", "eye": [0, -20, 1.7], "target": [0, 0, 1.5], "fov": 50, "size": [96, 64]},
        "far": {"kind": "perspective", "eye": [0, 0, 150000], "target": [0, 1, 0], "fov": 20, "size": [96, 64]},
        "sky": {"kind": "perspective", "eye": [0, 0, 5], "target": [0, 20, 60], "fov": 20, "size": [96, 64]},
    }
    terrain = {"generate": {"kind": "landscape", "size": [2000, 2000], "cell": 40, "relief": 1, "seed": 3}}
    path = tmp_path / "level.yaml"
    path.write_text(json.dumps({"version": 1, "terrain": terrain, "sun": {"azimuth": 90, "altitude": 40}, "views": views}))
    return build_scene(load_level(path))


def detail_at(scene: Scene, points: np.ndarray, eye: np.ndarray, kind: int = RELIEF) -> np.ndarray:
    """Return an albedo of 1 with detail applied, at level points (n, 3) of the frame seen from an eye: (n, 3)."""
    view = look_at(eye, points.mean(axis=0), np.array([0.0, 1.0, 0.0]), 40.0, 1, len(points))
    frame = view.frame(scene.world)
    ones = np.ones((1, len(points)), np.float32)
    normal = np.broadcast_to(UP.astype(np.float32), (1, len(points), 3))
    position = ((points - frame.origin_earth_m) @ frame.frame_from_earth.T)[None]
    height_m = 1e4 * ones
    buffer = GeometryBuffer(
        view, frame, ones > 0, position, height_m, normal, normal, 0 * ones, np.full(ones.shape, kind, np.uint8)
    )
    albedo = np.ones((1, len(points), 3), np.float32)
    apply_ground_detail(albedo, ShadingBlock(scene, replace(view, focal_px=1000.0), buffer, {}))
    return albedo[0]


def test_ground_detail_is_needed_only_near_the_ground(scene):
    verdicts = {name: EFFECT.judge(describe(scene, scene.view(name), name)) for name in ("eye", "far", "sky", "map")}
    assert {name for name, verdict in verdicts.items() if verdict.is_needed} == {"eye"}
    assert "tints only" in verdicts["map"].reason and "no ground" in verdicts["sky"].reason
    assert "pixels are as wide" in verdicts["far"].reason


def test_ground_detail_is_not_needed_on_imagery(scene):
    descriptor = describe(scene, scene.view("eye"), "eye")
    facts = {**descriptor.facts, "ground_detail": {**descriptor.facts["ground_detail"], "draped": True}}
    verdict = EFFECT.judge(descriptor.model_copy(update={"facts": facts}))
    assert not verdict.is_needed and "imagery" in verdict.reason


@pytest.mark.parametrize("style", ["grey", "urban", "analysis"])
def test_ground_detail_needs_natural_ground(scene, style):
    """Stone and neutral ground has no tufts, also if the effect is forced on."""
    styled_scene = scene.with_style(style)
    verdict = EFFECT.judge(describe(styled_scene, scene.view("eye"), "eye"))
    assert not verdict.is_needed and "no natural ground" in verdict.reason
    points = np.column_stack([np.linspace(-3, 3, 50), np.zeros(50), np.zeros(50)])
    assert (detail_at(styled_scene, points, np.array([0.0, 0.0, 5.0])) == 1.0).all()
    assert (detail_at(scene.with_style("swiss"), points, np.array([0.0, 0.0, 5.0])) != 1.0).any()


@pytest.mark.parametrize(("level", "view"), [("thesis_room", "main"), ("thesis_room_sun", "close"), ("thesis_boxgrid", "main")])
def test_floors_have_no_ground_detail(level, view):
    scene = build_scene(load_level(find_level(level)))
    assert not has_natural_ground(scene)
    assert not EFFECT.judge(describe(scene, scene.view(view), view)).is_needed


def test_ground_detail_is_not_needed_on_dark_ground(scene):
    descriptor = describe(scene, scene.view("eye"), "eye")
    facts = {**descriptor.facts, "ground_detail": {**descriptor.facts["ground_detail"], "steps": max_code_steps(0.0005, 0.5)}}
    verdict = EFFECT.judge(descriptor.model_copy(update={"facts": facts}))
    assert not verdict.is_needed and "too dark" in verdict.reason


def test_code_steps_bound_every_darker_colour():
    colors = np.linspace(0.0, 0.3, 500)
    for share in (0.05, 0.4, 1.2):
        brighter, darker = (255.0 * srgb_of_linear(np.maximum(colors * factor, 0.0)) for factor in (1.0 + share, 1.0 - share))
        codes = 255.0 * srgb_of_linear(colors)
        assert max(np.max(brighter - codes), np.max(codes - darker)) == pytest.approx(max_code_steps(0.3, share))


def test_largest_share_bounds_detail_and_falls_with_pixel_size(scene):
    widths = np.geomspace(1e-3, 100.0, 60)
    bounds = [max_albedo_change(width) for width in widths]
    assert (np.diff(bounds) <= 0.0).all() and bounds[-1] == 0.0 and bounds[0] > MAX_INVISIBLE_ALBEDO_CHANGE
    rng = np.random.default_rng(1)
    for distance_m in (2.0, 50.0, 1000.0, 15_000.0):
        points = np.column_stack([rng.uniform(-0.3, 0.3, (4000, 2)) * distance_m, np.zeros(4000)]) + [70.0, 40.0, 0.0]
        max_change = np.abs(detail_at(scene, points, np.array([70.0, 40.0, distance_m])) - 1.0).max()
        assert max_change <= max_albedo_change(distance_m / 1000.0) + 1e-6
        assert max_change > 0.2 * max_albedo_change(distance_m / 1000.0)


def test_ground_detail_stays_fixed_when_the_camera_moves(scene):
    points = np.column_stack([np.linspace(-3, 3, 400), np.linspace(5, 9, 400), np.zeros(400)])
    detail, other_detail = (detail_at(scene, points, np.array([x, 7.0, 20.0])) for x in (-2.0, 2.5))
    # Of a range of 0.9: the eyes' pixels differ by 2 %.
    np.testing.assert_allclose(detail, other_detail, atol=0.021)
    assert np.corrcoef(detail.ravel(), other_detail.ravel())[0, 1] > 0.999
    assert detail.std() > 0.03


def test_ground_detail_has_only_waves_that_pixels_can_show(scene):
    """Along a row of pixels the largest step is that of waves four pixels long, not that of noise from pixel to pixel."""
    for distance_m in (3.0, 30.0, 300.0):
        x = np.arange(-200, 200) * distance_m / 1000.0
        row = detail_at(scene, np.column_stack([x, 0 * x + 1.3, 0 * x]), np.array([0.0, 1.3, distance_m]))[:, 1]
        steps, two_pixel_steps = np.diff(row), row[2:] - row[:-2]
        assert np.abs(steps).max() < 0.25 and (steps[1:] * steps[:-1] > 0.0).mean() > 0.5
        assert np.abs(two_pixel_steps).mean() > 1.2 * np.abs(steps).mean()


@pytest.mark.parametrize("kind", [MESHES, FOREST])
def test_ground_detail_skips_meshes_and_trees(scene, kind):
    points = np.column_stack([np.linspace(-3, 3, 50), np.zeros(50), np.zeros(50)])
    assert (detail_at(scene, points, np.array([0.0, 0.0, 5.0]), kind) == 1.0).all()


def test_ground_detail_keeps_the_mean_albedo(scene):
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-400, 400, (20000, 2)), np.zeros(20000)])
    assert detail_at(scene, points, np.array([0.0, 0.0, 3.0])).mean(axis=0) == pytest.approx(np.ones(3), abs=0.02)
    assert len(GROUND_WAVES) == 8
