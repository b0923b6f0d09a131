"""Group the facets of meshes (triangles) by the plane in which they lie.

Corners are float32. Facets belong to one plane if the corners of all lie within the corners' own error of it, and if they face the
same way. The plane is that of the largest facet, whose corners determine a normal best. Of too many planes, those that most pixels
show are told apart.

Bodies of more than ``MAX_BODY_PLANES`` planes count as curved. Their facets are in no group, except for planes that are a large
part of the body, such as the top of a table with turned legs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.scene_objects import SceneObjects

CORNER_ERROR = 4.0 * float(np.finfo(np.float32).eps)
"""Upper bound of the float32 error of corners, as a share of the largest coordinate: 8 units in the last place."""

MAX_PLANES = 255
"""Upper bound of the number of planes that are told apart. It bounds the time, which grows with facets times planes."""

MAX_BODY_PLANES = 64
"""Upper bound of the number of planes of a body that is not curved. Extruded buildings with roofs have 5 to 20."""

MIN_PLANE_AREA_SHARE = 0.05
"""Least share of a curved body's area of a plane that does not count as curved. The sides of cones and cylinders have less."""

PLANE_STEP_SHARE = 1e-3
"""Step of normals, and of offsets as a share of the largest coordinate, by which planes are told apart before they are grouped."""


@dataclass(frozen=True, eq=False)
class FacetPlanes:
    """Planes of facets, the plane of the largest facet (or of the most visible one) first.

    Attributes
    ----------
    normal_frame
        Unit normals (k, 3), out of the surface.
    point_frame_m
        A point (k, 3) of each plane, metres.
    plane_of_facet
        The plane of each facet (n,) int64, from 0; -1 for facets without area, and beyond ``MAX_PLANES``.
    error_m
        Upper bound of the distance of the facets from their plane, metres.
    is_complete
        Whether all facets with an area lie in these planes.
    """

    normal_frame: np.ndarray
    point_frame_m: np.ndarray
    plane_of_facet: np.ndarray
    error_m: float
    is_complete: bool

    def __len__(self) -> int:
        return len(self.normal_frame)


def group_facets(
    corners_frame_m: np.ndarray,
    normal_frame: np.ndarray,
    area_m2: np.ndarray,
    max_planes: int = MAX_PLANES,
    pixel_count: np.ndarray | None = None,
) -> FacetPlanes:
    """Return the planes of facets.

    Parameters
    ----------
    corners_frame_m
        Points (n, k, 3) of each facet, metres.
    normal_frame
        Unit normals (n, 3).
    area_m2
        Areas (n,), square metres.
    max_planes
        Upper bound of the number of planes.
    pixel_count
        Pixels (n,) that show each facet. The facets with most pixels are grouped first. Default: the largest facets.
    """
    error_m = CORNER_ERROR * float(np.abs(corners_frame_m).max(initial=0.0))
    plane_of_facet = np.full(len(corners_frame_m), -1, np.int64)
    rest = np.argsort(-(area_m2 if pixel_count is None else pixel_count), kind="stable")
    rest = rest[area_m2[rest] > 0.0]
    firsts: list[int] = []
    while len(rest) and len(firsts) < max_planes:
        first = rest[0]
        in_plane = _is_in_plane(first, rest, corners_frame_m, normal_frame, error_m)
        if pixel_count is not None:
            first = rest[in_plane][np.argmax(area_m2[rest[in_plane]])]
            in_plane = _is_in_plane(first, rest, corners_frame_m, normal_frame, error_m)
            in_plane[0] = True  # a small facet may lie just off the plane of the largest one
        plane_of_facet[rest[in_plane]] = len(firsts)
        firsts.append(int(first))
        rest = rest[~in_plane]
    return FacetPlanes(normal_frame[firsts], corners_frame_m[firsts, 0], plane_of_facet, error_m, not len(rest))


def _is_in_plane(first: int, rest: np.ndarray, corners_frame_m: np.ndarray, normal_frame: np.ndarray, error_m: float) -> np.ndarray:
    """Return which of the facets ``rest`` (n,) lie in the plane of the facet ``first``, one of them, and face the same way."""
    distance_m = np.abs((corners_frame_m[rest] - corners_frame_m[first, 0]) @ normal_frame[first]).max(axis=1)
    is_in_plane: np.ndarray = (distance_m <= error_m) & (normal_frame[rest] @ normal_frame[first] > 0.0)
    is_in_plane[rest == first] = True
    return is_in_plane


@dataclass(frozen=True, eq=False)
class VisibleFacets:
    """The facets of meshes that a buffer shows.

    Attributes
    ----------
    corners_frame_m
        Corners (n, 3, 3), float64, metres.
    normal_frame
        Unit normals (n, 3), as the buffer's; 0 for facets without area.
    area_m2
        Areas (n,), square metres; 0 for curved facets.
    is_curved
        Whether each facet (n,) is curved (``curved_triangle_mask``).
    pixels
        Indices (m,) of the buffer's flattened points that show a mesh.
    facet_of_pixel
        The facet (m,) in each of these points.
    view_pixel_count
        Number of the view's own points, which come first. The others are samples at edges.
    """

    corners_frame_m: np.ndarray
    normal_frame: np.ndarray
    area_m2: np.ndarray
    is_curved: np.ndarray
    pixels: np.ndarray
    facet_of_pixel: np.ndarray
    view_pixel_count: int

    def group(self, max_planes: int = MAX_PLANES) -> FacetPlanes:
        """Return the planes of the facets that are not curved: if there are too many, those that most pixels show.

        Samples of pixels do not count: there are more of them on thin things.
        """
        pixel_count = np.bincount(self.facet_of_pixel[self.pixels < self.view_pixel_count], minlength=len(self.area_m2))
        visible = self._pixels_of_similar_planes(pixel_count)
        planes = group_facets(self.corners_frame_m, self.normal_frame, self.area_m2, MAX_PLANES, visible)
        if len(planes) <= max_planes:
            return planes
        pixels_of_plane = np.bincount(planes.plane_of_facet + 1, pixel_count, len(planes) + 1)[1:]
        kept = np.argsort(-pixels_of_plane, kind="stable")[:max_planes]
        number = np.full(len(planes) + 1, -1, np.int64)  # the last one is that of facets in no plane
        number[kept] = np.arange(max_planes)
        return FacetPlanes(
            planes.normal_frame[kept], planes.point_frame_m[kept], number[planes.plane_of_facet], planes.error_m, False
        )

    def _pixels_of_similar_planes(self, pixel_count: np.ndarray) -> np.ndarray:
        """Return the pixels (n,) that show a facet's plane, approximately: those of all facets in planes that round alike."""
        if not len(pixel_count):
            return pixel_count
        plane = _rounded_planes(self.corners_frame_m, self.normal_frame)
        return np.bincount(plane, pixel_count)[plane]


