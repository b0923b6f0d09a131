"""Sweep through the whole pipeline: maps and perspective views on a curved earth, compared with truth."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer

from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.bent_rays import MAX_STRAIGHT_RAYS_EXTENT_M
from skugga.shadows.passes import PassLog
from skugga.shadows.render import render_frame
from skugga.shadows.sweep import sweep
from skugga.shadows.sweep.rays import rays_at
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE, error_metrics, soft_error
from skugga.shadows.truth.truth import ray_scene, trace_truth
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters import reach
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.metrics import soft_truth
from tests.rasters import ENGINEERING
from tests.render import block_at, render, shadow

SUNS = [(22.0, 10.0), (67.0, 3.0), (113.0, 10.0), (158.0, 20.0), (202.0, 15.0), (247.0, 5.0), (293.0, 10.0), (338.0, 8.0)]
"""One sun in each octant, so that each orientation of the grid is used."""


@pytest.fixture(scope="module")
def jacksboro() -> Scene:
    """Scene of a bundled level of terrain only."""
    return build_scene(load_level("configs/jacksboro.yaml"))


@pytest.fixture(scope="module")
def tile() -> MapView:
    """Map of a tile over mountains."""
    return block_at(-84.25, 36.2933, 12).part(273, 300, 256, 256)


def with_sun_at(scene: Scene, azimuth: float, altitude: float) -> Scene:
    """Return a scene under a sun, angles in degrees."""
    return scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))


def sweep_view(scene: Scene, view, **settings) -> tuple[GeometryBuffer, Casters, np.ndarray]:
    """Return a view's buffer, its casters, and the sweep's visibility with attached shadow dark."""
    buffer = geometry_buffer(scene, view)
    casters = find_casters(scene, buffer)
    visibility = sweep.fill_visibility(
        receivers_of(buffer, scene, "sun"), scene, "sun", ("relief",), casters, SweepSettings(**settings), PassLog()
    )
    visibility[attached_shadow_mask(buffer, scene)] = 0.0
    return buffer, casters, visibility


@pytest.mark.parametrize("sun", SUNS)
def test_sweep_of_a_tile_on_a_curved_earth_matches_truth(jacksboro, tile, sun):
    """The tile has casters beyond the block, converging meridians and holes. At most 0.03 % of the decidable pixels are wrong."""
    scene = with_sun_at(jacksboro, *sun)
    buffer, casters, visibility = sweep_view(scene, tile)
    metrics = error_metrics(visibility, trace_truth(buffer, scene, casters), 30.0)
    assert metrics.wrong <= 3e-4 and metrics.interior <= 1e-4
    assert (visibility < 0.5).mean() > 0.02


@pytest.mark.parametrize("sun", SUNS[1::3])
def test_sweep_of_pixels_off_the_nodes_matches_truth(jacksboro, sun):
    scene = with_sun_at(jacksboro, *sun)
    view = scene.view(size=(301, 257))
    assert not view.is_on_nodes
    buffer, casters, visibility = sweep_view(scene, view)
    metrics = error_metrics(visibility, trace_truth(buffer, scene, casters), 100.0)
    assert metrics.wrong <= 3e-4 and metrics.interior <= 1e-4


def test_sweep_casts_far_ground_through_coarse_windows(write_raster, make_scene, monkeypatch):
    """The state of lines in a coarse window continues in the finer window before it."""
    monkeypatch.setattr(reach, "FULL_DETAIL_NODES", 600)
    row, col = np.mgrid[:1500, :500]
    heights = np.maximum(2000.0 - 8.0 * np.hypot((row - 150) * 4, col - 250), 30.0 * np.sin(row / 20.0) * np.sin(col / 23.0))
    scene = make_scene(write_raster(heights.astype(np.float32), ENGINEERING, 0.0, 30_000.0, 20.0), azimuth=3.0, altitude=5.0)
    view = scene.view(bounds=(2600.0, 5000.0, 6600.0, 9000.0), size=(200, 200))
    buffer = geometry_buffer(scene, view)
    casters = find_casters(scene, buffer)
    assert {patch.lod for patch in casters.patches} >= {0, 1}
    reference = trace_truth(buffer, scene, casters)
    visibility = sweep.fill_visibility(
        receivers_of(buffer, scene, "sun"), scene, "sun", ("relief",), casters, SweepSettings(), PassLog()
    )
    near_casters = Casters(tuple(patch for patch in casters.patches if patch.lod == 0), casters.reach)
    near_visibility = sweep.fill_visibility(
        receivers_of(buffer, scene, "sun"), scene, "sun", ("relief",), near_casters, SweepSettings(), PassLog()
    )
    assert (near_visibility - visibility).mean() > 0.05  # the far ground casts the shadow
    visibility[attached_shadow_mask(buffer, scene)] = 0.0
    assert error_metrics(visibility, reference, 20.0).wrong <= 1e-3 and visibility.mean() > 0.05


@pytest.mark.parametrize("sun", SUNS[::3])
def test_sweep_ignores_coarse_ground_behind_a_block(jacksboro, sun):
    """The map is far finer than the raster, so its casters are coarse close by, and some lie behind the block."""
    scene = with_sun_at(jacksboro, *sun)
    view = scene.view(bounds=(-84.2505, 36.2928, -84.2495, 36.2938), size=(128, 128), crs="EPSG:4326")
    buffer, casters, visibility = sweep_view(scene, view)
    assert max(patch.lod for patch in casters.patches) >= 1
    assert error_metrics(visibility, trace_truth(buffer, scene, casters), 0.8).wrong <= 3e-4


def test_sweep_far_from_the_anchor_keeps_summit_positions(write_raster, make_scene):
    """Ten degrees of longitude from the level's middle the anchor's light space leans, and would displace summits."""
    rng = np.random.default_rng(3)
    heights = np.kron(rng.uniform(0.0, 8000.0, (6, 60)), np.ones((4, 4))).astype(np.float32)
    heights = np.minimum(heights, np.roll(heights, 2, axis=1))
    scene = make_scene(write_raster(heights, "EPSG:4326", 70.0, 29.0, 20.0 / 240), azimuth=190.0, altitude=7.0)
    view = scene.view(bounds=(9.75e6, 3.19e6, 9.95e6, 3.31e6), size=(300, 180), crs="EPSG:3857")
    buffer, casters, visibility = sweep_view(scene, view)
    metrics = error_metrics(visibility, trace_truth(buffer, scene, casters), 700.0)
    assert 0.02 < visibility[buffer.valid].mean() < 0.98
    assert metrics.wrong <= 2e-3


@pytest.mark.parametrize("azimuth", [225.0, 270.0])
def test_sweep_of_converging_meridians_matches_truth(write_raster, make_scene, azimuth):
    """In the Arctic, twenty degrees of longitude turn the rays' direction on the map by as much from side to side."""
    row, col = np.mgrid[:300, :512]
    heights = (600.0 + 500.0 * np.sin(row / 9.0) * np.sin(col / 7.0)).astype(np.float32)
    scene = make_scene(write_raster(heights, "EPSG:4326", 20.0, 80.5, (20.0 / 512, 2.0 / 300)), azimuth=azimuth, altitude=4.0)
    view = scene.view(bounds=(2.3e6, 1.49e7, 4.4e6, 1.55e7), size=(700, 200), crs="EPSG:3857")
    buffer, casters, visibility = sweep_view(scene, view)
    reference = trace_truth(buffer, scene, casters)
    assert error_metrics(visibility, reference, 3000.0).wrong <= 2e-3


