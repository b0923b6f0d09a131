"""Layers of shadow volumes: valid and tight upper bounds, batches, and casters that may shade the near plane."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows.volumes.edges import find_edges
from skugga.shadows.volumes.layers import MAX_STENCIL_LAYERS, layer_batches, max_layers, may_shade_near_plane
from skugga.shadows.volumes.silhouettes import (
    FACING_RULE_CODES,
    Silhouette,
    faces_light,
    orientations_of,
    sheet_silhouette,
    silhouette,
)
from skugga.terrain.errors import InputError
from skugga.terrain.ground.sheet import sheet_of

Mesh = tuple[np.ndarray, np.ndarray]

OVERHEAD_LIGHT = np.array([0.0, 0.0, 1.0, 0.0])
LIGHTS = [
    OVERHEAD_LIGHT, np.array([2.0, 0.0, 0.0, 0.0]), np.array([0.31, -0.52, 0.43, 0.0]), np.array([2.3, 1.1, 3.2, 1.0]),
    np.array([0.07, -0.11, 0.13, 1.0]),
]  # fmt: skip


def translated_copies(vertices: np.ndarray, triangles: np.ndarray, offsets: np.ndarray) -> Mesh:
    """Return a mesh with a copy of vertices and triangles at each offset (n, 3)."""
    numbers = np.arange(len(offsets))[:, None, None] * len(vertices) + triangles
    return (vertices + np.asarray(offsets)[:, None]).reshape(-1, 3), numbers.reshape(-1, 3)


def boxes(size: float, offsets: np.ndarray) -> Mesh:
    """Return a mesh of cubes with sides of ``size`` at offsets (n, 3)."""
    box = trimesh.creation.box(extents=(size, size, size))
    return translated_copies(np.asarray(box.vertices), np.asarray(box.faces), offsets)


def stacked_squares(count: int) -> Mesh:
    """Return a stack of squares."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    return translated_copies(square, np.array([[0, 1, 2], [2, 3, 0]]), np.arange(count)[:, None] * [0.0, 0.0, 0.125])


def folded_strip(count: int) -> Mesh:
    """Return a strip folded back and forth, ``count`` layers thick, in one piece."""
    n = np.arange(count + 1)
    side = np.stack([n % 2, 0.0 * n, 0.1 * n], axis=-1)
    vertices = np.concatenate([side, side + [0.0, 1.0, 0.0]])
    a, b = n[:-1], n[:-1] + count + 1
    return vertices, np.concatenate([np.stack([a, a + 1, b], axis=-1), np.stack([b + 1, b, a + 1], axis=-1)])


def caster_silhouette(mesh: Mesh, light: np.ndarray, rule: str = "facing") -> Silhouette:
    """Return the silhouette of a mesh seen from a light. ``rule`` selects the triangles that cast."""
    vertices, triangles = mesh
    return silhouette(triangles, find_edges(vertices, triangles), orientations_of(faces_light(vertices, triangles, light), rule))  # type: ignore