def _rounded_planes(corners_m: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return a number (n,) of the plane of each facet. Planes that round alike share it; one plane may have several numbers.

    ``corners_m`` (n, 3, 3) are the facets' corners and ``normal`` (n, 3) their unit normals. The time grows as n log n.
    """
    offset_m = np.einsum("ij,ij->i", corners_m[:, 0], normal)
    step_m = PLANE_STEP_SHARE * max(float(np.abs(corners_m).max()), 1e-9)
    rounded = np.column_stack([np.rint(normal / PLANE_STEP_SHARE), np.rint(offset_m / step_m)]) + 0.0  # no -0.0
    number: np.ndarray = np.unique(rounded, axis=0, return_inverse=True)[1].ravel()
    return number


def visible_facets(buffer: GeometryBuffer, objects: SceneObjects) -> VisibleFacets:
    """Return the facets of meshes that a buffer shows. Equal corners are one facet. ``objects`` are those of the buffer's scene."""
    pixels = np.flatnonzero(buffer.valid & (buffer.surface_kind == MESHES))
    if not len(pixels) or buffer.corners_frame_m is None:
        nothing = np.zeros(0, np.int64)
        return VisibleFacets(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.bool_), nothing, nothing, 0)
    corners = buffer.corners_frame_m.reshape(-1, 9)[pixels]
    # Neighbouring pixels mostly show the same facet, so only the first of each run is compared with all others.
    is_first = np.ones(len(pixels), np.bool_)
    is_first[1:] = (corners[1:] != corners[:-1]).any(axis=1)
    firsts = np.flatnonzero(is_first)
    rows, first_of_facet, facet_of_run = np.unique(_rows(corners[firsts]), return_index=True, return_inverse=True)
    points = corners[firsts[first_of_facet]].reshape(-1, 3, 3).astype(np.float64)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    length = np.linalg.norm(normal, axis=1)
    outward = buffer.normal_frame.reshape(-1, 3)[pixels[firsts[first_of_facet]]]
    normal *= np.sign(np.einsum("ij,ij->i", normal, outward))[:, None] / np.maximum(length, 1e-30)[:, None]
    is_curved = np.zeros(len(rows), np.bool_)
    curved = curved_triangle_mask(objects)
    if curved.any() and objects.solids is not None and buffer.solids_frame_m is not None:
        curved_corners = buffer.solids_frame_m[objects.solids.triangles[curved]].astype(np.float32)
        is_curved = np.isin(rows, _rows(curved_corners.reshape(-1, 9)))
    area_m2 = np.where(is_curved, 0.0, 0.5 * length)
    facet_of_pixel = facet_of_run[np.cumsum(is_first) - 1]
    view_pixel_count = buffer.view.rows * buffer.view.cols
    return VisibleFacets(points, normal, area_m2, is_curved, pixels, facet_of_pixel, view_pixel_count)


def _rows(corners: np.ndarray) -> np.ndarray:
    """Return rows (n, 9) float32 as one value each (n,), which compares by its bytes."""
    return np.ascontiguousarray(corners).view(np.dtype((np.void, 36))).ravel()


@cached("scene", 64 * MIB, key=lambda objects: (objects.elevation, objects.placement))
def curved_triangle_mask(objects: SceneObjects) -> np.ndarray:
    """Return which of the visible meshes' triangles (m,) are curved.

    They belong to bodies of more than ``MAX_BODY_PLANES`` planes, but not to planes of ``MIN_PLANE_AREA_SHARE`` of the body's area.
    Planes of bodies that have far more of them are told apart by rounding, since exact groups take time for each plane.
    """
    bodies = () if objects.placement is None else objects.placement.visible_bodies
    unique = {id(placed.body): placed.body for placed in bodies}  # one body may stand in many places
    is_curved = {}
    for key, body in unique.items():
        if len(body.triangles) <= MAX_BODY_PLANES:
            is_curved[key] = np.zeros(len(body.triangles), np.bool_)
            continue
        corners = body.vertices_m[body.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1)
        unit = normal / np.maximum(length, 1e-30)[:, None]
        number = _rounded_planes(corners, unit)
        plane_count = int(number.max()) + 1
        if plane_count <= MAX_PLANES:
            planes = group_facets(corners, unit, length)
            number, plane_count = planes.plane_of_facet + 1, len(planes)  # 0 is that of facets without area
        areas = np.bincount(number, length)
        is_curved[key] = (areas < MIN_PLANE_AREA_SHARE * areas.sum())[number] & (plane_count > MAX_BODY_PLANES)
    return np.concatenate([np.zeros(0, np.bool_), *(is_curved[id(placed.body)] for placed in bodies)])
