"""Rectangles of marked tiles and culled faces: neither changes a count."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassRecord
from skugga.shadows.volumes import drawing as volume_drawing
from skugga.shadows.volumes.drawing import count_volumes
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.shadows.volumes.tiles import CULLING_TILE_PX, CulledFaces, covering_rectangles, cull_faces, depth_bounds, marked_tiles
from skugga.shadows.volumes.volumes import volumes_of
from tests.shadows.boxes import box, build_mesh_scene
from tests.shadows.volumes.test_shadow_volume import ShadowCase, eye_views, join_meshes, shadow_case, top_view

SIZES = st.tuples(st.integers(1, 90), st.integers(1, 90))
SEEDS = st.integers(0, 2**32 - 1)


def random_pixels(size: tuple[int, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of a picture: none, few, clustered, or all over."""
    rng = np.random.default_rng(seed)
    middle, spread = rng.random((rng.integers(0, 4), 2)), rng.choice([0.0, 0.02, 0.3])
    points = (middle[:, None] + rng.normal(0, spread, (len(middle), rng.integers(1, 60), 2))).reshape(-1, 2)
    pixels = np.clip(points, 0.0, 1.0 - 1e-9) * size
    return pixels[:, 0].astype(int), pixels[:, 1].astype(int)


@given(SIZES, SEEDS)
def test_rectangles_cover_each_marked_pixel_once(size, seed):
    """Rectangles are disjoint, lie inside the picture and begin at tile borders. Each holds a marked tile."""
    rows, cols = random_pixels(size, seed)
    tiles = marked_tiles(rows, cols, size)
    tile_rectangles = covering_rectangles(tiles, size, 10_000)
    cover_counts = np.zeros(size, int)
    for col, row, width, height in tile_rectangles.tolist():
        assert col % CULLING_TILE_PX == row % CULLING_TILE_PX == 0 and width > 0 and height > 0
        assert 0 <= col and col + width <= size[1] and 0 <= row and row + height <= size[0]
        cover_counts[row : row + height, col : col + width] += 1
        assert tiles[
            row // CULLING_TILE_PX : -(-(row + height) // CULLING_TILE_PX),
            col // CULLING_TILE_PX : -(-(col + width) // CULLING_TILE_PX),
        ].any()
    assert cover_counts.max(initial=0) <= 1 and (cover_counts[rows, cols] == 1).all()
    assert len(tile_rectangles) == 0 if not len(rows) else len(tile_rectangles) > 0


@given(arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12))))
def test_rectangles_cost_no_more_than_their_bounding_box(tiles):
    """The cost is the number of tiles, plus a constant for each further rectangle."""
    size = tuple(side * CULLING_TILE_PX for side in tiles.shape)
    tile_rectangles = covering_rectangles(tiles, size, 10_000)
    rows, cols = np.nonzero(tiles)
    if len(rows):
        bounding_box_cost = np.ptp(rows) * np.ptp(cols) + np.ptp(rows) + np.ptp(cols) + 1
        assert (tile_rectangles[:, 2] * tile_rectangles[:, 3]).sum() // CULLING_TILE_PX**2 + 8 * (
            len(tile_rectangles) - 1
        ) <= bounding_box_cost


@given(SIZES, SEEDS)
def test_depth_bounds_are_those_of_the_pixels(size, seed):
    rows, cols = random_pixels(size, seed)
    depth = np.random.default_rng(seed).random(len(rows))
    parts = covering_rectangles(marked_tiles(rows, cols, size), size, 10_000)
    for (col, row, width, height), (low, high) in zip(parts, depth_bounds(rows, cols, depth, parts, size), strict=True):
        inside = (row <= rows) & (rows < row + height) & (col <= cols) & (cols < col + width)
        assert inside.any() and low == depth[inside].min() and high == depth[inside].max()


# -- culling of faces


