"""Sheets: quads are split along the higher diagonal, so that no direction is preferred."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skugga.terrain.casters.rays import RayScene
from skugga.terrain.ground.sheet import Sheet, diagonal_cuts, sheet_of, sheet_triangles

UNIT_SQUARE_CORNERS = [(0, 0), (0, 1), (1, 0), (1, 1)]
"""Rows and columns of a quad's corners: NW, NE, SW, SE."""

HEIGHTS = arrays(np.int8, st.tuples(st.integers(2, 6), st.integers(2, 6)), elements=st.integers(-3, 5))
"""Few different heights, so that some quads are planar; the lowest stands for a missing node."""


def nodes_of(height: np.ndarray) -> np.ndarray:
    """Return nodes (rows, cols, 3) at 1 m spacing: rows run south, columns east."""
    row, col = np.mgrid[: height.shape[0], : height.shape[1]].astype(float)
    return np.stack([col, -row, height], axis=-1)


def height_at(sheet: Sheet, x: float, y: float) -> float:
    """Return the height of the first triangle that contains a place, borders included."""
    for o, a, b in sheet.position_frame_m.reshape(-1, 3)[sheet.triangles]:
        u, v = np.linalg.solve(np.stack([a - o, b - o], axis=1)[:2], [x - o[0], y - o[1]])
        if min(u, v, 1.0 - u - v) >= -1e-9:
            return float(o[2] + u * (a[2] - o[2]) + v * (b[2] - o[2]))
    return np.nan


@pytest.mark.parametrize("is_cut_nw_se", [False, True])
def test_triangles_of_either_cut_face_up_and_cover_the_sheet(is_cut_nw_se):
    triangles = sheet_triangles(np.full((3, 4), is_cut_nw_se))
    assert triangles.dtype == np.int32 and len(triangles) == 2 * 3 * 4
    row, col = np.divmod(triangles, 5)
    x, y = col.astype(float), -row.astype(float)
    area = ((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])) / 2
    assert (area == 0.5).all()
    diagonal, other = ((0, 6), (1, 5)) if is_cut_nw_se else ((1, 5), (0, 6))  # of the first quad
    corners = [set(triangle) for triangle in triangles.tolist()]
    assert sum(set(diagonal) <= node_set for node_set in corners) == 2 and not any(set(other) <= node_set for node_set in corners)
    # The two triangles of a quad contain its four corners; the northern one comes first.
    for n, (north, south) in enumerate(zip(corners[::2], corners[1::2], strict=True)):
        northwest = n // 4 * 5 + n % 4
        assert north | south == {northwest, northwest + 1, northwest + 5, northwest + 6}
        assert {northwest, northwest + 1} <= north and {northwest + 5, northwest + 6} <= south


def test_diagonal_with_the_higher_ends_is_the_cut():
    for height, is_cut_nw_se in (
        ([[1, 0], [0, 0]], True),
        ([[0, 0], [0, 1]], True),
        ([[0, 1], [0, 0]], False),
        ([[0, 0], [1, 0]], False),
        ([[5, 3], [3, 2]], True),
        ([[5, 4], [4, 2]], False),
        ([[-1, 0], [0, 0]], False),
    ):
        assert diagonal_cuts(np.array(height, np.float32)).tolist() == [[is_cut_nw_se]], height


