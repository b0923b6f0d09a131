"""Find the planes on which `planar` draws shadows, and the casters that may shade each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.casters.casting import VerticesAndTriangles
from skugga.terrain.gbuffer.facet_planes import MAX_PLANES, visible_facets
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.ground_plane import ground_plane
from skugga.terrain.scene import Scene

GROUND_NUMBER = 1
"""The number of the ground's plane. Planes of meshes have the numbers after it."""


@dataclass(frozen=True, eq=False)
class ReceiverPlane:
    """A plane that receives shadows.

    Attributes
    ----------
    number
        Its number in ``Receivers.plane_of_point``.
    origin_frame_m
        A point (3,) of the plane near the receivers, metres.
    normal_frame
        Its unit normal (3,), out of the surface.
    error_m
        Upper bound of the distance of the receivers from the plane, metres; 0 for the ground.
    corners_frame_m
        The corners (n, 3) of the visible facets; ``None`` for the ground, whose extent is not searched.
    """

    number: int
    origin_frame_m: np.ndarray
    normal_frame: np.ndarray
    error_m: float = 0.0
    corners_frame_m: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Receivers:
    """The planes that receive shadows.

    Attributes
    ----------
    planes
        The planes in the order of their numbers, the ground first.
    plane_of_point
        uint8 (rows, cols), the number of the plane of each of a buffer's points; 0 for none.
    ground_corners_frame_m
        The corners (4, 3) of ground that slopes, in order round it, metres; ``None`` for level ground.
    """

    planes: list[ReceiverPlane]
    plane_of_point: np.ndarray
    ground_corners_frame_m: np.ndarray | None

    def ground_casters(self, light_frame: np.ndarray) -> list[VerticesAndTriangles]:
        """Return the ground as a caster: two triangles if it slopes and the light is below its plane, otherwise nothing.

        From whatever stands on the ground, a ray to a light above its plane stays above it. ``light_frame`` (4,) is the homogeneous
        light in the frame, in metres.
        """
        ground = self.planes[0]
        to_light = light_frame[:3] - light_frame[3] * ground.origin_frame_m
        if self.ground_corners_frame_m is None or ground.normal_frame @ to_light > 0.0:
            return []
        return [(self.ground_corners_frame_m, np.array([[0, 1, 2], [0, 2, 3]], np.int32))]


def find_receivers(buffer: GeometryBuffer, scene: Scene, max_mesh_planes: int = MAX_PLANES - 1) -> Receivers:
    """Return the planes of the ground, and at most ``max_mesh_planes`` planes of the meshes that a buffer shows.

    The ground is level or lies in one plane. Curved bodies do not receive. The planes that most pixels show come first.
    """
    frame = buffer.frame
    below_eye, corners = _point_below_eye(buffer, scene), None
    normal = np.array([0.0, 0.0, 1.0])
    low, high = scene.height_range_m
    slope = None if low == high else ground_plane(scene.world, scene.elevation)
    # A plan may have found no ground in a coarse view. Points of uneven ground lie in no plane.
    is_receiver = buffer.valid & (buffer.surface_kind == RELIEF) & (low == high or slope is not None)
    plane_of_point = np.where(is_receiver, np.uint8(GROUND_NUMBER), np.uint8(0))
    if slope is None:
        below_eye[2] = low
    else:
        corners, normal = frame.points_from_earth(slope.corners_earth_m), slope.normal_in_frame(frame)
        below_eye[2] = corners[0, 2] - (below_eye - corners[0])[:2] @ normal[:2] / normal[2]
    planes = [ReceiverPlane(GROUND_NUMBER, below_eye, normal)]
    if max_mesh_planes:
        facets = visible_facets(buffer, scene.objects)
        groups = facets.group(max_mesh_planes)
        number_of_facet = np.where(groups.plane_of_facet < 0, 0, groups.plane_of_facet + GROUND_NUMBER + 1)
        plane_of_point.ravel()[facets.pixels] = number_of_facet[facets.facet_of_pixel]
        for index, (point, facet_normal) in enumerate(zip(groups.point_frame_m, groups.normal_frame, strict=True)):
            facet_corners = facets.corners_frame_m[groups.plane_of_facet == index].reshape(-1, 3)
            planes.append(ReceiverPlane(GROUND_NUMBER + 1 + index, point, facet_normal, groups.error_m, facet_corners))
    return Receivers(planes, plane_of_point, corners)


