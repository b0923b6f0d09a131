"""Conservative map: certain points are right, however thin the casters are, and few points are masked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.shadows.hybrid.conservative_map import (
    LIT,
    MASKED,
    SHADED,
    ConservativeMap,
    classify_points,
    clipped_edges,
    clipped_triangles,
    conservative_map,
)
from skugga.shadows.hybrid.conservative_raster import MAX_DEPTH_RUNS

MAP_TEXELS = 12
STEPS_PER_TEXEL = 2**16
"""Steps per texel of the integer coordinates below, which make positions exact."""

CORNER_STEPS = 64
"""Corners are multiples of this, so that sixty-fourths of the distances between them are integers, too."""


def boundary_edges(triangles: np.ndarray) -> np.ndarray:
    """Return edges (e, 2, 3) whose signed sum over consistently oriented triangles (t, 3, 3) is not 0."""
    points, numbers = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    a = numbers.reshape(-1, 3)
    b = np.roll(a, -1, axis=1)
    pairs, edge_numbers = np.unique(np.sort(np.stack([a.ravel(), b.ravel()], axis=1), axis=1), axis=0, return_inverse=True)
    multiplicity = np.bincount(edge_numbers.ravel(), np.where(a.ravel() < b.ravel(), 1, -1), len(pairs))
    return points[pairs[(multiplicity != 0) & (pairs[:, 0] != pairs[:, 1])]]


def counter_clockwise(triangles: np.ndarray) -> np.ndarray:
    """Return the triangles (t, 3, 3), all counter-clockwise in (u, v)."""
    a, b, c = np.moveaxis(triangles[..., :2], 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return np.where((area < 0)[:, None, None], triangles[:, ::-1], triangles)


def count_layers_before(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how many triangles (t, 3, 3) int64, borders included, lie before points (n, 3) int64, in exact arithmetic."""
    count = np.zeros(len(points), np.int64)
    for corners in triangles:
        shares = []
        for k in range(3):
            a, b = corners[(k + 1) % 3], corners[(k + 2) % 3]
            shares.append((b[0] - a[0]) * (points[:, 1] - a[1]) - (b[1] - a[1]) * (points[:, 0] - a[0]))
        share = np.stack(shares, axis=1)
        area = share.sum(axis=1)
        count += (area > 0) & (share >= 0).all(axis=1) & (share @ corners[:, 2] < area * points[:, 2])
    return count


def triangle_soup(rng: np.random.Generator) -> np.ndarray:
    """Return triangles (t, 3, 3) int64: large, tiny, slivers, wires, edge-on, walls, and stacks of welded sheets."""

    def sample_points(n: int, margin: float = 3.0) -> np.ndarray:  # (n, 3) points
        return np.concatenate([rng.uniform(-margin, MAP_TEXELS + margin, (n, 2)), rng.uniform(0, 1, (n, 1))], axis=1)

    parts = [np.stack([sample_points(3) for _ in range(rng.integers(1, 4))])]
    for spread in (0.002, 0.1, 1.0):
        if rng.random() < 0.6:
            n = rng.integers(1, 8)
            parts.append(sample_points(n)[:, None] + rng.normal(0, 1, (n, 3, 3)) * [spread, spread, 0.1])
    for _ in range(rng.integers(0, 4)):  # wires, and strips of nearly no width
        a, b = sample_points(2)
        width_vector = np.append(np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a)[:2]), 0.0)
        width_vector = width_vector * rng.choice([2.0**-15, 0.004, 0.05, 0.3, 1.0, 2.0])
        parts.append(np.array([[a, b, b + width_vector], [a, b + width_vector, a + width_vector]]))
    if rng.random() < 0.4:  # a wall that stands on edge, at whole or fractional texels
        a, b = np.round(sample_points(2) * [1, 1, 8]) / [1, 1, 8] if rng.random() < 0.5 else sample_points(2)
        down = np.array([0.0, 0.0, 0.4])
        parts.append(np.array([[a, b, b + down], [a, b + down, a + down]]))
    for _ in range(rng.integers(0, 4)):
        n = rng.integers(2, 9)
        u, v = np.meshgrid(np.linspace(-1, MAP_TEXELS + 1, n), np.linspace(rng.uniform(-1, 6), MAP_TEXELS + 1, n))
        wobble = rng.choice([0.0, 0.2]) * (MAP_TEXELS / n)
        node = np.stack([u, v, np.full((n, n), rng.random())], axis=-1) + rng.uniform(-1, 1, (n, n, 3)) * [wobble, wobble, 0.1]
        a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
        sheet = np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
        parts.append(sheet[rng.random(len(sheet)) < rng.choice([1.0, 0.9])])
    return counter_clockwise(np.round(np.concatenate(parts) * STEPS_PER_TEXEL / CORNER_STEPS).astype(np.int64) * CORNER_STEPS)


