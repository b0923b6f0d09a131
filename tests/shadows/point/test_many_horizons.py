"""Horizons of many points at once equal those of each point alone: over ground of every kind, beside a house, in any order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from skugga.shadows.point import horizon_walk, relief_pages, sight_lines
from skugga.shadows.point.horizon import horizon_angles, horizon_profile, load_surroundings
from skugga.shadows.point.place import place_at, places_at
from skugga.terrain.errors import InputError
from tests.rasters import ENGINEERING
from tests.shadows.point.test_objects import village  # noqa: F401

AZIMUTHS_DEG = np.arange(48) * 7.5
TOLERANCE_DEG = 1e-6


def hills(rows: int, cols: int, relief_m: float = 400.0) -> np.ndarray:
    """Return random smooth hills (rows, cols), metres; the seed is fixed."""
    noise = np.random.default_rng(3).standard_normal((rows, cols))
    smooth = gaussian_filter(noise, 6.0) + 0.1 * gaussian_filter(noise, 1.5)
    return (relief_m * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.float32)


def points_within(scene, count: int) -> np.ndarray:
    """Return random points (count, 2) of a raster in its CRS; the seed is fixed."""
    rng, elevation = np.random.default_rng(5), scene.elevation
    xy = elevation.xy(rng.uniform(0, elevation.rows - 1, count), rng.uniform(0, elevation.cols - 1, count))
    return np.stack(xy, axis=-1)


def assert_as_alone(scene, points, crs=None, heights=0.0) -> None:
    """Assert that the horizons of points differ from each other, and each equals that of its point alone."""
    height_m = np.broadcast_to(heights, len(points))
    together = horizon_angles(scene, places_at(scene, points, crs, height_m), AZIMUTHS_DEG)
    alone = []
    for point, height in zip(points, height_m, strict=True):
        surroundings = load_surroundings(scene, place_at(scene, tuple(point), crs, float(height)))
        alone.append(horizon_profile(surroundings, AZIMUTHS_DEG).elevation_deg)
    assert together == pytest.approx(np.array(alone), abs=TOLERANCE_DEG)
    assert np.abs(together - np.roll(together, 1, axis=0)).max(axis=1).min() > 100 * TOLERANCE_DEG


@pytest.mark.parametrize("surface", ["smooth", "blocks"])
def test_horizons_equal_those_of_single_points(write_raster, make_scene, surface):
    scene = make_scene(
        write_raster(hills(300, 560), "EPSG:32633", 400_000.0, 5_000_000.0, 30.0), terrain={"surface": surface}
    )  # fmt: skip
    assert_as_alone(scene, points_within(scene, 60), scene.elevation.crs, np.arange(60) % 3 * 20.0)


def test_horizons_do_not_depend_on_batches(write_raster, make_scene, monkeypatch):
    """Three points a batch, of which each reads further pages and levels of detail."""
    monkeypatch.setattr(relief_pages, "FULL_DETAIL_NODES", 64)
    monkeypatch.setattr(horizon_walk, "BATCH_LINES", 3 * len(AZIMUTHS_DEG))
    scene = make_scene(write_raster(hills(300, 560), "EPSG:32633", 400_000.0, 5_000_000.0, 30.0))
    assert_as_alone(scene, points_within(scene, 40), scene.elevation.crs)
    assert {0, 1, 2} <= set(relief_pages.paged_relief(scene).levels)


def test_horizons_in_a_flat_world(write_raster, make_scene):
    scene = make_scene(write_raster(hills(120, 120), ENGINEERING, 0.0, 1200.0, 10.0))
    assert_as_alone(scene, np.random.default_rng(1).uniform(-590.0, 590.0, (20, 2)), None, 1.6)


def test_horizons_in_degrees_and_at_a_pole(write_raster, make_scene):
    """At a pole each line is located exactly; farther south the lines of one batch are interpolated."""
    ridges = hills(200, 360, 3000.0)
    scene = make_scene(write_raster(ridges, "EPSG:4326", -180.0, 90.0, (1.0, 0.1)))
    points = np.array([(10.0, 89.95), (-170.0, 89.5), (179.8, 72.0), (-179.8, 75.0), (40.0, 71.0)])
    assert_as_alone(scene, points)
    lines_are_exact = []
    for point in points:
        place = place_at(scene, tuple(point))
        ground = relief_pages.paged_relief(scene)
        polynomials = sight_lines._sight_line_polynomials(ground.grid, [place], np.array([30]))
        lines_are_exact.append(not polynomials.is_accurate[0])
    assert set(lines_are_exact) == {False, True}


def test_horizons_beside_a_house_and_a_tree(village):  # noqa: F811
    scene, middle = village(hills(64, 64, 3.0))
    offsets = np.array([(0.0, 0.0), (8e-5, 0.0), (0.0, -2e-4), (-3e-4, 1e-4), (6e-4, 0.0)])
    assert_as_alone(scene, np.array(middle) + offsets, None, 1.6)
    beside = horizon_angles(scene, places_at(scene, np.array([middle, middle])), np.array([90.0, 180.0]))
    assert (beside > 10.0).all()  # house and tree


def test_places_name_the_point_that_is_wrong(write_raster, make_scene):
    scene = make_scene(write_raster(hills(40, 40), ENGINEERING, 0.0, 400.0, 10.0))
    with pytest.raises(InputError, match=r"point: '5000,0 \(point 2 of 3\)' is not allowed. Allowed: a place on the level's data"):
        places_at(scene, np.array([(0.0, 0.0), (5000.0, 0.0), (np.nan, 0.0)]))
    with pytest.raises(InputError, match=r"height: '-2 \(point 2 of 2\)' is not allowed"):
        places_at(scene, np.zeros((2, 2)), None, np.array([1.0, -2.0]))
