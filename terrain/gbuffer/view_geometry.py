"""Compute the geometry buffer of a view: its ground, and the meshes and trees that stand on it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol, get_args

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.gbuffer.geometry import GeometryBuffer, MapNodes, map_geometry, map_nodes
from skugga.terrain.gbuffer.ground_mesh import MAX_GROUND_TRIANGLES, GroundMesh, ground_creases, ground_mesh
from skugga.terrain.gbuffer.id_buffer import IdBuffer, ObjectPixels, object_pixels, rasterise_map, rasterise_perspective
from skugga.terrain.gbuffer.map_columns import column_geometry
from skugga.terrain.gbuffer.resolve import MESHES, RELIEF, resolve_map, resolve_perspective
from skugga.terrain.gbuffer.resolve_types import (
    Faces,
    GroundInPerspective,
    PixelCamera,
    ResolvedPoints,
    SolidsInMap,
    SolidsInPerspective,
    TreesInMap,
    TreesInPerspective,
)
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_instances_in_map, tree_instances_in_perspective
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.imagery import Imagery
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

IMAGERY_STEP_PX = 16
"""Spacing of the pixels whose position in a map's imagery is computed exactly."""

_NO_POINTS = np.zeros((0, 3))
_NO_FACES = Faces(
    np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32), np.zeros((0, 3, 3), np.float32), np.zeros(0, np.float32),
)  # fmt: skip
_NO_CELLS = np.zeros((0, 0, 2), np.float32)
_NO_LIFT = np.zeros((0, 0), np.float32)
_NO_SHAPE, _NO_YAW = np.zeros((0, 4), np.float32), np.zeros((0, 2), np.float32)


def view_frame(scene: Scene, view: MapView | PerspectiveView) -> LocalFrame:
    """Return the local frame that a view is drawn in."""
    if isinstance(view, PerspectiveView):
        return view.frame(scene.world)
    return scene.world.frame_near(view.grid.crs, *view.centre)


def geometry_buffer(
    scene: Scene,
    view: MapView | PerspectiveView,
    frame: LocalFrame | None = None,
    max_triangles: int = MAX_GROUND_TRIANGLES,
    pixel_mask: np.ndarray | None = None,
    nodes: MapNodes | None = None,
) -> GeometryBuffer:
    """Return the geometry buffer of a perspective view or of a block of a map.

    Parameters
    ----------
    scene, view
        The scene and the view.
    frame
        The local frame of the buffer; by default that of ``view_frame``.
    max_triangles
        The maximum number of the ground's triangles in perspective.
    pixel_mask
        (rows, cols), selects pixels of a map; the others show nothing.
    nodes
        The nodes of a map's ground, if several views share them (``shared_nodes``).

    Raises
    ------
    GraphicsError
        If OpenGL is needed and fails.
    """
    frame = frame or view_frame(scene, view)
    if isinstance(view, PerspectiveView):
        return resolve_buffer(scene, view, RasterisedView(scene, view, frame, max_triangles))
    return _map_buffer(scene, view, frame, pixel_mask, nodes)


def shared_nodes(scene: Scene, views: Sequence[MapView | PerspectiveView], frame: LocalFrame) -> MapNodes | None:
    """Return the nodes of smooth ground that the pixels of several map views of one grid are interpolated from.

    ``None`` if no view is a map, or for ground of upright columns.
    """
    maps = [view for view in views if isinstance(view, MapView)]
    if not maps or scene.elevation.surface == "blocks":
        return None
    return map_nodes(scene.surface(maps[0].grid), maps, frame)


class RasterisedTriangles(Protocol):
    """The visible triangles of a camera's pixels. ``resolve_buffer`` computes the visible points from them.

    Attributes
    ----------
    frame
        The local frame of all positions.
    ground
        The mesh of the ground.
    solids
        float64 (n, 3), the vertices of the meshes in the frame, metres; ``None`` without meshes.
    id_buffer
        The number of the visible triangle in each pixel.
    tree_instances
        The trees that the view draws; ``None`` without any.
    """

    @property
    def frame(self) -> LocalFrame: ...

    @property
    def ground(self) -> GroundMesh: ...

    @property
    def solids(self) -> np.ndarray | None: ...

    @property
    def id_buffer(self) -> IdBuffer: ...

    @property
    def tree_instances(self) -> TreeInstances | None: ...


