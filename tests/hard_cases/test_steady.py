"""Temporal stability: a camera that moves, turns or zooms does not change the shadows on the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached import attached
from skugga.shadows.maps import perspective_shadow_map
from skugga.shadows.maps.drawing import draw_map
from skugga.shadows.maps.lookup import look_up
from skugga.shadows.maps.resolve import EXTENT_STEP
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS, sun_maps
from skugga.shadows.passes import PassRecord
from skugga.shadows.plan import Step
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import Seen, Trial, hard_case
from tests.hard_cases.sites import site
from tests.metrics import flicker

# -- fixed points, seen from two views


def flickers(frames: list[Seen]) -> list[float]:
    """Return FK of each pair of frames: over the points that both show, at the nearest pixel of the next frame."""
    shares = []
    for one, other in zip(frames, frames[1:], strict=False):
        known, row, col = _pixels_of(one, other)
        comparable = known & one.truth.decidable & other.truth.decidable[row, col]
        assert comparable.mean() > 0.3 and 0.02 < one.dark[comparable].mean() < 0.98, "points in light and shadow"
        shares.append(flicker(one.dark, other.dark[row, col], ~one.truth.lit, ~other.truth.lit[row, col], comparable))
    return shares


def _pixels_of(one: Seen, other: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project a picture's points into another one: whether they are visible, and the nearest pixel's row and column."""
    frame, view = one.buffer.frame, other.view
    assert isinstance(view, PerspectiveView)
    earth_m = one.buffer.position_frame_m @ frame.frame_from_earth + frame.origin_earth_m
    right, down, ahead = np.moveaxis((earth_m - view.eye_earth_m) @ view.earth_from_camera, -1, 0)
    pixel = [(v / ahead * view.focal_px - first) / view.step for v, first in ((down, view.row0), (right, view.col0))]
    known = one.buffer.valid & (ahead > 0.0)
    row, col = (np.where(known, np.rint(v), -1).astype(int) for v in pixel)
    known &= (row >= 0) & (row < view.rows) & (col >= 0) & (col < view.cols)
    row, col = np.where(known, row, 0), np.where(known, col, 0)
    beside_m = other.buffer.position_frame_m[row, col] @ other.buffer.frame.frame_from_earth + other.buffer.frame.origin_earth_m
    apart_px = np.linalg.norm(beside_m - earth_m, axis=-1) / (ahead * view.pixel)
    return known & other.buffer.valid[row, col] & (apart_px < 4.0), row, col


def turned(view: PerspectiveView, up_earth: np.ndarray, turn_deg: float) -> PerspectiveView:
    """Return the camera turned to the left about the vertical."""
    x, y, z = up_earth
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.radians(turn_deg)
    rotation = np.eye(3) + np.sin(turn) * cross + (1.0 - np.cos(turn)) * cross @ cross
    return replace(view, earth_from_camera=rotation @ view.earth_from_camera)


def moved(kind: str, scene: Scene, view: PerspectiveView, frame: int) -> PerspectiveView:
    """Return a view after some frames of 0.1 px of pan, 0.01 degrees of yaw or 1 % of zoom each."""
    if kind == "pan":
        return view.shifted(0.07 * frame, 0.07 * frame)
    if kind == "yaw":
        return turned(view, scene.world.earth_from_anchor[:, 2], 0.01 * frame)
    return replace(view, focal_px=view.focal_px * 1.01**frame)


def steadiness(trial: Trial, kind: str) -> dict[str, float]:
    """Return mean FK over the frames of a move, all drawn by the first one's plan.

    Where truth must be computed, only a few frames are compared.
    """
    scene, is_map = site(trial), trial.algorithm in ("shadow_map", "perspective_shadow_map")
    view = scene.view("oblique", size=(320, 240) if trial.thorough else (128, 96))
    count = (40 if is_map else 4) if trial.thorough else 3
    views, size = [moved(kind, scene, view, frame) for frame in range(count)], 1024 if trial.thorough else 256
    if is_map:
        return {"flicker": float(np.mean(map_flickers(trial, scene, views, map_size=size)))}
    return {"flicker": float(np.mean(flickers([trial.see(scene, each, map_size=size) for each in views])))}


