"""Light through leaves: the phase function keeps energy, bark and snow transmit nothing, and neighbouring trees differ."""

from __future__ import annotations

import json

import numpy as np
import pyogrio
import pytest
import shapely

from skugga.terrain.gbuffer.resolve import FOREST, TREE_BRIGHTNESS_VARIATION, TREE_HUE_VARIATION, tree_tint
from skugga.terrain.gbuffer.view_geometry import RasterisedView, geometry_buffer, resolve_buffer, view_frame
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import LEAF_TRANSLUCENCY, LEAF_TRANSMITTANCE_RATIO, leaf_optics, shade
from skugga.terrain.shading_loops import CROWN_OPTICAL_DEPTH, leaf_share, transmitted_share
from skugga.terrain.srgb import linear_of_srgb
from skugga.terrain.trees.foliage import foliage
from tests.rasters import ENGINEERING, write_geotiff


def test_leaves_transmit_no_more_light_than_they_receive():
    """The radiance over all directions sums to the transmitted light, for a crown's rim, through which no path leads."""
    cosines = np.cos((np.arange(2000) + 0.5) * np.pi / 2000)
    solid_angle = 2.0 * np.pi * np.sqrt(1.0 - cosines**2) * np.pi / 2000
    total = sum(transmitted_share(cosine, 0.0) * angle for cosine, angle in zip(cosines, solid_angle, strict=True)) / np.pi
    assert total == pytest.approx(1.0, abs=1e-4)
    for k, reflectance in enumerate((0.066, 0.127, 0.032)):
        assert reflectance * (1.0 + LEAF_TRANSMITTANCE_RATIO[k]) < 1.0


def test_transmitted_light_is_brightest_against_the_sun():
    assert transmitted_share(1.0, 0.0) == pytest.approx(2.0 / 3.0)
    assert transmitted_share(0.0, 0.0) == pytest.approx(2.0 / (3.0 * np.pi))
    assert transmitted_share(-1.0, 1.0) == pytest.approx(0.0, abs=1e-9)
    assert transmitted_share(1.0, -1.0) == pytest.approx(2.0 / 3.0 * np.exp(-CROWN_OPTICAL_DEPTH))
    shares = [transmitted_share(cosine, 0.0) for cosine in np.linspace(-1.0, 1.0, 50)]
    assert (np.diff(shares) > 0.0).all()


def test_bark_and_snow_transmit_nothing():
    assert leaf_share(0.073, 0.112) == 1.0
    assert leaf_share(0.12, 0.10) == 0.0 and leaf_share(0.5, 0.48) == 0.0 and leaf_share(0.8, 0.8) == 0.0
    assert 0.0 < leaf_share(0.1, 0.11) < 1.0


def test_painted_leaves_count_as_leaves_in_every_tint():
    """Even the warmest tree has green leaves."""
    texels = foliage().mip_levels[-1][1::2, 1:-1, 1:-1, :3].reshape(-1, 3)  # means of views from above: leaves only
    for red, green, _ in linear_of_srgb(texels / 255.0):
        assert leaf_share(red * (1.0 + TREE_HUE_VARIATION), green) > 0.5


def test_neighbouring_trees_differ_within_bounds():
    tints = np.array([tree_tint(number) for number in range(2000)])
    assert np.abs(tints[:, 1] - 1.0).max() <= TREE_BRIGHTNESS_VARIATION
    assert np.abs(tints[:, 0] / tints[:, 1] - 1.0).max() <= TREE_HUE_VARIATION + 1e-9
    assert tints[:, 0] / tints[:, 1] + tints[:, 2] / tints[:, 1] == pytest.approx(2.0)
    assert tints.mean(axis=0) == pytest.approx(1.0, abs=0.01)
    assert len(np.unique(tints[:, 1])) == 2000 and np.abs(np.corrcoef(tints[:-1, 1], tints[1:, 1])[0, 1]) < 0.05


def make_scene_of_trees(folder, azimuth: float) -> Scene:
    """Return a floor with three equal trees in a row, 16 m apart, and views from the south and from above."""
    write_geotiff(folder / "floor.tif", np.zeros((64, 64), np.float32), ENGINEERING, -320.0, 320.0, 10.0)
    trees = shapely.to_wkb(np.array([shapely.Point(x, 0.0) for x in (-16.0, 0.0, 16.0)], object))
    pyogrio.raw.write(folder / "trees.gpkg", trees, [np.full(3, 12.0)], ["height"], geometry_type="Point", crs=ENGINEERING)
    level = {
        "version": 1, "terrain": {"source": "floor.tif"}, "sun": {"azimuth": azimuth, "altitude": 20},
        "forest": [{"source": "trees.gpkg", "height": "height", "species": "broadleaf"}],
        "views": {"south": {"kind": "perspective", "eye": [0, -60, 7], "target": [0, 0, 6], "fov": 40, "size": [160, 120]}},
    }  # fmt: skip
    path = folder / f"level{azimuth}.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.mark.parametrize(("azimuth", "min_gain", "max_gain"), [(0.0, 1.15, 3.0), (180.0, 1.0, 1.05)])
def test_crowns_are_brighter_and_yellower_against_the_sun(gl, tmp_path, monkeypatch, azimuth, min_gain, max_gain):
    scene = make_scene_of_trees(tmp_path, azimuth)
    buffer = geometry_buffer(scene, scene.view("south"))
    leaves, sunlight = buffer.surface_kind == FOREST, np.ones(buffer.valid.shape, np.float32)
    color = shade(buffer, scene, sunlight)[leaves].mean(axis=0)
    monkeypatch.setattr("skugga.terrain.shading.LEAF_TRANSMITTANCE_RATIO", (0.0, 0.0, 0.0))
    opaque_color = shade(buffer, scene, sunlight)[leaves].mean(axis=0)
    gain = color / opaque_color
    assert min_gain < gain[1] < max_gain
    assert gain[2] == pytest.approx(1.0) and gain[0] >= 1.0


def test_maps_show_no_light_through_leaves(gl, tmp_path):
    scene = make_scene_of_trees(tmp_path, 0.0)
    buffer = geometry_buffer(scene, scene.view("map", bounds=(-30.0, -30.0, 30.0, 30.0), size=(40, 40)))
    optics = leaf_optics(buffer)
    assert optics.transmittance_ratio.max() == 0.0 and optics.isotropic_share == LEAF_TRANSLUCENCY


def test_views_tint_the_picture_of_each_tree_by_its_number(gl, tmp_path):
    scene = make_scene_of_trees(tmp_path, 0.0)
    view = scene.view("south")
    rasterised = RasterisedView(scene, view, view_frame(scene, view))
    albedo = resolve_buffer(scene, view, rasterised).albedo
    first = len(rasterised.ground.triangles) + 1
    tree = (rasterised.id_buffer.triangle_number.astype(np.int64) - first) // 6
    painted = (rasterised.id_buffer.sqrt_albedo[..., :3] / 255.0) ** 2
    for instance, number in enumerate(rasterised.tree_instances.tree_number):
        np.testing.assert_allclose(albedo[tree == instance], painted[tree == instance] * tree_tint(number), rtol=1e-5)
    assert {0, 1, 2} <= set(np.unique(tree))
