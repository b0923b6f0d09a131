"""Films: frames equal the stills of their moments to the bit, and invalid requests fail before any frame is drawn."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from datetime import datetime

import numpy as np
import pytest

from skugga.selector import film
from skugga.selector.cost.typical_device import typical_device
from skugga.selector.film import FilmFrame, film_frames, frame_moments
from skugga.selector.film_request import FilmRequest, FilmSpan
from skugga.selector.planner.planner import make_plan
from skugga.selector.portfolio import portfolio
from skugga.selector.replanning import INITIAL_PATIENCE_FRAMES, MAX_CHANGED_SHARE, Replanner
from skugga.selector.select import select
from skugga.shadows.draw import draw
from skugga.shadows.plan import Plan, Predicted
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

NOON = datetime.fromisoformat("2024-06-21T12:00:00-04:00")
SIZE = 96, 80

FIGURE = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}},
    "meshes": [{"generate": "tetrahedra", "motion": {"spin": 30}}], "sun": {"azimuth": 200, "altitude": 35}, "seconds": 2.0,
    "views": {"eye": {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [160, 128]}},
}  # fmt: skip
CAMERA_PATH = CameraPathSpec.model_validate({
    "size": SIZE,
    "keys": [
        {"at": "0s", "eye": [-30, -48, 15], "target": [3, 2, 2]},
        {"at": "2s", "eye": [30, -40, 12], "target": [3, 2, 2], "fov": 40},
        {"at": "3s", "eye": [40, 10, 20], "target": [0, 0, 2], "fov": 45},
    ],
})  # fmt: skip


@pytest.fixture(scope="module")
def figure(tmp_path_factory) -> Scene:
    """Return a tetrahedron that turns on a floor."""
    path = tmp_path_factory.mktemp("film") / "figure.yaml"
    path.write_text(json.dumps(FIGURE), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.fixture(scope="module")
def hills() -> Scene:
    """Scene of a bundled level of terrain only."""
    return build_scene(load_level("configs/jacksboro.yaml"))


def frames_of(scene: Scene, request: FilmRequest, replanner: Replanner | None = None) -> Iterator[FilmFrame]:
    """Yield the frames of a film. ``replanner`` ``None`` stands for a new replanner."""
    return film_frames(scene, request, frame_moments(scene, request), replanner)


def still_of(scene: Scene, frame: FilmFrame) -> np.ndarray:
    """Return the picture of a frame's time, clock, view and plan, drawn with a fresh scene object that shares nothing."""
    moment = frame.moment
    sun = None if moment.time is None else SunSpec(time=moment.time)
    fresh_scene = build_scene(scene.loaded).with_sun(sun).at_second(moment.second)
    return render_frame(fresh_scene, moment.view, frame.plan).color


def test_film_frames_of_a_moving_sun_equal_stills(gl, hills):
    request = FilmRequest(FilmSpan(5, 10800.0, NOON), "map", size=SIZE)
    frames = list(frames_of(hills, request))
    assert [frame.moment.time.isoformat() for frame in frames][::4] == ["2024-06-21T12:00:00-04:00", "2024-06-22T00:00:00-04:00"]
    assert len({frame.color.tobytes() for frame in frames}) == 5
    for frame in frames:
        assert frame.transition is None and frame.color.shape == (SIZE[1], SIZE[0], 3) and frame.color.dtype == np.uint8
        assert (frame.color == still_of(hills, frame)).all()


def test_film_frames_of_moving_camera_and_meshes_equal_stills(gl, figure):
    request = FilmRequest(FilmSpan(7, 0.5), path=CAMERA_PATH)
    frames = list(frames_of(figure, request))
    assert [frame.moment.second for frame in frames] == [2.0 + 0.5 * n for n in range(7)]
    assert len({frame.color.tobytes() for frame in frames}) == 7
    for frame in frames:
        assert frame.plan.view == "path" and (frame.color == still_of(figure, frame)).all()


def test_film_starts_at_the_second_of_its_scene(tmp_path):
    """Only a lamp moves, which leaves the meshes unchanged. The frames' lamps follow the clock."""
    keys = [{"seconds": 0, "position": [-20, 0, 9]}, {"seconds": 10, "position": [20, 0, 9]}]
    level = {**FIGURE, "meshes": [{"generate": "tetrahedra"}], "lights": {"lamp": {"kind": "omni", "motion": {"path": keys}}}}
    (tmp_path / "lit.yaml").write_text(json.dumps(level), encoding="utf-8")
    scene = build_scene(load_level(tmp_path / "lit.yaml"))
    for start_scene, start_second in ((scene, 2.0), (scene.at_second(5.0), 5.0)):
        moments = frame_moments(start_scene, FilmRequest(FilmSpan(2, 5.0), "eye"))
        assert [moment.second for moment in moments] == [start_second, start_second + 5.0]
    assert [moment.scene(scene).lamps["lamp"].position_earth_m[0] for moment in moments] == pytest.approx([0.0, 20.0])


