"""Find silhouettes as seen from a light: the edges at which the shadow of casting triangles begins and ends.

Take one triangle that is oriented towards the light (counter-clockwise as seen from there). Its shadow is bounded by the triangle,
by a side from each of its three edges away from the light and, for a lamp, by a cap at infinity. A ray that leaves a point of the
shadow crosses this boundary outwards once more often than inwards. A ray from any other point crosses it equally often outwards and
inwards.

Boundaries add up. Over a set of triangles, the signed count of crossings is the number of triangles between the point and the
light. Where triangles run along an edge in opposite directions, their sides cancel before anything is drawn. The multiplicity of an
edge is the signed sum of its directions, and its side counts that many times. The triangles therefore need not be closed or
manifold (B. Kim, K. Kim, G. Turk 2008, "A shadow-volume algorithm for opaque and transparent nonmanifold casters", J. Graphics
Tools 13(3), who count by multiplicity; for closed bodies C. Everitt, M. Kilgard 2002, "Practical and robust stenciled shadow
volumes for hardware-accelerated rendering").

A rule selects the casting triangles. It depends on what the triangles bound:

- ``facing``: triangles that face the light cast. It serves closed bodies with their faces outwards. A segment from a point to the
  light crosses as many facing triangles as other ones, and one more for each body that contains the point. Where any triangle
  blocks it, a facing one does. (It crosses one less for each body that contains the lamp: a lamp's own housing needs another rule.)
- ``turned_away``: triangles that do not face the light cast, flipped. It serves ground seen from above. A blocked segment from a
  point on or above the ground first enters the ground, through a triangle that faces away from the light. The caps lie in attached
  shadow. (A segment that passes into a gap of the ground may come up from below it: around gaps all triangles need to cast.)
- ``all``: all triangles cast. It serves any triangles, open or closed.

Whether a triangle faces the light is computed once, and both neighbours across an edge use the result. The edges of the silhouette
therefore join up, even if rounding affects a triangle seen edge-on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skugga.shadows.volumes.edges import Edges, signed_side_counts
from skugga.terrain.compiled import compiled
from skugga.terrain.errors import InputError
from skugga.terrain.ground.columns import ColumnMesh
from skugga.terrain.ground.sheet import Sheet, sheet_triangles

FacingRule = Literal["facing", "turned_away", "all"]
"""Rule that selects the casting triangles of a mesh by the direction in which they face (see above)."""

FACING_CODE, TURNED_AWAY_CODE, ALL_CODE = 1, 2, 3
"""The rules as numbers, one for each triangle. Bit 0: triangles that face the light cast. Bit 1: the others cast."""

FACING_RULE_CODES: dict[FacingRule, int] = {"facing": FACING_CODE, "turned_away": TURNED_AWAY_CODE, "all": ALL_CODE}
"""The number of each rule."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The boundary of the casting triangles, as seen from a light.

    Attributes
    ----------
    edges
        int32 (k, 2): vertex numbers of edges from first to second, with the casters on the left as seen from the light.
    multiplicity
        int32 (k,), 1 or more: multiplicity of the side of each edge.
    caps
        int32 (c, 3): vertex numbers of the casting triangles, counter-clockwise as seen from the light.
    """

    edges: np.ndarray
    multiplicity: np.ndarray
    caps: np.ndarray


def checked_light(light: np.ndarray) -> np.ndarray:
    """Return a light (4,) as float64: a direction to the sun and 0, or a lamp's position and 1.

    Raises ``InputError`` for other values.
    """
    light_in_frame = np.asarray(light, np.float64)
    is_valid = (
        light_in_frame.shape == (4,)
        and np.isfinite(light_in_frame).all()
        and light_in_frame[3] in (0.0, 1.0)
        and light_in_frame.any()
    )
    if not is_valid:
        raise InputError("light", light, "(x, y, z, 0) with a direction that is not zero, or (x, y, z, 1) with a position")
    return light_in_frame


def faces_light(vertices: np.ndarray, triangles: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return which triangles (m, 3) of vertices (n, 3) face a light (4,), bool (m,). A triangle seen exactly edge-on does not.

    The test is in float64, on vertices rounded to float32, as they are drawn. A triangle (a, b, c) faces a light l where
    ((b - a) x (c - a)) . (l_xyz - l_w a) > 0.
    """
    return _compute_faces_light_mask(
        np.asarray(vertices, np.float32).reshape(-1, 3), np.asarray(triangles).reshape(-1, 3), checked_light(light)
    )


