"""Edges of meshes: known counts, welding by position, and connected and closed parts."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from skugga.shadows.volumes.edges import closed_part_mask, connected_parts, find_edges, signed_side_counts
from skugga.terrain.errors import InputError
from skugga.terrain.ground.sheet import sheet_of

Mesh = tuple[np.ndarray, np.ndarray]


def triangle_soup(vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
    """Return the same triangles without shared vertices."""
    return np.asarray(vertices)[np.ravel(triangles)], np.arange(3 * len(triangles)).reshape(-1, 3)


def row_of_boxes(count: int) -> Mesh:
    """Return a mesh of ``count`` separate boxes in a row."""
    box = trimesh.creation.box()
    vertices = np.concatenate([box.vertices + [2.0 * n, 0.0, 0.0] for n in range(count)])
    return vertices, np.concatenate([box.faces + 8 * n for n in range(count)])


def test_edges_of_a_square_of_two_triangles():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    edges = find_edges(vertices, np.array([[0, 1, 2], [2, 3, 0]]))
    assert edges.ends.tolist() == [[0, 1], [1, 2], [0, 2], [2, 3], [0, 3]]
    assert edges.triangle_edges.tolist() == [[0, 1, 2], [3, 4, 2]]
    assert edges.side_signs.tolist() == [[1, 1, -1], [1, -1, 1]]
    assert (edges.ends.dtype, edges.triangle_edges.dtype, edges.side_signs.dtype) == (np.int32, np.int32, np.int8)
    assert signed_side_counts(edges, np.array([1, 1])).tolist() == [1, 1, 0, 1, -1]
    assert signed_side_counts(edges, np.array([1, -1])).tolist() == [1, 1, -2, -1, 1]


@pytest.mark.parametrize("shared", [True, False])
def test_edges_of_a_sphere_obey_eulers_formula(shared: bool):
    sphere = trimesh.creation.icosphere(3)
    vertices, triangles = (sphere.vertices, sphere.faces) if shared else triangle_soup(sphere.vertices, sphere.faces)
    edges = find_edges(vertices, triangles)
    vertex_count = len(np.unique(edges.ends))
    assert vertex_count - len(edges.ends) + len(triangles) == 2
    assert (np.bincount(edges.triangle_edges.ravel()) == 2).all()
    assert not signed_side_counts(edges, np.ones(len(triangles))).any()


def test_edges_coincide_with_triangle_sides():
    rng = np.random.default_rng(4)
    vertices = rng.integers(0, 3, (60, 3)).astype(float)  # many vertices share a position
    triangles = rng.integers(0, 60, (200, 3))
    edges = find_edges(vertices, triangles)
    start, end = vertices[triangles], vertices[np.roll(triangles, -1, axis=1)]
    degenerate = (start == end).all(axis=2).any(axis=1)
    assert 0 < degenerate.sum() < 200
    assert (edges.side_signs[degenerate] == 0).all() and (edges.triangle_edges[degenerate] == -1).all()
    ends = vertices[edges.ends[edges.triangle_edges[~degenerate]]]
    forwards = edges.side_signs[~degenerate, :, None, None] > 0
    np.testing.assert_array_equal(np.where(forwards, ends, ends[:, :, ::-1]), np.stack([start, end], axis=2)[~degenerate])
    assert len(np.unique(vertices[edges.ends].reshape(-1, 6), axis=0)) == len(edges.ends)


def test_edges_weld_positions_equal_in_float32():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 1e-50, 0], [1 + 1e-9, 0, 0], [0, -1, 0]])
    assert len(find_edges(vertices, np.array([[0, 1, 2], [4, 3, 5]])).ends) == 5
    vertices[4, 0] = np.nextafter(np.float32(1), np.float32(2))
    assert len(find_edges(vertices, np.array([[0, 1, 2], [4, 3, 5]])).ends) == 6


@pytest.mark.parametrize("wrong", [-1, 3])
def test_edges_name_an_invalid_vertex_number(wrong: int):
    with pytest.raises(InputError, match=rf"triangles: '{wrong}' is not allowed. Allowed: vertex numbers below 3"):
        find_edges(np.eye(3), np.array([[0, 1, wrong]]))


def test_edges_of_empty_and_degenerate_meshes():
    edges = find_edges(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert edges.ends.shape == (0, 2) and edges.triangle_edges.shape == edges.side_signs.shape == (0, 3)
    assert connected_parts(edges).shape == closed_part_mask(edges).shape == (0,)
    degenerate_edges = find_edges(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    assert degenerate_edges.ends.shape == (0, 2) and signed_side_counts(degenerate_edges, np.array([1])).shape == (0,)


@pytest.mark.parametrize("shared", [True, False])
def test_hole_opens_only_its_part(shared: bool):
    vertices, triangles = row_of_boxes(3)
    complete_edges = find_edges(*((vertices, triangles) if shared else triangle_soup(vertices, triangles)))
    assert connected_parts(complete_edges).tolist() == np.repeat([0, 1, 2], 12).tolist()
    assert closed_part_mask(complete_edges).all()
    remaining_triangles = np.delete(triangles, 17, axis=0)
    holed_edges = find_edges(*((vertices, remaining_triangles) if shared else triangle_soup(vertices, remaining_triangles)))
    np.testing.assert_array_equal(closed_part_mask(holed_edges), np.repeat([True, False, True], [12, 11, 12]))


def test_flipped_triangle_opens_its_part():
    vertices, triangles = row_of_boxes(2)
    triangles[3] = triangles[3][::-1]
    np.testing.assert_array_equal(closed_part_mask(find_edges(vertices, triangles)), np.repeat([False, True], 12))


def test_bodies_with_a_shared_edge_are_one_closed_part():
    box = trimesh.creation.box()
    vertices = np.concatenate([box.vertices, box.vertices + [1.0, 1.0, 0.0]])
    edges = find_edges(vertices, np.concatenate([box.faces, box.faces + 8]))
    assert np.bincount(edges.triangle_edges.ravel()).max() == 4
    assert connected_parts(edges).max() == 0 and closed_part_mask(edges).all()


def test_sheet_is_open():
    row, col = np.mgrid[:5, :7].astype(float)
    sheet = sheet_of(np.stack([col, -row, row * col], axis=-1))
    edges = find_edges(sheet.position_frame_m.reshape(-1, 3), sheet.triangles)
    assert len(edges.ends) == 5 * 6 + 4 * 7 + 4 * 6
    assert not closed_part_mask(edges).any()