class RasterisedView:
    """The visible triangles of a camera's pixels, rasterised with OpenGL.

    ``caster_kinds`` may leave out trees (``forest``). ``pixel_mask`` (rows, cols) selects pixels; the others stay empty.
    """

    def __init__(
        self,
        scene: Scene,
        view: PerspectiveView,
        frame: LocalFrame,
        max_triangles: int = MAX_GROUND_TRIANGLES,
        caster_kinds: tuple[CasterKind, ...] = get_args(CasterKind),
        pixel_mask: np.ndarray | None = None,
    ) -> None:
        self.frame = frame
        self.ground = ground_mesh(scene, view, max_triangles)
        self.tree_instances: TreeInstances | None = None
        if "forest" in caster_kinds:
            self.tree_instances = tree_instances_in_perspective(scene.objects, frame, tuple(view.eye_earth_m), view.focal_px)
        self.solids = solid_vertices(scene.objects, frame)
        solids = scene.objects.solids
        solid_mesh = None if self.solids is None or solids is None else (self.solids, solids.triangles)
        self.id_buffer: IdBuffer = rasterise_perspective(view, frame, self.ground, solid_mesh, self.tree_instances, pixel_mask)


PixelSelection = tuple[PerspectiveView, RasterisedView, tuple[np.ndarray, np.ndarray]]
"""A view, its rasterised triangles, and the rows and columns (n, cols) of the selected pixels."""


def resolve_buffer(
    scene: Scene, view: PerspectiveView, rasterised: RasterisedTriangles, samples: PixelSelection | None = None
) -> GeometryBuffer:
    """Return the geometry buffer of a camera's rasterised triangles.

    ``samples`` adds rows of pixels of a finer view of the same camera below the view's own rows.
    """
    number, sqrt_albedo = rasterised.id_buffer.triangle_number, rasterised.id_buffer.sqrt_albedo
    finer, (row, col) = view, (np.zeros((0, view.cols), np.int64), np.zeros((0, view.cols), np.int64))
    if samples is not None:
        finer, finer_visible, (row, col) = samples
        number = np.concatenate([number, finer_visible.id_buffer.triangle_number[row, col]])
        sqrt_albedo = (
            np.concatenate([sqrt_albedo, finer_visible.id_buffer.sqrt_albedo[row, col]]) if sqrt_albedo.size else sqrt_albedo
        )
    eye, camera_from_frame = view.in_frame(rasterised.frame)
    tangents, finer_tangents = (np.array([v.col0, v.row0, v.step_px]) / v.focal_px for v in (view, finer))
    ground, trees, solids = rasterised.ground, rasterised.tree_instances, scene.objects.solids
    image = ground_imagery(scene)
    points = resolve_perspective(
        number,
        PixelCamera(tangents, finer_tangents, row, col, view.rows, eye, np.ascontiguousarray(camera_from_frame.T)),
        GroundInPerspective(
            ground.position_frame_m, ground.height_m, ground.normal_frame, ground.triangles, ground_creases(ground, number),
            np.zeros((0, 2)) if image is None else _ground_cells(image, ground),
        ),
        SolidsInPerspective(_NO_POINTS, np.zeros(0), _NO_FACES)
        if solids is None or rasterised.solids is None
        else SolidsInPerspective(
            rasterised.solids, scene.objects.solids_in_crs(scene.map_crs)[:, 2], _solid_faces(scene.objects, rasterised.frame)
        ),
        TreesInPerspective(_NO_POINTS, np.zeros(0), _NO_SHAPE, _NO_YAW, scene.world.curvature, np.zeros(0, np.int64))
        if trees is None
        else TreesInPerspective(trees.base_frame_m, trees.base_height_m, trees.quad_sizes_m, trees.yaw_cos_sin,
        scene.world.curvature, trees.tree_number),
        sqrt_albedo,
    )  # fmt: skip
    albedo = points.albedo
    if image is not None:
        cells_per_pixel = np.linalg.norm(points.position - eye, axis=-1) * view.pixel_tangent / image.cell_m(scene.world)
        draped = image.albedo(points.imagery_cells, np.nan_to_num(cells_per_pixel, nan=1.0))
        albedo = np.where((points.surface_kind == RELIEF)[..., None], draped, albedo)
    return GeometryBuffer(
        view, rasterised.frame, points.valid, points.position, points.height, points.normal, points.shading_normal, points.crease,
        points.surface_kind, ground=ground, corners_frame_m=points.corners, albedo=albedo, tree_instances=trees,
        solids_frame_m=rasterised.solids,
        first_sample_row=None if samples is None else view.rows, sample_pixels=None if samples is None else (row, col),
        lift_m=points.lift_m, mesh_triangle=_mesh_triangles(scene, number, points.surface_kind, len(ground.triangles)),
    )  # fmt: skip


def _mesh_triangles(scene: Scene, number: np.ndarray, surface_kind: np.ndarray, ground_count: int) -> np.ndarray | None:
    """Return ``GeometryBuffer.mesh_triangle`` from the numbers (rows, cols) of triangles, the ground's ``ground_count`` first."""
    placement = scene.objects.placement
    if placement is None:
        return None
    if placement.surface is None and not any(placed.footprint is not None for placed in placement.visible_bodies):
        return None
    return np.where(surface_kind == MESHES, number.astype(np.int32) - np.int32(ground_count + 1), np.int32(-1))