def map_flickers(trial: Trial, scene: Scene, views: list[PerspectiveView], **asked: object) -> list[float]:
    """Return FK of each pair of frames of an algorithm with one map, with the frame's own points looked up in both maps.

    Truth cannot change, since the points are the same.
    """
    shares = []
    frames = [trial.see(scene, view, cascades=1, **asked) for view in views]
    (step,) = frames[0].plan.steps
    for one, other in zip(frames, frames[1:], strict=False):
        known, _, _ = _pixels_of(one, other)
        dark, next_dark = (_dark_by(scene, step, each.buffer, one.buffer) for each in (one, other))
        assert 0.02 < dark[known].mean() < 0.98, "points in light and shadow"
        shares.append(flicker(dark, next_dark, np.zeros_like(dark), np.zeros_like(dark), known))
    return shares


def _dark_by(scene: Scene, step: Step, drawn_for: GeometryBuffer, points: GeometryBuffer) -> np.ndarray:
    """Return which points of a buffer (rows, cols) are in shadow by the map of another buffer in the same frame."""
    assert drawn_for.frame is points.frame and step.settings is not None
    turned_away = attached(drawn_for, scene), attached(points, scene)
    if isinstance(step.settings, ShadowMapSettings):
        (drawn,) = sun_maps(drawn_for, scene, step.settings, None)
    else:
        seen = drawn_for.valid & ~turned_away[0]
        drawn = perspective_shadow_map.perspective_map(drawn_for, seen, scene, step.light, step.settings, None).drawn
    gl, record, visibility = device(), PassRecord("map"), np.ones(points.valid.shape, np.float32)
    target = draw_map(gl, drawn, drawn_for, scene, step.kinds, find_casters(scene, drawn_for), step.settings, record)
    asked = np.flatnonzero(points.valid & ~turned_away[1])
    look_up(
        gl,
        replace(drawn, pixels=asked),
        target,
        points,
        scene.light_position(step.light, points.frame),
        step.settings,
        visibility,
        record,
    )
    return (visibility < 0.5) | turned_away[1]


MOVES = {"pan": "0.1 px of pan", "yaw": "0.01 degrees of yaw", "zoom": "1 % of zoom"}
FOLLOW = ("shadow_map", "shadow_volume", "hybrid", "planar", "sweep")


@hard_case("T1", "Panning, shadows stay on the ground", f"{MOVES['pan']} a frame", {"flicker": 1e-4}, FOLLOW)
def test_steady_under_pan(trial: Trial) -> dict[str, float]:
    return steadiness(trial, "pan")


@hard_case("T2", "Turning, shadows stay on the ground", f"{MOVES['yaw']} a frame", {"flicker": 1e-4}, FOLLOW)
def test_steady_under_yaw(trial: Trial) -> dict[str, float]:
    return steadiness(trial, "yaw")


@hard_case("T3", "Zooming, shadows stay on the ground", f"{MOVES['zoom']} a frame", {"flicker": 1e-4}, FOLLOW)
def test_steady_under_zoom(trial: Trial) -> dict[str, float]:
    return steadiness(trial, "zoom")


@hard_case(
    "T4",
    "A perspective map, whose texels follow the camera, shimmers by less than a texel",
    "the same moves of pan, yaw and zoom",
    {"pan": 3e-3, "yaw": 3e-3, "zoom": 3e-3},
    ("perspective_shadow_map",),
)
def test_shimmer_of_a_perspective_map(trial: Trial) -> dict[str, float]:
    return {kind: steadiness(trial, kind)["flicker"] for kind in MOVES}


@hard_case(
    "H6",
    "Shifts of a map by whole pixels move no shadow",
    "600 shifts of a map whose pixels lie between the nodes",
    {"flicker": 0.0},
    ("shadow_map", "perspective_shadow_map"),
)
def test_whole_pixel_shifts(trial: Trial) -> dict[str, float]:
    return {"flicker": _whole_pixel_flicker(trial)}


