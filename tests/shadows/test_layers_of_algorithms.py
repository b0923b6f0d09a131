"""Layers of algorithms: created only on request, with the drawn values, and refused with a reason where no algorithm has them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skugga.api.compute import product_of_frame
from skugga.api.encoding import encode_exactly
from skugga.api.products import PRODUCTS
from skugga.api.products.product import ProductOptions
from skugga.shadows import layer_collector
from skugga.shadows.layer_collector import LayerCollector, tiled_pictures
from skugga.shadows.passes import PassLog
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.errors import InputError, UnsupportedError
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView, map_view
from skugga.terrain.gl.device import Device
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of

SPOT = {"kind": "spot", "position": [-20, 10, 25], "target": [0, 0, 0], "cutoff": 40}
OMNI = {"kind": "omni", "position": [0, -12, 20]}
EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [160, 120]}


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """Return ``build(at, azimuth)``, the scene of a figure on a flat floor, under a sun, a spot and an omni light."""

    def level(at: tuple[float, float] = (0.0, 0.0), azimuth: float = 200.0) -> Scene:
        path = tmp_path_factory.mktemp("layers") / "figure.yaml"
        keys = {
            "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
            "meshes": [{"generate": "tetrahedra", "at": at}], "sun": {"azimuth": azimuth, "altitude": 35},
            "lights": {"spot": SPOT, "omni": OMNI},
        }  # fmt: skip
        path.write_text(json.dumps(keys), encoding="utf-8")
        return build_scene(load_level(path))

    return level


@pytest.fixture(scope="module")
def scene(build) -> Scene:
    """The scene that all tests of this module draw."""
    return build()


def render_with_layers(scene: Scene, *layers: str, view=None, **overrides) -> Frame:
    """Render a view, by default ``eye``, with layers of the algorithms; without samples of edges, which have maps of their own."""
    view = view or scene.view("eye")
    return render_frame(scene, view, plan_of(scene, view, **overrides), layers=frozenset(layers), pixel_sampling="points")


def pass_picture(layer: str, array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return a layer as the picture that PNG shows over the frame's colour."""
    to_picture = PRODUCTS[layer].to_picture
    return array if to_picture is None else to_picture(array, color)


def write_pass_layer(scene: Scene, frame: Frame, layer: str, path: Path) -> None:
    """Write a layer of a frame to a file."""
    array, format = product_of_frame(scene, frame, layer), path.suffix[1:]
    pixels = array if format == "npy" else pass_picture(layer, array, frame.color)
    path.write_bytes(encode_exactly(pixels, PRODUCTS[layer], ProductOptions(), format, frame.view))


# -- the mechanism


def test_pass_log_creates_only_requested_layers(gl, scene, monkeypatch):
    """A layer that nobody requests costs nothing: its picture is not even read back."""
    created = []
    log = PassLog()
    log.keep_layer("stencil", SUN, created.append, 1)
    assert created == [] and log.take_layers() == {}
    log = PassLog(requested_layers=frozenset({"stencil"}))
    log.keep_layer("stencil", SUN, np.full, (2, 2), 7)
    log.keep_layer("shadow-map", SUN, created.append, 1)
    assert (
        created == []
        and [array.tolist() for array in log.take_layers()["stencil", SUN]] == [[[7, 7], [7, 7]]]
        and log.take_layers() == {}
    )
    reads = []
    original = Device.read
    monkeypatch.setattr(
        Device,
        "read",
        lambda self, target, *arguments, **keywords: reads.append(arguments) or original(self, target, *arguments, **keywords),
    )
    clear_caches("light", "scene")
    plan = plan_of(scene, scene.view("eye"), algorithm="shadow_map")
    plain_frame = render_frame(scene, scene.view("eye"), plan, pixel_sampling="points")
    count = len(reads)
    clear_caches("light", "scene")
    layered_frame = render_with_layers(scene, "shadow-map", algorithm="shadow_map")
    assert plain_frame.layers == {} and set(layered_frame.layers) == {"shadow-map"}
    assert len(reads) - count > count
    np.testing.assert_array_equal(plain_frame.color, layered_frame.color)
    assert [record.name for record in layered_frame.passes] == layered_frame.plan.passes


