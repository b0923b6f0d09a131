"""Silhouettes as a light sees them: the edges at which the shadow of casting triangles begins and ends.

The shadow of one triangle that is oriented towards the light (counter-clockwise as seen from there) is bounded by itself, by a
side from each of its three edges away from the light and, for a lamp, by a cap at infinity. A ray that leaves a point of the
shadow crosses this boundary outwards once more often than inwards; one that leaves any other point, as often. Boundaries add:
over a set of triangles the signed count of crossings is the number of triangles between the point and the light, and where
triangles run along an edge in opposite directions their sides cancel before anything is drawn. What is left of an edge is the
signed sum of its directions, the multiplicity, and its side counts so many times. So nothing need be closed or manifold, and any
set of triangles will do (B. Kim, K. Kim, G. Turk 2008, "A shadow-volume algorithm for opaque and transparent nonmanifold
casters", J. Graphics Tools 13(3), who count by multiplicity; for closed bodies C. Everitt, M. Kilgard 2002, "Practical and robust
stenciled shadow volumes for hardware-accelerated rendering").

Which triangles need cast is up to what they bound:

- ``facing``: those that face the light. For closed bodies with their faces outwards: a way from a point to the light crosses as
  many facing triangles as others, and one more for each body that the point is in; so where any triangle blocks it, a facing one
  does. (One less for each body that a lamp is in: a lamp's own housing needs another rule.)
- ``turned_away``: the others, flipped. For ground seen from above: where the way from a point on it or above it is blocked, it
  first goes into the ground, through a triangle turned away from the light. The caps lie where it is dark anyway. (A way that dips
  into a gap of the ground may come up from below it: around gaps all triangles need cast.)
- ``all``: both. For anything, open or not.

Whether a triangle faces the light is computed once, and both neighbours across an edge go by it: whatever rounding does to a
triangle seen edge-on, the edges of the silhouette join up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from skugga.shadows.volumes.edges import Edges, signed_sums
from skugga.terrain.compiled import compiled
from skugga.terrain.errors import InputError
from skugga.terrain.ground.columns import ColumnSheet
from skugga.terrain.ground.sheet import Sheet, sheet_triangles

FacingRule = Literal["facing", "turned_away", "all"]

FACING_CODE, TURNED_AWAY_CODE, ALL_CODE = 1, 2, 3
"""The rules as numbers, one for each triangle: bit 0, cast those that face the light; bit 1, cast the others."""

FACING_RULE_CODES: dict[FacingRule, int] = {"facing": FACING_CODE, "turned_away": TURNED_AWAY_CODE, "all": ALL_CODE}


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The boundary of the triangles that cast, as seen from a light.

    Attributes
    ----------
    edges
        int32 (k, 2), vertex numbers: an edge from its first to its second, with what casts on the left as seen from the light.
    times
        int32 (k,), 1 or more: how often the side of each edge counts.
    caps
        int32 (c, 3), vertex numbers: the casting triangles, counter-clockwise as seen from the light.
    """

    edges: np.ndarray
    times: np.ndarray
    caps: np.ndarray


def homogeneous(light: np.ndarray) -> np.ndarray:
    """A light (4,) float64: a direction to the sun and 0, or a lamp's position and 1. Raises ``InputError`` for anything else."""
    checked = np.asarray(light, np.float64)
    sound = checked.shape == (4,) and np.isfinite(checked).all() and checked[3] in (0.0, 1.0) and checked.any()
    if not sound:
        raise InputError("light", light, "a direction other than zero and 0, or a position and 1")
    return checked


