"""Block casters: a block skips casters that provably do not matter, its picture stays the same to the bit, and records say so."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from morecantile import tms as matrix_sets

from skugga.configs import LEVELS_FOLDER
from skugga.shadows.block_casters import NO_CASTERS_NOTE, NO_OUTSIDE_CASTERS_NOTE
from skugga.shadows.executed_effects import executed_effects
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.geo.grid import MapView, tile_grid
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.params import mark_long_except
from tests.products import draw_map
from tests.render import plan_of

WINDOW_COUNTS = {"jacksboro": 6, "jacksboro_alpine": 4, "jacksboro_wooded": 2, "spatialace": 4}
"""Number of windows on each bundled level. Those of the forest take longest."""

MOUNTAIN_RASTERS = ("mountain/bigtujunga_30m_utm11.tif", "mountain/grenoble_copernicus_4326.tif", "mountain/sierra_30m_albers.tif")

OVERRIDES = (
    {},
    {"algorithm": {"relief": "sweep"}, "filter": "sun"},
    {},
    {"algorithm": {"relief": "sweep"}},
    {"algorithm": "shadow_map"},
)

SUN_ALTITUDES_DEG = (4.0, 50.0, 12.0, 65.0, 25.0, 38.0)

ZOOMS = (14, 16, 13, 15, 12, 15, 13)
"""Zooms of the windows on tile pixels. Depth maps are drawn at the coarsest, where they have few triangles."""


@contextmanager
def omissions_disabled(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Disable all omissions, so that each block draws everything that its plan lists."""
    with monkeypatch.context() as patch:
        patch.setattr("skugga.shadows.block_casters.culled_patches", lambda *arguments: frozenset())
        patch.setattr("skugga.shadows.block_casters.block_ground_casts_no_shadow", lambda *arguments: False)
        clear_caches("light")
        yield


def random_windows(scene: Scene, random: np.random.Generator, count: int) -> Iterator[tuple[Scene, MapView]]:
    """Yield random windows on a level, on and off tile pixels, under suns of all altitudes."""
    for number in range(count):
        sun = SunSpec(azimuth=float(random.uniform(0.0, 360.0)), altitude=SUN_ALTITUDES_DEG[number % len(SUN_ALTITUDES_DEG)])
        if scene.world.is_flat:
            whole = scene.view()
            west, south, east, north = whole.bounds
            side = 0.3 * min(east - west, north - south)
            x, y = random.uniform(west, east - side), random.uniform(south, north - side)
            yield scene.with_sun(sun), scene.view(bounds=(x, y, x + side, y + side), size=(60, 60))
            continue
        grid = tile_grid(matrix_sets.get("WebMercatorQuad"), ZOOMS[number % len(ZOOMS)])
        (top, bottom), (left, right) = extent_on_grid(scene.world, scene.elevation, grid)
        row, col = random.integers(top - 20, max(bottom - 40, top)), random.integers(left - 20, max(right - 40, left))
        whole = bool(random.random() < 0.7)
        yield scene.with_sun(sun), MapView(grid, row + (0.0 if whole else 0.3), float(col), 1.0, 1.0, 70, 60)


def assert_frames_equal(frame: Frame, other_frame: Frame) -> None:
    """Assert that all layers of two frames are equal to the bit."""
    assert np.array_equal(frame.color, other_frame.color) and np.array_equal(frame.height_m, other_frame.height_m, equal_nan=True)
    for light, visibility in frame.visibilities.items():
        assert np.array_equal(visibility, other_frame.visibilities[light], equal_nan=True)
        assert np.array_equal(frame.shown_visibilities[light], other_frame.shown_visibilities[light], equal_nan=True)
    assert frame.reach == other_frame.reach


def count_omissions(scene: Scene, monkeypatch: pytest.MonkeyPatch, count: int, seed: int) -> dict[str, int]:
    """Compare windows with and without omissions, and return their number and the number of each omission."""
    random, omission_counts = np.random.default_rng(seed), {"windows": 0, "outside_casters": 0, "shadows": 0}
    for number, (lit, view) in enumerate(random_windows(scene, random, count)):
        plan = plan_of(lit, view, **OVERRIDES[number % len(OVERRIDES)])
        frame, picture = render_frame(lit, view, plan), draw_map(lit, view, plan)
        with omissions_disabled(monkeypatch):
            full_frame, full_picture = render_frame(lit, view, plan), draw_map(lit, view, plan)
        assert_frames_equal(frame, full_frame)
        assert np.array_equal(picture.color, full_picture.color) and np.array_equal(picture.opacity, full_picture.opacity)
        assert [record.name for record in frame.passes] == plan.passes == [record.name for record in full_frame.passes]
        assert full_frame.effects - frame.effects <= {"outside_casters", "cast_shadows", "soft_edges"}
        omission_counts["windows"] += 1
        omission_counts["outside_casters"] += "outside_casters" in full_frame.effects - frame.effects
        omission_counts["shadows"] += "cast_shadows" in full_frame.effects - frame.effects
    return omission_counts


@pytest.mark.parametrize("name", mark_long_except(WINDOW_COUNTS, "jacksboro"))
def test_block_casters_keep_pictures_of_bundled_levels(gl, monkeypatch, name):
    scene = build_scene(load_level(LEVELS_FOLDER / f"{name}.yaml"))
    omission_counts = count_omissions(scene, monkeypatch, WINDOW_COUNTS[name], 5)
    print(name, omission_counts)
    assert name != "jacksboro" or (
        omission_counts["outside_casters"] > 1 and 0 < omission_counts["shadows"] < omission_counts["windows"]
    )


@pytest.mark.long
@pytest.mark.parametrize("source", MOUNTAIN_RASTERS)
def test_block_casters_keep_pictures_of_real_mountains(gl, monkeypatch, shared_data, make_scene, source):
    omission_counts = count_omissions(make_scene(shared_data / source), monkeypatch, 4, 6)
    print(source, omission_counts)


def test_block_casters_record_what_a_block_omits(gl, monkeypatch):
    """Under a high sun over gentle ground no shadow pass runs, though the level's plan lists it."""
    scene = build_scene(load_level(LEVELS_FOLDER / "jacksboro.yaml")).with_sun(SunSpec(azimuth=200.0, altitude=50.0))
    random = np.random.default_rng(3)
    _, view = next((lit, view) for lit, view in random_windows(scene, random, 50) if view.is_on_nodes)
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), 14)
    (top, bottom), (left, right) = extent_on_grid(scene.world, scene.elevation, grid)
    view = MapView(grid, float((top + bottom) // 2), float((left + right) // 2), 1.0, 1.0, 200, 200)
    plan = plan_of(scene, view)
    frame = render_frame(scene, view, plan)
    records = {record.name: record for record in frame.passes}
    assert list(records) == plan.passes and "cast_shadows" in plan.effect_names
    assert records["outside_casters"].note == NO_OUTSIDE_CASTERS_NOTE and records["outside_casters"].is_left_out
    assert records["sun/relief: sweep"].note == NO_CASTERS_NOTE and records["sun/relief: sweep"].is_left_out
    assert frame.effects == plan.effect_names - {"cast_shadows", "outside_casters"}
    assert executed_effects(draw_map(scene, view, plan).passes) == frame.effects
    with omissions_disabled(monkeypatch):
        assert render_frame(scene, view, plan).effects == plan.effect_names