def test_tiled_pictures_are_laid_out_side_by_side():
    wide, tall, single_pixel = np.full((2, 3), 1.0, np.float32), np.full((3, 1), 2.0, np.float32), np.full((1, 1), 3.0, np.float32)
    np.testing.assert_array_equal(tiled_pictures([wide]), wide)
    tiled = tiled_pictures([wide, tall, single_pixel])
    assert tiled.shape == (6, 6) and tiled.dtype == np.float32
    np.testing.assert_array_equal(tiled[:2, :3], wide)
    np.testing.assert_array_equal(tiled[:3, 3:4], tall)
    assert tiled[3, 0] == 3.0 and np.isfinite(tiled).sum() == wide.size + tall.size + single_pixel.size


def test_layer_collector_places_blocks():
    """Sample rows below a block's own rows are dropped. Pixels without a block are 0 or NaN."""
    collector = LayerCollector((4, 5))
    target, source = (slice(1, 3), slice(2, 5)), (slice(0, 2), slice(1, 4))
    block = np.arange(20, dtype=np.uint8).reshape(5, 4)
    collector.add_block({("stencil", SUN): [block], ("shadow-height", SUN): [block.astype(np.float32)]}, target, source)
    layers = collector.assembled_pictures
    np.testing.assert_array_equal(layers["stencil"][SUN][target], block[source])
    assert layers["stencil"][SUN].sum() == block[source].sum() and layers["stencil"][SUN].dtype == np.uint8
    assert np.isnan(layers["shadow-height"][SUN]).sum() == 20 - 6


def test_layer_collector_refuses_too_many_texels(monkeypatch):
    monkeypatch.setattr(layer_collector, "MAX_LAYER_TEXELS", 100)
    collector, empty_window = LayerCollector((4, 4)), (slice(0, 0), slice(0, 0))
    collector.add_block({("shadow-map", SUN): [np.zeros((10, 10), np.float32)]}, empty_window, empty_window)
    with pytest.raises(InputError, match="layer: shadow-map has 101 texels, more than the limit of 100"):
        collector.add_block({("shadow-map", SUN): [np.zeros((1, 1), np.float32)]}, empty_window, empty_window)


# -- content of layers


def test_shadow_map_layer_of_each_light(gl, scene):
    """A sun has a map for each cascade, a spot one, an omni light six. Depths are as drawn, nearest 0."""
    frame = render_with_layers(scene, "shadow-map", algorithm="shadow_map", map_size=256, cascades=2)
    maps = frame.layers["shadow-map"]
    assert set(maps) == {SUN, "spot", "omni"}
    texels = {light: sum(record.map_texels for record in frame.passes if record.name.startswith(f"{light}/")) for light in maps}
    for light, picture in maps.items():
        assert picture.dtype == np.float32 and np.nanmin(picture) >= 0.0 and np.nanmax(picture) == 1.0
        assert np.isfinite(picture).sum() == texels[light] and (picture < 1.0).any()
    assert maps["spot"].shape == (256, 256) and maps["omni"].shape == (512, 768)
    assert product_of_frame(scene, frame.with_light_first("omni"), "shadow-map") is maps["omni"]


def test_shadow_map_layer_of_a_sun_has_its_up_on_top(gl, build):
    """The sun stands in the south. A body farther north, and so farther from the sun, appears higher up."""
    mean_rows = []
    for y in (-30.0, 30.0):
        scene = build((0.0, y), 180.0)
        view = scene.view(bounds=(-50, -50, 50, 50), size=(90, 90))
        algorithm = {"relief": "none", "meshes": "shadow_map", "spot": "none", "omni": "none"}
        picture = render_with_layers(scene, "shadow-map", view=view, algorithm=algorithm).layers["shadow-map"][SUN]
        mean_rows.append(np.nonzero(picture < 1.0)[0].mean() / len(picture))
    assert mean_rows[0] > mean_rows[1] + 0.2


