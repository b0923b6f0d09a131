"""Heights encoded as colours (Mapbox Terrain-RGB, Terrarium), computed by the published formulas."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.api.products.heights import encode_heights, nodata_height_m
from skugga.api.terrain_encodings import encode_terrain_rgb, encode_terrarium


def mapbox_height_m(rgb: np.ndarray) -> np.ndarray:
    """Return heights by the formula of Mapbox's documentation."""
    r, g, b = np.moveaxis(rgb.astype(np.float64), -1, 0)
    return -10000 + (r * 256 * 256 + g * 256 + b) * 0.1


def terrarium_height_m(rgb: np.ndarray) -> np.ndarray:
    """Return heights by the formula of Tilezen's documentation."""
    r, g, b = np.moveaxis(rgb.astype(np.float64), -1, 0)
    return r * 256 + g + b / 256 - 32768


@pytest.mark.parametrize(
    ("height_m", "mapbox", "terrarium_rgb"),
    [
        (0.0, (1, 134, 160), (128, 0, 0)),  # 100000 = 1 * 65536 + 134 * 256 + 160
        (-10000.0, (0, 0, 0), (88, 240, 0)),
        (8848.86, (2, 224, 73), (162, 144, 220)),
        (-0.1, (1, 134, 159), (127, 255, 230)),
    ],
)
def test_known_heights_have_their_published_codes(height_m: float, mapbox: tuple[int, ...], terrarium_rgb: tuple[int, ...]):
    height = np.array([[height_m]])
    assert tuple(encode_terrain_rgb(height)[0, 0]) == mapbox
    assert tuple(encode_terrarium(height)[0, 0]) == terrarium_rgb


def test_decoded_heights_are_within_half_a_step():
    height = np.random.default_rng(5).uniform(-9999, 9000, (50, 70))
    assert np.abs(mapbox_height_m(encode_terrain_rgb(height)) - height).max() <= 0.05 + 1e-9
    assert np.abs(terrarium_height_m(encode_terrarium(height)) - height).max() <= 0.5 / 256 + 1e-9


def test_half_a_step_rounds_to_even():
    """512ths of a metre are exact in binary. Truncation and rounding away from zero would give other values."""
    halves = np.array([[1.0, 3.0, 5.0, -1.0, -3.0]]) / 512
    steps = (terrarium_height_m(encode_terrarium(halves)) * 256).tolist()
    assert steps == [[0.0, 2.0, 2.0, 0.0, -2.0]]
    quarters = np.array([[0.25, 0.75]])  # 2.5 and 7.5 steps of 0.1 m
    assert np.rint(mapbox_height_m(encode_terrain_rgb(quarters)) * 10).tolist() == [[2, 8]]


def test_heights_are_clamped_and_nodata_is_filled():
    extreme_heights = np.array([[-20000.0, 2e6]])
    assert encode_terrain_rgb(extreme_heights).tolist() == [[[0, 0, 0], [255, 255, 255]]]
    assert encode_terrarium(np.array([[-40000.0, 40000.0]])).tolist() == [[[0, 0, 0], [255, 255, 255]]]
    for encoding, height_m in (("mapbox", mapbox_height_m), ("terrarium", terrarium_height_m)):
        decoded_heights = height_m(encode_heights(np.array([[np.nan, 12.0]]), nodata_height_m(-3.4), encoding))
        np.testing.assert_allclose(decoded_heights, [[-4.0, 12.0]], atol=1e-6)