def _map_buffer(
    scene: Scene, view: MapView, frame: LocalFrame, pixel_mask: np.ndarray | None, nodes: MapNodes | None
) -> GeometryBuffer:
    """Return the geometry buffer of a map view: its ground, and meshes and trees where they are higher.

    ``pixel_mask`` and ``nodes`` are those of ``geometry_buffer``.
    """
    surface = scene.surface(view.grid)
    if scene.elevation.surface == "blocks":
        buffer = column_geometry(surface, view, frame, pixel_mask)
    else:
        buffer = map_geometry(surface, view, frame, pixel_mask, nodes)
    image = ground_imagery(scene)
    if image is not None:
        buffer = replace(buffer, albedo=_draped_albedo(scene, image, view))
    objects = _map_objects(scene, view, frame)
    if objects is None:
        return buffer
    albedo = buffer.albedo
    if albedo is None:
        albedo = np.full((*buffer.valid.shape, 3), np.nan, np.float32)
    corners = np.zeros((*buffer.valid.shape, 9), np.float32)
    points = ResolvedPoints(
        buffer.valid, buffer.position_frame_m, buffer.height_m, buffer.normal_frame, buffer.shading_normal_frame,
        buffer.crease, buffer.surface_kind, albedo, corners, _NO_CELLS, _NO_LIFT,
    )  # fmt: skip
    pixels = _object_pixels(scene, view, frame)
    if pixel_mask is not None:
        pixels = pixels.select(pixel_mask)
    resolve_map(pixels.pixel, pixels.triangle_number, pixels.sqrt_albedo, objects.solids, objects.trees, points)
    return replace(
        buffer, corners_frame_m=corners, albedo=albedo, tree_instances=objects.instances, solids_frame_m=objects.vertices
    )


class _MapObjects(NamedTuple):
    """The meshes and trees of a level as a map shows them.

    Attributes
    ----------
    solids, trees
        Their triangles in the map.
    instances
        The drawn trees; ``None`` without any.
    vertices
        float64 (n, 3), the vertices of the meshes in the frame, metres; ``None`` without any.
    """

    solids: SolidsInMap
    trees: TreesInMap
    instances: TreeInstances | None
    vertices: np.ndarray | None


def _map_objects(scene: Scene, view: MapView, frame: LocalFrame) -> _MapObjects | None:
    """Return the meshes and trees of a level as a map shows them; ``None`` without any."""
    pixel_m, crs, curvature = map_pixel_m(scene.world, view), view.grid.crs, scene.world.curvature
    instances = tree_instances_in_map(scene.objects, frame, pixel_m)
    vertices = solid_vertices(scene.objects, frame)
    if vertices is None and instances is None:
        return None
    solids = SolidsInMap(_NO_POINTS, _NO_POINTS, _NO_FACES)
    if vertices is not None:
        vertices_px = _pixel_positions(view, scene.objects.solids_in_crs(crs))
        solids = SolidsInMap(vertices, vertices_px, _solid_faces(scene.objects, frame))
    px_from_m = _px_from_m(scene, view, frame)
    trees = TreesInMap(_NO_POINTS, _NO_POINTS, _NO_SHAPE, _NO_YAW, curvature, px_from_m)
    if instances is not None:
        bases_px = _pixel_positions(view, scene.objects.trees_in_crs(crs)[instances.tree_number])
        trees = TreesInMap(
            instances.base_frame_m, bases_px, instances.quad_sizes_m, instances.yaw_cos_sin, curvature, px_from_m
        )  # fmt: skip
    return _MapObjects(solids, trees, instances, vertices)


def _object_pixels_key(scene: Scene, view: MapView, frame: LocalFrame) -> tuple[object, ...]:
    """Return the cache key of ``_object_pixels``: its result does not depend on the sun."""
    return scene.world, scene.elevation, scene.objects, view, frame


@cached("scene", 128 * MIB, key=_object_pixels_key)
def _object_pixels(scene: Scene, view: MapView, frame: LocalFrame) -> ObjectPixels:
    """Return the pixels of a map that show meshes or trees wherever these are higher than the ground."""
    objects = _map_objects(scene, view, frame)
    assert objects is not None
    low, high = scene.height_range_m
    heights = low - 100.0, high + scene.objects.tallest_object_m + 100.0
    mesh = None if objects.vertices is None else (objects.solids.col_row_height, objects.solids.faces.triangles)
    trees = objects.trees
    return object_pixels(rasterise_map(view, mesh, objects.instances, trees.col_row_height, trees.px_from_m, heights))


