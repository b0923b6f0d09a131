"""Camera paths through keys: position, speed, height, and rejected paths."""

from __future__ import annotations

import json
from datetime import datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.terrain.camera_path import CameraPath, camera_path
from skugga.terrain.errors import InputError
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

ROWS, COLS = 24, 32


@pytest.fixture(scope="module")
def floor(tmp_path_factory) -> Scene:
    """Scene of a level floor."""
    path = tmp_path_factory.mktemp("path") / "floor.yaml"
    level = {"version": 1, "terrain": {"flat": {"size": [400, 400], "cells": [100, 100]}}, "sun": {"azimuth": 200, "altitude": 35}}
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def hills() -> Scene:
    """Scene of a bundled level with trees."""
    return build_scene(load_level("configs/jacksboro_wooded.yaml"))


def path_spec(*keys: tuple[str, tuple, tuple], **key_options) -> CameraPathSpec:
    """Return a camera path with keys (time, eye, target)."""
    return CameraPathSpec.model_validate(
        {"keys": [{"at": at, "eye": eye, "target": target_point, **key_options} for at, eye, target_point in keys]}
    )


def path_of(scene: Scene, *keys: tuple[str, tuple, tuple], **key_options) -> CameraPath:
    """Return the path of a camera in a scene from keys (time, eye, target)."""
    return camera_path(path_spec(*keys, **key_options), scene.geolocator, None)


def eye(path: CameraPath, time_s: float) -> np.ndarray:
    """Return east, north and up (3,) in metres on the floor, where the earth frame is the anchor frame."""
    return path.view_at(time_s, ROWS, COLS).eye_earth_m


def test_path_along_a_line_stays_on_the_line(floor):
    """The speed is constant between the second key and the last but one. The path starts and stops smoothly."""
    path = path_of(floor, *((f"{n}s", (10 * n, -20 * n, 5 + n), (0, 0, 0)) for n in range(5)))
    start, velocity = eye(path, 0.0), np.array([10.0, -20.0, 1.0])
    middle = np.linspace(1.0, 3.0, 21)
    assert np.array([eye(path, t) for t in middle]) - start == pytest.approx(middle[:, None] * velocity, abs=1e-9)
    for ends in (np.linspace(0.0, 1.0, 11), np.linspace(3.0, 4.0, 11)):
        displacements = np.array([eye(path, t) for t in ends]) - start
        assert np.cross(displacements, velocity) == pytest.approx(0.0, abs=1e-9)
        assert (np.diff(displacements @ velocity) > 0.0).all()
    assert np.linalg.norm(eye(path, 0.01) - start) < 0.01


def test_view_at_a_key_equals_the_view_of_a_level(hills):
    """Equal bit for bit, over real ground."""
    views = [view for view in hills.loaded.level.views.values() if view.kind == "perspective"]
    assert views
    for view in views:
        other = ((view.eye[0] + 1e-3, view.eye[1], view.eye[2]), view.target)
        path = path_of(hills, ("1s", view.eye, view.target), ("2s", *other), fov=view.fov)
        path_view, level_view = path.view_at(1.0, ROWS, COLS), hills.view_from(view, (COLS, ROWS))
        assert (path_view.eye_earth_m == level_view.eye_earth_m).all() and path_view.focal_px == level_view.focal_px
        assert (path_view.earth_from_camera == level_view.earth_from_camera).all()


def test_velocity_is_continuous_at_keys(floor):
    keys = [
        ("0s", (0, 0, 5), (9, 9, 0)),
        ("1s", (30, 5, 9), (9, 0, 0)),
        ("4s", (35, 60, 7), (0, 0, 0)),
        ("5s", (0, 60, 20), (1, 1, 1)),
    ]
    path, step_s = path_of(floor, *keys), 1e-6
    for time in (1.0, 4.0):
        before, after = (eye(path, time) - eye(path, time - step_s)) / step_s, (eye(path, time + step_s) - eye(path, time)) / step_s
        assert before == pytest.approx(after, abs=1e-3)
        assert np.linalg.norm(before[:2]) > 1.0


def test_camera_rests_between_equal_keys(floor):
    """A twice differentiable spline would overshoot."""
    near_eye, far_eye = (0, 0, 5), (80, 10, 30)
    path = path_of(
        floor, ("0s", near_eye, (9, 9, 0)), ("2s", far_eye, (9, 9, 0)), ("5s", far_eye, (9, 9, 0)), ("6s", near_eye, (9, 9, 0))
    )
    rest_positions = [eye(path, time) for time in np.linspace(2.0, 5.0, 13)]
    assert np.ptp(rest_positions, axis=0).max() < 1e-9
    assert np.linalg.norm(eye(path, 1.0) - rest_positions[0]) > 30.0


