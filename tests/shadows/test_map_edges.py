"""Map edges: anti-aliased in displayed pictures, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion

from skugga.api.compute import product_of_frame
from skugga.shadows import map_edges
from skugga.shadows.map_edges import edge_pixels
from skugga.shadows.maps import lookup
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING
from tests.render import plan_of, render

SIDE_M = 96

SMALL_SIDE_PX = 48
"""Side of the pictures that are compared to the bit."""


@pytest.fixture
def ridge(write_raster, make_scene) -> Scene:
    """Return a straight ridge across a plain. The edge of its shadow is straight and oblique to the pixels."""
    x, y = np.meshgrid(np.arange(SIDE_M) + 0.5, SIDE_M - 0.5 - np.arange(SIDE_M))
    heights = np.clip(12.0 - np.abs((x - 60.0) * np.cos(0.4) + (y - 48.0) * np.sin(0.4)), 0.0, None)
    return make_scene(write_raster(heights.astype(np.float32), ENGINEERING, 0.0, float(SIDE_M), 1.0), 90.0, 20.0)


@pytest.fixture
def tower(write_raster, make_scene, tmp_path) -> Scene:
    """Return a white tower, turned, on a plain."""
    trimesh.creation.box(extents=(17.0, 17.0, 20.0)).export(tmp_path / "tower.obj")
    meshes = [{"source": "tower.obj", "at": [10, 0], "turn": 17, "color": [0.95, 0.95, 0.95]}]
    floor = write_raster(np.zeros((SIDE_M, SIDE_M), np.float32), ENGINEERING, 0.0, float(SIDE_M), 1.0)
    return make_scene(floor, 100.0, 40.0, meshes=meshes)


def view_of(scene: Scene, pixels: int = SIDE_M) -> MapView:
    """Return a map of the whole ground with ``pixels`` pixels a side."""
    return scene.view(bounds=(0.0, 0.0, float(SIDE_M), float(SIDE_M)), size=(pixels, pixels))


def render_at_points(scene: Scene, view: MapView, **overrides) -> Frame:
    """Render a map with one sample point per pixel."""
    return render_frame(scene, view, plan_of(scene, view, **overrides), pixel_sampling="points")


@pytest.fixture(scope="module")
def lit_share_cache() -> dict[int, np.ndarray]:
    """Return a cache of the lit share of each pixel of the ridge's view, by 16 x 16 points, for each number of pixels a side."""
    return {}


