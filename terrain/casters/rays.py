"""Trace rays through the drawn triangles with Embree. Ray offsets are derived from its float32 precision.

A few rays in one direction can be traced through the ground's grid meshes instead (``skugga.terrain.casters.sheet_rays``). That
method works in float64 and would need a smaller offset. Its rays start at the same points all the same, so that results do not
depend on the method.

**Offset.** Embree works in float32. Coordinates are relative to the middle of the geometry. With the largest coordinate X, each
vertex and each ray origin is off by at most half a unit in the last place per axis: sqrt(3) X 2^-24. The distance between a
triangle's plane and a ray origin on it may thus be twice that. The intersection itself adds a few units more: Embree's own bound
for its robust Pluecker tests is of that order. With a safety factor of two

    e = 16 X 2^-24        (1 mm per kilometre of extent)

suffices: a ray that starts e above its triangle, along the normal, does not meet that triangle. The offset changes results only for
geometry within e of the surface. Callers that must detect such results also trace rays with the offsets 2e and 4e. They discard
answers that differ.

**Alpha.** A ray passes texels whose alpha is below a threshold, and stops at all other texels, from either side of the triangle.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from skugga.terrain.cache import estimated_bytes
from skugga.terrain.casters.sheet_rays import SheetRays
from skugga.terrain.compiled import compiled
from skugga.terrain.errors import RenderError
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.interpolation import bilinear
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

RAY_OFFSET_ULPS = 16.0
MAX_TRANSPARENT_LAYERS = 256
"""Maximum number of transparent surfaces that a ray passes before it counts as stopped."""

TRIANGLE_BYTES = 128
"""Approximate memory of a triangle in Embree, with its share of the BVH."""


@dataclass(frozen=True, eq=False)
class AlphaMesh:
    """Two-sided triangles with an alpha mask: opaque where the texture reaches the threshold.

    Attributes
    ----------
    vertices_m
        float64 (n, 3), metres.
    triangles
        int (m, 3), vertex indices.
    uv
        (n, 2) in [0, 1], texture coordinates; v = 0 is the texture's first row.
    alpha
        (h, w) or (layers, h, w) in [0, 1], read bilinearly between texel centres and clamped at the border.
    alpha_threshold
        The minimum alpha of opaque texels.
    layer
        (m,), each triangle's layer of ``alpha``.
    """

    vertices_m: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    alpha: np.ndarray
    alpha_threshold: float = 0.5
    layer: np.ndarray | None = None


class RayScene:
    """The geometry that rays can meet. Coordinates are float64 in one frame, metres.

    Parameters
    ----------
    sheets
        Grid meshes of the ground.
    meshes
        Vertices (n, 3) and triangles (m, 3) of each opaque mesh.
    alpha_meshes
        Alpha-tested meshes.
    traverse_sheets
        Whether ``skugga.terrain.casters.sheet_rays`` traces rays through the sheets, which is faster for few rays in one direction.
        Otherwise Embree builds a bounding volume hierarchy (BVH) of all geometry, sheets included.

    Attributes
    ----------
    offset_m
        The distance by which callers must lift a ray's start off its triangle, metres.
    nbytes
        Approximate memory in bytes.
    """

    def __init__(
        self,
        sheets: Iterable[Sheet] = (),
        meshes: Iterable[tuple[np.ndarray, np.ndarray]] = (),
        alpha_meshes: Iterable[AlphaMesh] = (),
        traverse_sheets: bool = False,
    ) -> None:
        ground, solids = [sheet for sheet in sheets if sheet.is_cut_nw_se.size], list(meshes)
        self._alpha_meshes = tuple(alpha_meshes)
        vertices = [sheet.position_frame_m for sheet in ground] + [part for part, _ in solids]
        vertices += [mesh.vertices_m for mesh in self._alpha_meshes]
        low, high = bounding_box(vertices)
        self._centre = (low + high) / 2
        self.offset_m = float(RAY_OFFSET_ULPS * 2.0**-24 * max(np.abs(high - low).max() / 2, 1.0))
        self._sheet_rays = SheetRays(ground, self._centre) if traverse_sheets and ground else None
        parts = [] if traverse_sheets else [(sheet.position_frame_m.reshape(-1, 3), sheet.triangles) for sheet in ground]
        opaque = [(part, triangles) for part, triangles in parts + solids if len(triangles)]
        self._opaque = self._build_embree_scene(opaque) if opaque else None
        triangles = sum(len(faces) for _, faces in opaque) + sum(len(mesh.triangles) for mesh in self._alpha_meshes)
        self.nbytes = TRIANGLE_BYTES * triangles + estimated_bytes(self._alpha_meshes)
        self.nbytes += 0 if self._sheet_rays is None else self._sheet_rays.nbytes
        self._alpha = [self._build_embree_scene([(mesh.vertices_m, mesh.triangles)]) for mesh in self._alpha_meshes]

    def _build_embree_scene(self, parts: list[tuple[np.ndarray, np.ndarray]]) -> Any:
        """Build Embree's scene, which has no static type, from vertices and triangles of meshes.

        Raises ``RenderError`` if the package embreex is not installed.
        """
        try:
            from embreex import mesh_construction, rtcore_scene
        except ImportError:
            raise RenderError("embreex: the package is not installed. Run: pip install 'skugga[truth]'.") from None

        scene = rtcore_scene.EmbreeScene(robust=True)
        for all_vertices, all_triangles in parts:
            vertices, triangles = _drop_unused_vertices(all_vertices, all_triangles)
            local = np.nan_to_num(vertices - self._centre).astype(np.float32)
            mesh_construction.TriangleMesh(scene, local, np.ascontiguousarray(triangles, np.int32))
        return scene

    def is_blocked(self, start_m: np.ndarray, direction: np.ndarray, length_m: np.ndarray | None = None) -> np.ndarray:
        """Return whether rays from starts (n, 3) towards unit directions (3,) or (n, 3) meet opaque geometry, bool (n,).

        ``length_m`` (n,) limits the rays' lengths; ``None`` means no limit. Raises ``ValueError`` if the scene was built with
        ``traverse_sheets`` and the rays have several directions or a length.
        """
        if self._sheet_rays is not None and (np.ndim(direction) > 1 or length_m is not None):
            problem = f"direction: with traverse_sheets=True, give one direction (3,) and no length_m, not {np.shape(direction)}"
            raise ValueError(f"{problem}. Or build the scene with traverse_sheets=False.")
        start = (start_m - self._centre).astype(np.float32)
        directions = np.ascontiguousarray(np.broadcast_to(np.asarray(direction, np.float32), start.shape))
        stopped = np.zeros(len(start), bool)
        if not len(start):
            return stopped
        if self._sheet_rays is not None:
            stopped |= self._sheet_rays.is_blocked(start_m, direction)
        if self._opaque is not None:
            length_limits = {} if length_m is None else {"dists": length_m.astype(np.float32)}
            stopped |= self._opaque.run(start, directions, query="OCCLUDED", **length_limits) != -1
        for mesh, scene in zip(self._alpha_meshes, self._alpha, strict=True):
            active = np.flatnonzero(~stopped)
            length = np.full(len(active), np.inf) if length_m is None else length_m[active]
            stopped[active] = self._blocked_by_alpha(mesh, scene, start[active], directions[active], length)
        return stopped

    def _blocked_by_alpha(
        self, mesh: AlphaMesh, scene: Any, start: np.ndarray, directions: np.ndarray, length: np.ndarray
    ) -> np.ndarray:
        """Return whether rays (n,) meet an opaque texel of an alpha-tested mesh, bool (n,).

        ``scene`` is Embree's scene of the mesh. ``start`` and ``directions`` are float32 (n, 3), relative to the scene's centre.
        ``length`` (n,) limits the rays, metres; infinite without a limit.
        """
        stopped = np.zeros(len(start), bool)
        active, start, remaining = np.arange(len(start)), start.copy(), length.astype(np.float64)
        for _ in range(MAX_TRANSPARENT_LAYERS):
            if not len(active):
                return stopped
            intersections = scene.run(start[active], directions[active], query="INTERSECT", output=True)
            is_hit = (intersections["primID"] != -1) & (intersections["tfar"] < remaining[active])
            active = active[is_hit]
            u, v, corners = intersections["u"][is_hit], intersections["v"][is_hit], mesh.triangles[intersections["primID"][is_hit]]
            uv = (
                (1 - u - v)[:, None] * mesh.uv[corners[:, 0]]
                + u[:, None] * mesh.uv[corners[:, 1]]
                + v[:, None] * mesh.uv[corners[:, 2]]
            )
            layer = None if mesh.layer is None else mesh.layer[intersections["primID"][is_hit]]
            opaque = sample_alpha(mesh.alpha, uv, layer) >= mesh.alpha_threshold
            stopped[active[opaque]] = True
            advance = intersections["tfar"][is_hit] + self.offset_m
            start[active] += (advance[:, None] * directions[active]).astype(np.float32)
            remaining[active] -= advance
            active = active[~opaque]
        stopped[active] = True
        return stopped


def _drop_unused_vertices(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (n, 3) that triangles (m, 3) use, and the triangles with their indices.

    Nodes off the raster, most of those of some sheets, have no triangles, and Embree would store them all.
    """
    if len(triangles) >= len(vertices):  # as good as all are used
        return vertices, triangles
    is_used = np.zeros(len(vertices), np.bool_)
    is_used[triangles] = True
    return vertices[is_used], (np.cumsum(is_used) - 1)[triangles]


