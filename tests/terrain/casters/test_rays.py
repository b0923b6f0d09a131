"""Ground truth rays against shadows known in closed form, and their start offset."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from skugga.terrain.casters.rays import AlphaMesh, RayScene, sample_alpha
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.ground.sheet import Sheet, sheet_of

PIXEL_M = 0.5
OUTLINE_TOLERANCE_PX = 0.02
SUN_ANGLES_DEG = [(190.0, 45.0), (233.0, 17.0), (67.0, 24.0), (311.0, 71.0)]


def receiver_plane(tilt: float, size_m: float = 200.0) -> tuple[Sheet, np.ndarray, np.ndarray]:
    """Return a plane z = tilt * x as a sheet, its pixels' centres (n, 3), and its unit normal."""
    axis = np.linspace(-size_m, size_m, 9)
    x, y = np.meshgrid(axis, -axis)
    normal = np.array([-tilt, 0.0, 1.0]) / np.hypot(tilt, 1.0)
    centres = np.arange(-size_m + PIXEL_M / 2, size_m, PIXEL_M)
    px, py = np.meshgrid(centres, -centres)
    return sheet_of(np.stack([x, y, tilt * x], -1)), np.stack([px, py, tilt * px], -1).reshape(-1, 3), normal


def hull_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the signed distance (negative inside) of points (n, 2) from the convex hull of corners (m, 2)."""
    hull = ConvexHull(corners)
    return np.max(points @ hull.equations[:, :2].T + hull.equations[:, 2], axis=1)


def project_along_sun(points: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Project points along the sun's direction onto z = 0: (n, 2)."""
    return (points - points[:, 2:] / sun[2] * sun)[:, :2]


def box(centre, half) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8, 3) and triangles (12, 3) of a box with half sides ``half``."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * half + centre
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])


def cone_mesh(apex: np.ndarray, ring: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a closed cone with an apex (3,) and a base ring (n, 3)."""
    n = len(ring)
    index = np.arange(n)
    sides = np.stack([np.zeros(n, int), 1 + index, 1 + (index + 1) % n], 1)
    base = np.stack([np.full(n - 2, 1), 2 + index[: n - 2], 3 + index[: n - 2] - (index[: n - 2] == n - 1)], 1)[: n - 2]
    return np.vstack([apex, ring]), np.vstack([sides, base])


def sphere(centre: np.ndarray, radius: float, rings: int = 700) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a sphere."""
    latitude, longitude = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij"
    )
    vertices = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1)
    index = np.arange(latitude.size).reshape(latitude.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([d, c, b], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3) * radius + centre, triangles


def check_shadow(mesh, tilt: float, sun: np.ndarray, distance) -> None:
    """Assert that every pixel farther than 0.02 px from the outline agrees.

    ``distance`` returns the signed distance from the outline, measured on z = 0 along the sun.
    """
    sheet, points, normal = receiver_plane(tilt)
    assert normal @ sun > 0.02
    scene = RayScene([sheet], [mesh])
    blocked = scene.is_blocked(points + scene.offset_m * normal, sun)
    outline_distance = distance(points)
    far = np.abs(outline_distance) > OUTLINE_TOLERANCE_PX * PIXEL_M
    assert 0.001 < blocked.mean() < 0.5 and far.mean() > 0.99
    is_mismatch = far & (blocked != (outline_distance < 0))
    assert is_mismatch.sum() == 0, (
        f"{is_mismatch.sum()} of {far.sum()}, up to {np.abs(outline_distance[is_mismatch]).max():.3f} m from the outline"
    )


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize(("azimuth", "altitude"), SUN_ANGLES_DEG)
def test_rays_match_the_shadow_of_a_box(tilt, azimuth, altitude):
    sun = direction_enu(azimuth, altitude)
    mesh = box([0.0, 0.0, 40.0], [10.0, 6.0, 8.0])
    check_shadow(mesh, tilt, sun, lambda points: hull_distance(project_along_sun(points, sun), project_along_sun(mesh[0], sun)))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize(("azimuth", "altitude"), SUN_ANGLES_DEG)
def test_rays_match_the_shadow_of_a_thin_wall(tilt, azimuth, altitude):
    sun = direction_enu(azimuth, altitude)
    mesh = box([5.0, 0.0, 40.0], [0.05, 60.0, 12.0])
    check_shadow(mesh, tilt, sun, lambda points: hull_distance(project_along_sun(points, sun), project_along_sun(mesh[0], sun)))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize(
    ("azimuth", "altitude"), [SUN_ANGLES_DEG[0], *(pytest.param(*sun, marks=pytest.mark.long) for sun in SUN_ANGLES_DEG[1:])]
)
def test_rays_match_the_shadow_of_a_sphere(tilt, azimuth, altitude):
    """A point is in shadow if its ray passes the centre within the radius.

    The mesh itself errs by r (1 - cos(half a step)): 0.1 mm.
    """
    sun, centre, radius = direction_enu(azimuth, altitude), np.array([0.0, 0.0, 45.0]), 12.0

    def distance(points: np.ndarray) -> np.ndarray:
        to_centre = centre - points
        return np.linalg.norm(to_centre - (to_centre @ sun)[:, None] * sun, axis=1) - radius

    check_shadow(sphere(centre, radius), tilt, sun, distance)


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize(("azimuth", "altitude"), SUN_ANGLES_DEG)
def test_rays_match_the_shadow_of_a_cone(tilt, azimuth, altitude):
    """The shadow is the hull of the disc and the apex, projected along the sun onto the disc's plane: tangents from the apex."""
    sun, base_z, radius, apex = direction_enu(azimuth, altitude), 30.0, 10.0, np.array([0.0, 0.0, 55.0])
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(4000, base_z)], 1)
    tip = (apex - (apex[2] - base_z) / sun[2] * sun)[:2]

    def distance(points: np.ndarray) -> np.ndarray:
        projected_points = (points - (points[:, 2:] - base_z) / sun[2] * sun)[:, :2]
        disc = np.linalg.norm(projected_points, axis=1) - radius
        reach = np.linalg.norm(tip)
        if reach <= radius:
            return disc
        towards = tip / reach
        u, v = projected_points @ towards, np.abs(projected_points @ np.array([-towards[1], towards[0]]))
        sine = radius / reach
        cosine = np.sqrt(1 - sine**2)
        side = u * sine + v * cosine - radius  # from the tangent; it touches at u = radius * sine
        wedge = (u * cosine - v * sine > 0) & (u > radius * sine - 1e-9)
        return np.where(wedge, np.where(u < reach, side, np.maximum(side, 0.0)), disc)

    check_shadow(cone_mesh(apex, ring), tilt, sun, distance)