def solid_vertices(objects: SceneObjects, frame: LocalFrame) -> np.ndarray | None:
    """Return the vertices (n, 3) float64 of the meshes in a frame; ``None`` without meshes."""
    solids = objects.solids
    return None if solids is None else frame.points_from_earth(solids.vertices_earth_m)


@cached("scene", 512 * MIB)
def _solid_faces(objects: SceneObjects, frame: LocalFrame) -> Faces:
    """Return the triangles of the meshes with their albedo, normals and creases in a frame."""
    solids = objects.solids
    assert solids is not None
    normals = frame.directions_from_earth(solids.corner_normals_earth).astype(np.float32)
    return Faces(solids.triangles, solids.albedo.astype(np.float32), normals, objects.solid_creases)


def _pixel_positions(view: MapView, map_xyz: np.ndarray) -> np.ndarray:
    """Convert map positions x, y and heights (n, 3) to columns, rows and heights (n, 3).

    Columns and rows are pixels from the corner of the view's first pixel. Longitudes change by 360 degrees where that brings them
    nearer to the view's middle, so that columns continue beyond the antimeridian.
    """
    grid, x = view.grid, map_xyz[:, 0]
    if grid.crs.is_geographic:
        x = x + 360.0 * np.rint((view.centre[0] - x) / 360.0)
    col = (grid.col(x) - view.col0) / view.col_step + 0.5
    row = (grid.row(map_xyz[:, 1]) - view.row0) / view.row_step + 0.5
    return np.stack([col, row, map_xyz[:, 2]], axis=-1)


def _px_from_m(scene: Scene, view: MapView, frame: LocalFrame) -> np.ndarray:
    """Return the matrix (2, 2) of pixels (column, row) per metre along a frame's first two axes, at a view's middle."""
    point, _ = scene.world.points_at_zero_height(view.grid.crs, *view.centre)
    middle = frame.points_from_earth(point)
    steps = middle + np.array([[10.0, 0, 0], [-10.0, 0, 0], [0, 10.0, 0], [0, -10.0, 0]])
    map_xyz = np.stack(scene.world.map_position(view.grid.crs, frame.points_to_earth(steps)), axis=-1)
    px = _pixel_positions(view, map_xyz)[:, :2]
    return np.column_stack([(px[0] - px[1]) / 20.0, (px[2] - px[3]) / 20.0])


@cached("scene", 512 * MIB)
def _imagery(elevation: Elevation, source: str, file_stamp: tuple[int, int]) -> Imagery:
    """Return the imagery in a file. ``file_stamp``, the file's modification time and size, is a part of the cache key."""
    return Imagery(source)


def ground_imagery(scene: Scene) -> Imagery | None:
    """Return the level's ground imagery; ``None`` without any. Raises ``SourceError`` if it cannot be read."""
    source = scene.loaded.level.terrain.imagery
    if source is None:
        return None
    path = scene.loaded.resolve(source)
    try:
        status = os.stat(path)
    except OSError:  # not a local file, or a missing one: reading it raises the error
        return _imagery(scene.elevation, path, (0, 0))
    return _imagery(scene.elevation, path, (status.st_mtime_ns, status.st_size))


@cached("scene", 256 * MIB)
def _ground_cells(image: Imagery, ground: GroundMesh) -> np.ndarray:
    """Return the rows and columns (n, 2) of the ground's nodes in an image."""
    return image.cells_at(ground.grid.crs, ground.x, ground.y)


def _draped_albedo(scene: Scene, image: Imagery, view: MapView) -> np.ndarray:
    """Return the imagery's linear albedo (rows, cols, 3) on a map's ground.

    Positions in the imagery are exact on every ``IMAGERY_STEP_PX``-th pixel and interpolated bilinearly between.
    """
    from scipy.ndimage import map_coordinates

    count = [-(-(size - 1) // IMAGERY_STEP_PX) + 1 for size in (view.rows, view.cols)]
    row, col = np.meshgrid(*(np.arange(n + 1) * float(IMAGERY_STEP_PX) for n in count), indexing="ij")
    x, y = view.grid.x(view.col0 + col * view.col_step), view.grid.y(view.row0 + row * view.row_step)
    exact = image.cells_at(view.grid.crs, np.ravel(x), np.ravel(y)).reshape(*row.shape, 2)
    samples = np.meshgrid(*(np.arange(size) / IMAGERY_STEP_PX for size in (view.rows, view.cols)), indexing="ij")
    cells = np.stack([map_coordinates(exact[..., k], samples, order=1) for k in (0, 1)], axis=-1)
    pixel_m = map_pixel_m(scene.world, view)
    return image.albedo(cells, pixel_m / image.cell_m(scene.world))