def triangle_coverage(points: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a triangle (3, 4) of homogeneous x, y, z, w covers pixels (n,), its depth there, and its turn (+1, -1, 0).

    By the plane through the corners and the eye: with M the matrix of their (x, y, w), the weights are M^-T (x, y, 1).
    """
    matrix = points[:, [0, 1, 3]]
    orientation = np.sign(np.linalg.det(matrix)) if matrix[:, 2].any() else 0.0
    if orientation == 0:
        return np.zeros(len(x), bool), np.zeros(len(x)), orientation
    weights = np.linalg.solve(matrix.T, np.stack([x, y, np.ones(len(x))]))
    return (weights > 0).all(axis=0), weights.T @ points[:, 2], orientation


@given(SEEDS, st.booleans(), st.booleans())
def test_cull_faces_keeps_every_count(seed, behind, clamped):
    """Triangles lie before, behind and beside the eye, with corners at infinity.

    In each pixel of a rectangle, at any depth within the bounds, the kept faces and the constant give the whole count. Nothing is
    drawn before the near plane, at depth 1, unless depths are clamped.
    """
    rng = np.random.default_rng(seed)
    size = 40, 56
    clip = rng.normal(0, 1, (24, 4)) * [2, 2, 1, 1]
    clip[:8, 3] *= 0.0  # at infinity
    clip[8:16, :2] *= 20.0
    faces = np.array([rng.choice(len(clip), 3, replace=False) for _ in range(30)], np.int32)
    rows, cols = random_pixels(size, seed)
    near = np.inf if clamped else 1.0
    depth = rng.uniform(0.1, 2.0 if clamped else 0.95, len(rows))
    parts = covering_rectangles(marked_tiles(rows, cols, size), size, 10_000)
    culled = cull_faces(clip, faces, behind, parts, depth_bounds(rows, cols, depth, parts, size), size, clamped)
    x, y = (cols + 0.5) / size[1] * 2 - 1, (rows + 0.5) / size[0] * 2 - 1
    counts = np.zeros((len(faces), len(rows)), int)
    for number, face in enumerate(faces):
        is_covered, face_depth, orientation = triangle_coverage(clip[face], x, y)
        counts[number] = (
            is_covered
            * (face_depth <= depth if behind else (face_depth > depth) & (face_depth <= near))
            * (orientation if behind else -orientation)
        )
    for number, (col, row, width, height) in enumerate(parts.tolist()):
        inside = (row <= rows) & (rows < row + height) & (col <= cols) & (cols < col + width)
        kept_faces = culled.face_numbers[culled.rectangle_starts[number] : culled.rectangle_starts[number + 1]]
        assert len(np.unique(kept_faces)) == len(kept_faces)
        np.testing.assert_array_equal(
            counts[kept_faces][:, inside].sum(axis=0) + culled.added_layers[number], counts[:, inside].sum(axis=0)
        )


def all_faces(
    clip: np.ndarray,
    faces: np.ndarray,
    counts_behind: bool,
    tile_rectangles: np.ndarray,
    depths: np.ndarray,
    size: tuple[int, int],
    clamped: bool,
) -> CulledFaces:
    """Return all faces in every rectangle."""
    rectangle_count, face_count = len(tile_rectangles), len(faces)
    return CulledFaces(
        np.tile(np.arange(face_count, dtype=np.int32), rectangle_count),
        np.arange(rectangle_count + 1) * face_count,
        np.zeros(rectangle_count, np.int64),
    )


def stencil_counts(case: ShadowCase, pixel_mask: np.ndarray, is_marked: bool, counting: Any = "auto") -> np.ndarray:
    """Return the number of shadow volumes that contain each point of ``pixel_mask`` (rows, cols).

    ``is_marked`` restricts counting to the mask by a bit of the stencil.
    """
    light = np.array(case.scene.light_position(case.light, case.buffer.frame))
    volumes = volumes_of(case.buffer, case.scene, light, case.scene.objects.caster_kinds, case.casters, PassRecord("volumes"))
    return count_volumes(
        case.buffer, case.scene, light, volumes, VolumeSettings(counting=counting), pixel_mask, is_marked, PassRecord("stencil")
    )


def random_objects(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return boxes, wires, holed spheres and loose triangles, and a pebble on the ground."""
    parts = [box((0.1, 0.1, 0.1), at_m=(25, 25))]
    for _ in range(rng.integers(1, 6)):
        east, north = rng.uniform(-8, 8, 2)
        ball = trimesh.creation.icosphere(1, rng.uniform(0.5, 3))
        ball.apply_translation([east, north, 3.5])
        holed = trimesh.Trimesh(ball.vertices, ball.faces[rng.random(len(ball.faces)) < 0.8], process=False)
        loose_triangles = trimesh.Trimesh(
            rng.uniform(-4, 4, (9, 3)) + [east, north, 4.5], np.arange(9).reshape(-1, 3), process=False
        )
        boxes = [box(tuple(rng.uniform(0.2, 6, 3)), at_m=(east, north)), box((0.02, 0.02, 6.0), at_m=(east, north))]
        parts.append([*boxes, holed, loose_triangles][rng.integers(0, 4)])
    return join_meshes(*parts)


@pytest.mark.parametrize("seed", range(12))
def test_stencil_counts_equal_those_of_all_faces(gl, tmp_path, monkeypatch, seed):
    """Volumes, lights and eyes are random. Drawing all faces everywhere gives the same number in every pixel."""
    rng = np.random.default_rng(seed)
    kind = ("sun", "spot", "omni")[seed % 3]
    position = [*rng.uniform(-10, 10, 2), rng.uniform(12, 25)]
    lamp = {"kind": kind, "position": position} | ({"target": [0, 0, 1], "cutoff": 60} if kind == "spot" else {})
    keys = {} if kind == "sun" else {"sun": "none", "lights": {"lamp": lamp}}
    start, target = (*rng.uniform(-14, 14, 2), rng.uniform(0.2, 10)), (*rng.uniform(-6, 6, 2), rng.uniform(0, 4))
    views = eye_views(start, target, fov=rng.uniform(30, 100))
    scene = build_mesh_scene(tmp_path, [random_objects(rng)], rng.uniform(0, 360), rng.choice([2.0, 35.0, 80.0]), **views, **keys)
    for case in (shadow_case(scene), shadow_case(scene, top_view(scene, 12.0, 70))):
        lit = case.buffer.valid & ~attached_shadow_mask(case.buffer, scene, case.light)
        sparse = lit & (rng.random(lit.shape) < 0.01)
        for pixel_mask, is_marked, counting in ((lit, False, "auto"), (lit, False, "z_fail"), (sparse, True, "auto")):
            with monkeypatch.context() as patch:
                culled_counts = stencil_counts(case, pixel_mask, is_marked, counting)
                patch.setattr(volume_drawing, "cull_faces", all_faces)
                full_counts = stencil_counts(case, pixel_mask, is_marked, counting)
            np.testing.assert_array_equal(culled_counts[pixel_mask], full_counts[pixel_mask])
            assert (culled_counts[~pixel_mask] == 0).all()


def test_stencil_counts_ignore_faces_before_the_near_plane(gl, tmp_path, monkeypatch):
    lamp = {"kind": "omni", "position": [-6, -12, 18]}
    body = join_meshes(box((8, 6, 5)), box((0.3, 0.3, 0.01), 6.1, (10, 20)))
    case = shadow_case(
        build_mesh_scene(tmp_path, [body], 0, 0, **eye_views((10, 20, 6.05), (0, 2, 0)), sun="none", lights={"lamp": lamp})
    )
    lit = case.buffer.valid & ~attached_shadow_mask(case.buffer, case.scene, case.light)
    culled_counts = stencil_counts(case, lit, False)
    monkeypatch.setattr(volume_drawing, "cull_faces", all_faces)
    np.testing.assert_array_equal(culled_counts, stencil_counts(case, lit, False))