def block_means(values: np.ndarray, side: int) -> np.ndarray:
    """Return the means over squares of ``side`` x ``side`` values."""
    return values.reshape(values.shape[0] // side, side, values.shape[1] // side, side).mean(axis=(1, 3))


@pytest.mark.parametrize(("pixels", "algorithm"), [
    (96, "sweep"), (70, "sweep"), (70, "shadow_map"), (70, "shadow_volume"), (70, "hybrid"), (70, "truth"),
])  # fmt: skip
def test_shown_visibility_is_the_lit_share_of_a_pixel(gl, ridge, lit_share_cache, pixels, algorithm):
    """Against 16 x 16 points a pixel, the result is much closer than one point a pixel, and unbiased."""
    view = view_of(ridge, pixels)
    frame = render(ridge, view, algorithm=algorithm)
    if pixels not in lit_share_cache:
        lit_share_cache[pixels] = block_means(render_at_points(ridge, view.finer(16), algorithm="sweep").visibility, 16)
    exact = lit_share_cache[pixels]
    inside = binary_erosion(frame.height_m < 0.01, iterations=2)  # only the plain: the ridge has rounding of its surface
    partly_lit = inside & (exact > 0.02) & (exact < 0.98)
    assert partly_lit.sum() > 80
    shown_visibility, point_visibility = frame.shown_visibilities["sun"], frame.visibility
    error, point_error = (np.sqrt(((values - exact)[partly_lit] ** 2).mean()) for values in (shown_visibility, point_visibility))
    assert error < 0.6 * point_error and error < 0.2 and abs((shown_visibility - exact)[partly_lit].mean()) < 0.05
    uniform_px = inside & ~binary_dilation((exact > 0.0) & (exact < 1.0), iterations=2)
    assert uniform_px.sum() > 1000
    np.testing.assert_array_equal(shown_visibility[uniform_px], point_visibility[uniform_px])


@pytest.mark.parametrize("algorithm", ["sweep", "shadow_map"])
def test_mask_and_value_layers_are_not_antialiased(gl, ridge, algorithm):
    view = view_of(ridge)
    antialiased, point_frame = render(ridge, view, algorithm=algorithm), render_at_points(ridge, view, algorithm=algorithm)
    for layer in ("mask", "visibility", "depth"):
        np.testing.assert_array_equal(product_of_frame(ridge, antialiased, layer), product_of_frame(ridge, point_frame, layer))
    np.testing.assert_array_equal(np.unique(antialiased.visibility), [0.0, 1.0])
    partly_shaded = (antialiased.opacity > 0) & (antialiased.opacity < 255)
    assert 40 < partly_shaded.sum() < 0.2 * partly_shaded.size and set(np.unique(point_frame.opacity)) == {0, 255}
    np.testing.assert_array_equal(product_of_frame(ridge, antialiased, "shadow")[..., 3], antialiased.opacity)
    changed = (antialiased.color != point_frame.color).any(axis=-1)
    on_plain = partly_shaded & (antialiased.height_m < 0.01)
    assert on_plain.sum() > 40 and changed[on_plain].mean() > 0.95
    sampled = partly_shaded if algorithm == "sweep" else edge_pixels(geometry_buffer(ridge, view), [point_frame.visibility])
    assert not (changed & ~sampled).any()


def test_outline_of_a_mesh_is_antialiased(gl, tower):
    """The roof stays white inside. On its rim the colour is a mean over the pixel, ground included."""
    view = view_of(tower)
    antialiased, point_frame = render(tower, view, algorithm="shadow_map"), render_at_points(tower, view, algorithm="shadow_map")
    fine_mesh_mask = geometry_buffer(tower, view.finer(16)).surface_kind == MESHES
    share = block_means(fine_mesh_mask.astype(float), 16)
    rim, roof = (share > 0.2) & (share < 0.8), share == 1.0
    assert rim.sum() > 30 and roof.sum() > 150
    low, high = 100, int(point_frame.color[roof].min())
    red = antialiased.color[..., 0].astype(int)
    assert high > 180 and ((red[rim] > low) & (red[rim] < high)).mean() > 0.8
    inside = ~binary_dilation(~roof, iterations=2)
    np.testing.assert_array_equal(antialiased.color[inside], point_frame.color[inside])


def test_edge_pixels_lie_where_class_or_object_changes(ridge):
    """Expected are pixels beside one of another class or object, also diagonally, and pixels along the sides of a block."""
    buffer = geometry_buffer(ridge, view_of(ridge, 12))
    lit = np.ones((12, 12), np.float32)
    lit[5, 5] = 0.0
    block_border = np.ones((12, 12), bool)
    block_border[1:-1, 1:-1] = False
    expected_edges = block_border.copy()
    expected_edges[4:7, 4:7] = True
    np.testing.assert_array_equal(edge_pixels(buffer, [lit]), expected_edges)
    np.testing.assert_array_equal(edge_pixels(buffer, [np.ones_like(lit), lit]), expected_edges)
    np.testing.assert_array_equal(edge_pixels(buffer, [np.where(lit == 0.0, np.float32(0.6), lit)]), block_border)  # a penumbra
    kind = buffer.surface_kind.copy()
    kind[5, 5] = MESHES
    np.testing.assert_array_equal(edge_pixels(replace(buffer, surface_kind=kind), [np.ones_like(lit)]), expected_edges)
    assert not edge_pixels(buffer, []).any()
    valid = buffer.valid.copy()
    valid[0] = False
    assert not edge_pixels(replace(buffer, valid=valid), [lit])[0].any()


def test_antialiasing_is_independent_of_block_parts(gl, ridge, monkeypatch):
    """The colour of a pixel does not depend on the part of a block that its samples are drawn with."""
    single_part_frame = render(ridge, view_of(ridge, SMALL_SIDE_PX), algorithm="shadow_volume")
    monkeypatch.setattr(map_edges, "SAMPLED_PART_PX", 17)
    split_frame = render(ridge, view_of(ridge, SMALL_SIDE_PX), algorithm="shadow_volume")
    assert (
        np.abs(single_part_frame.color.astype(int) - split_frame.color).max() <= 1
        and (single_part_frame.opacity == split_frame.opacity).mean() > 0.999
    )


def test_antialiasing_leaves_a_plain_unchanged(gl, write_raster, make_scene):
    """On a sunlit plain, colours, shadows and drawn triangles are those of the pixels' own points, except along the sides."""
    floor = write_raster(np.zeros((SIDE_M, SIDE_M), np.float32), ENGINEERING, 0.0, float(SIDE_M), 1.0)
    scene = make_scene(floor, 100.0, 40.0)
    frame = render(scene, view_of(scene), algorithm="shadow_map")
    assert (frame.opacity == 0).all() and np.ptp(frame.color.reshape(-1, 3).astype(int), axis=0).max() <= 1


def test_shown_visibility_is_kept_per_light(gl, tower):
    """A frame under one light equals the part of that light in the whole frame."""
    frame = render(tower, view_of(tower), algorithm="shadow_map")
    sun_frame = frame.with_light_first("sun")
    assert list(sun_frame.shown_visibilities) == list(sun_frame.visibilities) == ["sun"]
    np.testing.assert_array_equal(sun_frame.opacity, frame.opacity)


def turn_loops_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let shaders look up the points of maps, as they do for lamps and for the sun's disc."""
    monkeypatch.setattr(lookup, "_has_loop", lambda depth_map, settings: False)


@pytest.mark.parametrize(("place", "light"), [("ridge", (250, 12)), ("tower", (110, 40))])
def test_lookup_of_gathered_points_equals_all_points(gl, place, light, request, monkeypatch):
    scene = request.getfixturevalue(place).with_sun(SunSpec(azimuth=light[0], altitude=light[1]))
    gathered_counts: list[int] = []
    in_rows = lookup._reshape_to_rows
    turn_loops_off(monkeypatch)
    monkeypatch.setattr(lookup, "_reshape_to_rows", lambda values: (gathered_counts.append(len(values)), in_rows(values))[1])
    gathered_frame = render(scene, view_of(scene), algorithm="shadow_map")
    assert gathered_counts and 0 < max(gathered_counts) < SIDE_M * SIDE_M
    gathered_counts.clear()
    monkeypatch.setattr(lookup, "MAX_GATHERED_SHARE", 0.0)
    full_frame = render(scene, view_of(scene), algorithm="shadow_map")
    assert not gathered_counts
    np.testing.assert_array_equal(gathered_frame.color, full_frame.color)
    np.testing.assert_array_equal(gathered_frame.opacity, full_frame.opacity)


@pytest.mark.parametrize(("place", "filter"), [("ridge", 1), ("tower", 3), ("ridge", 5)])
def test_lookup_shortcut_for_empty_maps_keeps_the_picture(gl, place, filter, request, monkeypatch):
    scene = request.getfixturevalue(place)
    turn_loops_off(monkeypatch)
    shortcut_frame = render(scene, view_of(scene, SMALL_SIDE_PX), algorithm="shadow_map", filter=filter)
    original = type(gl).program

    def program_without_shortcut(device, vertex, fragment, constants=None):
        assert constants is None or constants.get("lit_by_taps", True)
        return original(device, vertex, fragment, None if constants is None else {**constants, "lit_by_taps": False})

    monkeypatch.setattr(type(gl), "program", program_without_shortcut)
    thorough_frame = render(scene, view_of(scene, SMALL_SIDE_PX), algorithm="shadow_map", filter=filter)
    assert 0.0 < np.nanmean(thorough_frame.visibility) < 1.0
    np.testing.assert_array_equal(shortcut_frame.visibility, thorough_frame.visibility)
    np.testing.assert_array_equal(shortcut_frame.color, thorough_frame.color)
