"""Curves through timed keys: their positions and directions, without jerks or overshoot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from skugga.terrain.geo.keyed_curve import KeyedCurve

SEEDS = st.integers(0, 10_000)


def random_curve(seed: int, loop: bool = False, count: int = 7, size: int = 2) -> KeyedCurve:
    """Return a random curve with ``count`` keys and values (size,). It rests between the third and the fourth key."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, size)) * 10.0
    values[2] = values[3]  # it rests between these
    if loop:
        values[-1] = values[0]
    return KeyedCurve(rng.uniform(-1e4, 1e4) + np.cumsum(rng.uniform(0.2, 9.0, count)), values, loop)


@given(SEEDS, st.booleans())
def test_curve_passes_its_keys_at_their_times(seed, loop):
    curve = random_curve(seed, loop)
    np.testing.assert_allclose(curve.at(curve.times_s), curve.values, atol=1e-9)
    np.testing.assert_array_equal(curve.at(curve.times_s[0]), curve.values[0])


@given(SEEDS, st.booleans())
def test_curve_velocity_is_continuous(seed, loop):
    """This includes times where the curve is held, and where a loop begins again."""
    curve = random_curve(seed, loop)
    h = 1e-6  # an acceleration of 2,000 m/s² is no jump of the velocity
    for time in curve.times_s:
        before, middle, after = curve.at(time + np.array([-h, 0.0, h]))
        np.testing.assert_allclose((middle - before) / h, (after - middle) / h, atol=2e-2)


def test_curve_of_one_coordinate_is_pchip():
    """The ends differ, because the curve starts from rest."""
    rng = np.random.default_rng(3)
    times, values = np.cumsum(rng.uniform(0.2, 3.0, 12)), rng.normal(size=12)
    curve = KeyedCurve(times, values[:, None])
    inner = np.linspace(times[1], times[-2], 500)
    np.testing.assert_allclose(curve.at(inner)[:, 0], PchipInterpolator(times, values)(inner), atol=1e-12)


def test_curve_of_even_keys_is_catmull_rom():
    """A quarter of the way from p1 to p2, the Catmull-Rom weights are -9, 111, 29 and -3 of 128."""
    values = np.array([[0.0, 0.0], [6.0, 8.0], [16.0, 8.0], [22.0, 16.0]])  # each 10 m from the next
    curve = KeyedCurve(np.array([0.0, 2.0, 4.0, 6.0]), values)
    np.testing.assert_allclose(curve.at(2.5), np.array([-9.0, 111.0, 29.0, -3.0]) / 128.0 @ values, atol=1e-12)


@given(SEEDS, st.booleans(), st.floats(0.0, 360.0))
def test_curve_is_rotation_invariant(seed, loop, turn_deg):
    curve, rotation_rad = random_curve(seed, loop), np.radians(turn_deg)
    rotation = np.array([[np.cos(rotation_rad), -np.sin(rotation_rad)], [np.sin(rotation_rad), np.cos(rotation_rad)]])
    turned = KeyedCurve(curve.times_s, curve.values @ rotation.T, loop)
    seconds = np.linspace(curve.times_s[0] - 5.0, curve.times_s[-1] + 5.0, 200)
    np.testing.assert_allclose(turned.at(seconds), curve.at(seconds) @ rotation.T, atol=1e-9)


@given(SEEDS, st.booleans())
def test_curve_stays_between_the_values_of_neighbouring_keys(seed, loop):
    curve = random_curve(seed, loop, size=1)
    for k in range(len(curve.times_s) - 1):
        ends = curve.values[k : k + 2, 0]
        between = curve.at(np.linspace(*curve.times_s[k : k + 2], 100))[:, 0]
        assert ends.min() - 1e-9 <= between.min() and between.max() <= ends.max() + 1e-9


@given(SEEDS, st.booleans())
def test_curve_rests_between_equal_keys(seed, loop):
    curve = random_curve(seed, loop)
    np.testing.assert_array_equal(curve.at(np.linspace(*curve.times_s[2:4], 50)), np.tile(curve.values[2], (50, 1)))


def test_curve_is_held_before_and_after_its_keys():
    """With two keys the curve starts and stops slowly, and is half-way at half the time."""
    curve = KeyedCurve(np.array([10.0, 30.0]), np.array([[0.0, 5.0], [100.0, 5.0]]))
    seconds = np.array([-1e9, 10.0, 15.0, 20.0, 25.0, 30.0, 1e9])
    np.testing.assert_allclose(curve.at(seconds)[:, 0], [0.0, 0.0, 15.625, 50.0, 84.375, 100.0, 100.0])


def test_a_loop_is_periodic():
    angle = np.linspace(0.0, 2.0 * np.pi, 9)
    values = 40.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    values[-1] = values[0]
    curve = KeyedCurve(5.0 + 3.0 * np.arange(9.0), values, loop=True)
    seconds = np.linspace(0.0, 24.0, 100)
    for loop_count in (-1, 1, 1000):
        np.testing.assert_allclose(curve.at(seconds + 24.0 * loop_count), curve.at(seconds), atol=1e-7)
    radius = np.linalg.norm(curve.at(seconds), axis=1)
    assert 39.6 < radius.min() and radius.max() < 40.01  # eight keys make nearly a circle


@given(SEEDS, st.booleans())
def test_curve_direction_is_that_of_its_motion(seed, loop):
    curve = random_curve(seed, loop)
    for seconds in np.random.default_rng(seed).uniform(curve.times_s[0], curve.times_s[-1], 20):
        displacement = curve.at(seconds + 1e-5) - curve.at(seconds - 1e-5)
        if np.linalg.norm(displacement) > 1e-4:
            np.testing.assert_allclose(normalized(curve.direction_at(float(seconds))), normalized(displacement), atol=1e-3)


def test_a_resting_curve_keeps_its_last_direction():
    values = np.array([[0.0, 0.0], [0.0, 0.0], [10.0, 0.0], [10.0, 0.0], [10.0, 10.0], [10.0, 10.0]])
    curve = KeyedCurve(np.arange(6.0), values)
    directions = {
        -3.0: (1, 0),
        0.5: (1, 0),
        1.0: (1, 0),
        1.5: (1, 0),
        2.0: (1, 0),
        2.7: (1, 0),
        3.5: (0, 1),
        4.6: (0, 1),
        9.0: (0, 1),
    }
    for seconds, direction in directions.items():
        np.testing.assert_allclose(normalized(curve.direction_at(seconds)), direction, atol=1e-5, err_msg=str(seconds))
    loop = KeyedCurve(np.arange(4.0), np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 7.0], [0.0, 0.0]]), loop=True)
    np.testing.assert_allclose(normalized(loop.direction_at(0.5)), (0, -1), atol=1e-5)
    assert not KeyedCurve(np.arange(2.0), np.zeros((2, 3))).direction_at(0.3).any()


@pytest.mark.parametrize("first_s", [0.0, 1e9 - 2.0])
def test_short_parts_late_on_the_clock_keep_their_direction(first_s):
    curve = KeyedCurve(first_s + np.array([0.0, 0.001, 0.002]), np.array([[0.0], [1.0], [2.0]]))
    assert all(curve.direction_at(first_s + after_s)[0] > 0.0 for after_s in (0.0, 0.001, 0.002))


def normalized(vector: np.ndarray) -> np.ndarray:
    """Return a vector scaled to length 1."""
    return vector / np.linalg.norm(vector)