def count_covering_triangles(points: np.ndarray, vertices: np.ndarray, caps: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return how many triangles cover each point (n, 3) as seen from a light, at any distance."""
    corners = np.asarray(vertices, np.float32).astype(float)[caps]
    to_light = light[:3] - light[3] * points
    if light[3]:
        a, b, c = (corners[:, k] - light[:3] for k in range(3))
        inside = [-to_light @ np.cross(p, q).T <= 0.0 for p, q in ((a, b), (b, c), (c, a))]
        return np.logical_and.reduce(inside).sum(axis=1)
    a, b, c = (corners[:, k] for k in range(3))
    broadcast_points = points[:, None]
    inside = [np.cross(q - p, broadcast_points - p) @ light[:3] >= 0.0 for p, q in ((a, b), (b, c), (c, a))]
    return np.logical_and.reduce(inside).sum(axis=1)


@pytest.mark.parametrize("light", LIGHTS, ids=str)
@pytest.mark.parametrize("seed", range(8))
def test_max_layers_is_an_upper_bound(light: np.ndarray, seed: int):
    """Soups have few large or many small triangles, and the points include the densest places."""
    rng = np.random.default_rng(seed)
    count = int(rng.choice([1, 3, 20, 150]))
    centres = rng.uniform(-1, 1, (count, 1, 3))
    vertices = (centres + rng.choice([0.2, 1.0]) * rng.uniform(-1, 1, (count, 3, 3))).reshape(-1, 3)
    triangles = np.arange(3 * count).reshape(-1, 3)
    if seed % 2:
        triangles = rng.permuted(triangles.ravel()).reshape(-1, 3) % max(count, 3)  # with shared vertices
    for rule in FACING_RULE_CODES:
        outline = caster_silhouette((vertices, triangles), light, rule)
        points = np.concatenate([rng.uniform(-2, 2, (1000, 3)), vertices[triangles].mean(axis=1)])
        counted_layers = int(count_covering_triangles(points, vertices, outline.caps, light).max())
        assert counted_layers <= max_layers(vertices, outline, light) <= len(outline.caps)


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_max_layers_of_a_convex_body_is_one(light: np.ndarray):
    ball = trimesh.creation.icosphere(3, 0.3)
    for middle in ([0.0, 0.0, -1.5], [0.4, -2.0, 0.1]):
        assert max_layers(ball.vertices + middle, caster_silhouette((ball.vertices + middle, ball.faces), light), light) == 1


@pytest.mark.parametrize("lamp", [np.array([0.2, 0.1, -0.3, 1.0]), np.array([0.0, 0.0, 0.1, 1.0])], ids=str)
@pytest.mark.parametrize("shells", [1, 2, 5])
def test_max_layers_of_a_lamp_in_shells(lamp: np.ndarray, shells: int):
    ball = trimesh.creation.icosphere(2)
    vertices, triangles = translated_copies(np.asarray(ball.vertices), np.asarray(ball.faces), np.zeros((shells, 3)))
    vertices *= np.repeat(1.0 + np.arange(shells), len(ball.vertices))[:, None]
    holed_mesh = vertices, np.delete(triangles, [17, 300, 306], axis=0)
    assert shells <= max_layers(vertices, caster_silhouette(holed_mesh, lamp, "all"), lamp) <= shells + 1
    assert max_layers(vertices, caster_silhouette(holed_mesh, lamp), lamp) == 0


def test_max_layers_of_a_lamp_on_a_corner():
    """No axis clears the mesh, since the lamp lies in no direction from the corner. The bound is the number of triangles."""
    vertices, triangles = stacked_squares(5)
    lamp = np.append(vertices[-1], 1.0)
    outline = caster_silhouette((vertices, triangles), lamp, "all")
    assert max_layers(vertices, outline, lamp) == len(outline.caps) == 10


@pytest.mark.parametrize("count", [1, 7, 40])
@pytest.mark.parametrize("light", [OVERHEAD_LIGHT, np.array([0.0, 0.0, 900.0, 1.0])], ids=str)
def test_max_layers_of_a_stack_is_its_number_of_boxes(light: np.ndarray, count: int):
    stack = boxes(1.0, np.arange(count)[:, None] * [0.0, 0.0, 1.5])
    assert max_layers(stack[0], caster_silhouette(stack, light), light) == count


def test_max_layers_of_a_wave_is_its_number_of_crests():
    x, y = np.meshgrid(np.linspace(0, 10, 201), np.linspace(0, 4, 40))
    position = np.stack([x, -y, 0.5 * np.sin(2 * np.pi * x)], axis=-1)
    position[3, 40] = np.nan
    sun = np.array([1.0, 0.1, 0.02, 0.0])
    for rule in ("turned_away", "facing"):
        assert 9 <= max_layers(position, sheet_silhouette(sheet_of(position), sun, rule), sun) <= 12


@pytest.mark.parametrize("light", [np.array([0.6, 0.5, 0.4, 0.0]), np.array([1.0, 1, 1, 0]), np.array([30.0, 20, 15, 1]),
                                   np.array([4.5, 4.5, 4.5, 1]), OVERHEAD_LIGHT], ids=str)  # fmt: skip
def test_max_layers_of_a_thousand_boxes_fits_the_stencil(light: np.ndarray):
    rng = np.random.default_rng(1)
    mesh = boxes(0.6, np.stack(np.meshgrid(*[np.arange(10.0)] * 3), axis=-1).reshape(-1, 3))
    outline = caster_silhouette(mesh, light)
    points = rng.uniform(-1, 11, (500, 3))
    counted_layers, layer_bound = (
        int(count_covering_triangles(points, mesh[0], outline.caps, light).max()),
        max_layers(mesh[0], outline, light),
    )
    assert counted_layers <= layer_bound <= 60
    assert len(layer_batches(*mesh, find_edges(*mesh), orientations_of(faces_light(*mesh, light), "facing"), light)) == 1


def test_max_layers_of_rough_ground_fits_the_stencil():
    rng = np.random.default_rng(3)
    row, col = np.mgrid[:200, :200]
    position = np.stack([10.0 * col, -10.0 * row, rng.normal(0.0, 3.0, row.shape)], axis=-1)
    for light in (np.array([0.6, 0.5, 0.05, 0.0]), np.array([1000.0, -900.0, 15.0, 1.0])):
        outline = sheet_silhouette(sheet_of(position), light, "turned_away")
        assert len(outline.edges) > 20000
        assert max_layers(position, outline, light) < 100


@pytest.mark.parametrize(
    "mesh",
    [stacked_squares(300), stacked_squares(600), folded_strip(300), folded_strip(600)],
    ids=["plates", "more", "folded", "longer"],
)
def test_batches_fit_the_stencil_and_partition_the_mesh(mesh: Mesh):
    vertices, triangles = mesh
    edges, orientations = find_edges(vertices, triangles), orientations_of(faces_light(vertices, triangles, OVERHEAD_LIGHT), "all")
    layers = len(triangles) // 2
    assert max_layers(vertices, silhouette(triangles, edges, orientations), OVERHEAD_LIGHT) == layers > MAX_STENCIL_LAYERS
    groups = layer_batches(vertices, triangles, edges, orientations, OVERHEAD_LIGHT)
    assert 2 <= len(groups) <= 2 * layers / MAX_STENCIL_LAYERS
    assert all(max_layers(vertices, silhouette(triangles, edges, group), OVERHEAD_LIGHT) <= MAX_STENCIL_LAYERS for group in groups)
    assert (np.sum(np.abs(groups), axis=0) == 1).all() and (np.sum(groups, axis=0) == orientations).all()
    [group] = layer_batches(vertices, triangles, edges, orientations, OVERHEAD_LIGHT, layers)
    np.testing.assert_array_equal(group, orientations)
    assert len(layer_batches(vertices, triangles, edges, orientations, OVERHEAD_LIGHT, 1)) >= layers


def test_batches_keep_plates_whole():
    vertices, triangles = stacked_squares(300)
    edges, orientations = find_edges(vertices, triangles), orientations_of(faces_light(vertices, triangles, OVERHEAD_LIGHT), "all")
    groups = layer_batches(vertices, triangles, edges, orientations, OVERHEAD_LIGHT, 100)
    assert all((group[::2] == group[1::2]).all() for group in groups)
    heights = [vertices[triangles[group != 0], 2] for group in groups]
    assert all(before.min() > after.max() for before, after in zip(heights, heights[1:], strict=False))  # from the light on


def test_max_layers_of_no_caster_is_zero():
    row, col = np.mgrid[:3, :3].astype(float)
    position = np.stack([col, -row, 0.0 * row], axis=-1)
    none = sheet_silhouette(sheet_of(position), OVERHEAD_LIGHT, "turned_away")
    assert len(none.caps) == 0 and max_layers(position, none, OVERHEAD_LIGHT) == 0
    vertices, triangles = position.reshape(-1, 3), sheet_of(position).triangles
    [group] = layer_batches(vertices, triangles, find_edges(vertices, triangles), np.zeros(8, np.int8), OVERHEAD_LIGHT)
    assert not group.any()


def test_batches_refuse_zero_layers():
    vertices, triangles = stacked_squares(2)
    with pytest.raises(InputError, match="layer_limit: '0' is not allowed. Allowed: 1 or more"):
        layer_batches(vertices, triangles, find_edges(vertices, triangles), np.ones(4, np.int8), OVERHEAD_LIGHT, 0)


COORDINATE = st.floats(-5, 5, allow_subnormal=False)
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE).map(np.array)


@given(
    middle=POINT, turns=POINT, width=st.floats(0.01, 3), height=st.floats(0.01, 3), light=POINT.filter(np.any),
    is_lamp=st.booleans(), share=st.tuples(*[st.floats(0, 1)] * 3), size=st.tuples(*[st.floats(0, 2)] * 3),
    corner=st.tuples(*[st.floats(0, 1)] * 3),
)  # fmt: skip
def test_may_shade_near_finds_casters_towards_the_light(middle, turns, width, height, light, is_lamp, share, size, corner):
    rotation = trimesh.transformations.euler_matrix(*turns)[:3, :3]
    corners = np.array([[-width, -height], [width, -height], [width, height], [-width, height]])
    rectangle = middle + corners @ rotation[:2]
    light = np.append(light, float(is_lamp))
    width_share, height_share, distance_share = share
    start = middle + [(2 * width_share - 1) * width, (2 * height_share - 1) * height] @ rotation[:2]
    occluding_point = start + (distance_share if is_lamp else 20 * distance_share) * (light[:3] - light[3] * start)
    low = occluding_point - np.array(size) * corner
    assert may_shade_near_plane(low[None], (low + size)[None], rectangle, light).all()


def test_may_shade_near_excludes_other_casters():
    rectangle = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    middle = np.array([[0, 0, 5], [0, 0, -5], [5, 0, 0.5], [5, 0, 5], [0, -9, 5], [4, 4, 20]], float)
    low, high = middle - 0.4, middle + 0.4
    up, aslant, lamp = np.array([[0.0, 0, 1, 0], [1.0, 0, 1, 0], [0.0, 0, 8, 1]])
    assert may_shade_near_plane(low, high, rectangle, up).tolist() == [True, False, False, False, False, False]
    assert may_shade_near_plane(low, high, rectangle, aslant).tolist() == [False, False, False, True, False, False]
    assert may_shade_near_plane(low, high, rectangle[::-1], aslant).tolist() == [False, False, False, True, False, False]
    assert may_shade_near_plane(low, high, rectangle, lamp).tolist() == [True, False, False, False, False, False]
    assert may_shade_near_plane(low[:0], high[:0], rectangle, up).shape == (0,)


def test_may_shade_near_of_a_light_in_the_near_plane():
    rectangle = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    low, high = np.array([[50.0, 50, -50]]), np.array([[51.0, 51, -49]])
    for degrees, expected in ((0.0, True), (0.09, True), (-0.09, True), (0.11, False), (-0.11, False)):
        rise = np.tan(np.radians(degrees))
        assert may_shade_near_plane(low, high, rectangle, np.array([1.0, 0.0, rise, 0.0])).all() == expected
    assert may_shade_near_plane(low, high, rectangle, np.array([0.3, 0.2, 0.0, 1.0])).all()