HEIGHTS = st.lists(st.floats(1.0, 500.0), min_size=2, max_size=6)


@given(HEIGHTS, st.data())
def test_height_stays_between_those_of_adjacent_keys(floor, heights, data):
    gaps = data.draw(st.lists(st.floats(0.01, 100.0), min_size=len(heights), max_size=len(heights)))
    times = np.round(np.cumsum(gaps), 2)
    keys = [
        (f"{time:.2f}s", (3 * n, n % 2, height), (100, 100, 0)) for n, (time, height) in enumerate(zip(times, heights, strict=True))
    ]
    path = path_of(floor, *keys)
    base = eye(path, times[0])[2] - heights[0]
    for n in range(len(heights) - 1):
        heights_m = [eye(path, time)[2] - base for time in np.linspace(times[n], times[n + 1], 9)]
        low, high = sorted(heights[n : n + 2])
        assert low - 1e-6 <= min(heights_m) and max(heights_m) <= high + 1e-6


def test_camera_rests_before_and_after_its_keys(floor):
    path = path_of(floor, ("2s", (0, 0, 5), (9, 9, 0)), ("3s", (50, 0, 5), (9, 9, 0)))
    assert (eye(path, 0.0) == eye(path, 2.0)).all() and (eye(path, 99.0) == eye(path, 3.0)).all()
    assert np.linalg.norm(eye(path, 0.0) - eye(path, 99.0)) == pytest.approx(50.0)


def test_dates_are_counted_from_the_first_frame(hills):
    view = next(view for view in hills.loaded.level.views.values() if view.kind == "perspective")
    dated_spec = CameraPathSpec.model_validate({
        "keys": [{"at": f"2024-10-21T{hour}:00:00-04:00", "eye": view.eye, "target": view.target} for hour in (16, 18)]
    })  # fmt: skip
    start = datetime.fromisoformat("2024-10-21T19:30:00+00:00")
    assert camera_path(dated_spec, hills.geolocator, start).times_s.tolist() == [1800.0, 9000.0]
    with pytest.raises(InputError, match="the film has no date"):
        camera_path(dated_spec, hills.geolocator, None)


def test_path_across_the_antimeridian_is_the_short_one(hills):
    """Longitudes differ by 360 degrees as written: the path does not circle the earth between two keys."""
    view = next(view for view in hills.loaded.level.views.values() if view.kind == "perspective")
    lon, lat, height = view.eye
    path = path_of(hills, ("0s", (lon, lat, height), view.target), ("2s", (lon + 360.001, lat, height), view.target))
    distance_m = np.linalg.norm(eye(path, 1.0) - eye(path, 0.0))
    assert 1.0 < distance_m < 100.0


@pytest.mark.parametrize(
    ("keys", "name", "allowed"),
    [
        ([("0s", (0, 0, 5), (9, 9, 0)), ("1s", (900, 0, 5), (9, 9, 0))], "keys.1.eye", "a position on the terrain's data"),
        ([("0s", (0, 0, 5), (900, 9, 0)), ("1s", (90, 0, 5), (9, 9, 0))], "keys.0.target", "a position on the terrain's data"),
    ],
)
def test_keys_off_the_data_are_named(floor, keys, name, allowed):
    with pytest.raises(InputError) as caught:
        path_of(floor, *keys)
    assert (caught.value.name, caught.value.allowed) == (name, allowed)


def test_path_off_the_data_or_below_the_ground_is_rejected(floor, hills):
    under = path_of(floor, ("0s", (0, 0, 5), (9, 9, 0)), ("1s", (50, 0, -5), (9, 9, 0)))
    assert under.view_at(0.49, ROWS, COLS)
    with pytest.raises(InputError, match="eye: the camera is 3.44 m below the ground. Keep the camera above the ground"):
        under.view_at(0.75, ROWS, COLS)
    # This curve leaves the floor although its keys lie on it.
    bow = path_of(
        floor, *((f"{n}s", at, (0, 0, 0)) for n, at in enumerate([(150, -150, 5), (199, -60, 5), (199, 60, 5), (150, 150, 5)]))
    )
    with pytest.raises(InputError, match="lies outside of the terrain's data. Keep the camera over the terrain's data"):
        bow.view_at(1.5, ROWS, COLS)
    met = path_of(floor, ("0s", (0, 0, 5), (9, 0, 5)), ("2s", (18, 0, 5), (9, 0, 5)))
    with pytest.raises(InputError, match="target"):
        met.view_at(1.0, ROWS, COLS)