def orientations_of(facing: np.ndarray, rule: FacingRule | np.ndarray) -> np.ndarray:
    """Return the orientations in which triangles cast, int8 (m,): +1 as given, -1 flipped, 0 not at all.

    ``facing`` (m,) bool is the mask of the triangles that face the light. ``rule`` is one rule for all, or a number for each
    triangle: ``FACING_CODE``, ``TURNED_AWAY_CODE``, ``ALL_CODE``, or 0 for triangles that cast nothing. All triangles of a part of
    a mesh have the same number. Raises ``InputError`` for any other rule.
    """
    if isinstance(rule, str) and rule not in FACING_RULE_CODES:
        raise InputError("rule", rule, " or ".join(FACING_RULE_CODES))
    numbers = np.asarray(FACING_RULE_CODES[rule] if isinstance(rule, str) else rule, np.int8)
    if numbers.size and (numbers.min() < 0 or numbers.max() > ALL_CODE):
        raise InputError("rule", int(numbers.min() if numbers.min() < 0 else numbers.max()), f"0 to {ALL_CODE}")
    return np.where(facing, numbers & FACING_CODE, -(numbers >> 1))


def silhouette(triangles: np.ndarray, edges: Edges, orientations: np.ndarray) -> Silhouette:
    """Return the silhouette of triangles (m, 3) that cast in the given ``orientations`` (m,). ``edges`` are their edges."""
    multiplicity = signed_side_counts(edges, orientations)
    edge_numbers = np.flatnonzero(multiplicity)
    has_length = edges.side_signs[:, 0] != 0
    return Silhouette(
        *_directed_edges(edges.ends[edge_numbers], multiplicity[edge_numbers]), _oriented_caps(triangles, orientations * has_length)
    )


def sheet_silhouette(sheet: Sheet, light: np.ndarray, rule: FacingRule) -> Silhouette:
    """Return the silhouette of a sheet: ground of nodes (rows, cols, 3) and triangles. Vertices are numbered row by row.

    The result equals that of ``silhouette`` with ``edges_of``, unless two nodes are at one position.
    """
    position, is_cut_nw_se = sheet.position_frame_m, sheet.is_cut_nw_se
    rows, cols = position.shape[:2]
    triangles = sheet_triangles(is_cut_nw_se)
    is_valid = np.isfinite(position[..., 2]).ravel()[triangles].all(axis=1)
    is_facing = faces_light(position, triangles, light)
    if isinstance(sheet, ColumnMesh):  # triangles without area cast no shadow, so they count as facing the light
        is_facing |= ~np.repeat(sheet.is_quad_with_area.ravel(), 2)
    orientations = (orientations_of(is_facing, rule) * is_valid).reshape(*is_cut_nw_se.shape, 2)
    north, south = orientations[..., 0], orientations[..., 1]
    sums = np.zeros((4, rows, cols), np.int8)
    to_east, to_south, to_northeast, to_southeast = sums
    to_east[1:, :-1] += south
    to_east[:-1, :-1] -= north
    to_south[:-1, :-1] += np.where(is_cut_nw_se, south, north)
    to_south[:-1, 1:] -= np.where(is_cut_nw_se, north, south)
    to_northeast[1:, :-1] = np.where(is_cut_nw_se, 0, north - south)
    to_southeast[:-1, :-1] = np.where(is_cut_nw_se, north - south, 0)
    edge_numbers = np.flatnonzero(sums)
    kind, node = np.divmod(edge_numbers, rows * cols)
    ends = np.stack([node, node + np.array([1, cols, 1 - cols, 1 + cols])[kind]], axis=-1).astype(np.int32)
    return Silhouette(
        *_directed_edges(ends, sums.ravel()[edge_numbers].astype(np.int32)), _oriented_caps(triangles, orientations.ravel())
    )


def _directed_edges(ends: np.ndarray, multiplicity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return edges (k, 2) with their ends in the direction of the casters' boundary, and their multiplicities (k,), positive.

    ``multiplicity`` is negative where the boundary runs from the second end to the first.
    """
    return np.where(multiplicity[:, None] > 0, ends, ends[:, ::-1]), np.abs(multiplicity)


def _oriented_caps(triangles: np.ndarray, orientations: np.ndarray) -> np.ndarray:
    """Return the casting triangles (c, 3) in the orientations in which they cast."""
    casting = np.flatnonzero(orientations)
    caps = triangles[casting]
    flipped = orientations[casting] < 0
    caps[flipped] = caps[flipped][:, [0, 2, 1]]
    return caps


@compiled
def _compute_faces_light_mask(vertices, triangles, light):
    """Return which triangles (m, 3) of vertices (n, 3) face a homogeneous light (4,), bool (m,), as ``faces_light`` does."""
    out = np.empty(len(triangles), np.bool_)
    for t in range(len(triangles)):
        a, b, c = vertices[triangles[t, 0]], vertices[triangles[t, 1]], vertices[triangles[t, 2]]
        ax, ay, az = np.float64(a[0]), np.float64(a[1]), np.float64(a[2])
        ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
        vx, vy, vz = c[0] - ax, c[1] - ay, c[2] - az
        x, y, z = light[0] - light[3] * ax, light[1] - light[3] * ay, light[2] - light[3] * az
        out[t] = (uy * vz - uz * vy) * x + (uz * vx - ux * vz) * y + (ux * vy - uy * vx) * z > 0.0
    return out