@pytest.mark.parametrize("latitude, width_km", [(0.0, 1000.0), (65.0, 1000.0), (78.0, 500.0), (84.0, 250.0)])
def test_sweep_lines_follow_rays_across_wide_maps(write_raster, make_scene, latitude, width_km):
    """The maps are wider than any that sweeps serve, at all azimuths.

    Plans fall back to shadow maps (``skugga.shadows.bent_rays``).
    """
    assert 1e3 * width_km > MAX_STRAIGHT_RAYS_EXTENT_M
    x, y = Transformer.from_crs(4326, 3857, always_xy=True).transform(10.0, latitude)
    stretch, heights = 1.0 / np.cos(np.radians(latitude)), np.zeros((8, 8), np.float32)
    heights[4, 4] = 100.0
    raster = write_raster(heights, "EPSG:3857", x - 200.0 * stretch, y + 200.0 * stretch, 50.0 * stretch)
    half = 500.0 * width_km * stretch
    for azimuth in (0.0, 10.0, 45.0, 80.0, 90.0, 200.0):
        scene = make_scene(raster, azimuth=azimuth, altitude=3.0)
        view = scene.view(bounds=(x - half, y - half, x + half, y + half), size=(1024, 1024), crs="EPSG:3857")
        rays_at(scene, view.grid, view.row0 + 512.0, view.col0 + 512.0).window_cubics(
            0, view.row0, view.col0, 1024, 1024
        )  # or raises


