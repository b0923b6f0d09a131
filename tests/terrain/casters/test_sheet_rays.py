"""Rays that traverse sheets hit what Embree's rays hit, and leak nowhere."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.casters.rays import RayScene
from skugga.terrain.casters.sheet_rays import SheetRays
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.ground.sheet import Sheet, sheet_of
from tests.terrain.casters.test_rays import box

SUN_ANGLES_DEG = [(237.0, 3.0), (120.0, 15.0), (0.0, 30.0), (200.0, 62.0), (0.0, 90.0)]


def rough_sheet(seed: int, rows: int, cols: int, step_m: float, holes: int = 0, first_col: int = 0) -> Sheet:
    """Return rough ground with the earth's curvature and missing nodes."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid((first_col + np.arange(cols)) * step_m, -np.arange(rows) * step_m)
    z = rng.normal(size=(rows, cols)).cumsum(0).cumsum(1) * 0.02 * step_m + rng.normal(size=(rows, cols)) * 0.1 * step_m
    z -= (x**2 + y**2) / (2 * 6.371e6)
    height = z.copy()
    height[rng.integers(0, rows, holes), rng.integers(0, cols, holes)] = np.nan
    points = np.stack([x, y, height], -1)
    points[np.isnan(height)] = np.nan
    return sheet_of(points, height)


def random_points_on_sheet(sheet: Sheet, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random points on a sheet's triangles (n, 3), and these triangles' normals."""
    rng, nodes = np.random.default_rng(seed), sheet.position_frame_m.reshape(-1, 3)
    corners = nodes[sheet.triangles[rng.integers(0, len(sheet.triangles), count)]]
    share = rng.dirichlet([1.0, 1.0, 1.0], count)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.einsum("nk,nkj->nj", share, corners), normal / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.parametrize(("azimuth", "altitude"), SUN_ANGLES_DEG)
def test_traversing_rays_agree_with_embree_where_decidable(azimuth, altitude):
    """A ray is decidable if one, two and four times the start offset give the same answer.

    Fine and coarser ground lie side by side, with holes and a body. Their odd node counts fill no tile.
    """
    sun = direction_enu(azimuth, altitude)
    sheets = [rough_sheet(3, 131, 94, 30.0, holes=40), rough_sheet(4, 66, 37, 60.0, first_col=47), rough_sheet(5, 3, 2, 500.0)]
    meshes = [box([1500.0, -900.0, 200.0], [80.0, 40.0, 150.0])]
    scenes = RayScene(sheets, meshes), RayScene(sheets, meshes, traverse_sheets=True)
    assert scenes[0].offset_m == scenes[1].offset_m
    points, normal = random_points_on_sheet(sheets[0], 40_000, 6)
    upward_normal = normal * np.sign(normal @ sun)[:, None]
    is_blocked = np.array(
        [
            [ray_scene.is_blocked(points + k * ray_scene.offset_m * upward_normal, sun) for k in (1.0, 2.0, 4.0)]
            for ray_scene in scenes
        ]
    )
    is_decidable = (is_blocked[:, :1] == is_blocked).all(axis=(0, 1))
    assert is_decidable.mean() > 0.99
    assert np.array_equal(is_blocked[0, 0][is_decidable], is_blocked[1, 0][is_decidable])
    assert altitude == 90.0 or 0.02 < is_blocked[0, 0].mean() < 0.98


@pytest.mark.parametrize(("azimuth", "altitude"), SUN_ANGLES_DEG)
def test_traversing_rays_leak_at_no_edge_or_node(azimuth, altitude):
    """Rays start below the ground and aim at nodes, at the middles of quads' sides and at the middles of their diagonals.

    The ground is never as steep as the rays, because rounding decides beside a silhouette.
    """
    sun, nodes = direction_enu(azimuth, altitude), rough_sheet(7, 40, 40, 10.0).position_frame_m
    steepest = max(np.abs(np.diff(nodes[..., 2], axis=axis)).max() for axis in (0, 1)) / 10.0
    nodes[..., 2] *= 0.3 * min(np.tan(np.radians(altitude)), 1.0) / steepest
    sheet = sheet_of(nodes)
    diagonal_middles = np.where(sheet.is_cut_nw_se[..., None], nodes[:-1, :-1] + nodes[1:, 1:], nodes[1:, :-1] + nodes[:-1, 1:]) / 2
    places = [
        nodes[1:-1, 1:-1],
        (nodes[1:-1, 1:-2] + nodes[1:-1, 2:-1]) / 2,
        (nodes[1:-2, 1:-1] + nodes[2:-1, 1:-1]) / 2,
        diagonal_middles,
    ]
    rays = SheetRays([sheet], np.zeros(3))
    for place in places:
        for distance_m in (1e-3, 1.0, 7.0):
            assert rays.is_blocked(place.reshape(-1, 3) - distance_m * sun, sun).all()


@pytest.mark.parametrize("z_direction", [1.0, -1.0])
def test_edges_and_nodes_belong_to_a_triangle(z_direction):
    """All values are exact: vertical rays meet a level sheet at whole and half metres."""
    x, y = np.meshgrid(np.arange(9.0), -np.arange(9.0))
    places = np.stack(np.meshgrid(np.arange(0.0, 8.1, 0.5), -np.arange(0.0, 8.1, 0.5)), -1).reshape(-1, 2)
    starts = np.column_stack([places, np.full(len(places), -z_direction)])
    for is_cut_nw_se in (False, True):
        sheet = Sheet(np.stack([x, y, np.zeros((9, 9))], -1), np.full((8, 8), is_cut_nw_se))
        assert SheetRays([sheet], np.zeros(3)).is_blocked(starts, np.array([0.0, 0.0, z_direction])).all()


def test_a_sheet_is_walked_in_several_directions():
    sheet = rough_sheet(8, 60, 60, 30.0)
    traversed, embree = RayScene([sheet], traverse_sheets=True), RayScene([sheet])
    points, _ = random_points_on_sheet(sheet, 2000, 9)
    for azimuth in (40.0, 160.0, 280.0):
        sun = direction_enu(azimuth, 8.0)
        starts = points + [0.0, 0.0, 0.5]
        assert (traversed.is_blocked(starts, sun) == embree.is_blocked(starts, sun)).mean() > 0.999


def test_traversing_rays_refuse_lengths_and_accept_empty_input():
    sun, points = direction_enu(180.0, 20.0), np.zeros((3, 3))
    scene = RayScene([rough_sheet(1, 8, 8, 1.0)], traverse_sheets=True)
    for arguments in ({"direction": np.tile(sun, (3, 1))}, {"direction": sun, "length_m": np.ones(3)}):
        with pytest.raises(ValueError, match="traverse_sheets"):
            scene.is_blocked(points, **arguments)
    assert scene.is_blocked(np.zeros((0, 3)), sun).shape == (0,)
    assert not RayScene(traverse_sheets=True).is_blocked(points, sun).any()
    assert not RayScene([sheet_of(np.full((9, 9, 3), np.nan))], traverse_sheets=True).is_blocked(points, sun).any()
