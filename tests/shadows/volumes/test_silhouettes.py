"""Silhouettes: their volumes count the triangles that rays to the light meet, for any mesh and any set of casting triangles."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skugga.shadows.volumes.edges import edges_of
from skugga.shadows.volumes.silhouettes import (
    ALL_CODE,
    FACING_CODE,
    TURNED_AWAY_CODE,
    FacingRule,
    Silhouette,
    facing,
    sheet_silhouette,
    silhouette,
    turns_of,
)
from skugga.terrain.errors import InputError
from skugga.terrain.ground.sheet import sheet_of

Mesh = tuple[np.ndarray, np.ndarray]

SUNS = [np.array([0.31, -0.52, 0.43, 0.0]), np.array([-0.9, 0.17, 0.05, 0.0])]
LAMPS = [np.array([2.3, 1.1, 3.2, 1.0]), np.array([0.07, -0.11, 0.13, 1.0])]
LIGHTS = [*SUNS, *LAMPS]
RULES: list[FacingRule] = ["facing", "turned_away", "all"]


def soup(rng: np.random.Generator) -> Mesh:
    return rng.uniform(-1, 1, (90, 3)), np.arange(90).reshape(-1, 3)


def tangle(rng: np.random.Generator) -> Mesh:
    """Return triangles of few vertices: many share an edge in either direction, and some are duplicates."""
    triangles = np.stack([rng.choice(9, 3, replace=False) for _ in range(60)])
    return rng.uniform(-1, 1, (9, 3)), np.concatenate([triangles, triangles[:5]])


def fan(rng: np.random.Generator) -> Mesh:
    """Return five triangles around one edge."""
    vertices = np.concatenate([[[0, 0, -0.8], [0.1, 0, 0.9]], rng.uniform(-1, 1, (5, 3))])
    return vertices, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 1, 5], [1, 0, 6]])


def ground(rng: np.random.Generator, side: int = 9) -> np.ndarray:
    """Return rough ground (side, side, 3) over [-1, 1] x [-1, 1]."""
    row, col = np.mgrid[:side, :side] / (side - 1.0)
    return np.stack([2 * col - 1, 1 - 2 * row, rng.uniform(-0.3, 0.3, row.shape)], axis=-1)


def sheet(rng: np.random.Generator) -> Mesh:
    position = ground(rng)
    return position.reshape(-1, 3), sheet_of(position).triangles


def holed(rng: np.random.Generator) -> Mesh:
    position = ground(rng)
    position[rng.random(position.shape[:2]) < 0.15] = np.nan
    return position.reshape(-1, 3), sheet_of(position).triangles


def bodies(rng: np.random.Generator) -> Mesh:
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


CASTERS = [soup, tangle, fan, sheet, holed, bodies]


def drawn(vertices: np.ndarray) -> np.ndarray:
    """Return the vertices as drawn, rounded to float32, in float64."""
    return np.asarray(vertices, np.float32).astype(np.float64)


def crossings(start: np.ndarray, way: np.ndarray, o: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple:
    """Return where rays from (n, 3) along (n, 3) meet planes o + s p + t q (m, 3 each).

    The result is distance, s, t and slope (n, m) each, with distances in units of ``way`` (Moeller and Trumbore 1997).
    """
    normal = np.cross(p, q)
    away = o[None] - start[:, None]
    slope = way @ normal.T
    across = np.cross(away, way[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("nmk,mk->nm", away, normal) / slope
        s = np.einsum("nmk,mk->nm", across, q) / slope
        t = -np.einsum("nmk,mk->nm", across, p) / slope
    return distance, s, t, slope


def hits(start: np.ndarray, way: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which rays (n, 3) meet which triangles (m, 3, 3), bool (n, m), and at which distance in units of ``way``."""
    distance, s, t, _ = crossings(start, way, corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (distance > 0) & (s >= 0) & (t >= 0) & (s + t <= 1), distance


def layers(points: np.ndarray, vertices: np.ndarray, caps: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return how many triangles lie between points (n, 3) and a light, by rays."""
    way = light[:3] - light[3] * points
    met, distance = hits(points, way, vertices[caps])
    return (met & (distance < (1.0 if light[3] else np.inf))).sum(axis=1)


def within(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return which points (n, 3) lie in closed bodies of triangles (m, 3, 3): a ray leaves those more often than it enters them."""
    ways = np.broadcast_to([0.3, -0.2, 0.9], points.shape)
    met, _ = hits(points, ways, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (met * np.sign(normals @ ways[0])).sum(axis=1) > 0


def signed_count(points: np.ndarray, vertices: np.ndarray, bound: Silhouette, light: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return how much more often rays along (3,) leave the volumes than enter them, through all their bounds."""
    ways = np.broadcast_to(way, points.shape)
    corners = vertices[bound.caps]
    met, _ = hits(points, ways, corners)
    outwards = np.sign(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ way)
    count = (met * outwards).sum(axis=1)
    a, b = vertices[bound.edges[:, 0]], vertices[bound.edges[:, 1]]
    if light[3]:  # the cone from the lamp through the edge, beyond the edge: lamp + s (a - lamp) + t (b - lamp), s + t >= 1
        o, p, q = np.broadcast_to(light[:3], a.shape), a - light[:3], b - light[:3]
        distance, s, t, slope = crossings(points, ways, o, p, q)
        met = (distance > 0) & (s >= 0) & (t >= 0) & (s + t >= 1)
        far, _ = hits(np.broadcast_to(light[:3], (1, 3)), way[None], corners)
        count = count + far.sum()
    else:  # the strip b + s (a - b) - t sun
        distance, s, t, slope = crossings(points, ways, b, a - b, np.broadcast_to(-light[:3], a.shape))
        met = (distance > 0) & (s >= 0) & (s <= 1) & (t >= 0)
    return (count + (met * np.sign(slope) * bound.times).sum(axis=1)).astype(int)


def bounded(mesh: Mesh, light: np.ndarray, rule: FacingRule | np.ndarray) -> Silhouette:
    vertices, triangles = mesh
    return silhouette(triangles, edges_of(vertices, triangles), turns_of(facing(vertices, triangles, light), rule))


def balance(bound: Silhouette) -> np.ndarray:
    """Return how many more edges of a silhouette begin than end at each vertex."""
    count = int(bound.edges.max(initial=0)) + 1
    return np.bincount(bound.edges[:, 0], bound.times, count) - np.bincount(bound.edges[:, 1], bound.times, count)


@pytest.mark.parametrize("light", LIGHTS, ids=str)
@pytest.mark.parametrize("caster", CASTERS)
def test_silhouette_volumes_count_triangles_on_rays(caster, light: np.ndarray):
    rng = np.random.default_rng(7)
    for rule in RULES:
        vertices, triangles = caster(rng)
        bound, vertices = bounded((vertices, triangles), light, rule), drawn(vertices)
        points = rng.uniform(-1.6, 1.6, (300, 3))
        found = layers(points, vertices, bound.caps, light)
        np.testing.assert_array_equal(signed_count(points, vertices, bound, light, rng.standard_normal(3)), found)
    assert found.max() >= 1  # the last rule lets all triangles cast


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_silhouette_of_any_subset_counts_triangles_on_rays(light: np.ndarray):
    rng = np.random.default_rng(8)
    vertices, triangles = bodies(rng)
    bound = bounded((vertices, triangles), light, rng.integers(0, 4, len(triangles)))
    points = rng.uniform(-1.6, 1.6, (300, 3))
    found = layers(points, drawn(vertices), bound.caps, light)
    np.testing.assert_array_equal(signed_count(points, drawn(vertices), bound, light, rng.standard_normal(3)), found)


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_silhouette_caps_face_the_light(light: np.ndarray):
    vertices, triangles = tangle(np.random.default_rng(1))
    for rule in RULES:
        bound = bounded((vertices, triangles), light, rule)
        assert facing(vertices, bound.caps, light).all()
        np.testing.assert_array_equal(bound.edges.dtype, np.int32)
        assert (bound.times >= 1).all()


@pytest.mark.parametrize("light", [*SUNS, LAMPS[0]], ids=str)
def test_facing_rules_agree_outside_bodies(light: np.ndarray):
    rng = np.random.default_rng(3)
    vertices, triangles = bodies(rng)
    vertices = drawn(vertices)
    points = rng.uniform(-1.4, 1.4, (400, 3))
    points = points[~within(points, vertices[triangles])]
    dark = [layers(points, vertices, bounded((vertices, triangles), light, rule).caps, light) > 0 for rule in RULES]
    assert 20 < dark[2].sum() < len(points) - 20
    np.testing.assert_array_equal(dark[0], dark[2])
    np.testing.assert_array_equal(dark[1], dark[2])


def test_facing_rules_for_a_lamp_inside_a_body():
    vertices, triangles = np.asarray(trimesh.creation.icosphere(1).vertices), np.asarray(trimesh.creation.icosphere(1).faces)
    lamp, points = np.array([0.2, 0.1, 0.3, 1.0]), np.array([[2.0, 0.3, 0.1], [-0.4, 0.2, 0.0]])
    dark = [layers(points, drawn(vertices), bounded((vertices, triangles), lamp, rule).caps, lamp).tolist() for rule in RULES]
    assert dark == [[0, 0], [1, 0], [1, 0]]


@pytest.mark.parametrize("light", [*SUNS, LAMPS[0]], ids=str)
def test_facing_rules_agree_on_and_above_ground(light: np.ndarray):
    rng = np.random.default_rng(5)
    vertices, triangles = sheet(rng)
    vertices = drawn(vertices)
    weights = rng.dirichlet(np.ones(3), 600)
    points = np.einsum("nk,nkc->nc", weights, vertices[triangles[rng.integers(0, len(triangles), 600)]])
    points[:, 2] += np.where(np.arange(600) % 2, 1e-9, rng.exponential(0.1, 600))
    away, all_cast = (bounded((vertices, triangles), light, rule).caps for rule in ("turned_away", "all"))
    dark = layers(points, vertices, all_cast, light) > 0
    assert 20 < dark.sum() < 580
    np.testing.assert_array_equal(layers(points, vertices, away, light) > 0, dark)


@pytest.mark.parametrize("light", LIGHTS, ids=str)
def test_silhouette_of_a_convex_body_is_one_closed_loop(light: np.ndarray):
    ball = trimesh.creation.icosphere(2, 0.5)
    bound = bounded((ball.vertices + [0.0, 0.0, -1.0], ball.faces), light, "facing")
    assert (bound.times == 1).all() and not balance(bound).any()
    assert len(np.unique(bound.edges[:, 0])) == len(bound.edges)


def test_silhouette_of_opposite_triangles_has_double_edges():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    up = np.array([0.0, 0.0, 1.0, 0.0])
    bound = bounded((vertices, np.array([[0, 1, 2], [1, 0, 2]])), up, "all")
    assert sorted(bound.edges.tolist()) == [[0, 1], [1, 2], [2, 0]] and bound.times.tolist() == [2, 2, 2]
    assert bound.caps.tolist() == [[0, 1, 2], [1, 2, 0]]
    assert bounded((vertices, np.array([[0, 1, 2], [1, 0, 2]])), up, "facing").caps.tolist() == [[0, 1, 2]]
    assert bounded((vertices, np.array([[0, 1, 2], [1, 0, 2]])), up, "turned_away").caps.tolist() == [[1, 2, 0]]


@pytest.mark.parametrize("ulps", [-1, 0, 1])
@pytest.mark.parametrize("rule", RULES)
def test_silhouette_with_edge_on_walls_is_closed(rule: FacingRule, ulps: int):
    """The sun sees the walls of a box edge-on, up to a unit in the last place of one corner."""
    box = trimesh.creation.box()
    vertices = np.asarray(box.vertices, np.float32) + np.float32(0.7)
    vertices[3, 0] = np.nextafter(vertices[3, 0], np.float32(ulps * np.inf)) if ulps else vertices[3, 0]
    for light in ([0.0, 0.0, 1.0, 0.0], [0.0, -0.6, 0.8, 0.0], [1.2, 0.5, 4.0, 1.0]):
        bound = bounded((vertices, box.faces), np.array(light), rule)
        assert len(bound.edges) and not balance(bound).any()


@given(
    vertices=arrays(np.int8, (8, 3), elements=st.integers(-1, 1)), triangles=arrays(np.int8, (12, 3), elements=st.integers(0, 7)),
    light=st.tuples(*[st.integers(-2, 2)] * 3, st.integers(0, 1)).filter(any), rule=st.sampled_from(RULES),
)  # fmt: skip
def test_silhouette_of_random_triangles_is_closed(vertices, triangles, light, rule: FacingRule):
    bound = bounded((vertices.astype(float), triangles.astype(int)), np.array(light, float), rule)
    assert not balance(bound).any()


def test_facing_uses_float32_vertices():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1e-9], [1, 1, 1.0]])
    light = np.array([0.0, 1.0, 1e-10, 0.0])
    assert not facing(vertices, np.array([[0, 1, 2]]), light)[0]
    vertices[:, 2] += 1.0  # in float32 the triangle is level now
    assert facing(vertices, np.array([[0, 1, 2]]), light)[0]


def test_facing_is_false_for_edge_on_triangles():
    wall = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1]], float)
    assert not facing(wall, np.array([[0, 1, 2], [0, 2, 1]]), np.array([0.0, 0.0, 1.0, 0.0])).any()
    assert facing(wall, np.array([[0, 1, 2], [0, 2, 1]]), np.array([0.0, -1.0, 0.0, 1.0])).tolist() == [True, False]


def test_turns_of_rules_and_codes():
    faces = np.array([True, False])
    assert turns_of(faces, "facing").tolist() == [1, 0]
    assert turns_of(faces, "turned_away").tolist() == [0, -1]
    assert turns_of(faces, "all").tolist() == [1, -1]
    numbers = np.array([0, FACING_CODE, TURNED_AWAY_CODE, ALL_CODE], np.uint8)
    assert turns_of(np.ones(4, bool), numbers).tolist() == [0, 1, 0, 1]
    assert turns_of(np.zeros(4, bool), numbers).tolist() == [0, 0, -1, -1]
    assert turns_of(np.zeros(4, bool), numbers).dtype == np.int8


def test_silhouette_functions_name_invalid_arguments():
    with pytest.raises(InputError, match="rule: 'both' is not allowed. Allowed: facing or turned_away or all"):
        turns_of(np.ones(1, bool), "both")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="rule: '4' is not allowed. Allowed: 0 to 3"):
        turns_of(np.ones(2, bool), np.array([1, 4]))
    for light in ([0.0, 0.0, 0.0, 0.0], [0.0, np.nan, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.5]):
        with pytest.raises(InputError, match="light"):
            facing(np.eye(3), np.array([[0, 1, 2]]), np.array(light))


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
    sheet = sheet_of(position)
    own, general = sheet_silhouette(sheet, light, rule), bounded((position.reshape(-1, 3), sheet.triangles), light, rule)
    assert (own.edges.dtype, own.times.dtype, own.caps.dtype) == (np.int32, np.int32, np.int32)
    np.testing.assert_array_equal(own.caps, general.caps)
    for one, other in zip(
        *([*s.edges[np.lexsort(s.edges.T)].T, s.times[np.lexsort(s.edges.T)]] for s in (own, general)), strict=True
    ):
        np.testing.assert_array_equal(one, other)