def test_sweep_blocks_join_without_a_seam(jacksboro):
    """The same nodes have the same classes as part of two windows.

    Lines run elsewhere in each window. The test leaves out nodes that the sun's rays pass by centimetres, which truth does not
    decide.
    """
    scene = with_sun_at(jacksboro, 247.0, 6.0)
    block = block_at(-84.25, 36.2933, 12)
    views = block.part(313, 200, 160, 160), block.part(313, 280, 160, 160)
    (buffer, casters, first_window), (_, _, second_window) = (sweep_view(scene, view) for view in views)
    decidable = trace_truth(buffer, scene, casters).decidable[:, 80:]
    assert decidable.mean() > 0.9
    assert not (first_window[:, 80:] != second_window[:, :80])[decidable].any()
    assert 0.02 < first_window.mean() < 0.98


@pytest.mark.parametrize("size, decimated", [(3000, False), (14000, True)])
def test_sweep_of_perspective_views_matches_truth(tmp_path, size, decimated):
    """The ground is whole or decimated, and the drawn ground is the ground that casts."""
    path = tmp_path / "ridges.yaml"
    path.write_text(f"""
version: 1
terrain: {{generate: {{kind: ridges, size: [{size}, {size}], cell: 20, relief: 700, seed: 3}}}}
sun: {{azimuth: 113, altitude: 9}}
views:
  main: {{kind: perspective, eye: [-1200, -1300, 250], target: [0, 0, 100], fov: 60, size: [320, 256]}}
""")
    scene = build_scene(load_level(path))
    buffer, casters, visibility = sweep_view(scene, scene.view("main"))
    assert buffer.ground is not None and (buffer.ground.tolerance_px > 0.0) == decimated
    metrics = error_metrics(visibility, trace_truth(buffer, scene, casters), 5.0)
    assert (visibility[buffer.valid] < 0.5).mean() > 0.02
    assert metrics.wrong <= (1.5e-3 if decimated else 3e-4) and metrics.interior <= MAX_INTERIOR_SHARE


def test_sweep_shades_trees_and_houses_by_hills():
    """Only ground casts. Objects on it are shaded up to the shadow's height."""
    scene = build_scene(load_level("configs/jacksboro_wooded.yaml"))
    scene = with_sun_at(scene, 120.0, 6.0)
    view = scene.view("valley", size=(320, 256))
    buffer, casters, visibility = sweep_view(scene, view)
    on_object = buffer.valid & (buffer.surface_kind != RELIEF)
    reference = trace_truth(buffer, scene, casters, kinds=("relief",))
    decidable_object = on_object & reference.decidable & ~reference.attached_shadow_mask
    assert decidable_object.sum() > 1000 and (~reference.lit & decidable_object).sum() > 50
    assert (((visibility < 0.5) == reference.lit) & decidable_object).sum() <= 2e-3 * decidable_object.sum()


@pytest.mark.long
def test_sweep_penumbra_matches_the_sun_disc(jacksboro, tile):
    for sun in ((113.0, 10.0), (202.0, 25.0)):
        scene = with_sun_at(jacksboro, *sun)
        buffer, casters, visibility = sweep_view(scene, tile, filter="sun")
        reference = soft_truth(buffer, scene, casters, 64)
        self_shadow = attached_shadow_mask(buffer, scene)
        reference[self_shadow], visibility[self_shadow] = 0.0, 0.0
        in_penumbra = buffer.valid & (reference > 0.05) & (reference < 0.95)
        assert in_penumbra.sum() > 200
        assert soft_error(visibility, reference) < 0.002
        assert np.abs(visibility - reference)[in_penumbra].mean() < 0.1


