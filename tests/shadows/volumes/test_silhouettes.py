"""Silhouettes: their volumes count the triangles that rays to the light meet, for any mesh and any set of casting triangles."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skugga.shadows.volumes.edges import find_edges
from skugga.shadows.volumes.silhouettes import (
    ALL_CODE,
    FACING_CODE,
    TURNED_AWAY_CODE,
    FacingRule,
    Silhouette,
    faces_light,
    orientations_of,
    sheet_silhouette,
    silhouette,
)
from skugga.terrain.errors import InputError
from skugga.terrain.ground.sheet import sheet_of

Mesh = tuple[np.ndarray, np.ndarray]

SUNS = [np.array([0.31, -0.52, 0.43, 0.0]), np.array([-0.9, 0.17, 0.05, 0.0])]
LAMPS = [np.array([2.3, 1.1, 3.2, 1.0]), np.array([0.07, -0.11, 0.13, 1.0])]
LIGHTS = [*SUNS, *LAMPS]
RULES: list[FacingRule] = ["facing", "turned_away", "all"]


def triangle_soup(rng: np.random.Generator) -> Mesh:
    """Return a mesh of 30 random triangles without common vertices."""
    return rng.uniform(-1, 1, (90, 3)), np.arange(90).reshape(-1, 3)


def tangle(rng: np.random.Generator) -> Mesh:
    """Return triangles of few vertices: many share an edge in either direction, and some are duplicates."""
    triangles = np.stack([rng.choice(9, 3, replace=False) for _ in range(60)])
    return rng.uniform(-1, 1, (9, 3)), np.concatenate([triangles, triangles[:5]])


def fan(rng: np.random.Generator) -> Mesh:
    """Return five triangles around one edge."""
    vertices = np.concatenate([[[0, 0, -0.8], [0.1, 0, 0.9]], rng.uniform(-1, 1, (5, 3))])
    return vertices, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 1, 5], [1, 0, 6]])


def rough_ground(rng: np.random.Generator, side: int = 9) -> np.ndarray:
    """Return rough ground (side, side, 3) over [-1, 1] x [-1, 1]."""
    row, col = np.mgrid[:side, :side] / (side - 1.0)
    return np.stack([2 * col - 1, 1 - 2 * row, rng.uniform(-0.3, 0.3, row.shape)], axis=-1)


def sheet_mesh(rng: np.random.Generator) -> Mesh:
    """Return the mesh of a rough heightfield."""
    position = rough_ground(rng)
    return position.reshape(-1, 3), sheet_of(position).triangles


def holed_sheet(rng: np.random.Generator) -> Mesh:
    """Return the mesh of a rough heightfield with holes."""
    position = rough_ground(rng)
    position[rng.random(position.shape[:2]) < 0.15] = np.nan
    return position.reshape(-1, 3), sheet_of(position).triangles


def intersecting_bodies(rng: np.random.Generator) -> Mesh:
    """Return a torus, a box and a ball that intersect."""
    parts = [
        trimesh.creation.torus(0.7, 0.2, major_sections=14, minor_sections=8),
        trimesh.creation.box(extents=(0.5, 0.4, 1.1)), trimesh.creation.icosphere(1, 0.35),
    ]  # fmt: skip
    for part in parts:
        part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        part.apply_translation(rng.uniform(-0.3, 0.3, 3))
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


CASTERS = [triangle_soup, tangle, fan, sheet_mesh, holed_sheet, intersecting_bodies]


def rounded_to_float32(vertices: np.ndarray) -> np.ndarray:
    """Return the vertices as drawn, rounded to float32, in float64."""
    return np.asarray(vertices, np.float32).astype(np.float64)


def plane_intersections(start: np.ndarray, direction: np.ndarray, o: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple:
    """Return where rays from (n, 3) along (n, 3) meet planes o + s p + t q (m, 3 each).

    The result is distance, s, t and slope (n, m) each, with distances in units of ``direction`` (Moeller and Trumbore 1997).
    """
    normal = np.cross(p, q)
    offset = o[None] - start[:, None]
    slope = direction @ normal.T
    cross_product = np.cross(offset, direction[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("nmk,mk->nm", offset, normal) / slope
        s = np.einsum("nmk,mk->nm", cross_product, q) / slope
        t = -np.einsum("nmk,mk->nm", cross_product, p) / slope
    return distance, s, t, slope


def triangle_hits(start: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which rays (n, 3) meet which triangles (m, 3, 3), bool (n, m), and at which distance in units of ``direction``."""
    distance, s, t, _ = plane_intersections(
        start, direction, corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    )
    return (distance > 0) & (s >= 0) & (t >= 0) & (s + t <= 1), distance