def facing(vertices: np.ndarray, triangles: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Which triangles (m, 3) of vertices (n, 3) face a light (4,), bool (m,); one seen exactly edge-on does not.

    In float64, from the vertices as float32: the triangles as they are drawn. A triangle (a, b, c) faces a light l where
    ((b - a) x (c - a)) . (l_xyz - l_w a) > 0.
    """
    return _facing(np.asarray(vertices, np.float32).reshape(-1, 3), np.asarray(triangles).reshape(-1, 3), homogeneous(light))


def turns_of(facing: np.ndarray, rule: FacingRule | np.ndarray) -> np.ndarray:
    """How triangles cast, int8 (m,): +1 as they are, -1 flipped, 0 not at all.

    ``rule`` is one for all, or a number for each: ``FACING_CODE``, ``TURNED_AWAY_CODE``, ``ALL_CODE``, or 0 for what casts
    nothing; all triangles of a part of a mesh have the same. Raises ``InputError`` for any other rule.
    """
    if isinstance(rule, str) and rule not in FACING_RULE_CODES:
        raise InputError("rule", rule, " or ".join(FACING_RULE_CODES))
    numbers = np.asarray(FACING_RULE_CODES[rule] if isinstance(rule, str) else rule, np.int8)
    if numbers.size and (numbers.min() < 0 or numbers.max() > ALL_CODE):
        raise InputError("rule", int(numbers.min() if numbers.min() < 0 else numbers.max()), f"0 to {ALL_CODE}")
    return np.where(facing, numbers & FACING_CODE, -(numbers >> 1))


def silhouette(triangles: np.ndarray, edges: Edges, turns: np.ndarray) -> Silhouette:
    """The silhouette of triangles (m, 3) that cast as ``turns`` (m,) says, where ``edges`` are theirs."""
    times = signed_sums(edges, turns)
    drawn = np.flatnonzero(times)
    unbalanced = edges.along[:, 0] != 0
    return Silhouette(*_directed(edges.ends[drawn], times[drawn]), _caps(triangles, turns * unbalanced))


def sheet_silhouette(sheet: Sheet, light: np.ndarray, rule: FacingRule) -> Silhouette:
    """The silhouette of a sheet of nodes (rows, cols, 3).

    Vertices are numbered row by row. The same as by way of ``edges_of``, which finds nothing that the grid does not tell unless two
    nodes are in one place.
    """
    position, falls = sheet.position_frame_m, sheet.falls
    rows, cols = position.shape[:2]
    triangles = sheet_triangles(falls)
    known = np.isfinite(position[..., 2]).ravel()[triangles].all(axis=1)
    faces = facing(position, triangles, light)
    if isinstance(sheet, ColumnSheet):  # what has no area throws no shadow: it counts as facing the light
        faces |= ~np.repeat(sheet.has_area.ravel(), 2)
    turns = (turns_of(faces, rule) * known).reshape(*falls.shape, 2)
    north, south = turns[..., 0], turns[..., 1]
    sums = np.zeros((4, rows, cols), np.int8)
    to_east, to_south, to_northeast, to_southeast = sums
    to_east[1:, :-1] += south
    to_east[:-1, :-1] -= north
    to_south[:-1, :-1] += np.where(falls, south, north)
    to_south[:-1, 1:] -= np.where(falls, north, south)
    to_northeast[1:, :-1] = np.where(falls, 0, north - south)
    to_southeast[:-1, :-1] = np.where(falls, north - south, 0)
    drawn = np.flatnonzero(sums)
    kind, node = np.divmod(drawn, rows * cols)
    ends = np.stack([node, node + np.array([1, cols, 1 - cols, 1 + cols])[kind]], axis=-1).astype(np.int32)
    return Silhouette(*_directed(ends, sums.ravel()[drawn].astype(np.int32)), _caps(triangles, turns.ravel()))


def _directed(ends: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges the way they are run along, and how often."""
    return np.where(times[:, None] > 0, ends, ends[:, ::-1]), np.abs(times)


def _caps(triangles: np.ndarray, turns: np.ndarray) -> np.ndarray:
    casting = np.flatnonzero(turns)
    caps = triangles[casting]
    flipped = turns[casting] < 0
    caps[flipped] = caps[flipped][:, [0, 2, 1]]
    return caps


@compiled
def _facing(vertices, triangles, light):
    out = np.empty(len(triangles), np.bool_)
    for t in range(len(triangles)):
        a, b, c = vertices[triangles[t, 0]], vertices[triangles[t, 1]], vertices[triangles[t, 2]]
        ax, ay, az = np.float64(a[0]), np.float64(a[1]), np.float64(a[2])
        ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
        vx, vy, vz = c[0] - ax, c[1] - ay, c[2] - az
        x, y, z = light[0] - light[3] * ax, light[1] - light[3] * ay, light[2] - light[3] * az
        out[t] = (uy * vz - uz * vy) * x + (uz * vx - ux * vz) * y + (ux * vy - uy * vx) * z > 0.0
    return out