def test_edges_along_the_azimuth_have_penumbrae(write_raster, make_scene):
    """The side of a wall runs along the sun's azimuth, 100 m away. The penumbra of its side is as wide as the disc is there."""
    heights = np.zeros((200, 60), np.float32)
    heights[150:, 20:40] = 60.0
    scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 400.0, 2.0), azimuth=180.0, altitude=20.0)
    buffer, _, visibility = sweep_view(scene, scene.view(bounds=(77.0, 200.0, 83.0, 200.3), size=(200, 10)), filter="sun")
    row = visibility[5]
    assert buffer.valid.all() and row[0] == 0.0 and row[-1] == 1.0
    assert (np.diff(row) >= 0.0).all() and len(np.unique(row)) > 10
    disc_m = 2.0 * np.tan(np.radians(SUN_RADIUS_DEG)) * 100.0 / np.cos(np.radians(20.0))
    assert ((row > 0.0) & (row < 1.0)).sum() * 0.03 == pytest.approx(disc_m, rel=0.15)


def test_shadow_height_separates_sun_from_shadow(jacksboro, tile):
    scene = with_sun_at(jacksboro, 113.0, 8.0)
    plan = make_plan(describe(scene, tile), scene.loaded.level, {"algorithm": "sweep"})
    frame = render_frame(scene, tile, plan, layers=frozenset({"shadow-height"}))
    height_m = frame.layers["shadow-height"]["sun"]
    buffer = geometry_buffer(scene, tile)
    casters = find_casters(scene, buffer)
    deep_shadow = height_m - buffer.height_m > 5.0
    assert deep_shadow.mean() > 0.1
    assert np.allclose(height_m[frame.visibility == 1.0], buffer.height_m[frame.visibility == 1.0])
    rays = ray_scene(buffer, scene, casters, ("relief",))
    up = buffer.frame.frame_from_earth @ scene.world.earth_from_anchor[:, 2]
    to_sun = buffer.frame.frame_from_earth @ scene.sun.to_sun_earth
    for offset_m, is_lit in ((1.0, True), (-1.0, False)):
        start_points = buffer.position_frame_m[deep_shadow] + (height_m - buffer.height_m + offset_m)[deep_shadow][:, None] * up
        assert (~rays.is_blocked(start_points, to_sun) == is_lit).mean() > 0.98


def test_sweep_is_independent_of_the_number_of_cores(jacksboro, tile, monkeypatch):
    scene = with_sun_at(jacksboro, 67.0, 5.0)
    monkeypatch.setattr(sweep, "CORES", 1)
    single_core_visibility = sweep_view(scene, tile)[2]
    monkeypatch.setattr(sweep, "CORES", 3)
    assert (sweep_view(scene, tile)[2] == single_core_visibility).all()


def test_sweep_frame_needs_no_opengl(jacksboro, monkeypatch):
    from skugga.terrain.gl import device as gl

    def forbid_device() -> None:
        raise AssertionError("OpenGL was called")

    monkeypatch.setattr(gl, "device", forbid_device)
    scene = with_sun_at(jacksboro, 237.0, 12.0)
    frame = render(scene, scene.view(size=(200, 160)), algorithm="sweep")
    assert 0.02 < shadow(frame).mean() < 0.98
    assert [record.name for record in frame.passes] == frame.plan.passes
    assert [name for name in frame.plan.passes if "/" in name] == ["sun/relief: sweep"]


def test_sweep_ignores_the_sky_of_a_perspective_view(tmp_path):
    path = tmp_path / "floor.yaml"
    path.write_text("""
version: 1
terrain: {flat: {size: [200, 200], cells: [20, 20]}}
sun: {azimuth: 200, altitude: 20}
views:
  up: {kind: perspective, eye: [0, 0, 5], target: [0, 30, 60], fov: 30, size: [64, 48]}
  down: {kind: perspective, eye: [0, 0, 50], target: [0, 20, 0], fov: 50, size: [64, 48]}
""")
    scene = build_scene(load_level(path))
    for name in ("up", "down"):
        _, _, visibility = sweep_view(scene, scene.view(name))
        assert (visibility[geometry_buffer(scene, scene.view(name)).valid] == 1.0).all()
