"""A coarse look at a perspective view: which triangle shows in every few pixels, without OpenGL.

Pixels are few and triangles many, most of them smaller than the way between two pixels: what takes time elsewhere, handing all of
them to a rasteriser, is left out here. A pixel's ray r meets a triangle a, b, c (all in the camera's axes) where r . (b x c),
r . (c x a) and r . (a x b) have one sign; no corner need lie before the eye (M. Olano, T. Greer 1997, "Triangle scan conversion
using 2D homogeneous coordinates").

The same pass looks through the pixels of the view itself that lie beside each of these: whether something ends in a pixel hangs on
its neighbours in the full picture, not on those of the coarse one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.antialias import CROSS, edges_between, edges_in_neighbours, mesh_normals
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.ground_mesh import GroundMesh, ground_mesh
from skugga.terrain.gbuffer.id_buffer import NEAR_M, IdBuffer
from skugga.terrain.gbuffer.picture import buffer_of, solids_in
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene import Scene

COARSE_STEP_PX = 8
"""Distance of the pixels from which a perspective view is described."""


@dataclass(frozen=True, eq=False)
class NeighbourSamples:
    """Some pixels of a perspective view, each with the four beside it: what decides whether something ends in it, but for trees.

    ``row`` and ``col`` (n,) are the pixels; ``number`` (n, 5) uint32 the triangles seen in each and beside it, in the order of
    ``skugga.terrain.gbuffer.antialias``, counted from 1 through the ground's (``ground`` of them) and the meshes', 0 where there is
    none; ``away_m`` (n, 5) float64 how far away along the axis of the view, infinite where there is none; ``normals`` (m, 3)
    float32 those of the meshes' faces.
    """

    view: PerspectiveView
    row: np.ndarray
    col: np.ndarray
    number: np.ndarray
    away_m: np.ndarray
    ground: int
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class CoarseView:
    """What a perspective view shows, coarsely: every few pixels, of everything but the trees.

    ``points_frame_m`` (n, 3) float64 are the points seen, ``away_m`` (n,) their distances from ``eye_frame_m``, ``height_m`` (n,)
    their heights, ``spacing`` the angle (a tangent) between neighbours. ``edge_share`` is the share of the view's own pixels in
    which something ends, ``crosses`` are some of those.
    """

    buffer: GeometryBuffer
    eye_frame_m: np.ndarray
    points_frame_m: np.ndarray
    away_m: np.ndarray
    height_m: np.ndarray
    spacing: float
    edge_share: float
    crosses: NeighbourSamples


@dataclass(frozen=True, eq=False)
class _Coarse:
    """What ``skugga.terrain.gbuffer.picture`` resolves to points: as its ``RasterisedView``, without trees."""

    frame: LocalFrame
    ground: GroundMesh
    solids: np.ndarray | None
    seen: IdBuffer
    tree_instances: None = None


def _sight(scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    """What a look goes by: what stands on the ground, and which way it is looked at, whatever the light."""
    camera = (view.focal_px, view.row0, view.col0, view.step, view.rows, view.cols)
    return scene.objects, view.eye_earth_m.tobytes(), view.earth_from_camera.tobytes(), camera


@cached("scene", 1024 * MIB, key=_sight)
def coarse_view_of(scene: Scene, view: PerspectiveView) -> CoarseView:
    """Everything but the trees in every ``COARSE_STEP_PX``-th pixel; in every one, if those show the sky alone."""
    coarse_view = _look_every(scene, view, COARSE_STEP_PX)
    return coarse_view if len(coarse_view.points_frame_m) else _look_every(scene, view, 1, coarse_view.crosses)


def _look_every(scene: Scene, view: PerspectiveView, px: int, crosses: NeighbourSamples | None = None) -> CoarseView:
    """A look at every pixel is given the coarse one's crosses: its own would take much to keep."""
    coarse = replace(view, step=view.step * px, rows=-(-view.rows // px), cols=-(-view.cols // px))
    frame = view.frame(scene.world)
    ground, solids = ground_mesh(scene, coarse), solids_in(scene.objects, frame)
    meshes = [(ground.position_frame_m, ground.triangles)]
    if solids is not None and scene.objects.solids is not None:
        meshes.append((solids, scene.objects.solids.triangles))
    number, depth_m = nearest_triangles(coarse, frame, meshes, np.array(CROSS if crosses is None else CROSS[:1]) / px)
    seen = IdBuffer(np.ascontiguousarray(number[..., 0]), np.zeros((0, 0, 4), np.uint8), np.zeros((0, 0), np.float32))
    if crosses is None:
        row, col = (px * index.ravel() for index in np.indices(seen.number.shape))
        flat, normals = (len(row), len(CROSS)), mesh_normals(scene.objects)
        crosses = NeighbourSamples(view, row, col, number.reshape(flat), depth_m.reshape(flat), len(ground.triangles), normals)
        ends = edges_in_neighbours(crosses.number, crosses.away_m, crosses.ground, crosses.normals)
    else:
        depth = (NEAR_M / depth_m[..., 0]).astype(np.float32)
        ends = edges_between(seen.number, depth, crosses.ground, crosses.normals, NEAR_M)
    looked = buffer_of(scene, coarse, _Coarse(frame, ground, solids, seen))
    points = looked.position_frame_m[looked.there]
    eye, _ = view.in_frame(frame)
    away_m = np.linalg.norm(points - eye, axis=-1)
    return CoarseView(looked, eye, points, away_m, looked.height_m[looked.there], coarse.pixel, float(ends.mean()), crosses)


def nearest_triangles(
    view: PerspectiveView, frame: LocalFrame, meshes: list[tuple[np.ndarray, np.ndarray]], beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The number of the nearest triangle through places beside each pixel, shares of pixels down and to the right (k, 2) from its
    middle, and the distance along the axis of the view: (rows, cols, k) uint32, and float64, metres, infinite where there is none.

    Triangles are counted from 1 through meshes of vertices (n, 3) in a frame and triangles (m, 3).
    """
    eye, camera_from_frame = view.in_frame(frame)
    number = np.zeros((view.rows, view.cols, len(beside)), np.uint32)
    depth = np.full(number.shape, np.inf)
    tangents = np.array([view.col0, view.row0, view.step]) / view.focal_px
    first = 1
    for vertices, triangles in meshes:
        in_camera, pixel = _projected(vertices, eye, np.ascontiguousarray(camera_from_frame), tangents)
        _draw(in_camera, pixel, triangles, tangents, beside, NEAR_M, first, number, depth)
        first += len(triangles)
    return number, depth


@compiled
def _projected(vertices, eye, rotation, tangents):
    """Vertices (n, 3) in the camera's axes, and columns and rows (n, 2) of those ahead of the eye."""
    at, pixel = np.empty((len(vertices), 3)), np.empty((len(vertices), 2))
    for n in range(len(vertices)):
        x, y, z = vertices[n, 0] - eye[0], vertices[n, 1] - eye[1], vertices[n, 2] - eye[2]
        for k in range(3):
            at[n, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
        for k in range(2):
            pixel[n, k] = (at[n, k] / at[n, 2] - tangents[k]) / tangents[2]
    return at, pixel


@internal
def _beyond(a, b, c, tangents, reach, rows, cols):
    """Whether a triangle lies beyond one side of the picture's pyramid as a whole, a share of a pixel wider on all sides."""
    for k in range(2):
        low = tangents[k] - reach * tangents[2]
        high = low + ((cols if k == 0 else rows) - 1 + 2.0 * reach) * tangents[2]
        if a[k] < low * a[2] and b[k] < low * b[2] and c[k] < low * c[2]:
            return True
        if a[k] > high * a[2] and b[k] > high * b[2] and c[k] > high * c[2]:
            return True
    return False


@compiled
def _draw(at, pixel, triangles, tangents, beside, near, first, number, depth):
    rows, cols, places = number.shape
    reach = np.abs(beside).max()
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        before = (at[i, 2] < near) + (at[j, 2] < near) + (at[k, 2] < near)
        if before == 3:
            continue
        if before == 0:
            low_col, high_col = min(pixel[i, 0], pixel[j, 0], pixel[k, 0]), max(pixel[i, 0], pixel[j, 0], pixel[k, 0])
            low_row, high_row = min(pixel[i, 1], pixel[j, 1], pixel[k, 1]), max(pixel[i, 1], pixel[j, 1], pixel[k, 1])
            if not (high_col >= -reach and low_col <= cols - 1 + reach and high_row >= -reach and low_row <= rows - 1 + reach):
                continue
            # Places lie straight beside a middle: what holds no middle's row and no middle's column holds none.
            if np.ceil(low_col) > high_col and np.ceil(low_row) > high_row:
                continue
            c0, c1 = int(np.ceil(max(low_col - reach, 0.0))), int(min(high_col + reach, cols - 1.0))
            r0, r1 = int(np.ceil(max(low_row - reach, 0.0))), int(min(high_row + reach, rows - 1.0))
        elif _beyond(at[i], at[j], at[k], tangents, reach, rows, cols):
            continue
        else:
            r0, r1, c0, c1 = 0, rows - 1, 0, cols - 1
        if c0 > c1 or r0 > r1:
            continue
        a0, a1, a2 = at[i, 0], at[i, 1], at[i, 2]
        b0, b1, b2 = at[j, 0], at[j, 1], at[j, 2]
        d0, d1, d2 = at[k, 0], at[k, 1], at[k, 2]
        u0, u1, u2 = b1 * d2 - b2 * d1, b2 * d0 - b0 * d2, b0 * d1 - b1 * d0
        v0, v1, v2 = d1 * a2 - d2 * a1, d2 * a0 - d0 * a2, d0 * a1 - d1 * a0
        w0, w1, w2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        volume = a0 * u0 + a1 * u1 + a2 * u2
        side = 1.0 if volume > 0.0 else -1.0
        # How much less than at a pixel's middle each may be beside it.
        wide = reach * tangents[2]
        less_u, less_v, less_w = wide * (abs(u0) + abs(u1)), wide * (abs(v0) + abs(v1)), wide * (abs(w0) + abs(w1))
        for r in range(r0, r1 + 1):
            y = tangents[1] + r * tangents[2]
            for c in range(c0, c1 + 1):
                x = tangents[0] + c * tangents[2]
                u, v, w = side * (x * u0 + y * u1 + u2), side * (x * v0 + y * v1 + v2), side * (x * w0 + y * w1 + w2)
                if u < -less_u or v < -less_v or w < -less_w:
                    continue
                for p in range(places):
                    y_p, x_p = y + beside[p, 0] * tangents[2], x + beside[p, 1] * tangents[2]
                    u, v = side * (x_p * u0 + y_p * u1 + u2), side * (x_p * v0 + y_p * v1 + v2)
                    w = side * (x_p * w0 + y_p * w1 + w2)
                    if u < 0.0 or v < 0.0 or w < 0.0 or u + v + w <= 0.0:
                        continue
                    z = side * volume / (u + v + w)
                    if near <= z < depth[r, c, p]:
                        depth[r, c, p] = z
                        number[r, c, p] = first + t