def test_film_frames_are_drawn_lazily(figure, monkeypatch):
    draw_calls = []
    monkeypatch.setattr(film, "draw", lambda *args: draw_calls.append(1) or draw(*args))
    frames = frames_of(figure, FilmRequest(FilmSpan(100, 0.01), path=CAMERA_PATH))
    assert draw_calls == []
    next(frames), next(frames)
    assert len(draw_calls) == 2


class SwitchingPolicy:
    """A policy that takes one algorithm for a number of calls, then prefers another one."""

    def __init__(self, first: str, second: str, calls: int) -> None:
        self.names, self.calls = (first, second), calls

    def __call__(self, descriptor, plan_request, overrides) -> Plan:
        requested = (overrides or {}).get("algorithm")
        self.calls -= requested is None
        name = requested["sun"]["meshes"] if requested else self.names[self.calls < 0]
        ms = 5.0 if name == self.names[self.calls < 0] else 10.0
        plan_overrides = {**(overrides or {}), "algorithm": {"sun": {"meshes": name}}}
        if name == "shadow_map":
            plan_overrides |= {"map_size": 64, "cascades": 1, "filter": 1}
        plan = make_plan(descriptor, plan_request, plan_overrides)
        return plan.model_copy(update={"policy": "predict", "predicted": Predicted(ms=ms, wrong=0.001, wrong_cast=0.01)})


def test_film_switch_is_spread_logged_and_recorded(gl, figure, caplog):
    """Frames before and after the switch are stills.

    In between, the pixels that change from frame to frame stay within the limit.
    """
    caplog.set_level(logging.INFO, "skugga")
    logging.getLogger("skugga").propagate = True
    request = FilmRequest(FilmSpan(INITIAL_PATIENCE_FRAMES + 40, 1e-3), "eye")  # the camera is at rest, and the body hardly moves
    frames = list(frames_of(figure, request, Replanner(plans=SwitchingPolicy("shadow_map", "shadow_volume", 3))))
    (switch_frame,) = (frame for frame in frames if frame.switch is not None)
    switch, transition_frames = switch_frame.switch, [frame for frame in frames if frame.transition is not None]
    assert (switch.number, switch.before, switch.after) == (3 + INITIAL_PATIENCE_FRAMES - 1, "shadow_map 64 1", "shadow_volume")
    assert "5.0 ms" in switch.reason and "10 ms" in switch.reason and f"{INITIAL_PATIENCE_FRAMES} frames in a row" in switch.reason
    assert (
        transition_frames[0] is switch_frame and 4 <= len(transition_frames) < 40 and transition_frames[-1].transition.share == 1.0
    )
    (message,) = (record.getMessage() for record in caplog.records if "instead of" in record.getMessage())
    assert message == f"frame {switch.number + 1} (0.007 s): {switch.after} instead of {switch.before}: {switch.reason}"
    valid_count = render_frame(figure, frames[0].moment.view, frames[0].plan).valid.sum()
    for previous, current in zip(frames, frames[1:], strict=False):
        if previous.transition or current.transition:
            # The sun rests and the body turns by 0.03 degrees a frame: colours change, but hardly between light and shadow.
            changed_count = (np.abs(previous.color.astype(int) - current.color).max(axis=-1) > 40).sum()
            assert changed_count <= 1.5 * max(MAX_CHANGED_SHARE * valid_count, 1.0)
    total_change = np.abs(frames[switch.number - 1].color.astype(int) - frames[-1].color).max(axis=-1) > 40
    assert total_change.sum() > 2 * MAX_CHANGED_SHARE * valid_count  # otherwise the test would be vacuous
    for frame in (*frames[:3], *frames[-2:]):
        assert (frame.color == still_of(figure, frame)).all()
    assert not (switch_frame.color == still_of(figure, switch_frame)).all()


def test_film_reports_the_switch_at_night(gl, hills, caplog):
    caplog.set_level(logging.INFO, "skugga")
    logging.getLogger("skugga").propagate = True
    evening = datetime.fromisoformat("2024-06-21T20:00:00-04:00")
    frames = list(frames_of(hills, FilmRequest(FilmSpan(3, 3600.0, evening), "map", size=(32, 32))))
    (switch_frame,) = (frame for frame in frames if frame.switch is not None)
    assert switch_frame.switch.after == "none" and switch_frame.switch.reason == "nothing casts shadows now"


def test_frame_moments_at_rest_share_one_view(hills):
    moments = frame_moments(hills, FilmRequest(FilmSpan(3, 60.0, NOON), "map", size=SIZE))
    assert isinstance(moments[0].view, MapView) and all(moment.view is moments[0].view for moment in moments)
    assert [moment.second for moment in moments] == [0.0, 60.0, 120.0]
    assert moments[2].label == "frame 3 (2024-06-21T12:02:00-04:00)"