def test_layers_of_map_blocks_lie_side_by_side(gl, scene, monkeypatch):
    monkeypatch.setattr("skugga.terrain.geo.grid.BLOCK_PX", 32)
    view = scene.view(bounds=(-20, -20, 20, 20), size=(50, 60))
    overrides = {"sun": "planar", "spot": "shadow_map", "omni": "none"}
    frame = render_with_layers(scene, "shadow-map", "stencil", view=view, algorithm=overrides, map_size=64)
    assert frame.layers["shadow-map"]["spot"].shape == (128, 128)
    stencil = frame.layers["stencil"][SUN]
    assert stencil.shape == frame.valid.shape == (60, 50)
    ground = frame.valid & (frame.height_m == 0.0)
    assert (stencil == 2).sum() > 20
    np.testing.assert_array_equal((stencil == 2)[ground], (frame.visibilities[SUN] < 0.5)[ground])
    assert (stencil > 0)[ground].all() and (frame.visibilities[SUN] < 0.5)[stencil == 2].all()
    np.testing.assert_array_equal(stencil > 0, frame.valid)  # roofs receive, too


def lit_floor(scene: Scene, view: MapView | PerspectiveView, light: str) -> np.ndarray:
    """Return where a visible floor would be lit without casters."""
    plain_frame = render_with_layers(scene, view=view, algorithm="none")
    return plain_frame.valid & (plain_frame.height_m == 0.0) & (plain_frame.visibilities[light] > 0.5)


@pytest.mark.parametrize(("view", "light"), [("eye", SUN), ("eye", "spot"), ("eye", "omni"), ("map", SUN)])
def test_shadow_volume_layers_are_consistent(gl, scene, view, light):
    """The stencil counts the volumes that contain a point.

    From an eye outside, a ray meets one face for each volume that it enters, and two for each volume that it crosses.
    """
    scene_view = scene.view("eye") if view == "eye" else scene.view(bounds=(-30, -30, 30, 30), size=(90, 90))
    algorithm = {item: "none" for item in (SUN, "spot", "omni")} | {light: "shadow_volume"}
    layers = {"stencil", "silhouettes", "volumes"}
    frame = render_with_layers(scene, *layers, view=scene_view, algorithm=algorithm)
    assert set(frame.layers) == layers
    stencil, silhouettes, face_counts = (frame.layers[layer][light] for layer in ("stencil", "silhouettes", "volumes"))
    assert {item.dtype for item in (stencil, silhouettes, face_counts)} == {np.dtype(np.uint8)}
    floor, dark = lit_floor(scene, scene_view, light), frame.visibilities[light] < 0.5
    np.testing.assert_array_equal((stencil > 0)[floor], dark[floor])
    assert dark[floor].any() and not stencil[frame.valid & ~dark].any()
    assert (face_counts >= stencil)[floor].all() and ((face_counts - stencil) % 2 == 0)[floor].all()
    assert (face_counts > stencil)[floor].any() and set(np.unique(silhouettes)) == {0, 255}


def test_hybrid_layers_are_consistent(gl, scene):
    """The silhouettes are the marked pixels, and the stencil counts in no other pixel."""
    algorithm = {SUN: "hybrid", "spot": "none", "omni": "none"}
    frame = render_with_layers(scene, "stencil", "silhouettes", "volumes", "shadow-map", algorithm=algorithm)
    stencil, marks, face_counts, depths = (
        frame.layers[layer][SUN] for layer in ("stencil", "silhouettes", "volumes", "shadow-map")
    )
    (record,) = [record for record in frame.passes if record.name.endswith("stencil")]
    assert set(np.unique(marks)) == {0, 255} and record.marked == (marks == 255).sum() > 0 < record.tiles
    assert not stencil[marks == 0].any() and depths.dtype == np.float32
    floor = lit_floor(scene, frame.view, SUN) & (marks == 255)
    np.testing.assert_array_equal((stencil > 0)[floor], (frame.visibilities[SUN] < 0.5)[floor])
    volume_frame = render_with_layers(scene, "volumes", algorithm={**algorithm, SUN: "shadow_volume"})
    np.testing.assert_array_equal(face_counts, volume_frame.layers["volumes"][SUN])