@given(
    height=arrays(np.float64, (2, 2), elements=st.floats(-1000, 1000)),
    place=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_surface_is_the_higher_of_the_two_cuts(height, place):
    """The surface is the upper hull of the four corners everywhere in a quad."""
    x, y = place[0], -place[1]
    nodes = nodes_of(height)
    rising, falling = (height_at(Sheet(nodes, np.array([[is_cut_nw_se]])), x, y) for is_cut_nw_se in (False, True))
    assert height_at(sheet_of(nodes), x, y) == pytest.approx(max(rising, falling), abs=1e-9)


@given(
    corners=st.tuples(*[st.integers(-100, 100)] * 3),
    place=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_planar_quad_is_equal_for_both_cuts(corners, place):
    nw, ne, sw = corners
    x, y = place[0], -place[1]
    nodes = nodes_of(np.array([[nw, ne], [sw, ne + sw - nw]], float))
    expected = nw + x * (ne - nw) - y * (sw - nw)
    for is_cut_nw_se in (False, True):
        assert height_at(Sheet(nodes, np.array([[is_cut_nw_se]])), x, y) == pytest.approx(expected, abs=1e-9)


def triangle_positions(sheet: Sheet, plane: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> set[frozenset[tuple[int, int]]]:
    """Return the triangles of quads that are not ``plane``, as places of their nodes in ``rows`` and ``cols``."""
    quads = sheet_triangles(sheet.is_cut_nw_se).reshape(-1, 2, 3)
    bent_triangles = {frozenset(map(int, triangle)) for triangle in quads[~plane.ravel()].reshape(-1, 3)}
    place = list(zip(rows.ravel().tolist(), cols.ravel().tolist(), strict=True))
    return {
        frozenset(place[node] for node in triangle)
        for triangle in sheet.triangles.tolist()
        if frozenset(triangle) in bent_triangles
    }


@given(height=HEIGHTS, turned=st.booleans(), down=st.sampled_from([1, -1]), right=st.sampled_from([1, -1]))
def test_triangles_follow_rotation_and_mirroring(height, turned, down, right):
    """All eight symmetries, also beside holes. Planar quads are left out because both cuts are right."""
    height = np.where(height < -2, np.nan, height.astype(float))
    rows, cols = np.indices(height.shape)
    triangle_sets = []
    for transformed in (lambda v: v, lambda v: (v.T if turned else v)[::down, ::right]):
        heights = transformed(height)
        plane = heights[:-1, :-1] + heights[1:, 1:] == heights[:-1, 1:] + heights[1:, :-1]
        triangle_sets.append(triangle_positions(sheet_of(nodes_of(heights)), plane, transformed(rows), transformed(cols)))
    assert triangle_sets[0] == triangle_sets[1]


@given(height=arrays(np.float64, (5, 7), elements=st.floats(-1000, 1000)))
def test_cuts_of_mirrored_ground_are_mirrored(height):
    is_bent = height[:-1, :-1] + height[1:, 1:] != height[:-1, 1:] + height[1:, :-1]
    cuts = diagonal_cuts(height)
    np.testing.assert_array_equal(diagonal_cuts(height[:, ::-1])[:, ::-1][is_bent], ~cuts[is_bent])
    np.testing.assert_array_equal(diagonal_cuts(height[::-1])[::-1][is_bent], ~cuts[is_bent])
    np.testing.assert_array_equal(diagonal_cuts(height[::-1, ::-1])[::-1, ::-1][is_bent], cuts[is_bent])
    np.testing.assert_array_equal(diagonal_cuts(height.T).T[is_bent], cuts[is_bent])


@given(height=arrays(np.float64, (2, 2), elements=st.floats(-1000, 1000)), missing=st.sets(st.sampled_from(range(4))))
def test_three_corners_are_a_triangle_and_two_are_none(height, missing):
    for corner in missing:
        height[UNIT_SQUARE_CORNERS[corner]] = np.nan
    triangles = [set(triangle) for triangle in sheet_of(nodes_of(height)).triangles.tolist()]
    if not missing:
        assert len(triangles) == 2 and triangles[0] | triangles[1] == set(range(4))
    elif len(missing) == 1:
        assert triangles == [set(range(4)) - missing]
    else:
        assert triangles == []


@pytest.mark.parametrize("ridge_line", ["falling diagonal", "rising diagonal", "row", "column"])
def test_ridge_of_one_node_has_no_gaps(ridge_line):
    """In any direction, horizontal rays from both sides hit the ridge up to its crest, at its nodes and between them."""
    side, crest_m = 12, 10.0
    row, col = np.indices((side, side))
    on_ridge = {"falling diagonal": row == col, "rising diagonal": row + col == side - 1, "row": row == 6, "column": col == 6}[
        ridge_line
    ]
    sheet = sheet_of(nodes_of(np.where(on_ridge, crest_m, 0.0)))
    rays = RayScene([sheet])
    ends = sheet.position_frame_m[on_ridge][[0, -1]]
    crest = ends[0] + np.linspace(0.1, 0.9, 81)[:, None] * (ends[1] - ends[0])
    ridge_direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    cross_direction, up = np.array([-ridge_direction[1], ridge_direction[0], 0.0]), np.array([0.0, 0.0, 1.0])
    for direction in (
        cross_direction,
        -cross_direction,
        0.8 * cross_direction + 0.6 * ridge_direction,
        0.8 * cross_direction - 0.6 * ridge_direction,
    ):
        start = crest - 1.5 * direction
        assert rays.is_blocked(start - 0.01 * up, direction).all()
        assert not rays.is_blocked(start + 0.01 * up, direction).any()
    assert rays.is_blocked(crest - 0.01 * up, up).all()  # from below
    inside = ends[0] + 0.05 * (ends[1] - ends[0]) - 0.01 * up
    assert not rays.is_blocked(
        inside[None], ridge_direction, np.array([0.9 * np.linalg.norm(ends[1] - ends[0])])
    ).any()  # along the ridge: no gap


def test_cuts_use_heights_and_not_bent_nodes():
    """A saddle on ground that falls away with the curvature: the heights above the ground decide."""
    height = np.array([[0.0, 1.0], [1.0, 0.0]])
    bent_nodes = nodes_of(height)
    bent_nodes[0, 1, 2] -= 5.0
    assert sheet_of(bent_nodes, height).is_cut_nw_se.tolist() == [[False]] and sheet_of(bent_nodes).is_cut_nw_se.tolist() == [
        [True]
    ]


@given(height=HEIGHTS)
def test_normals_are_those_of_the_triangles(height):
    height = np.where(height < -2, np.nan, height.astype(float))
    sheet = sheet_of(nodes_of(height))
    normals = sheet.normals_frame
    assert normals.shape == (height.shape[0] - 1, height.shape[1] - 1, 2, 3) and normals.dtype == np.float32
    o, a, b = sheet.position_frame_m.reshape(-1, 3)[sheet_triangles(sheet.is_cut_nw_se)].transpose(1, 0, 2)
    expected = np.cross(a - o, b - o)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(normals.reshape(-1, 3), expected, atol=1e-6)
    assert np.isfinite(normals).all(axis=-1).sum() == len(sheet.triangles)


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (1, 5), (5, 1)])
def test_single_row_or_column_has_no_triangle(shape):
    sheet = sheet_of(nodes_of(np.zeros(shape)))
    assert sheet.is_cut_nw_se.size == 0 and sheet.triangles.shape == (0, 3)