def count_layers(points: np.ndarray, vertices: np.ndarray, caps: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return how many triangles lie between points (n, 3) and a light, by rays."""
    direction = light[:3] - light[3] * points
    is_hit, distance = triangle_hits(points, direction, vertices[caps])
    return (is_hit & (distance < (1.0 if light[3] else np.inf))).sum(axis=1)


def inside_bodies(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return which points (n, 3) lie in closed bodies of triangles (m, 3, 3): a ray leaves those more often than it enters them."""
    directions = np.broadcast_to([0.3, -0.2, 0.9], points.shape)
    is_hit, _ = triangle_hits(points, directions, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (is_hit * np.sign(normals @ directions[0])).sum(axis=1) > 0


def signed_count(
    points: np.ndarray, vertices: np.ndarray, outline: Silhouette, light: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Return how much more often rays along (3,) leave the volumes than enter them, through all their bounds."""
    directions = np.broadcast_to(direction, points.shape)
    corners = vertices[outline.caps]
    is_hit, _ = triangle_hits(points, directions, corners)
    outwards = np.sign(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ direction)
    count = (is_hit * outwards).sum(axis=1)
    a, b = vertices[outline.edges[:, 0]], vertices[outline.edges[:, 1]]
    if light[3]:  # the cone from the lamp through the edge, beyond the edge: lamp + s (a - lamp) + t (b - lamp), s + t >= 1
        o, p, q = np.broadcast_to(light[:3], a.shape), a - light[:3], b - light[:3]
        distance, s, t, slope = plane_intersections(points, directions, o, p, q)
        is_hit = (distance > 0) & (s >= 0) & (t >= 0) & (s + t >= 1)
        lamp_hits, _ = triangle_hits(np.broadcast_to(light[:3], (1, 3)), direction[None], corners)
        count = count + lamp_hits.sum()
    else:  # the strip b + s (a - b) - t sun
        distance, s, t, slope = plane_intersections(points, directions, b, a - b, np.broadcast_to(-light[:3], a.shape))
        is_hit = (distance > 0) & (s >= 0) & (s <= 1) & (t >= 0)
    return (count + (is_hit * np.sign(slope) * outline.multiplicity).sum(axis=1)).astype(int)


def silhouette_of(mesh: Mesh, light: np.ndarray, rule: FacingRule | np.ndarray) -> Silhouette:
    """Return the silhouette of a mesh seen from a light. ``rule`` selects the triangles that cast."""
    vertices, triangles = mesh
    return silhouette(triangles, find_edges(vertices, triangles), orientations_of(faces_light(vertices, triangles, light), rule))


def vertex_balance(outline: Silhouette) -> np.ndarray:
    """Return how many more edges of a silhouette begin than end at each vertex."""
    count = int(outline.edges.max(initial=0)) + 1
    return np.bincount(outline.edges[:, 0], outline.multiplicity, count) - np.bincount(
        outline.edges[:, 1], outline.multiplicity, count
    )


@pytest.mark.parametrize("light", LIGHTS, ids=str)
@pytest.mark.parametrize("caster", CASTERS)
def test_silhouette_volumes_count_triangles_on_rays(caster, light: np.ndarray):
    rng = np.random.default_rng(7)
    for rule in RULES:
        vertices, triangles = caster(rng)
        outline, vertices = silhouette_of((vertices, triangles), light, rule), rounded_to_float32(vertices)
        points = rng.uniform(-1.6, 1.6, (300, 3))
        expected_counts = count_layers(points, vertices, outline.caps, light)
        np.testing.assert_array_equal(signed_count(points, vertices, outline, light, rng.standard_normal(3)), expected_counts)
    assert expected_counts.max() >= 1  # the last rule lets all triangles cast


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_silhouette_of_any_subset_counts_triangles_on_rays(light: np.ndarray):
    rng = np.random.default_rng(8)
    vertices, triangles = intersecting_bodies(rng)
    outline = silhouette_of((vertices, triangles), light, rng.integers(0, 4, len(triangles)))
    points = rng.uniform(-1.6, 1.6, (300, 3))
    expected_counts = count_layers(points, rounded_to_float32(vertices), outline.caps, light)
    np.testing.assert_array_equal(
        signed_count(points, rounded_to_float32(vertices), outline, light, rng.standard_normal(3)), expected_counts
    )


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_silhouette_caps_face_the_light(light: np.ndarray):
    vertices, triangles = tangle(np.random.default_rng(1))
    for rule in RULES:
        outline = silhouette_of((vertices, triangles), light, rule)
        assert faces_light(vertices, outline.caps, light).all()
        np.testing.assert_array_equal(outline.edges.dtype, np.int32)
        assert (outline.multiplicity >= 1).all()


@pytest.mark.parametrize("light", [*SUNS, LAMPS[0]], ids=str)
def test_facing_rules_agree_outside_bodies(light: np.ndarray):
    rng = np.random.default_rng(3)
    vertices, triangles = intersecting_bodies(rng)
    vertices = rounded_to_float32(vertices)
    points = rng.uniform(-1.4, 1.4, (400, 3))
    points = points[~inside_bodies(points, vertices[triangles])]
    dark = [count_layers(points, vertices, silhouette_of((vertices, triangles), light, rule).caps, light) > 0 for rule in RULES]
    assert 20 < dark[2].sum() < len(points) - 20
    np.testing.assert_array_equal(dark[0], dark[2])
    np.testing.assert_array_equal(dark[1], dark[2])


def test_facing_rules_for_a_lamp_inside_a_body():
    vertices, triangles = np.asarray(trimesh.creation.icosphere(1).vertices), np.asarray(trimesh.creation.icosphere(1).faces)
    lamp, points = np.array([0.2, 0.1, 0.3, 1.0]), np.array([[2.0, 0.3, 0.1], [-0.4, 0.2, 0.0]])
    dark = [
        count_layers(points, rounded_to_float32(vertices), silhouette_of((vertices, triangles), lamp, rule).caps, lamp).tolist()
        for rule in RULES
    ]
    assert dark == [[0, 0], [1, 0], [1, 0]]


@pytest.mark.parametrize("light", [*SUNS, LAMPS[0]], ids=str)
def test_facing_rules_agree_on_and_above_ground(light: np.ndarray):
    rng = np.random.default_rng(5)
    vertices, triangles = sheet_mesh(rng)
    vertices = rounded_to_float32(vertices)
    weights = rng.dirichlet(np.ones(3), 600)
    points = np.einsum("nk,nkc->nc", weights, vertices[triangles[rng.integers(0, len(triangles), 600)]])
    points[:, 2] += np.where(np.arange(600) % 2, 1e-9, rng.exponential(0.1, 600))
    turned_away_caps, all_caps = (silhouette_of((vertices, triangles), light, rule).caps for rule in ("turned_away", "all"))
    dark = count_layers(points, vertices, all_caps, light) > 0
    assert 20 < dark.sum() < 580
    np.testing.assert_array_equal(count_layers(points, vertices, turned_away_caps, light) > 0, dark)


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_silhouette_of_a_convex_body_is_one_closed_loop(light: np.ndarray):
    ball = trimesh.creation.icosphere(2, 0.5)
    outline = silhouette_of((ball.vertices + [0.0, 0.0, -1.0], ball.faces), light, "facing")
    assert (outline.multiplicity == 1).all() and not vertex_balance(outline).any()
    assert len(np.unique(outline.edges[:, 0])) == len(outline.edges)


def test_silhouette_of_opposite_triangles_has_double_edges():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    up = np.array([0.0, 0.0, 1.0, 0.0])
    outline = silhouette_of((vertices, np.array([[0, 1, 2], [1, 0, 2]])), up, "all")
    assert sorted(outline.edges.tolist()) == [[0, 1], [1, 2], [2, 0]] and outline.multiplicity.tolist() == [2, 2, 2]
    assert outline.caps.tolist() == [[0, 1, 2], [1, 2, 0]]
    assert silhouette_of((vertices, np.array([[0, 1, 2], [1, 0, 2]])), up, "facing").caps.tolist() == [[0, 1, 2]]
    assert silhouette_of((vertices, np.array([[0, 1, 2], [1, 0, 2]])), up, "turned_away").caps.tolist() == [[1, 2, 0]]


@pytest.mark.parametrize("ulps", [-1, 0, 1])
@pytest.mark.parametrize("rule", RULES)
def test_silhouette_with_edge_on_walls_is_closed(rule: FacingRule, ulps: int):
    """The sun sees the walls of a box edge-on, up to a unit in the last place of one corner."""
    box = trimesh.creation.box()
    vertices = np.asarray(box.vertices, np.float32) + np.float32(0.7)
    vertices[3, 0] = np.nextafter(vertices[3, 0], np.float32(ulps * np.inf)) if ulps else vertices[3, 0]
    for light in ([0.0, 0.0, 1.0, 0.0], [0.0, -0.6, 0.8, 0.0], [1.2, 0.5, 4.0, 1.0]):
        outline = silhouette_of((vertices, box.faces), np.array(light), rule)
        assert len(outline.edges) and not vertex_balance(outline).any()


@given(
    vertices=arrays(np.int8, (8, 3), elements=st.integers(-1, 1)), triangles=arrays(np.int8, (12, 3), elements=st.integers(0, 7)),
    light=st.tuples(*[st.integers(-2, 2)] * 3, st.integers(0, 1)).filter(any), rule=st.sampled_from(RULES),
)  # fmt: skip
def test_silhouette_of_random_triangles_is_closed(vertices, triangles, light, rule: FacingRule):
    outline = silhouette_of((vertices.astype(float), triangles.astype(int)), np.array(light, float), rule)
    assert not vertex_balance(outline).any()


def test_facing_uses_float32_vertices():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1e-9], [1, 1, 1.0]])
    light = np.array([0.0, 1.0, 1e-10, 0.0])
    assert not faces_light(vertices, np.array([[0, 1, 2]]), light)[0]
    vertices[:, 2] += 1.0  # in float32 the triangle is level now
    assert faces_light(vertices, np.array([[0, 1, 2]]), light)[0]


def test_facing_is_false_for_edge_on_triangles():
    wall = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1]], float)
    assert not faces_light(wall, np.array([[0, 1, 2], [0, 2, 1]]), np.array([0.0, 0.0, 1.0, 0.0])).any()
    assert faces_light(wall, np.array([[0, 1, 2], [0, 2, 1]]), np.array([0.0, -1.0, 0.0, 1.0])).tolist() == [True, False]


def test_orientations_of_rules_and_codes():
    faces = np.array([True, False])
    assert orientations_of(faces, "facing").tolist() == [1, 0]
    assert orientations_of(faces, "turned_away").tolist() == [0, -1]
    assert orientations_of(faces, "all").tolist() == [1, -1]
    numbers = np.array([0, FACING_CODE, TURNED_AWAY_CODE, ALL_CODE], np.uint8)
    assert orientations_of(np.ones(4, bool), numbers).tolist() == [0, 1, 0, 1]
    assert orientations_of(np.zeros(4, bool), numbers).tolist() == [0, 0, -1, -1]
    assert orientations_of(np.zeros(4, bool), numbers).dtype == np.int8


def test_silhouette_functions_name_invalid_arguments():
    with pytest.raises(InputError, match="rule: 'both' is not allowed. Allowed: facing or turned_away or all"):
        orientations_of(np.ones(1, bool), "both")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="rule: '4' is not allowed. Allowed: 0 to 3"):
        orientations_of(np.ones(2, bool), np.array([1, 4]))
    for light in ([0.0, 0.0, 0.0, 0.0], [0.0, np.nan, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.5]):
        with pytest.raises(InputError, match="light"):
            faces_light(np.eye(3), np.array([[0, 1, 2]]), np.array(light))


@given(
    height=arrays(np.int8, st.tuples(st.integers(1, 6), st.integers(1, 6)), elements=st.integers(-3, 3)),
    light=st.tuples(*[st.integers(-3, 3)] * 3, st.integers(0, 1)).filter(any), rule=st.sampled_from(RULES),
)  # fmt: skip
def test_sheet_silhouette_equals_silhouette(height, light, rule: FacingRule):
    row, col = np.mgrid[: height.shape[0], : height.shape[1]]
    position = np.stack([col, -row, np.where(height < -1, np.nan, height)], axis=-1)
    check_sheet(position, np.array(light, float), rule)


@pytest.mark.parametrize("rule", RULES)
def test_sheet_silhouette_of_a_large_sheet_equals_silhouette(rule: FacingRule):
    rng = np.random.default_rng(2)
    row, col = np.mgrid[:70, :90] * 10.0
    position = np.stack([col, -row, rng.uniform(0, 20, row.shape)], axis=-1)
    position[rng.random(row.shape) < 0.02] = np.nan
    for light in (np.array([0.6, 0.5, 0.3, 0.0]), np.array([400.0, -300.0, 25.0, 1.0])):
        check_sheet(position, light, rule)


def check_sheet(position: np.ndarray, light: np.ndarray, rule: FacingRule) -> None:
    """Check that the fast silhouette of a heightfield (rows, cols, 3) equals the general one."""
    grid_sheet = sheet_of(position)
    sheet_outline, general_outline = (
        sheet_silhouette(grid_sheet, light, rule),
        silhouette_of((position.reshape(-1, 3), grid_sheet.triangles), light, rule),
    )
    assert (sheet_outline.edges.dtype, sheet_outline.multiplicity.dtype, sheet_outline.caps.dtype) == (np.int32, np.int32, np.int32)
    np.testing.assert_array_equal(sheet_outline.caps, general_outline.caps)
    for actual, expected in zip(
        *(
            [*mesh_outline.edges[np.lexsort(mesh_outline.edges.T)].T, mesh_outline.multiplicity[np.lexsort(mesh_outline.edges.T)]]
            for mesh_outline in (sheet_outline, general_outline)
        ),
        strict=True,
    ):
        np.testing.assert_array_equal(actual, expected)
