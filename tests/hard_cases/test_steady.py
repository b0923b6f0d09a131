"""Temporal stability: a camera that moves, turns or zooms does not change the shadows on the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import perspective_shadow_map
from skugga.shadows.maps.drawing import draw_map
from skugga.shadows.maps.lookup import look_up
from skugga.shadows.maps.resolve import EXTENT_ROUNDING_FACTOR
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
from tests.hard_cases.cases import FIND_CANDIDATES, MAP_ALGORITHMS, PERSPECTIVE_MAP_ALGORITHMS, RenderedView, Trial, hard_case
from tests.hard_cases.sites import site
from tests.metrics import flicker

# -- fixed points, seen from two views


def frame_flickers(frames: list[RenderedView]) -> list[float]:
    """Return the flicker of each pair of frames: over the points that both show, at the nearest pixel of the next frame."""
    shares = []
    for frame, next_frame in zip(frames, frames[1:], strict=False):
        visible, row, col = _pixels_of(frame, next_frame)
        comparable = visible & frame.truth.decidable & next_frame.truth.decidable[row, col]
        assert comparable.mean() > 0.3 and 0.02 < frame.dark[comparable].mean() < 0.98, "points in light and shadow"
        shares.append(flicker(frame.dark, next_frame.dark[row, col], ~frame.truth.lit, ~next_frame.truth.lit[row, col], comparable))
    return shares


def _pixels_of(first_picture: RenderedView, other_picture: RenderedView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project a picture's points into another one: whether they are visible, and the nearest pixel's row and column."""
    frame, view = first_picture.buffer.frame, other_picture.view
    assert isinstance(view, PerspectiveView)
    earth_m = first_picture.buffer.position_frame_m @ frame.frame_from_earth + frame.origin_earth_m
    right_m, down_m, depth_m = np.moveaxis((earth_m - view.eye_earth_m) @ view.earth_from_camera, -1, 0)
    pixel = [(v / depth_m * view.focal_px - first) / view.step_px for v, first in ((down_m, view.row0), (right_m, view.col0))]
    visible = first_picture.buffer.valid & (depth_m > 0.0)
    row, col = (np.where(visible, np.rint(v), -1).astype(int) for v in pixel)
    visible &= (row >= 0) & (row < view.rows) & (col >= 0) & (col < view.cols)
    row, col = np.where(visible, row, 0), np.where(visible, col, 0)
    beside_m = (
        other_picture.buffer.position_frame_m[row, col] @ other_picture.buffer.frame.frame_from_earth
        + other_picture.buffer.frame.origin_earth_m
    )
    apart_px = np.linalg.norm(beside_m - earth_m, axis=-1) / (depth_m * view.pixel_tangent)
    return visible & other_picture.buffer.valid[row, col] & (apart_px < 4.0), row, col


def rotate_camera(view: PerspectiveView, up_earth: np.ndarray, turn_deg: float) -> PerspectiveView:
    """Return the camera turned to the left about the vertical."""
    x, y, z = up_earth
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle_rad = np.radians(turn_deg)
    rotation = np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
    return replace(view, earth_from_camera=rotation @ view.earth_from_camera)


def move_camera(kind: str, scene: Scene, view: PerspectiveView, frame: int) -> PerspectiveView:
    """Return a view after some frames of 0.1 px of pan, 0.01 degrees of yaw or 1 % of zoom each."""
    if kind == "pan":
        return view.shifted(0.07 * frame, 0.07 * frame)
    if kind == "yaw":
        return rotate_camera(view, scene.world.earth_from_anchor[:, 2], 0.01 * frame)
    return replace(view, focal_px=view.focal_px * 1.01**frame)


def steadiness(trial: Trial, kind: str) -> dict[str, float]:
    """Return the mean flicker over the frames of a move, all drawn by the first one's plan.

    Where truth must be computed, only a few frames are compared.
    """
    scene, is_map = site(trial), trial.algorithm in MAP_ALGORITHMS
    view = scene.view("oblique", size=(320, 240) if trial.thorough else (128, 96))
    count = (40 if is_map else 4) if trial.thorough else 3
    views, size = [move_camera(kind, scene, view, frame) for frame in range(count)], 1024 if trial.thorough else 256
    if is_map:
        return {"flicker": float(np.mean(map_flickers(trial, scene, views, map_size=size)))}
    return {
        "flicker": float(np.mean(frame_flickers([trial.render_view(scene, moved_view, map_size=size) for moved_view in views])))
    }


def map_flickers(trial: Trial, scene: Scene, views: list[PerspectiveView], **options: object) -> list[float]:
    """Return the flicker of each pair of frames of an algorithm with one map.

    The frame's own points are looked up in both maps. Truth cannot change, since the points are the same.
    """
    shares = []
    frames = [trial.render_view(scene, view, cascades=1, **options) for view in views]
    (step,) = frames[0].plan.steps
    for frame, next_frame in zip(frames, frames[1:], strict=False):
        visible, _, _ = _pixels_of(frame, next_frame)
        dark, next_dark = (_shadow_of_map(scene, step, drawn_frame.buffer, frame.buffer) for drawn_frame in (frame, next_frame))
        assert 0.02 < dark[visible].mean() < 0.98, "points in light and shadow"
        shares.append(flicker(dark, next_dark, np.zeros_like(dark), np.zeros_like(dark), visible))
    return shares