def test_perspective_shadow_map_layer_has_its_depths(gl, scene):
    choice = {SUN: "perspective_shadow_map", "spot": "perspective_shadow_map", "omni": "none"}
    maps = render_with_layers(scene, "shadow-map", algorithm=choice, map_size=128).layers["shadow-map"]
    for light in (SUN, "spot"):
        assert maps[light].shape == (128, 128) and 0.0 <= maps[light].min() < maps[light].max() == 1.0


def test_volumes_picture_blends_over_the_frame():
    """n faces cover four fifths of 1 - 0.88^n. Under adjacent pictures of volumes the frame is repeated."""
    ground = np.full((1, 3, 3), 100, np.uint8)
    counts = np.array([[0, 1, 255]], np.uint8)
    picture = pass_picture("volumes", counts, ground)
    shares = 0.8 * (1.0 - 0.88 ** counts[..., None].astype(float))
    np.testing.assert_allclose(picture, 100 + shares * (np.array([255, 120, 30]) - 100.0), atol=0.5)
    assert picture.dtype == np.uint8 and picture[0, 0].tolist() == [100, 100, 100]
    np.testing.assert_array_equal(pass_picture("volumes", np.tile(counts, (1, 2)), ground), np.tile(picture, (1, 2, 1)))


# -- files


