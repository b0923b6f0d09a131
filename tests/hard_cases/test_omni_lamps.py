"""A lamp that shines all round: its six maps join without a seam, and what stands behind it throws no shadow before it."""

from __future__ import annotations

from itertools import product

import numpy as np
import trimesh

from skugga.shadows.maps.settings import LampMapSettings
from skugga.shadows.maps.windows import CUBE_FACES, MAP_BORDER_TEXELS
from skugga.shadows.reconstruction.settings import ReconstructionSettings
from skugga.shadows.truth.metrics import MetricCoverage
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from tests.hard_cases.bodies import FLOOR, eye, join_meshes
from tests.hard_cases.cases import RenderedView, Trial, hard_case
from tests.hard_cases.reach_of_error import STENCIL_PX

LAMP_M = np.array([0.3, -0.2, 6.1])

HALF_SIDE_M, CEILING_M = 8.0, 12.0
"""Half the side of the room round the lamp, and the height of its ceiling."""

MAP_TEXELS = 512

TEXEL_REACH = 1.0 + 1.0 / 64.0
"""Reach of a lamp's map in texels: half a texel to the centre of the texel that holds the point, and half a texel by which the
bias moves points whose triangle ends before that centre; and the rasteriser's grid of 1/256 texel, as for ``GRID_TEXELS``, for
both."""

MIN_FACE_SHADOW_PX = 20
"""Each of the six maps must throw at least so many pixels of shadow, all pictures together."""


def boxes_round_the_lamp() -> list[np.ndarray]:
    """Return 26 boxes, low and high corner each: before the middles, the edges and the corners of the six maps."""
    boxes = []
    for direction in product((-1.0, 0.0, 1.0), repeat=3):
        if any(direction):
            centre = LAMP_M + 3.6 * np.array(direction) / np.linalg.norm(direction)
            half = np.array([0.31, 0.27, 0.23]) * (1.0 + 0.1 * direction[0])
            boxes.append(np.stack([centre - half, centre + half]))
    return boxes


def room_with(boxes: list[np.ndarray]) -> trimesh.Trimesh:
    """Return four walls, a ceiling and the boxes as one body, which stands on the floor."""
    side, top = HALF_SIDE_M, CEILING_M
    walls = [
        [[-side - 1.0, -side - 1.0, 0.0], [side + 1.0, -side, top + 1.0]],
        [[-side - 1.0, side, 0.0], [side + 1.0, side + 1.0, top + 1.0]],
        [[-side - 1.0, -side, 0.0], [-side, side, top + 1.0]], [[side, -side, 0.0], [side + 1.0, side, top + 1.0]],
        [[-side, -side, top], [side, side, top + 1.0]],
    ]  # fmt: skip
    return join_meshes(*(trimesh.creation.box(bounds=np.asarray(bounds)) for bounds in [*walls, *boxes]))


def segments_are_blocked(points: np.ndarray, boxes: list[np.ndarray]) -> np.ndarray:
    """Return which segments from points (..., 3) to the lamp meet a box (T. Kay and J. Kajiya, 1986)."""
    to_lamp = LAMP_M - points
    blocked = np.zeros(points.shape[:-1], bool)
    for low, high in boxes:
        ends = [(side - points) / to_lamp for side in (low, high)]
        entered, left = np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)
        blocked |= (left > np.maximum(entered, 0.0)) & (entered < 1.0)
    return blocked


def is_behind_a_wall(points: np.ndarray) -> np.ndarray:
    """Return which points (n, 3) lie outside of the room, where no light gets."""
    room = np.array([[-HALF_SIDE_M, -HALF_SIDE_M, 0.0], [HALF_SIDE_M, HALF_SIDE_M, CEILING_M]])
    return ((points < room[0] - 1e-6) | (points > room[1] + 1e-6)).any(axis=1)


def room_normals(points: np.ndarray) -> np.ndarray:
    """Return the unit normal (n, 3) of the room's side on which points (n, 3) lie; NaN for points on none."""
    normals = np.full(points.shape, np.nan)
    for axis, (low, high) in enumerate([(-HALF_SIDE_M, HALF_SIDE_M)] * 2 + [(0.0, CEILING_M)]):
        for place, sign in ((low, 1.0), (high, -1.0)):
            normals[np.abs(points[:, axis] - place) < 1e-3] = sign * np.eye(3)[axis]
    return normals


def face_of(points: np.ndarray, frame_from_face: np.ndarray) -> np.ndarray:
    """Return the number (n,) of the map that serves each point: that with the point nearest to its axis."""
    return np.argmax((points - LAMP_M) @ frame_from_face[:, :, 2].T, axis=1)