def map_of_triangles(triangles: np.ndarray, size: tuple[int, int] = (MAP_TEXELS, MAP_TEXELS)) -> ConservativeMap:
    """Return the map of triangles in grid steps."""
    return conservative_map(size, triangles / STEPS_PER_TEXEL, boundary_edges(triangles) / STEPS_PER_TEXEL)


def points_on_triangles(triangles: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return points (n, 3) int64 exactly on triangles."""
    shares = rng.multinomial(CORNER_STEPS, [1 / 3, 1 / 3, 1 / 3], n)
    return np.einsum("nk,nkc->nc", shares, triangles[rng.integers(0, len(triangles), n)]) // CORNER_STEPS


def random_points(triangles: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return points (n, 3) int64 all over the map, on texel borders, and before and behind triangles."""
    points = np.round(rng.uniform(0, 1, (n, 3)) * [MAP_TEXELS, MAP_TEXELS, 1.1] * STEPS_PER_TEXEL).astype(np.int64)
    points[: n // 2, :2] = points_on_triangles(triangles, n // 2, rng)[:, :2]
    axis = rng.integers(0, 2, n)
    snapped = rng.random(n) < 0.3
    points[snapped, axis[snapped]] = points[snapped, axis[snapped]] // STEPS_PER_TEXEL * STEPS_PER_TEXEL
    return points


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_classify_points_is_right_where_certain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    triangles = triangle_soup(rng)
    points = random_points(triangles, 3000, rng)
    before = count_layers_before(triangles, points)
    rounding = rng.uniform(-1e-6, 1e-6, (2, len(points)))  # within the error of rounding
    classes = classify_points(
        map_of_triangles(triangles),
        points[:, 0] / STEPS_PER_TEXEL + rounding[0],
        points[:, 1] / STEPS_PER_TEXEL + rounding[1],
        points[:, 2] / STEPS_PER_TEXEL,
        1e-9,
    )
    assert not before[classes == LIT].any()
    assert (before[classes == SHADED] > 0).all()


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_classify_points_on_casters_is_right_where_certain(seed: int) -> None:
    rng = np.random.default_rng(seed)
    triangles = triangle_soup(rng)
    points = points_on_triangles(triangles, 3000, rng)
    before = count_layers_before(triangles, points)
    classes = classify_points(map_of_triangles(triangles), *(points / STEPS_PER_TEXEL).T, 1e-9, on_caster=True)
    assert not before[classes == LIT].any()
    assert (before[classes == SHADED] > 0).all()


SLOPES = [0.0, 0.05, 0.11, 0.25, 0.43, 0.6, 0.8, 1.0]


def wire_triangles(width: float, slope: float, intercept: float = 32.2) -> np.ndarray:
    """Return a wire (2, 3, 3) across a map of 64 texels, at depth 0.2."""
    direction = np.array([1.0, slope]) / np.hypot(1.0, slope)
    width_vector = width * np.array([-direction[1], direction[0]])
    ends = intercept + np.array([[-80.0], [80.0]]) * direction
    a, b, c, d = (np.append(p, 0.2) for p in (*ends, ends[1] + width_vector, ends[0] + width_vector))
    return np.array([[a, b, c], [a, c, d]])


def points_in_shadow(triangles: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return u, v (2, n') of points in the map covered by triangles of equal size."""
    shares = rng.dirichlet([1.0, 1.0, 1.0], n)
    u, v, _ = np.einsum("nk,nkc->cn", shares, triangles[rng.integers(0, len(triangles), n)])
    return np.stack([u, v])[:, (np.abs(u - 32) < 31) & (np.abs(v - 32) < 31)]


@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize("width", [0.05, 0.1, 0.25, 0.5, 0.75, 1.0, 2.0])
def test_conservative_map_misses_no_wire(width: float, slope: float) -> None:
    triangles, rng = wire_triangles(width, slope), np.random.default_rng(1)
    shadow_map = conservative_map((64, 64), triangles, boundary_edges(triangles))
    shadow_points = points_in_shadow(triangles, 10000, rng)
    assert shadow_points.shape[1] > 3000
    assert not (classify_points(shadow_map, *shadow_points, np.full(shadow_points.shape[1], 0.9), 1e-9) == LIT).any()
    uniform_points = rng.uniform(0, 64, (2, 20000))
    masked = (classify_points(shadow_map, *uniform_points, np.full(20000, 0.9), 1e-9) == MASKED).mean()
    assert masked <= (width * np.hypot(1.0, slope) + 2.0 + slope) / 64  # the texels that the wire touches


def test_depths_at_texel_centres_miss_thin_casters() -> None:
    """Chan and Durand's criterion compares two by two texels around a point. Its misses are why the conservative map exists."""
    rng, miss_shares = np.random.default_rng(1), []
    for slope in SLOPES:
        for intercept in rng.uniform(31, 33, 10):
            triangles = wire_triangles(0.25, slope, intercept)
            direction = np.array([1.0, slope]) / np.hypot(1.0, slope)
            u, v = np.floor(points_in_shadow(triangles, 2000, rng) - 0.5) + 0.5
            distances = [(v + j - intercept) * direction[0] - (u + i - intercept) * direction[1] for i in (0, 1) for j in (0, 1)]
            miss_shares.append((~((np.array(distances) >= 0) & (np.array(distances) <= 0.25)).any(axis=0)).mean())
    assert 0.3 < np.mean(miss_shares) < 0.7


def roof_triangles(turn_deg: float) -> np.ndarray:
    """Return two triangles (2, 3, 3): a rectangle of 60 x 40 texels at depth 10, in the middle of a map of 128."""
    rotation_rad = np.radians(turn_deg)
    corners = np.array([[-30.0, -20.0], [30.0, -20.0], [30.0, 20.0], [-30.0, 20.0]])
    corners = (
        corners @ np.array([[np.cos(rotation_rad), np.sin(rotation_rad)], [-np.sin(rotation_rad), np.cos(rotation_rad)]]) + 64.0
    )
    a, b, c, d = np.concatenate([corners, np.full((4, 1), 10.0)], axis=1)
    return np.array([[a, b, c], [a, c, d]])


@pytest.mark.parametrize("floor_casts", [False, True])
@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 45.0])
def test_conservative_map_masks_only_outlines(turn_deg: float, floor_casts: bool) -> None:
    roof, rng = roof_triangles(turn_deg), np.random.default_rng(1)
    a, b, c, d = np.array([[-1.0, -1.0, 20.0], [129.0, -1.0, 60.0], [129.0, 129.0, 90.0], [-1.0, 129.0, 50.0]])
    casters = np.concatenate([roof, [[a, b, c], [a, c, d]]]) if floor_casts else roof
    shadow_map = conservative_map((128, 128), casters, boundary_edges(casters))
    u, v = rng.uniform(0, 128, (2, 100_000))
    depth = 20.0 + 40.0 * (u + 1) / 130 + 30.0 * (v + 1) / 130
    classes = classify_points(shadow_map, u, v, depth, 1e-9, on_caster=floor_casts)
    side = np.roll(roof[[0, 0, 0, 1], [0, 1, 2, 2]], -1, axis=0)[:, :2] - roof[[0, 0, 0, 1], [0, 1, 2, 2]][:, :2]
    from_corner = np.stack([u, v], axis=-1)[:, None] - roof[[0, 0, 0, 1], [0, 1, 2, 2]][:, :2]
    dark = (side[:, 0] * from_corner[..., 1] - side[:, 1] * from_corner[..., 0] > 0).all(axis=1)
    certain = classes != MASKED
    assert ((classes == SHADED) == dark)[certain].all()
    assert (~certain).mean() * 128**2 < 2.1 * 200.0  # the outline is 200 texels long


def test_conservative_map_resolves_stacked_plates() -> None:
    """There are more plates than a texel has depth runs. Points before and on the first plate are lit, points behind it dark."""
    a, b, c, d = np.array([[-1.0, -1.0], [9.0, -1.0], [9.0, 9.0], [-1.0, 9.0]])
    plates = [[[*p, float(k)] for p in corners] for k in range(2 * MAX_DEPTH_RUNS + 1) for corners in ((a, b, c), (a, c, d))]
    shadow_map = conservative_map((8, 8), np.array(plates[::-1]), np.zeros((0, 2, 3)))
    assert (np.abs(shadow_map.nearest_depth) < 1e-9).all()
    assert (np.abs(shadow_map.nearest_other_depth - 1.0) < 1e-9).all()
    assert (np.abs(shadow_map.shadow_depth) < 1e-9).all()
    edge = np.array([[[4.5, 4.5, -1.0], [4.6, 4.6, -1.0]]])  # a wire before the plates does not change what they shade
    shadow_map = conservative_map((8, 8), np.array(plates), edge)
    assert shadow_map.nearest_depth[4, 4] == shadow_map.nearest_other_depth[4, 4] == pytest.approx(-1.0)
    assert abs(shadow_map.shadow_depth[4, 4]) < 1e-9
    edge[..., 2] = 0.0  # an edge in the first plate opens its run, and the next plate shades
    assert conservative_map((8, 8), np.array(plates), edge).shadow_depth[4, 4] == pytest.approx(1.0)


def test_conservative_map_keeps_a_hole_in_a_far_layer() -> None:
    """Layers beyond a texel's depth runs merge into one run, and a hole in any of them opens it."""
    a, b, c, d = np.array([[-1.0, -1.0], [9.0, -1.0], [9.0, 9.0], [-1.0, 9.0]])
    edges = np.array([[[-1.0, 4.5, float(k)], [9.0, 4.5, float(k)]] for k in range(MAX_DEPTH_RUNS + 2)])
    plates = np.array([[[*p, float(k)] for p in corners] for k in range(MAX_DEPTH_RUNS + 2) for corners in ((a, b, c), (a, c, d))])
    for layer in range(MAX_DEPTH_RUNS + 2):  # all layers but one have an edge at this texel
        shadow_map = conservative_map((8, 8), plates, np.delete(edges, layer, axis=0))
        assert shadow_map.shadow_depth[4, 4] == (pytest.approx(layer) if layer < MAX_DEPTH_RUNS - 1 else np.inf)
        assert (np.abs(shadow_map.shadow_depth[:4]) < 1e-9).all()


def test_conservative_map_merges_runs_in_any_order() -> None:
    """A steep sheet is welded of two parts, and the second is drawn when its texel has a free run again.

    A point beyond the second part may lie before the first.
    """
    tiny = np.array([[4.2, 4.2, 0.0], [4.3, 4.2, 0.0], [4.2, 4.3, 0.0]])
    bridge = tiny + [[0, 0, -0.5], [0, 0, 1.5], [0, 0, 1.5]]
    near_triangles = [tiny + [0.0, 0.0, float(k)] for k in range(MAX_DEPTH_RUNS)]
    far_edge, shared_edge, near_edge = (np.array([[u, -9.0, z], [u, 18.0, z]]) for u, z in ((-9.0, 60.0), (4.3, 10.0), (18.0, 8.0)))
    first = np.array([[far_edge[0], shared_edge[0], shared_edge[1]], [far_edge[0], shared_edge[1], far_edge[1]]])
    second = np.array([[shared_edge[0], near_edge[0], near_edge[1]], [shared_edge[0], near_edge[1], shared_edge[1]]])
    triangles = np.stack([*near_triangles, *first, bridge, *second])
    shadow_map = conservative_map((9, 9), triangles, boundary_edges(triangles))
    assert classify_points(shadow_map, np.array([4.1]), np.array([4.6]), np.array([10.2]), 1e-9) == MASKED


def test_conservative_map_counts_layers_at_shared_edges() -> None:
    """Two layers have the same depth. The edge between two triangles of one layer passes through the sample point."""
    plate = np.array([[[-40.0, -40.0, 1.0], [90.0, -40.0, 1.0], [-40.0, 90.0, 1.0]]])
    for rotation_rad in np.linspace(0.0, 6.0, 40):
        half_edge, apex_offset = 20.0 * np.array(
            [[np.cos(rotation_rad), np.sin(rotation_rad), 0.0], [-np.sin(rotation_rad), np.cos(rotation_rad), 0.0]]
        )
        probe = np.array([4.437, 4.613, 1.0])
        a, b = probe - half_edge, probe + half_edge
        triangles = np.concatenate([plate, [[a, b, probe + apex_offset], [b, a, probe - apex_offset]]])
        shadow_map = conservative_map((9, 9), triangles, boundary_edges(triangles))
        assert abs(shadow_map.nearest_other_depth[4, 4] - 1.0) < 1e-9
        assert abs(shadow_map.shadow_depth[4, 4] - 1.0) < 1e-9


def test_conservative_map_ignores_a_fin_seen_edge_on() -> None:
    """The fin has no thickness: both sides cast, and their edges cancel. It passes through the sample point."""
    for direction in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]):
        a = np.array([4.437, 4.613, 1.0]) - 8.0 * np.array(direction)
        b = a + 16.0 * np.array(direction)
        for offset in (0.0, 1e-12, 1e-8):
            c = (a + b) / 2 + [offset, 0.0, 3.0]
            fin = np.array([[a, b, c], [b, a, c]])
            shadow_map = conservative_map((9, 9), fin, np.zeros((0, 2, 3)))
            assert np.isinf(shadow_map.shadow_depth).all()
            assert shadow_map.nearest_depth[4, 4] == pytest.approx(1.0)