def test_volume_layers_in_npy_and_png(gl, scene, tmp_path):
    """Values are exact in .npy. In .png, edges are white on black, counts are scaled, and volumes lie over the frame."""
    frame = render_with_layers(scene, "stencil", "silhouettes", "volumes", algorithm={SUN: "shadow_volume"})
    for layer in ("stencil", "silhouettes", "volumes"):
        for format in PRODUCTS[layer].formats:
            write_pass_layer(scene, frame, layer, tmp_path / f"{layer}.{format}")
        np.testing.assert_array_equal(np.load(tmp_path / f"{layer}.npy"), frame.layers[layer][SUN])
    pictures = {layer: np.asarray(Image.open(tmp_path / f"{layer}.png")) for layer in ("stencil", "silhouettes", "volumes")}
    np.testing.assert_array_equal(pictures["silhouettes"], frame.layers["silhouettes"][SUN])
    stencil = frame.layers["stencil"][SUN]
    np.testing.assert_array_equal(pictures["stencil"], stencil * np.uint8(255 // stencil.max()))
    clear = frame.layers["volumes"][SUN] == 0
    np.testing.assert_array_equal((pictures["volumes"] == frame.color).all(axis=-1), clear)
    assert 0.05 < clear.mean() < 0.99


def test_volume_layers_of_two_algorithms_lie_side_by_side(gl, scene, tmp_path):
    choice = {SUN: {"relief": "shadow_volume", "meshes": "hybrid"}, "spot": "none", "omni": "none"}
    frame = render_with_layers(scene, "volumes", algorithm=choice)
    write_pass_layer(scene, frame, "volumes", tmp_path / "two.png")
    picture = np.asarray(Image.open(tmp_path / "two.png"))
    rows, cols = frame.valid.shape
    assert picture.shape == (rows, 2 * cols, 3)
    np.testing.assert_array_equal(picture[:, :cols], frame.color)  # level ground has no volume
    assert (picture[:, cols:] != frame.color).any()


def test_shadow_map_and_stencil_layers_in_npy_and_png(gl, scene, tmp_path):
    """Depths are 16-bit gray, nearest brightest; the stencil is scaled to eight bits. Both are exact in .npy."""
    frame = render_with_layers(scene, "shadow-map", "stencil", algorithm={"sun": "planar", "spot": "shadow_map"}, map_size=128)
    for layer, light in (("stencil", SUN), ("shadow-map", "spot")):
        for format in PRODUCTS[layer].formats:
            write_pass_layer(scene, frame.with_light_first(light), layer, tmp_path / f"{layer}.{format}")
    depths = np.load(tmp_path / "shadow-map.npy")
    gray = np.asarray(Image.open(tmp_path / "shadow-map.png"))
    assert gray.dtype == np.uint16 and gray.shape == depths.shape
    np.testing.assert_allclose(gray / 65535.0, 1.0 - depths, atol=0.6 / 65535)
    stencil = np.load(tmp_path / "stencil.npy")
    gray = np.asarray(Image.open(tmp_path / "stencil.png"))
    np.testing.assert_array_equal(gray, stencil * 127)
    assert set(np.unique(stencil)) == {0, 1, 2}
    assert pass_picture("shadow-map", np.array([[np.nan, 1.0, 0.0]], np.float32), frame.color).tolist() == [[0, 0, 65535]]
    assert pass_picture("stencil", np.zeros((1, 2), np.uint8), frame.color).tolist() == [[0, 0]]


def test_algorithm_layers_are_products():
    declared_layers = {layer for algorithm in ALGORITHMS.values() for layer in algorithm.layers}
    assert declared_layers == {name for name, product in PRODUCTS.items() if product.pass_layer == name}


# -- refusals


MAP_ALGORITHMS = "shadow_map, perspective_shadow_map, light_space_perspective_map, hybrid, reconstructed_volume"
STENCIL_ALGORITHMS = "shadow_volume, hybrid, reconstructed_volume"


@pytest.mark.parametrize(
    ("algorithm", "layer", "words"),
    [
        ("none", "shadow-map", f"none has no such layer; algorithms that have it: {MAP_ALGORITHMS}"),
        ("shadow_map", "stencil", f"shadow_map has no such layer; algorithms that have it: {STENCIL_ALGORITHMS}, planar"),
        ("planar", "shadow-map", "planar has no such layer; algorithms that have it: shadow_map"),
        ("planar", "silhouettes", "planar has no such layer; algorithms that have it: shadow_volume, hybrid"),
        ("shadow_map", "volumes", f"shadow_map has no such layer; algorithms that have it: {STENCIL_ALGORITHMS}"),
        (
            "shadow_volume",
            "shadow-map",
            f"shadow_volume has no such layer; algorithms that have it: {MAP_ALGORITHMS}",
        ),
    ],
)
def test_layer_without_an_algorithm_is_refused_before_drawing(scene, algorithm, layer, words, monkeypatch):
    monkeypatch.setattr("skugga.shadows.render.render_block", None)
    with pytest.raises(UnsupportedError) as caught:
        render_with_layers(scene, layer, algorithm=algorithm)
    assert layer in str(caught.value) and words in str(caught.value) and "\n" not in str(caught.value)


def test_layer_of_another_light_is_refused(gl, scene):
    frame = render_with_layers(scene, "stencil", algorithm={"sun": "none", "spot": "planar", "omni": "none"})
    assert product_of_frame(scene, frame.with_light_first("spot"), "stencil").max() == 2
    with pytest.raises(InputError, match="light: 'sun'.*spot for layer stencil"):
        product_of_frame(scene, frame, "stencil")


def test_shadow_map_layer_of_an_empty_view_is_refused(gl, scene, tmp_path):
    view = map_view(scene.world, scene.world.crs, (9000.0, 9000.0, 9050.0, 9050.0), rows=48, cols=48)
    frame = render_with_layers(scene, "shadow-map", view=view, algorithm={"sun": "shadow_map"})
    with pytest.raises(InputError, match="no light has a layer shadow-map"):
        write_pass_layer(scene, frame, "shadow-map", tmp_path / "map.png")