def bounding_box(vertices: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum and the maximum coordinates (3,) of all points of some arrays (..., 3); zeros without points.

    Points whose third coordinate is NaN or infinite do not count.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points in vertices:
        _extend_box(points.reshape(-1, 3), low, high)
    return (low, high) if np.isfinite(low).all() else (np.zeros(3), np.zeros(3))


@compiled
def _extend_box(points, low, high):
    """Extend a box from ``low`` to ``high`` (3,) to contain the points (n, 3), in place.

    Points whose third coordinate is NaN or infinite do not count.
    """
    for n in range(len(points)):
        if np.isfinite(points[n, 2]):
            for k in range(3):
                low[k], high[k] = min(low[k], points[n, k]), max(high[k], points[n, k])


def sample_alpha(alpha: np.ndarray, uv: np.ndarray, layer: np.ndarray | None = None) -> np.ndarray:
    """Return the values (n,) of a texture at coordinates ``uv`` (n, 2) in [0, 1].

    The texture is (h, w), or (layers, h, w) with the index ``layer`` (n,) for each coordinate. Sampling is bilinear between texel
    centres and clamped at the border.
    """
    height, width = alpha.shape[-2:]
    x = np.clip(uv[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip(uv[:, 1] * height - 0.5, 0, height - 1)
    return bilinear(alpha, y, x, layer)


def trees_as_mesh(instances: TreeInstances) -> AlphaMesh:
    """Return the three quads of each tree as alpha-tested triangles, with the foliage texture at full resolution."""
    count = len(instances)
    first = np.arange(count * 3, dtype=np.int32)[:, None] * 4
    triangles = (first[:, None, :] + np.array([[0, 1, 2], [0, 2, 3]], np.int32)).reshape(-1, 3)
    uv = np.tile(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]), (count * 3, 1))
    layer = np.repeat((2 * instances.variant[:, None] + np.array([0, 0, 1])).ravel(), 2)
    alpha = foliage().mip_levels[0][..., 3].astype(np.float32) / 255.0
    return AlphaMesh(instances.corners().reshape(-1, 3), triangles, uv, alpha, ALPHA_THRESHOLD, layer)