def test_start_offset_neither_self_intersects_nor_leaks():
    """On rough ground 40 km wide no ray meets the triangle that it starts on. No start is lifted over neighbouring triangles."""
    rng = np.random.default_rng(2)
    n = 400
    x, y = np.meshgrid(np.arange(n) * 100.0, -np.arange(n) * 100.0)
    z = rng.normal(size=(n, n)).cumsum(0).cumsum(1) * 0.5 + 3000.0
    sheet = sheet_of(np.stack([x, y, z], -1))
    scene = RayScene([sheet])
    assert scene.offset_m == pytest.approx(16 * 20_000 / 2**24, rel=0.2)
    corners = sheet.position_frame_m.reshape(-1, 3)[sheet.triangles].transpose(1, 0, 2)
    middle = corners.mean(axis=0)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    start = middle + scene.offset_m * normal
    assert not scene.is_blocked(start, np.array([0.0, 0.0, 1.0])).any()
    assert not scene.is_blocked(start, normal).mean() > 0.02  # rays along the normal are blocked by other ground only
    assert scene.is_blocked(middle - scene.offset_m * normal, np.array([0.0, 0.0, 1.0])).all()


def test_rays_pass_through_transparent_texels():
    """Five alpha-tested sheets lie one behind the other, each opaque in a different fifth.

    Together they block all rays, alone a fifth.
    """
    corners = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * 10
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
    x = np.linspace(-9.9, 9.9, 400)
    start = np.stack([x, np.full(400, -5.0), np.full(400, 0.5)], 1)
    north = np.array([0.0, 1.0, 0.0])
    meshes = []
    for k in range(5):
        alpha = np.zeros((20, 20))
        alpha[:, 4 * k : 4 * k + 4] = 1.0
        meshes.append(AlphaMesh(corners + [0, 3.0 * k, 0], triangles, uv, alpha, 0.5))
        expected = (x >= -10 + 4 * k) & (x < -6 + 4 * k)
        is_off_edge = np.abs(np.abs(x - (-8 + 4 * k)) - 2) > 0.06
        is_blocked = RayScene(alpha_meshes=[meshes[-1]]).is_blocked(start, north)
        np.testing.assert_array_equal(is_blocked[is_off_edge], expected[is_off_edge])
    assert RayScene(alpha_meshes=meshes).is_blocked(start, north).mean() > 0.99
    stacked = AlphaMesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([triangles + 4 * k for k in range(5)]),
        np.tile(uv, (5, 1)),
        np.where(np.arange(20) >= 10, 1.0, 0.0)[None, :].repeat(20, 0),
    )
    is_blocked = RayScene(alpha_meshes=[stacked]).is_blocked(start, north)
    np.testing.assert_array_equal(is_blocked[np.abs(x) > 0.06], (x > 0)[np.abs(x) > 0.06])
    assert not RayScene(alpha_meshes=[AlphaMesh(corners, triangles, uv, np.zeros((4, 4)))]).is_blocked(start, north).any()


def test_alpha_is_bilinear_between_texel_centres():
    alpha = np.array([[0.0, 1.0], [1.0, 0.0]])
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [0.5, 0.25]])
    np.testing.assert_allclose(sample_alpha(alpha, uv), [0, 1, 0.5, 0, 1, 0.5])


def test_an_empty_scene_blocks_no_ray():
    assert not RayScene().is_blocked(np.zeros((3, 3)), np.array([0.0, 0.0, 1.0])).any()
    assert RayScene([sheet_of(np.full((3, 3, 3), np.nan))]).is_blocked(np.zeros((0, 3)), np.array([0.0, 0.0, 1.0])).shape == (0,)
