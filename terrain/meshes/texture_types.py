"""Inputs of ``skugga.terrain.meshes.texture_loops``, as named tuples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Atlas(NamedTuple):
    """Textures and materials as arrays.

    Attributes
    ----------
    linear_of_srgb
        float64 (256,), linear values of sRGB bytes.
    texels, levels, texture
        Colours uint8 (n, 3) of all mip levels. Each row of ``levels`` int64 (l, 6) holds a level's first texel, rows, columns, wrap
        modes across and down, and the number of levels from it on. ``texture`` int64 (k,) is the first level of each material's
        texture, -1 without.
    normals, normal_levels, normal_map
        The same of normal maps, whose vectors are int16 (n, 3).
    factors
        float64 (k, 7), of each material: colour (3), scale of normals, roughness, metallic factor, and 1 if it is glossy.
    """

    linear_of_srgb: np.ndarray
    texels: np.ndarray
    levels: np.ndarray
    texture: np.ndarray
    normals: np.ndarray
    normal_levels: np.ndarray
    normal_map: np.ndarray
    factors: np.ndarray


class VisibleTriangles(NamedTuple):
    """The triangles of models that pixels show.

    Attributes
    ----------
    number
        int32 (rows, cols), the triangle in each pixel; -1 where it shows no model.
    position_frame_m
        float64 (rows, cols, 3), the visible points.
    vertices_frame_m, triangles
        Vertices (n, 3) in the frame and vertex indices (m, 3) of the triangles.
    uv, color, material
        The arrays of a ``Surface``.
    eye_frame_m, pixel_tangent
        The eye (3,), and the width of a pixel at the distance 1.
    """

    number: np.ndarray
    position_frame_m: np.ndarray
    vertices_frame_m: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    color: np.ndarray
    material: np.ndarray
    eye_frame_m: np.ndarray
    pixel_tangent: float