def test_conservative_map_is_robust_to_rounding_at_borders() -> None:
    """Triangles begin or end within rounding of a border, and rounding moves a point across it."""
    for end in (5.0 - 1e-9, 5.0, 5.0 + 1e-9):
        left = np.array([[[-20.0, -20.0, 1.0], [end, -20.0, 1.0], [end, 40.0, 1.0]]])
        right = np.array([[[end, -20.0, 1.0], [30.0, -20.0, 1.0], [end, 40.0, 1.0]]])
        for triangle in (left, right, left[..., [1, 0, 2]], right[..., [1, 0, 2]]):
            shadow_map = conservative_map((9, 9), triangle, boundary_edges(triangle))
            for coordinate in (5.0 - 1e-8, 5.0 + 1e-8):
                for u, v in ((coordinate, 4.3), (4.3, coordinate)):
                    on_border = (np.abs(triangle[0, :, 0 if u == coordinate else 1] - end) < 1e-6).sum() == 2
                    classes = classify_points(shadow_map, np.array([u]), np.array([v]), np.array([2.0]), 1e-9)
                    assert classes == MASKED or not on_border


def test_classify_points_masks_points_outside() -> None:
    shadow_map = conservative_map((4, 3), np.zeros((0, 3, 3)), np.zeros((0, 2, 3)))
    u, v = np.array([0.0, 3.99, -1e-9, 4.0, 1.0, 1e300, np.nan]), np.array([0.0, 2.99, 1.0, 1.0, 3.0, 1.0, 1.0])
    assert classify_points(shadow_map, u, v, np.zeros(7), 0.0).tolist() == [LIT, LIT] + 5 * [MASKED]