@hard_case(
    "T5",
    "What is drawn in the view itself, or along lines through its middle, moves next to no shadow",
    "the same shifts by whole pixels, 60 of them",
    {"flicker": 1e-4},
    ("shadow_volume", "hybrid", "planar", "sweep"),
)
def test_whole_pixel_shifts_without_texels(trial: Trial) -> dict[str, float]:
    """Corners snap to a grid of 1/256 pixel that moves with the view, and sweep lines run through the view's middle. A pixel
    whose centre lies on an edge, or whose ray grazes a ridge, may have either class. Such pixels are truth's own boundary.
    """
    return {"flicker": _whole_pixel_flicker(trial)}


def _whole_pixel_flicker(trial: Trial) -> float:
    """Return the largest FK of whole-pixel shifts: the overlap has the same points, and each frame has a plan of its own.

    Algorithms without texels get 60 shifts only.
    """
    scene = site(trial)
    px, size = (256, 512) if trial.thorough else (128, 128)
    view = scene.view(bounds=(-100.3, -99.1, 91.7, 92.9), size=(px, px))
    assert isinstance(view, MapView) and not view.on_nodes
    count = (600 if trial.algorithm == "shadow_map" else 60) if trial.thorough else 4
    shifts = np.random.default_rng(5).integers(-3, 4, (count, 2))
    one, worst = trial.see(scene, view, map_size=size), 0.0
    for rows, cols in shifts.tolist():
        other = trial.see(scene, one.view.part(rows, cols, px, px), map_size=size)
        before, after = one.dark[_shared(rows, px), _shared(cols, px)], other.dark[_shared(-rows, px), _shared(-cols, px)]
        assert 0.02 < before.mean() < 0.98, "light and shadow"
        worst = max(worst, float((before != after).mean()))
        one = other
    return worst


def _shared(shift: int, px: int) -> slice:
    """Return the slice of a side that is still visible after a shift."""
    return slice(max(shift, 0), px + min(shift, 0))


@hard_case(
    "H7",
    "A camera that turns round keeps its texels' sizes, but for steps of a ladder",
    "yaw of 360 degrees in steps of 0.01",
    {"off the ladder": 0.0, "flicker": 1e-4, "frames that step": 0.02},
    ("shadow_map",),
)
def test_a_full_turn(trial: Trial) -> dict[str, float]:
    """A map is fitted to the visible ground, and a turn shows other ground. One size for every direction would be that of the
    whole circle, with texels several times as wide.

    So sizes are constant but for steps by the fourth root of 2. Frames with such a step are rare, and nothing flickers between
    steps. The test draws a run of frames every 10 degrees.
    """
    scene = site(trial, sun=(237.0, 30.0))
    view = scene.view("oblique", size=(128, 96))
    up = scene.world.earth_from_anchor[:, 2]
    frames, off, steps, shares = 0, 0, 0, []
    for degree in range(0, 360, 10 if trial.thorough else 60):
        before = None
        for frame in range(20 if trial.thorough else 5):
            near = turned(view, up, degree + 0.01 * frame)
            facts = describe(scene, near)
            if not facts.bands:
                continue
            chosen = make_plan(facts, scene.loaded.level, {"algorithm": "shadow_map", "map_size": 256, "cascades": 1})
            texel_m = np.array(chosen.settings["sun"]["relief"].cascades[0].texel_m)
            rungs = np.log(texel_m * (256 - 2 * MAP_BORDER_TEXELS)) / np.log(EXTENT_STEP)
            off += not np.abs(rungs - np.rint(rungs)).max() < 1e-9
            frames, steps = frames + 1, steps + (before is not None and before != texel_m.tolist())
            before = texel_m.tolist()
        pair = [turned(view, up, degree + 0.01 * frame) for frame in (0, 1)]
        if geometry_buffer(scene, pair[0]).valid.mean() > 0.3:
            shares += map_flickers(trial, scene, pair, map_size=256)
    assert frames >= 20 and len(shares) > 2
    return {"off the ladder": off / frames, "flicker": float(np.mean(shares)), "frames that step": steps / frames}