def _point_below_eye(buffer: GeometryBuffer, scene: Scene) -> np.ndarray:
    """Return the eye, or the middle of a map, in the buffer's frame (3,), metres."""
    view = buffer.view
    if isinstance(view, MapView):
        middle, _ = scene.world.points_at_zero_height(view.grid.crs, *view.centre)
        return buffer.frame.points_from_earth(middle)
    return buffer.frame.points_from_earth(view.eye_earth_m)


@dataclass(frozen=True, eq=False)
class CasterBoxes:
    """Triangles with their bounding boxes along a light: those that may shade a plane are found by their boxes.

    Attributes
    ----------
    corners_frame_m
        Corners (m, 3, 3), metres.
    light_from_frame
        Axes (3, 3) of the boxes: for the sun right, up and towards it, for a lamp those of the frame.
    low_m, high_m
        Bounds (m, 3) of the triangles along these axes, metres.
    lamp_frame_m
        The lamp (3,); ``None`` for the sun.
    """

    corners_frame_m: np.ndarray
    light_from_frame: np.ndarray
    low_m: np.ndarray
    high_m: np.ndarray
    lamp_frame_m: np.ndarray | None

    def triangles_before(self, plane: ReceiverPlane) -> VerticesAndTriangles:
        """Return the triangles that may shade a plane's facets: before the plane, in the box of the light's way to them."""
        low, high = self._box(plane)
        inside = ((self.high_m >= low) & (self.low_m <= high)).all(axis=1)
        corners = self.corners_frame_m[inside]
        corners = corners[((corners - plane.origin_frame_m) @ plane.normal_frame).max(axis=1, initial=-np.inf) > plane.error_m]
        return corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)

    def trees_before(self, plane: ReceiverPlane, trees: TreeInstances) -> TreeInstances:
        """Return the trees that may shade a plane's facets."""
        low, high = self._box(plane)
        trees = trees.select(trees.in_box(self.light_from_frame, np.zeros(3), low, high))
        radius_m = trees.quad_sizes_m[:, :2].max(axis=1, initial=0.0) + trees.quad_sizes_m[:, 2]
        return trees.select((trees.base_frame_m - plane.origin_frame_m) @ plane.normal_frame + radius_m > plane.error_m)

    def _box(self, plane: ReceiverPlane) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds (3,) of the way of light to a plane's facets."""
        if plane.corners_frame_m is None:
            return np.full(3, -np.inf), np.full(3, np.inf)
        ends = plane.corners_frame_m @ self.light_from_frame.T
        if self.lamp_frame_m is not None:
            ends = np.concatenate([ends, (self.light_from_frame @ self.lamp_frame_m)[None]])
        low, high = ends.min(axis=0) - plane.error_m, ends.max(axis=0) + plane.error_m
        if self.lamp_frame_m is None:
            high[2] = np.inf
        return low, high


def caster_boxes(meshes: list[VerticesAndTriangles], light_frame: np.ndarray) -> CasterBoxes:
    """Return the triangles of meshes with their boxes along a homogeneous light (4,). All are in one frame, in metres."""
    corners = np.concatenate([np.zeros((0, 3, 3)), *(vertices[triangles] for vertices, triangles in meshes)])
    axes, lamp = np.eye(3), light_frame[:3]
    if light_frame[3] == 0.0:
        to_sun = light_frame[:3] / np.linalg.norm(light_frame[:3])
        right = np.cross(np.eye(3)[np.argmin(np.abs(to_sun))], to_sun)
        right /= np.linalg.norm(right)
        axes = np.array([right, np.cross(to_sun, right), to_sun])
    along = corners @ axes.T
    return CasterBoxes(corners, axes, along.min(axis=1), along.max(axis=1), lamp if light_frame[3] != 0.0 else None)