def test_conservative_map_ignores_triangles_outside() -> None:
    triangle = np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 1.0], [0.0, 3.0, 1.0]])
    for offset in ([-9, 0], [9, 0], [0, -9], [0, 9], [-6, 4], [5, 5], [-1e6, 1e6]):
        shifted = triangle + [*offset, 0.0]
        assert np.isinf(conservative_map((4, 4), shifted[None], boundary_edges(shifted[None])).nearest_depth).all()


@given(st.integers(0, 2**32 - 1))
def test_clipping_keeps_areas_and_edges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    triangles, z_near = rng.uniform(-1, 1, (20, 3, 3)), 0.25
    front_triangles = clipped_triangles(triangles, z_near)
    mirror = np.array([1.0, 1.0, -1.0])
    back_triangles = clipped_triangles(triangles * mirror, -z_near) * mirror

    def area(t: np.ndarray) -> np.ndarray:  # (t, 3)
        return np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) / 2

    assert (front_triangles[..., 2] >= z_near).all() and (back_triangles[..., 2] <= z_near).all()
    np.testing.assert_allclose(
        area(front_triangles).sum(axis=0) + area(back_triangles).sum(axis=0), area(triangles).sum(axis=0), atol=1e-12
    )
    total_area = np.linalg.norm(area(triangles), axis=1).sum()
    assert sum(np.linalg.norm(area(t), axis=1).sum() for t in (front_triangles, back_triangles)) == pytest.approx(total_area)
    for edges in (triangles[:, [0, 1]], triangles[:, [1, 0]]):
        ends = clipped_edges(edges, z_near).reshape(-1, 3)
        assert {tuple(end) for end in ends} <= {tuple(corner) for corner in front_triangles.reshape(-1, 3)}


def test_clipped_lamp_depth_is_linear_over_the_map() -> None:
    """(u, v, -1/z) interpolates linearly between the corners of a clipped triangle in perspective."""
    rng = np.random.default_rng(3)
    corners = clipped_triangles(np.array([[[-1.0, -2.0, -1.0], [3.0, 1.0, 4.0], [-2.0, 2.0, 6.0]]]), 0.1)
    assert len(corners) == 2
    for triangle in corners:
        points = rng.dirichlet([1.0, 1.0, 1.0], 50) @ triangle
        project = np.stack([points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], np.ones(50)])
        u, v, z = triangle.T
        shares = np.linalg.solve(np.stack([u / z, v / z, np.ones(3)]), project)
        np.testing.assert_allclose((-1 / z) @ shares, -1 / points[:, 2], rtol=1e-9)