def moves_within_reach(rendered: RenderedView, points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
    """Return points (n, 3) on the room's sides within the reach of the algorithm's error from points (n, 3).

    For maps they lie up to ``TEXEL_REACH`` texels away in the map that serves the point; else up to ``STENCIL_PX`` pixels.
    """
    (step,) = rendered.plan.steps_of_light(rendered.light)
    settings = step.settings.map if isinstance(step.settings, ReconstructionSettings) else step.settings
    shares = np.linspace(-1.0, 1.0, 5)
    if not isinstance(settings, LampMapSettings):
        assert isinstance(rendered.view, PerspectiveView)
        eye_m = rendered.view.eye_earth_m
        reach_m = STENCIL_PX * np.linalg.norm(points - eye_m, axis=1) * rendered.view.pixel_tangent
        to_eye = (eye_m - points) / np.linalg.norm(eye_m - points, axis=1)[:, None]
        moved = [points + reach_m[:, None] * np.array(direction) for direction in product((-1.0, 0.0, 1.0), repeat=3)]
        return [p - (((p - points) * normals).sum(axis=1) / (to_eye * normals).sum(axis=1))[:, None] * to_eye for p in moved]
    frame_from_face = _frame_from_faces(rendered)
    axes = frame_from_face[face_of(points, frame_from_face)]
    right, up, ahead = ((points - LAMP_M)[:, None] @ axes)[:, 0].T
    size = settings.map_size
    texel = TEXEL_REACH * 2.0 * size / (size - 2 * MAP_BORDER_TEXELS) / size
    to_side = ((points - LAMP_M) * normals).sum(axis=1)
    result = []
    for i, j in product(shares, repeat=2):
        ray = np.stack([right / ahead + i * texel, up / ahead + j * texel, np.ones(len(points))], axis=-1)
        ray = (axes @ ray[..., None])[..., 0]
        result.append(LAMP_M + ray * (to_side / (ray * normals).sum(axis=1))[:, None])
    return result


def _frame_from_faces(rendered: RenderedView) -> np.ndarray:
    """Return the rotations (6, 3, 3) from the axes of the six maps to metres east, north and up."""
    lamp = rendered.scene.lamps[rendered.light]
    return np.stack([lamp.earth_from_lamp @ face.T for face in CUBE_FACES])


@hard_case(
    "L1",
    "A lamp that shines all round throws every shadow, also over the seams of its six maps",
    "a lamp in a room, among boxes before the middles, edges and corners of its six maps, seen from beside it to all sides",
    {"wrong beyond its reach": 0.0},
)
def test_a_lamp_that_shines_all_round(trial: Trial) -> dict[str, float]:
    """The boxes hover between the lamp and the sides of a room, so truth has a closed form: the segment to the lamp meets a box.

    A wrong pixel is excused if the closed form has the other answer within the algorithm's reach: a texel of the map that serves
    it, else 1/128 pixel. Planar shadows are judged on the floor.
    """
    boxes = boxes_round_the_lamp()
    targets = list(product((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)))
    targets = targets if trial.thorough else [targets[0], targets[3], targets[5]]
    at_m = LAMP_M + [0.9, 0.5, -0.7]
    scene = trial.scene(
        FLOOR, meshes=[room_with(boxes)], lights={"lamp": {"kind": "omni", "position": LAMP_M.tolist()}},
        views={str(n): eye(at_m, at_m + np.array(target) * [3.0, 2.6, 2.8], fov=100) for n, target in enumerate(targets)},
    )  # fmt: skip
    unexplained, judged, face_shadow_px = 0, 0, np.zeros(len(CUBE_FACES), int)
    for number in range(len(targets)):
        view = scene.view(str(number), size=(200, 160) if trial.thorough else (88, 72))
        rendered = trial.render_view(scene, view, map_size=MAP_TEXELS, filter=1)
        points = (rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m).reshape(-1, 3).astype(np.float64)
        normals = room_normals(points)
        in_question = rendered.buffer.valid.ravel() & np.isfinite(normals).all(axis=1)
        if trial.algorithm == "planar":
            in_question &= rendered.buffer.surface_kind.ravel() == RELIEF
        points, normals, dark = points[in_question], normals[in_question], rendered.dark.ravel()[in_question]
        true_dark = segments_are_blocked(points, boxes)
        always, never = true_dark.copy(), ~true_dark
        for moved in moves_within_reach(rendered, points, normals):
            is_dark = segments_are_blocked(moved, boxes) | is_behind_a_wall(moved)
            always &= is_dark
            never &= ~is_dark
        unexplained += int((dark & never).sum() + (~dark & always).sum())
        judged += len(points)
        faces = face_of(points, _frame_from_faces(rendered))
        face_shadow_px += np.bincount(faces[true_dark], minlength=len(CUBE_FACES))
        trial.record_coverage(
            "wrong beyond its reach",
            MetricCoverage(int(true_dark.sum()), int(always.sum()), int((dark != true_dark).sum()), int((dark | true_dark).sum())),
        )
    faces_in_question = face_shadow_px[:1] if trial.algorithm == "planar" else face_shadow_px
    assert faces_in_question.min() >= MIN_FACE_SHADOW_PX, f"shadow by map: {face_shadow_px}"
    return {"wrong beyond its reach": unexplained / judged}
