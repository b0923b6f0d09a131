"""Sampling step of sun hours: minutes that a step misses, counted by hand, and grounds with a known step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skugga.api.raster_view import raster_view
from skugga.shadows.sun_hours.steps import (
    LONG_STEP_MINUTES,
    SHORT_STEP_MINUTES,
    interpolation_error_minutes,
    missed_minutes,
    sampling_step_minutes,
)
from skugga.shadows.sun_hours.sun_hours import SunRules, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff
from tests.shadows.sun_hours.test_sun_hours import SPRING, forbid_plan, window_of


def sunlit_series(text: str) -> np.ndarray:
    """Return whether the sun is visible at each time (1, n), from a text in which "#" is sun."""
    return np.array([[character == "#" for character in text]])


@pytest.mark.parametrize(
    ("minutes", "step", "missed"),
    [
        ("####.####.#", 5, 2.0),  # both breaks lie between samples
        ("....#.....#", 5, 1.0),  # a minute of sun between samples
        ("...........", 5, 0.0),
        ("##.........", 5, 0.0),  # one crossing, which is found
        ("..#.######.", 5, 1.0),  # dark, then lit: the first crossing is found, and the dark minute after it is missed
        ("####.####.#", 1, 0.0),  # each minute is sampled
    ],
)
def test_missed_minutes_by_hand(minutes, step, missed):
    assert missed_minutes(sunlit_series(minutes), step) == pytest.approx([missed])


def test_missed_minutes_cancel_opposite_errors():
    assert missed_minutes(sunlit_series("##.##..#..#"), 5) == pytest.approx([0.0])
    assert missed_minutes(np.concatenate([sunlit_series("##.########"), sunlit_series("...........")]), 5) == pytest.approx(
        [1.0, 0.0]
    )


def test_interpolation_error_by_hand():
    rising = np.arange(-6.0, 7.0)[None]
    assert interpolation_error_minutes(rising, 12) == pytest.approx(0.0)
    kinked = np.where(rising < 0.0, rising, 2.0 * rising)  # 6 minutes of sun; the chord from -6 to 12 has 8
    assert interpolation_error_minutes(kinked, 12) == pytest.approx(2.0)
    assert interpolation_error_minutes(kinked, 6) == pytest.approx(0.0)
    glance = np.where(np.abs(rising) < 2.0, 1.0, -1.0)  # 3 minutes of sun between the samples
    assert interpolation_error_minutes(glance, 12) == pytest.approx(3.0)
    assert interpolation_error_minutes(np.concatenate([glance, rising]), 12) == pytest.approx(1.5)
    assert interpolation_error_minutes(np.empty((5, 0)), 12) == 0.0


@pytest.fixture
def open_scene(tmp_path: Path):
    """A function that returns the scene of heights (rows, cols). ``cell`` is the side of a cell in metres.

    Scenes are closed after the test.
    """
    scenes: list[Scene] = []

    def make(heights: np.ndarray, cell: float) -> Scene:
        path = write_geotiff(tmp_path / f"{len(scenes)}.tif", heights.astype(np.float32), "EPSG:32632", 500e3, 5200e3, cell)
        scenes.append(build_scene(load_level(path)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def sampling_step_of(scene: Scene) -> float:
    """Return the automatic step of sun hours in a scene, minutes."""
    view = raster_view(scene).view.with_pixels_as_nodes()
    day = window_suns(scene.world, [window_of(scene, SPRING)])[0]
    return sampling_step_minutes(scene, bare_nodes(scene, view, 1), day, 0.0, 0.0)


def dome() -> np.ndarray:
    """Return heights in metres (121, 121) of a round hill."""
    row, col = np.mgrid[-60:61, -60:61]
    return 400.0 * np.exp(-(row**2 + col**2) / 800.0)


def poles() -> np.ndarray:
    """Return a field of 500 poles of one cell, 15 m high. The sun passes the gaps between them in minutes."""
    heights = np.zeros((121, 121))
    rng = np.random.default_rng(3)
    heights[rng.integers(0, 121, 500), rng.integers(0, 121, 500)] = 15.0
    return heights


def test_sampling_step_is_long_over_smooth_ground_only(open_scene):
    assert sampling_step_of(open_scene(dome(), 30.0)) == LONG_STEP_MINUTES
    assert sampling_step_of(open_scene(poles(), 1.0)) == SHORT_STEP_MINUTES


def test_sun_hours_without_a_step_use_the_sampling_step(open_scene):
    scene = open_scene(dome(), 30.0)
    view = raster_view(scene).view.with_pixels_as_nodes()
    days = window_suns(scene.world, [window_of(scene, SPRING)])
    default_hours, long_step_hours, hourly_step_hours = (
        sun_hours(scene, view, days, SunRules(step), forbid_plan).hours for step in (None, LONG_STEP_MINUTES, 60.0)
    )
    np.testing.assert_array_equal(default_hours, long_step_hours)
    assert not np.array_equal(default_hours, hourly_step_hours, equal_nan=True)
