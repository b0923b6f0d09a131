"""The meshes of a scene as two sets of triangles: those that are visible, and those that cast shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Solids:
    """All meshes of a scene in earth-fixed coordinates, metres.

    Attributes
    ----------
    vertices_earth_m
        float64 (n, 3).
    triangles
        int32 (m, 3), counter-clockwise from outside.
    albedo
        float32 (m, 3), linear, in [0, 1].
    corner_normals_earth
        float32 (m, 3, 3), unit shading normals at the triangles' corners: smooth over curved parts, sharp at creases.
    body_index
        int32 (m,): index of each triangle's body.
    is_closed
        For each body whether its surface is closed: two triangles share every edge, in opposite directions.
    caster_vertices_earth_m, caster_triangles
        Vertices and triangles that cast shadows, in the same form. Simpler models (stand-ins) replace some visible bodies.
    """

    vertices_earth_m: np.ndarray
    triangles: np.ndarray
    albedo: np.ndarray
    corner_normals_earth: np.ndarray
    body_index: np.ndarray
    is_closed: tuple[bool, ...]
    caster_vertices_earth_m: np.ndarray
    caster_triangles: np.ndarray
