"""Horizons of many points: their table as CSV and npz, and their errors."""

from __future__ import annotations

import io

import numpy as np
import pandas
import pytest

from skugga.api.point.horizons import horizons_at_points
from skugga.shadows.point.horizon import horizon_profile, load_surroundings
from skugga.shadows.point.place import place_at
from skugga.terrain.errors import InputError
from tests.rasters import ENGINEERING

POINTS = [(-30.0, 10.0), (42.0, -17.0), (0.0, 0.0)]


@pytest.fixture
def scene(write_raster, make_scene):
    """Scene of a wall 20 m high from north to south, 50 m east of the middle."""
    heights = np.zeros((41, 41), np.float32)
    heights[:, 25] = 20.0
    return make_scene(write_raster(heights, ENGINEERING, 0.0, 410.0, 10.0))


def test_a_table_has_the_horizon_of_each_point(scene):
    horizons = horizons_at_points(scene, POINTS, 8, [0.0, 1.6, 25.0])
    assert horizons.azimuth_deg.tolist() == [0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0]
    for n, (point, height) in enumerate(zip(POINTS, (0.0, 1.6, 25.0), strict=True)):
        alone = horizon_profile(load_surroundings(scene, place_at(scene, point, None, height)), horizons.azimuth_deg)
        assert horizons.horizon_deg[n] == pytest.approx(alone.elevation_deg, abs=1e-6)
    assert horizons.ground_m == pytest.approx([0.0, 4.0, 0.0], abs=1e-5)  # the second is on the slope between two nodes
    assert horizons.horizon_deg[:, 2] == pytest.approx(np.degrees(np.arctan([20 / 80, (20 - 4 - 1.6) / 8, -5 / 50])), abs=1e-6)


def test_csv_and_npz_hold_the_same_table(scene):
    horizons = horizons_at_points(scene, POINTS, 16, [0.0, 1.6, 25.0])
    table = pandas.read_csv(io.StringIO(horizons.csv_text()))
    assert list(table.columns[:6]) == ["lon", "lat", "height_m", "elevation_m", "0", "22.5"]
    with np.load(io.BytesIO(horizons.npz_bytes())) as arrays:
        assert arrays["horizon_deg"].shape == (3, 16)
        for name in ("lon", "lat", "height_m", "elevation_m"):
            assert table[name].to_numpy() == pytest.approx(arrays[name], abs=0.005)
        assert table.iloc[:, 4:].to_numpy() == pytest.approx(arrays["horizon_deg"], abs=5.1e-5)
        assert [float(name) for name in table.columns[4:]] == pytest.approx(arrays["azimuth_deg"])
        assert np.column_stack([arrays["lon"], arrays["lat"]]).tolist() == [list(point) for point in POINTS]


@pytest.mark.parametrize(
    ("arguments", "expected_text"),
    [
        ({"points": []}, "points: no points. Give at least one"),
        ({"points": np.zeros((0, 2))}, "points: no points. Give at least one"),
        ({"points": [1.0, 2.0]}, "points: an array of shape (2,). Give pairs"),
        ({"points": [(0.0, "north")]}, "points: not an array of numbers. Give pairs"),
        ({"points": np.zeros((10_001, 2))}, "points: 10001 points, more than the limit of 10000."),
        (
            {"points": [(0.0, 0.0), (900.0, 0.0)]},
            "points: '900,0 (point 2 of 2)' is not allowed. Allowed: a place on the level's data",
        ),
        ({"points": [(0.0, np.inf)]}, "points: '0,inf' is not allowed. Allowed: a place on the level's data"),
        ({"points": POINTS, "azimuths": 100_000}, "azimuths: '100000' is not allowed. Allowed: 1 to 3600"),
        ({"points": POINTS, "azimuths": 0}, "azimuths: '0' is not allowed. Allowed: 1 to 3600"),
        ({"points": POINTS, "height_m": [1.0, 2.0]}, "height: '[1.0, 2.0]' is not allowed. Allowed: a number, or one for each"),
    ],
)
def test_wrong_arguments_are_one_line(scene, arguments, expected_text):
    with pytest.raises(InputError) as error:
        horizons_at_points(scene, **arguments)
    assert str(error.value).startswith(expected_text) and "\n" not in str(error.value)
