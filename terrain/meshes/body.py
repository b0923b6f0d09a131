"""Bodies: meshes in their own coordinates, and bodies placed on the earth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.ground.ground_path import GroundPath
from skugga.terrain.meshes.surface import Surface, SurfaceBounds
from skugga.terrain.srgb import linear_of_srgb

NEUTRAL_GRAY = (0.6, 0.6, 0.6)
"""Default sRGB colour: light gray."""

MIN_CREASE_DEG = 30.0
"""Largest angle between two faces that are shaded as one curved surface."""

MAX_SMOOTHED_CORNERS = 512
"""Maximum number of corners at a vertex whose normals are smoothed, since their faces are compared pair by pair.

More corners meet in the middle of a large fan, or if faces coincide. Each face then has its own normal. The difference is invisible
between such faces.
"""

MERGE_TOLERANCE_SHARE = 1e-8
"""Tolerance for merging vertices, as a share of the body's size."""


VectorLike = Sequence[float] | np.ndarray


def srgb_albedo(color: VectorLike) -> np.ndarray:
    """Return the linear albedo (..., 3) float32 of sRGB colours in [0, 1]."""
    return linear_of_srgb(np.asarray(color, np.float64)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in its own coordinates. The constructor drops triangles without an area.

    Attributes
    ----------
    vertices_m
        float64 (n, 3): east, north, up from the body's origin, metres. ``PlacedBody.earth_from_body`` may define other axes.
    triangles
        int32 (m, 3), counter-clockwise from outside.
    albedo
        float32 (m, 3), linear, in [0, 1]; one colour (3,) is broadcast to all triangles.
    surface
        Textures and materials of the triangles; ``None`` for triangles of one colour each.
    warnings
        Sentences on what a file asks for that is ignored.
    crease_deg
        float64 (m,): for each triangle the largest angle to a face that is shaded with it as one curved surface, degrees; ``None``
        for ``MIN_CREASE_DEG``.
    """

    vertices_m: np.ndarray
    triangles: np.ndarray
    albedo: np.ndarray
    surface: Surface | None = None
    warnings: tuple[str, ...] = ()
    crease_deg: np.ndarray | None = None

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices_m, np.float64).reshape(-1, 3)
        triangles = np.asarray(self.triangles, np.int32).reshape(-1, 3)
        albedo = np.broadcast_to(np.asarray(self.albedo, np.float32), triangles.shape)
        has_area = _has_area(vertices, triangles)
        object.__setattr__(self, "vertices_m", vertices)
        object.__setattr__(self, "triangles", triangles[has_area])
        object.__setattr__(self, "albedo", albedo[has_area])
        if self.surface is not None and not has_area.all():
            object.__setattr__(self, "surface", self.surface.select(has_area))
        if self.crease_deg is not None:
            object.__setattr__(self, "crease_deg", np.asarray(self.crease_deg, np.float64)[has_area])

    @cached_property
    def merged_triangles(self) -> np.ndarray:
        """The triangles (m, 3) int32 with one index for all vertices at the same position."""
        low, high = self.vertices_m.min(axis=0, initial=np.inf), self.vertices_m.max(axis=0, initial=-np.inf)
        step = MERGE_TOLERANCE_SHARE * max(float(np.max(high - low, initial=0.0)), 1e-30)
        cells = np.rint((self.vertices_m - low) / step).astype(np.int64)
        _, vertex_index = np.unique(cells, axis=0, return_inverse=True)
        return vertex_index.reshape(-1).astype(np.int32)[self.triangles]

    @cached_property
    def is_closed(self) -> bool:
        """Whether the surface is closed: every directed edge occurs once, and once reversed, after merging vertices by position."""
        a = self.merged_triangles.astype(np.int64)
        if not len(a):
            return False
        start, end = a.ravel(), np.roll(a, -1, axis=1).ravel()
        span = int(a.max()) + 1
        forward, reverse = np.sort(start * span + end), np.sort(end * span + start)
        return bool((forward == reverse).all() and (np.diff(forward) > 0).all())

    @cached_property
    def surface_bounds(self) -> list[SurfaceBounds]:
        """Bounds of what the body's materials show; empty without a ``surface``."""
        return [] if self.surface is None else self.surface.bounds(self.vertices_m[self.triangles], self.albedo)

    @cached_property
    def bounding_sphere(self) -> tuple[np.ndarray, float]:
        """Centre (3,) and radius of a sphere around the triangles, metres."""
        corners = self.vertices_m[self.triangles].reshape(-1, 3)
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        return centre, float(np.linalg.norm(corners - centre, axis=1).max())

    @property
    def volume_m3(self) -> float:
        """Signed volume: positive if the triangles of a closed body face outwards."""
        a, b, c = np.moveaxis((self.vertices_m - self.vertices_m[:1])[self.triangles], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def corner_normals(self, crease_deg: float | None = None) -> np.ndarray:
        """Return unit shading normals (m, 3, 3) float32 at the triangles' corners.

        A corner's normal is the mean of the normals of the faces around its vertex that lie within ``crease_deg`` of the triangle's
        own normal; ``None`` stands for the angles of the body. Weights are the faces' angles at the vertex, so the result does not
        depend on the triangulation (Thuermer and Wuethrich 1998, "Computing vertex normals from polygonal facets", J. Graphics
        Tools 3(1):43-46).
        """
        if crease_deg is not None or self.crease_deg is None:
            return _corner_normals(self, MIN_CREASE_DEG if crease_deg is None else float(crease_deg))
        angles = np.unique(self.crease_deg)
        normals = _corner_normals(self, float(angles[0])).copy()
        for angle in angles[1:]:
            has_angle = self.crease_deg == angle
            normals[has_angle] = _corner_normals(self, float(angle))[has_angle]
        return normals


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Motion of a body by the clock: a spin about its up axis, a path, or both.

    Attributes
    ----------
    spin_deg_per_s
        Counter-clockwise about the up axis, degrees per second.
    path
        Path of the body's origin.
    faces_along_path
        Whether the body's south side faces along the path.
    """

    spin_deg_per_s: float = 0.0
    path: GroundPath | None = None
    faces_along_path: bool = False

    def yaw_deg(self, seconds: float) -> float:
        """Return the body's rotation at a second of the level's clock, degrees counter-clockwise."""
        heading = 180.0 - self.path.azimuth_deg(seconds) if self.faces_along_path and self.path is not None else 0.0
        return heading + self.spin_deg_per_s * seconds


@dataclass(frozen=True, eq=False)
class Footprint:
    """The footprint that a building was extruded from. Its façades follow from it (``skugga.terrain.meshes.facades``).

    Attributes
    ----------
    hash_bits
        32 bits that choose the building's materials. All polygons of a feature have the same.
    ground_floor_m
        Height of the ground floor above the body's lowest vertices: the mean ground along the outline; 0 if the building begins
        above the ground. Metres.
    eaves_m
        Height of the tops of the walls above the ground floor, metres. A sloped roof begins at them.
    corner_ground_m
        float32 (n,), height of the ground at the n corners above the ground floor, metres; NaN where unknown. Vertices [0, n) of
        the body are the corners at the tops of the walls, [n, 2 n) those at the floor. Those of a sloped roof follow.
    """

    hash_bits: int
    ground_floor_m: float
    eaves_m: float
    corner_ground_m: np.ndarray


@dataclass(frozen=True, eq=False)
class PlacedBody:
    """A body on the earth, before its motion: ``vertex_earth = origin_earth_m + earth_from_body @ vertex``.

    Attributes
    ----------
    body
        The mesh.
    origin_earth_m
        Earth-fixed position of the body's origin, float64 (3,), metres.
    earth_from_body
        Rotation (3, 3) float64 from the body's to earth-fixed axes.
    motion
        Motion by the level's clock; ``None`` for a body at rest.
    footprint
        The footprint of a building; ``None`` for other bodies.
    """

    body: Body
    origin_earth_m: np.ndarray
    earth_from_body: np.ndarray
    motion: BodyMotion | None = None
    footprint: Footprint | None = None


def box(size_m: VectorLike, centre_m: VectorLike = (0.0, 0.0, 0.0), albedo: VectorLike | None = None) -> Body:
    """Return a box of ``size_m`` (east, north, up) around its centre; ``albedo`` is linear."""
    return _body_of_mesh(trimesh.creation.box(extents=size_m), centre_m, albedo)


def transformed(body: Body, offset_m: Sequence[float] = (0.0, 0.0, 0.0), yaw_deg: float = 0.0, scale: float = 1.0) -> Body:
    """Return a body scaled, then turned counter-clockwise about the up axis through its origin, then moved."""
    vertices = scale * body.vertices_m @ rotation_about_up(yaw_deg).T + np.asarray(offset_m, np.float64)
    return replace(body, vertices_m=vertices)


def rotation_about_up(yaw_deg: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a counter-clockwise turn about the up axis."""
    # The remainder keeps precision, because the angle grows with the clock without bound.
    angle_rad = np.radians(np.remainder(yaw_deg, 360.0))
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _body_of_mesh(mesh: trimesh.Trimesh, centre_m: VectorLike, albedo: VectorLike | None) -> Body:
    """Return a mesh of trimesh, moved by ``centre_m`` (3,). Its linear albedo is by default that of ``NEUTRAL_GRAY``."""
    color = srgb_albedo(NEUTRAL_GRAY) if albedo is None else np.asarray(albedo, np.float32)
    return Body(np.asarray(mesh.vertices) + np.asarray(centre_m, np.float64), np.asarray(mesh.faces), color)


def _has_area(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return a mask of the triangles (m, 3) whose area float64 distinguishes from 0."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.einsum("ij,ij->i", side, side) for side in (b - a, c - b, a - c)], axis=0)
    return double_area > 1e-12 * longest


@cached("scene", 256 * MIB)
def _corner_normals(body: Body, crease_deg: float) -> np.ndarray:
    """Return the result of ``Body.corner_normals``, read-only."""
    merged_triangles = body.merged_triangles
    count = int(merged_triangles.max(initial=-1)) + 1
    corners_by_vertex = np.argsort(merged_triangles.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(merged_triangles.ravel(), minlength=count))])
    # A tolerance, so that rounding does not separate faces at exactly the crease angle.
    min_cos = np.cos(np.radians(min(crease_deg, 180.0))) - 1e-9
    normals = _smoothed_normals(body.vertices_m[body.triangles], corners_by_vertex, first, min_cos, MAX_SMOOTHED_CORNERS)
    normals.flags.writeable = False
    return normals


@compiled
def _smoothed_normals(corners, corners_by_vertex, first, min_cos, max_corners):
    """Return angle-weighted means of face normals within the crease angle, float32 (m, 3, 3), at the corners of m triangles.

    ``corners`` (m, 3, 3) are the triangles' corners. ``corners_by_vertex`` (3 m,) holds flat indices of corners, of which those at
    vertex n are ``corners_by_vertex[first[n] : first[n + 1]]``. ``min_cos`` is the cosine of the crease angle. Corners at a vertex
    with more than ``max_corners`` corners get the normal of their own face.
    """
    count = corners.shape[0]
    normal = np.empty((count, 3))
    angle = np.empty((count, 3))
    for t in range(count):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        n = np.cross(b - a, c - a)
        normal[t] = n / np.sqrt((n * n).sum())
        for k in range(3):
            p, q, r = corners[t, k], corners[t, (k + 1) % 3], corners[t, (k + 2) % 3]
            n = np.cross(q - p, r - p)
            angle[t, k] = np.arctan2(np.sqrt((n * n).sum()), ((q - p) * (r - p)).sum())
    out = np.empty((count, 3, 3), np.float32)
    for vertex in range(first.shape[0] - 1):
        is_crowded = first[vertex + 1] - first[vertex] > max_corners
        for i in range(first[vertex], first[vertex + 1]):
            t, k = corners_by_vertex[i] // 3, corners_by_vertex[i] % 3
            if is_crowded:
                out[t, k, 0], out[t, k, 1], out[t, k, 2] = normal[t, 0], normal[t, 1], normal[t, 2]
                continue
            x, y, z = 0.0, 0.0, 0.0
            for j in range(first[vertex], first[vertex + 1]):
                s, w = corners_by_vertex[j] // 3, angle[corners_by_vertex[j] // 3, corners_by_vertex[j] % 3]
                if normal[t, 0] * normal[s, 0] + normal[t, 1] * normal[s, 1] + normal[t, 2] * normal[s, 2] >= min_cos:
                    x += w * normal[s, 0]
                    y += w * normal[s, 1]
                    z += w * normal[s, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                out[t, k, 0], out[t, k, 1], out[t, k, 2] = x / length, y / length, z / length
            else:
                out[t, k, 0], out[t, k, 1], out[t, k, 2] = normal[t, 0], normal[t, 1], normal[t, 2]
    return out
