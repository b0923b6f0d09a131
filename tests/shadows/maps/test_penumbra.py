"""Penumbra of the sun's disc in shadow maps: close to rays, and as wide as theory."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, minimum_filter

from skugga.shadows.area_light import sun_disc_directions
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.sun_disc import (
    DISC_EDGE_STEPS,
    DISC_SAMPLES,
    DISC_TANGENT,
    MAX_HALF_DISC_TEXELS,
    disc_samples_before_edges,
)
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.metrics import soft_truth
from tests.params import mark_long_except
from tests.rasters import ENGINEERING
from tests.render import block_at, plan_of, render
from tests.shadows.boxes import View, box, build_mesh_scene, visibility
from tests.shadows.maps.test_bias import EYE, shaded_share, write_plane

ALTITUDE = 50.0


def disc_visibility(scene: Scene, view: View) -> np.ndarray:
    """Return the visibility of the sun's disc by rays, attached shadow included."""
    buffer = geometry_buffer(scene, view)
    expected = soft_truth(buffer, scene, find_casters(scene, buffer))
    return np.where(attached_shadow_mask(buffer, scene) & buffer.valid, 0.0, expected)


def mean_difference(rendered: np.ndarray, expected: np.ndarray) -> float:
    """Return the mean absolute difference of visibilities, without NaN."""
    return float(np.nanmean(np.abs(rendered - expected)))


# -- theory


def edge_profile(folder, height_m: float, width_m: float, **overrides) -> tuple[np.ndarray, np.ndarray]:
    """Return the visibility of ground along a line of ``width_m`` across the straight edge of a high plate's shadow, and theory.

    The sun stands in the south, and the edge runs north. The part of a disc of radius 1 beyond a chord at u is (acos u - u sqrt(1 -
    u^2)) / pi.
    """
    scene = build_mesh_scene(folder, [box((30, 10, 0.05), height_m, (-15, -40))], 180, ALTITUDE)
    north = -40 + height_m / np.tan(np.radians(ALTITUDE))
    half = width_m / 2
    view = scene.view(bounds=(-half, north - half / 16, half, north + half / 16), size=(320, 20))
    rendered, buffer = visibility(scene, view, filter="sun", **overrides)
    distance_m = height_m / np.sin(np.radians(ALTITUDE))
    u = np.clip(-buffer.position_frame_m[10, :, 0] / (distance_m * DISC_TANGENT), -1.0, 1.0)
    return rendered, (np.arccos(u) - u * np.sqrt(1.0 - u**2)) / np.pi


@pytest.mark.parametrize(
    ("height_m", "radii_texels"),
    mark_long_except(product([8.0, 30.0, 70.0], [2.5, 20.0, 50.0]), (8.0, 50.0), (30.0, 20.0), (70.0, 2.5)),
)
def test_penumbra_of_a_straight_edge_matches_the_disc(gl, tmp_path, height_m, radii_texels):
    """This holds for all distances and texels. The caster lies outside the view, far towards the sun."""
    width_m = 4.0 * height_m / np.sin(np.radians(ALTITUDE)) * DISC_TANGENT
    rendered, theory = edge_profile(tmp_path, height_m, width_m, map_size=int(4 * radii_texels + 64))
    assert theory[0] == 0.0 and theory[-1] == 1.0
    assert np.abs(rendered - theory).max() < 0.02 + 0.3 / radii_texels
    assert mean_difference(rendered, theory) < 0.005 + 0.03 / radii_texels
    steps = np.diff(rendered, axis=1)
    assert steps.min() > -0.02 and steps.max() < 0.05  # neither bands nor noise
    assert np.ptp(rendered, axis=0).max() < 0.01 + 0.2 / radii_texels


@pytest.mark.long
def test_penumbra_widens_with_distance(gl, tmp_path):
    widths = []
    for height_m in (10.0, 20.0, 40.0):
        rendered, _ = edge_profile(tmp_path, height_m, 1.0, map_size=256)
        widths.append(((rendered[10] > 0.1) & (rendered[10] < 0.9)).sum())
    np.testing.assert_allclose(np.array(widths) / widths[0], [1.0, 2.0, 4.0], rtol=0.15)