def _shadow_of_map(scene: Scene, step: Step, drawn_for: GeometryBuffer, points: GeometryBuffer) -> np.ndarray:
    """Return which points of a buffer (rows, cols) are in shadow by the map of another buffer in the same frame."""
    assert drawn_for.frame is points.frame and step.settings is not None
    turned_away = attached_shadow_mask(drawn_for, scene), attached_shadow_mask(points, scene)
    if isinstance(step.settings, ShadowMapSettings):
        (depth_map,) = sun_maps(drawn_for, scene, step.settings, None)
    else:
        receivers = drawn_for.valid & ~turned_away[0]
        find_candidates = FIND_CANDIDATES[step.algorithm]
        depth_map = perspective_shadow_map.perspective_map(
            drawn_for, receivers, scene, step.light, step.settings, None, find_candidates
        ).depth_map
    gl, record, visibility = device(), PassRecord("map"), np.ones(points.valid.shape, np.float32)
    target = draw_map(gl, depth_map, drawn_for, scene, step.kinds, find_casters(scene, drawn_for), step.settings, record)
    pixels = np.flatnonzero(points.valid & ~turned_away[1])
    look_up(
        gl,
        replace(depth_map, point_indices=pixels),
        target,
        points,
        scene.light_position(step.light, points.frame),
        step.settings,
        visibility,
        record,
    )
    return (visibility < 0.5) | turned_away[1]


MOVES = {"pan": "0.1 px of pan", "yaw": "0.01 degrees of yaw", "zoom": "1 % of zoom"}
STEADY_ALGORITHMS = ("shadow_map", "shadow_volume", "hybrid", "planar", "sweep")


@hard_case("T1", "Panning, shadows stay on the ground", f"{MOVES['pan']} a frame", {"flicker": 1e-4}, STEADY_ALGORITHMS)
def test_steady_under_pan(trial: Trial) -> dict[str, float]:
    return steadiness(trial, "pan")


@hard_case("T2", "Turning, shadows stay on the ground", f"{MOVES['yaw']} a frame", {"flicker": 1e-4}, STEADY_ALGORITHMS)
def test_steady_under_yaw(trial: Trial) -> dict[str, float]:
    return steadiness(trial, "yaw")


@hard_case("T3", "Zooming, shadows stay on the ground", f"{MOVES['zoom']} a frame", {"flicker": 1e-4}, STEADY_ALGORITHMS)
def test_steady_under_zoom(trial: Trial) -> dict[str, float]:
    return steadiness(trial, "zoom")


@hard_case(
    "T4",
    "A perspective map, whose texels follow the camera, shimmers by less than a texel",
    "the same moves of pan, yaw and zoom",
    {"pan": 3e-3, "yaw": 3e-3, "zoom": 3e-3},
    PERSPECTIVE_MAP_ALGORITHMS,
)
def test_shimmer_of_a_perspective_map(trial: Trial) -> dict[str, float]:
    return {kind: steadiness(trial, kind)["flicker"] for kind in MOVES}


@hard_case(
    "H6",
    "Shifts of a map by whole pixels move no shadow",
    "600 shifts of a map whose pixels lie between the nodes",
    {"flicker": 0.0},
    MAP_ALGORITHMS,
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
    """Return the largest flicker of whole-pixel shifts: the overlap has the same points, and each frame has a plan of its own.

    Algorithms without texels get 60 shifts only.
    """
    scene = site(trial)
    px, size = (256, 512) if trial.thorough else (128, 128)
    view = scene.view(bounds=(-100.3, -99.1, 91.7, 92.9), size=(px, px))
    assert isinstance(view, MapView) and not view.is_on_nodes
    count = (600 if trial.algorithm == "shadow_map" else 60) if trial.thorough else 4
    shifts = np.random.default_rng(5).integers(-3, 4, (count, 2))
    picture, worst = trial.render_view(scene, view, map_size=size), 0.0
    for rows, cols in shifts.tolist():
        next_picture = trial.render_view(scene, picture.view.part(rows, cols, px, px), map_size=size)
        before, after = (
            picture.dark[_shared_slice(rows, px), _shared_slice(cols, px)],
            next_picture.dark[_shared_slice(-rows, px), _shared_slice(-cols, px)],
        )
        assert 0.02 < before.mean() < 0.98, "light and shadow"
        worst = max(worst, float((before != after).mean()))
        picture = next_picture
    return worst


def _shared_slice(shift: int, px: int) -> slice:
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
    frames, off_ladder_count, step_count, shares = 0, 0, 0, []
    for degree in range(0, 360, 10 if trial.thorough else 60):
        before = None
        for frame in range(20 if trial.thorough else 5):
            turned_view = rotate_camera(view, up, degree + 0.01 * frame)
            facts = describe(scene, turned_view)
            if not facts.bands:
                continue
            plan = make_plan(facts, scene.loaded.level, {"algorithm": "shadow_map", "map_size": 256, "cascades": 1})
            texel_m = np.array(plan.settings["sun"]["relief"].cascades[0].texel_m)
            rungs = np.log(texel_m * (256 - 2 * MAP_BORDER_TEXELS)) / np.log(EXTENT_ROUNDING_FACTOR)
            off_ladder_count += not np.abs(rungs - np.rint(rungs)).max() < 1e-9
            frames, step_count = frames + 1, step_count + (before is not None and before != texel_m.tolist())
            before = texel_m.tolist()
        pair = [rotate_camera(view, up, degree + 0.01 * frame) for frame in (0, 1)]
        if geometry_buffer(scene, pair[0]).valid.mean() > 0.3:
            shares += map_flickers(trial, scene, pair, map_size=256)
    assert frames >= 20 and len(shares) > 2
    return {"off the ladder": off_ladder_count / frames, "flicker": float(np.mean(shares)), "frames that step": step_count / frames}