def test_frame_moments_start_at_the_requested_second(figure):
    moments = frame_moments(figure, FilmRequest(FilmSpan(2, 0.25, None, 10.0), "eye", size=SIZE))
    assert [moment.second for moment in moments] == [10.0, 10.25]
    assert moments[1].label == "frame 2 (0.25 s)" and isinstance(moments[1].view, PerspectiveView)


def test_frame_moments_take_size_from_request_or_path(figure):
    path_view = frame_moments(figure, FilmRequest(FilmSpan(1, 1.0), path=CAMERA_PATH))[0].view
    sized_view = frame_moments(figure, FilmRequest(FilmSpan(1, 1.0), path=CAMERA_PATH, size=(50, 40)))[0].view
    assert ((path_view.cols, path_view.rows), (sized_view.cols, sized_view.rows)) == (SIZE, (50, 40))


def low_camera_path(height: float) -> CameraPathSpec:
    """Return a path of four seconds whose camera ends at a height, metres above the ground."""
    keys = [{"at": at, "eye": [x, 0, z], "target": [0, 9, 0]} for at, x, z in (("0s", 0, 5), ("4s", 50, height))]
    return CameraPathSpec.model_validate({"keys": keys})


def chosen_names(plan: Plan) -> set[str]:
    return {name for kinds in plan.algorithm.values() for name in kinds.values()}


def test_film_of_a_moving_camera_avoids_perspective_maps():
    """Their texels follow the camera, so edges crawl over the ground. The hard cases T1 to T4 bound by how much."""
    scene = build_scene(load_level("configs/thesis_rocks_sun.yaml"))
    still = describe(scene, scene.view("main"), "main")
    moving = still.model_copy(update={"camera_moves": True})
    level, device = scene.loaded.level, typical_device()
    plans = {
        (policy, descriptor.camera_moves): select(descriptor, level, policy=policy, device=device)
        for policy in ("rules", "predict")
        for descriptor in (still, moving)
    }
    assert "perspective_shadow_map" in chosen_names(plans["rules", False]), "otherwise the test says nothing"
    assert not any("perspective_shadow_map" in chosen_names(plans[policy, True]) for policy in ("rules", "predict"))
    (reason,) = (r.reason for r in plans["predict", True].rejected if r.name == "perspective_shadow_map")
    assert "follow the camera" in reason
    offered = [{name for choice in portfolio(d, "sun", d.casters) for name in choice.algorithm.values()} for d in (still, moving)]
    assert offered[0] - offered[1] == {"perspective_shadow_map"}
    named = make_plan(moving, level, {"algorithm": "perspective_shadow_map"})
    assert chosen_names(named) == {"perspective_shadow_map"}, "whoever names it gets it"


def test_film_frames_tell_whether_the_camera_moves(gl, figure):
    told = []

    def plans(descriptor, plan_request, overrides) -> Plan:
        told.append(descriptor.camera_moves)
        return make_plan(descriptor, plan_request, overrides)

    for request in (
        FilmRequest(FilmSpan(2, 0.5), path=CAMERA_PATH),
        FilmRequest(FilmSpan(1, 0.5), path=CAMERA_PATH),
        FilmRequest(FilmSpan(2, 0.5), "eye", size=SIZE),
    ):
        list(frames_of(figure, request, Replanner(plans=plans)))
    assert told == [True, True, False, False, False]


INVALID_REQUESTS = {
    "no frame": (FilmRequest(FilmSpan(0, 1.0), "eye"), "frames: '0'", "1 to 10000 frames"),
    "many frames": (FilmRequest(FilmSpan(10_001, 1.0), "eye"), "frames: '10001'", "1 to 10000 frames"),
    "a date on a floor": (FilmRequest(FilmSpan(2, 1.0, NOON), "eye"), "time: '2024-06-21T12:00:00-04:00'", "not georeferenced"),
    "no view": (FilmRequest(FilmSpan(2, 1.0), "hill"), "view: 'hill'", "map, eye"),
    "no bounds of a perspective": (FilmRequest(FilmSpan(2, 1.0), "eye", bounds=(0, 0, 1, 1)), "bounds:", "perspective view"),
    "under the ground": (
        FilmRequest(FilmSpan(5, 1.0), path=low_camera_path(-3.3333333333333335)),
        "path, frame 4 (3 s): eye: the camera is 2.03 m below the ground",
        "above",
    ),
    "a large picture": (FilmRequest(FilmSpan(5, 1.0), path=CAMERA_PATH, size=(5000, 9)), "size: '5000x9'", "at most 4096"),
}


@pytest.mark.parametrize("name", INVALID_REQUESTS)
def test_frame_moments_refuse_invalid_requests(figure, name):
    request, problem, allowed = INVALID_REQUESTS[name]
    with pytest.raises(InputError) as caught:
        frame_moments(figure, request)
    assert problem in str(caught.value) and allowed in str(caught.value)


def test_frame_moments_respect_max_frames(figure):
    with pytest.raises(InputError, match="1 to 10 frames"):
        frame_moments(figure, FilmRequest(FilmSpan(11, 1.0), "eye"), max_frames=10)