def test_penumbra_too_wide_for_the_map_is_narrowed(gl, tmp_path):
    """Beyond ``MAX_HALF_DISC_TEXELS`` the edge keeps its position, and points that are wholly lit or dark stay so."""
    rendered, theory = edge_profile(tmp_path, 70.0, 2.0, map_size=2048)
    assert np.abs(rendered - theory)[:, (theory == 0.0) | (theory == 1.0)].max() == 0.0
    middle_columns = rendered[10, theory.size // 2 - 2 : theory.size // 2 + 2]
    assert 2.0 / 2048 * MAX_HALF_DISC_TEXELS < 0.4 and abs(middle_columns.mean() - 0.5) < 0.1


def test_penumbra_narrower_than_texels_is_three_taps_wide(gl, tmp_path):
    scene = build_mesh_scene(tmp_path, [box((30, 10, 0.05), 3.0, (-15, -40))], 180, ALTITUDE)
    view = scene.view(bounds=(-4, -34, 4, -33.5), size=(320, 20))
    widths = []
    for filter in (3, "sun"):
        rendered, _ = visibility(scene, view, filter=filter, map_size=80)
        widths.append(((rendered > 0.02) & (rendered < 0.98)).sum(axis=1).mean())
    assert widths[0] > 10 and abs(widths[1] - widths[0]) <= 0.15 * widths[0]


@pytest.mark.parametrize("bias", ["receiver_plane", "normal_offset"])
@pytest.mark.parametrize(("slope", "towards"), [(0, 0), (45, 203), (75, 290)])
def test_penumbra_filter_causes_no_self_shadowing(gl, write_raster, make_scene, slope, towards, bias):
    raster = write_plane(write_raster, slope, towards)
    for altitude, azimuth_offset in ((60.0, 20.0), (25.0, -60.0), (3.0, 80.0)):
        assert shaded_share(make_scene, raster, towards + azimuth_offset, altitude, filter="sun", bias=bias) == 0.0, (
            altitude,
            azimuth_offset,
        )


def test_plane_under_part_of_the_sun_is_partly_lit(gl, write_raster, make_scene):
    """The sun's centre is 0.06 degrees above the plane: the chord at 0.2 of the radius leaves 0.62 of the disc."""
    altitude = np.degrees(np.arcsin(np.sin(np.radians(0.053)) / np.cos(np.radians(30.0))))
    scene = make_scene(write_plane(write_raster, 30.0, 90.0), 0.0, altitude)
    view = scene.view(bounds=(-300, -300, 300, 300), size=(64, 64))
    rendered, _ = visibility(scene, view, filter="sun", map_size=256)
    np.testing.assert_allclose(rendered, disc_visibility(scene, view), atol=0.03)
    assert abs(np.mean(rendered) - 0.626) < 0.03


def test_disc_samples_are_the_rays_of_truth():
    """Both use the same spiral, and the bits before an edge are those of the samples before it."""
    rays = sun_disc_directions(np.array([0.0, -1.0, 0.0]), DISC_SAMPLES)
    disc_radius = np.hypot(rays[:, 0], rays[:, 2]) / -rays[:, 1] / DISC_TANGENT
    angle = np.arange(DISC_SAMPLES) * np.pi * (3.0 - 5.0**0.5)
    for bits, coordinate in zip(
        disc_samples_before_edges(), (disc_radius * np.cos(angle), disc_radius * np.sin(angle)), strict=True
    ):
        assert bits.shape == (DISC_EDGE_STEPS + 1, 4) and bits.dtype == np.uint32
        for number in (0, 13, 64, 100, DISC_EDGE_STEPS):
            set_bits = [bool(bits[number, k // 32] >> np.uint32(k % 32) & np.uint32(1)) for k in range(DISC_SAMPLES)]
            np.testing.assert_array_equal(set_bits, coordinate < 2.0 * number / DISC_EDGE_STEPS - 1.0)


# -- scenes


@pytest.mark.parametrize(
    ("level", "view"),
    [("thesis_street_sun", "main"), ("thesis_water_tower_sun", "close"), ("thesis_boxgrid_sun", "close")],
)
def test_penumbra_of_bundled_scenes_is_near_rays(gl, level, view):
    """The mean difference is within 0.02, and smaller than that of nine taps, which ignore the distance."""
    scene = build_scene(load_level(f"configs/{level}.yaml"))
    scene_view = scene.view(view, size=(192, 154))
    expected = disc_visibility(scene, scene_view)
    differences = {
        filter: mean_difference(visibility(scene, scene_view, filter=filter, map_size=2048)[0], expected) for filter in (3, "sun")
    }
    assert differences["sun"] < 0.015 and differences["sun"] < 0.9 * differences[3]


@pytest.mark.parametrize("altitude", [30.0, pytest.param(10.0, marks=pytest.mark.long)])
def test_penumbra_of_terrain_is_near_rays(gl, altitude):
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=237, altitude=altitude))
    view = block_at(-84.25, 36.2933, 13).part(0, 0, 192, 192)
    expected = disc_visibility(scene, view)
    rendered, _ = visibility(scene, view, filter="sun", map_size=2048)
    assert mean_difference(rendered, expected) < 0.01
    inside = minimum_filter(np.nan_to_num(1.0 - expected), 7) == 1.0  # the umbra, away from its edge
    assert inside.any() == (altitude == 10.0) and (not inside.any() or (rendered[inside] > 0.05).mean() < 5e-3)


def test_penumbra_of_rolling_ground_is_near_rays(gl, write_raster, make_scene):
    y, x = np.mgrid[0:121, 0:121] * 5.0
    heights = 30 * np.sin(x / 60) + 25 * np.cos(y / 45 + 1) + 10 * np.sin((x + y) / 20)
    scene = make_scene(write_raster(heights.astype(np.float32), ENGINEERING, 0, 605, 5.0), 140.0, 14.0)
    view = scene.view(bounds=(150, 150, 450, 450), size=(240, 240))
    expected = disc_visibility(scene, view)
    assert 0.1 < np.mean(expected < 0.5) < 0.9 and np.mean((expected > 0.02) & (expected < 0.98)) > 0.005
    differences = {
        filter: mean_difference(visibility(scene, view, filter=filter, map_size=2048)[0], expected) for filter in (3, "sun")
    }
    assert differences["sun"] < 0.01 and differences["sun"] <= differences[3]


def test_penumbra_leaks_no_light_at_ground_contacts(gl, tmp_path):
    """The umbra reaches the walls, and there is no shadow outside the penumbra."""
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5)), box((3, 3, 3), 0, (-6, -5))], 110, 28, views={"eye": EYE})
    view = scene.view("eye")
    expected = disc_visibility(scene, view)
    rendered, buffer = visibility(scene, view, filter="sun", map_size=2048)
    contact_pixels = binary_dilation(buffer.surface_kind == MESHES) & (buffer.surface_kind != MESHES)
    umbra, lit = (buffer.valid & ~binary_dilation((expected != value) | contact_pixels, iterations=2) for value in (0.0, 1.0))
    assert umbra.mean() > 0.03 and lit.mean() > 0.3
    assert rendered[umbra].max() < 0.1 and (rendered[umbra] > 0.01).mean() < 1e-3
    assert rendered[lit].min() > 0.9


