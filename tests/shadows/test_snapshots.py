"""Snapshots: pictures of the bundled levels against stored golden pictures."""

from __future__ import annotations

import re

import numpy as np
import pytest
from PIL import Image

from skugga.api.compute import product_of_frame
from skugga.api.products import PRODUCTS
from skugga.shadows.render import render_frame
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
from tests import golden
from tests.golden import assert_golden
from tests.render import block_at, plan_of, render

SUNS = {"evening": (246, 12), "morning": (110, 25), "low": (67, 3), "usual": (315, 45), "dusk": (250, -4)}

PICTURES = [
    ("jacksboro", "evening", "color"),
    ("jacksboro", "evening", "shadow"),
    ("jacksboro", "evening", "mask"),
    ("jacksboro", "low", "color"),
    ("jacksboro", "usual", "color"),
    ("jacksboro", "dusk", "color"),
    ("jacksboro_alpine", "morning", "color"),
    ("jacksboro_alpine", "evening", "mask"),
]

PERSPECTIVE_ALGORITHMS = ("shadow_volume", "hybrid", "perspective_shadow_map")
PERSPECTIVE_VIEWS = (("thesis_boxgrid_sun", "main"), ("thesis_street", "main"), ("thesis_room_sun", "close"))

MAP_ALGORITHMS = ("shadow_volume", "hybrid")
MAP_BOUNDS = (("thesis_rocks_sun", (-30, -30, 30, 30)), ("thesis_water_tower", (-40, -40, 40, 40)), ("jacksboro", None))


@pytest.mark.parametrize(("level", "sun", "layer"), PICTURES)
def test_map_views(gl, level, sun, layer, request):
    azimuth, altitude = SUNS[sun]
    scene = build_scene(load_level(f"configs/{level}.yaml")).with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
    frame = render(scene, scene.view(size=(300, 300)))
    picture = product_of_frame(scene, frame, layer)
    assert_golden(f"{level}-{sun}-{layer}", picture, gl.renderer, request.config.getoption("regenerate_goldens"))


@pytest.mark.parametrize("algorithm", PERSPECTIVE_ALGORITHMS)
@pytest.mark.parametrize(("level", "view"), PERSPECTIVE_VIEWS)
def test_algorithms_in_perspective(gl, level, view, algorithm, request):
    scene = build_scene(load_level(f"configs/{level}.yaml"))
    frame = render(scene, scene.view(view, size=(360, 288)), algorithm=algorithm)
    assert frame.plan.algorithms_text == algorithm
    picture = product_of_frame(scene, frame, "color")[..., :3]
    assert_golden(f"{level}-{view}-{algorithm}", picture, gl.renderer, request.config.getoption("regenerate_goldens"))


@pytest.mark.parametrize("algorithm", MAP_ALGORITHMS)
@pytest.mark.parametrize(("level", "bounds"), MAP_BOUNDS)
def test_algorithms_in_maps(gl, level, bounds, algorithm, request):
    scene = build_scene(load_level(f"configs/{level}.yaml"))
    frame = render(scene, scene.view(bounds=bounds, size=(256, 256)), algorithm=algorithm)
    assert frame.plan.algorithms_text == algorithm
    picture = product_of_frame(scene, frame, "mask")
    assert_golden(f"{level}-map-{algorithm}", picture, gl.renderer, request.config.getoption("regenerate_goldens"))


@pytest.mark.parametrize(
    ("algorithm", "layer"),
    [("shadow_volume", "volumes"), ("shadow_volume", "silhouettes"), ("shadow_volume", "stencil"), ("hybrid", "silhouettes")],
)
def test_layers_of_volumes(gl, algorithm, layer, request):
    scene = build_scene(load_level("configs/thesis_street_sun.yaml"))
    view = scene.view("main", size=(360, 288))
    frame = render_frame(scene, view, plan_of(scene, view, algorithm=algorithm), layers=frozenset({layer}))
    array, to_picture = product_of_frame(scene, frame, layer), PRODUCTS[layer].to_picture
    picture = array if to_picture is None else to_picture(array, frame.color)
    assert_golden(f"thesis_street_sun-{layer}-{algorithm}", picture, gl.renderer, request.config.getoption("regenerate_goldens"))


def test_tiles_of_a_block(gl, request):
    """The picture has four tiles at the corner of a ridge at zoom 13, cut from their block."""
    scene = build_scene(load_level("configs/jacksboro.yaml"))
    view = block_at(-84.25, 36.2933, 13).part(256, 256, 512, 512)
    picture = product_of_frame(scene, render(scene, view), "color")
    assert_golden("jacksboro-tiles-13", picture, gl.renderer, request.config.getoption("regenerate_goldens"))


def test_assert_golden_fails_on_changed_or_missing_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(golden, "FOLDER", tmp_path / "golden")
    monkeypatch.setattr(golden, "OUTPUT", tmp_path / "output")
    picture = np.full((8, 8, 3), 100, np.uint8)
    monkeypatch.setenv("CI", "true")
    with pytest.raises(AssertionError, match="no golden picture"):
        assert_golden("p", picture, "llvmpipe", regenerate=False)
    monkeypatch.delenv("CI")
    assert_golden("p", picture, "llvmpipe", regenerate=False)  # writes the golden picture
    assert_golden("p", picture + np.uint8(1), "llvmpipe", regenerate=False)
    with pytest.raises(pytest.fail.Exception, match="1.562 % of the pixels"):
        changed = picture.copy()
        changed[3, 4, 1] += 2
        assert_golden("p", changed, "llvmpipe", regenerate=False)
    assert {path.name for path in (tmp_path / "output").iterdir()} == {f"p.{k}.png" for k in ("actual", "expected", "difference")}


def test_assert_golden_applies_a_tolerance_to_other_renderers(tmp_path, monkeypatch):
    """The comparison is not skipped: a picture shifted by a pixel fails.

    A renderer whose name merely contains llvmpipe is another one.
    """
    monkeypatch.setattr(golden, "OUTPUT", tmp_path / "output")
    for name in ("jacksboro-map-hybrid", "thesis_street-main-hybrid", "thesis_boxgrid_sun-main-perspective_shadow_map"):
        picture = np.asarray(Image.open(golden.FOLDER / f"{name}.png"))
        slightly_changed = picture.copy()
        slightly_changed[:1, : picture.shape[1] // 2] = 255 - slightly_changed[:1, : picture.shape[1] // 2]
        for renderer in ("another", "zink (llvmpipe)"):
            assert_golden(name, slightly_changed, renderer, regenerate=False)
            with pytest.raises(pytest.fail.Exception, match=f"{re.escape(f'{name} on {renderer}')}: .* by more than 32 of 255"):
                assert_golden(name, np.roll(picture, 1, axis=1), renderer, regenerate=False)
    with pytest.raises(AssertionError, match="are made on llvmpipe"):
        assert_golden("p", picture, "another", regenerate=True)
    with pytest.raises(AssertionError, match="no golden picture"):
        assert_golden("p", picture, "another", regenerate=False)
    assert not (golden.FOLDER / "p.png").exists()
