"""Inputs and results of ``skugga.terrain.gbuffer.resolve``, as named tuples for its compiled loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class ResolvedPoints(NamedTuple):
    """The per-pixel arrays of a ``GeometryBuffer`` (``skugga.terrain.gbuffer.geometry``) while they are computed.

    ``imagery_cells`` (rows, cols, 2) are the points' rows and columns in the ground's imagery, empty without imagery. ``lift_m`` is
    0 in pixels that show no ground.
    """

    valid: np.ndarray
    position: np.ndarray
    height: np.ndarray
    normal: np.ndarray
    shading_normal: np.ndarray
    crease: np.ndarray
    surface_kind: np.ndarray
    albedo: np.ndarray
    corners: np.ndarray
    imagery_cells: np.ndarray
    lift_m: np.ndarray


class PixelCamera(NamedTuple):
    """A camera and the directions of its pixels.

    Attributes
    ----------
    tangents
        float64 (3,), x / z and y / z of the first pixel in camera axes, and their increase from pixel to pixel.
    finer_tangents
        float64 (3,), the tangents of a finer view of the same camera, whose pixels are the anti-aliasing samples.
    finer_row, finer_col
        int64 (n, cols), rows and columns in the finer view of the samples. They fill n rows below the picture's own rows.
    picture_rows
        The number of the picture's own rows.
    eye_frame_m
        float64 (3,), the eye in the frame.
    frame_from_camera
        float64 (3, 3), the rotation from the camera's axes to the frame.
    """

    tangents: np.ndarray
    finer_tangents: np.ndarray
    finer_row: np.ndarray
    finer_col: np.ndarray
    picture_rows: int
    eye_frame_m: np.ndarray
    frame_from_camera: np.ndarray


class GroundInPerspective(NamedTuple):
    """The mesh of a perspective view's ground.

    Attributes
    ----------
    position_frame_m, height_m, normal_frame
        Positions (n, 3), heights (n,) and smooth unit normals (n, 3) of the nodes; metres.
    triangles, crease
        Node indices (t, 3) of the triangles, and their creases (t,) as in ``GeometryBuffer``.
    imagery_cells
        (n, 2), the nodes' rows and columns in the ground's imagery; (0, 2) without imagery.
    """

    position_frame_m: np.ndarray
    height_m: np.ndarray
    normal_frame: np.ndarray
    triangles: np.ndarray
    crease: np.ndarray
    imagery_cells: np.ndarray


class Faces(NamedTuple):
    """The triangles of meshes.

    Attributes
    ----------
    triangles
        int32 (t, 3), vertex indices.
    albedo
        float32 (t, 3), linear.
    normals_frame
        float32 (t, 3, 3), unit normals at the corners.
    crease
        float32 (t,), the triangles' creases as in ``GeometryBuffer``.
    """

    triangles: np.ndarray
    albedo: np.ndarray
    normals_frame: np.ndarray
    crease: np.ndarray


class SolidsInPerspective(NamedTuple):
    """Meshes in perspective: positions (n, 3) and heights (n,) of their vertices, metres, and their faces."""

    position_frame_m: np.ndarray
    height_m: np.ndarray
    faces: Faces


class SolidsInMap(NamedTuple):
    """Meshes in a map.

    Attributes
    ----------
    position_frame_m
        (n, 3), the vertices in the frame, metres.
    col_row_height
        (n, 3), the vertices' columns and rows in the map, in pixels, and their heights, metres.
    faces
        The meshes' triangles.
    """

    position_frame_m: np.ndarray
    col_row_height: np.ndarray
    faces: Faces


class TreesInPerspective(NamedTuple):
    """Trees (n,) in perspective. The arrays are those of ``skugga.terrain.gbuffer.tree_instances.TreeInstances``."""

    base_frame_m: np.ndarray
    base_height_m: np.ndarray
    quad_sizes_m: np.ndarray
    yaw_cos_sin: np.ndarray
    curvature: float
    tree_number: np.ndarray


class TreesInMap(NamedTuple):
    """Trees (n,) in a map.

    Attributes
    ----------
    base_frame_m, quad_sizes_m, yaw_cos_sin, curvature
        As in ``skugga.terrain.gbuffer.tree_instances.TreeInstances``.
    col_row_height
        (n, 3), columns and rows of the trees' feet in the map, in pixels, and their heights, metres.
    px_from_m
        (2, 2), the map's pixels per metre along the frame's first two axes.
    """

    base_frame_m: np.ndarray
    col_row_height: np.ndarray
    quad_sizes_m: np.ndarray
    yaw_cos_sin: np.ndarray
    curvature: float
    px_from_m: np.ndarray