def test_penumbra_is_the_same_in_adjacent_blocks(gl):
    """The maps of the two blocks start at different places, but texels are grouped into the same cells."""
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=237, altitude=10))
    block = block_at(-84.25, 36.2933, 13)
    strip = 64
    left_strip = visibility(scene, block.part(0, 0, 256, 256), filter="sun", map_size=8192)[0][:, -strip:]
    right_strip = visibility(scene, block.part(0, 256 - strip, 256, 256), filter="sun", map_size=8192)[0][:, :strip]
    assert ((left_strip > 0.05) & (left_strip < 0.95)).mean() > 1e-3
    assert ((left_strip < 0.5) != (right_strip < 0.5)).mean() <= 1e-4 and np.nanmean(np.abs(left_strip - right_strip)) < 1e-4


# -- plans


def test_sun_filter_uses_24_bits_and_changes_pictures(gl, tmp_path):
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5), 12)], 110, 28, views={"eye": EYE})
    view = scene.view("eye")
    plan = plan_of(scene, view, filter="sun")
    assert {settings.filter for settings in plan.settings["sun"].values()} == {"sun"}
    assert {settings.depth_bits for settings in plan.settings["sun"].values()} == {24}
    pictures = [render(scene, view, filter=filter, map_size=2048).color for filter in (3, "sun", "sun")]
    assert (pictures[0] != pictures[1]).any(axis=-1).mean() > 1e-3
    np.testing.assert_array_equal(pictures[1], pictures[2])


def test_sun_filter_is_refused_for_lamps_without_radius(tmp_path):
    lamp = {"kind": "omni", "position": [0, -8, 12]}
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5))], 110, 28, views={"eye": EYE}, lights={"lamp": lamp})
    settings = plan_of(scene, scene.view("eye"), filter="sun").settings
    assert (settings["sun"]["meshes"].filter, settings["lamp"]["meshes"].filter) == ("sun", 3)
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5))], 110, 28, views={"eye": EYE}, lights={"lamp": lamp}, sun="none")
    with pytest.raises(UnsupportedError, match="filter: 'sun' is not supported here: the lamp 'lamp' has no radius"):
        plan_of(scene, scene.view("eye"), filter="sun")
