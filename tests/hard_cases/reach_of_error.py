"""The spatial tolerance of an algorithm: a wrong pixel is within its error bound if truth has the other answer within that reach.

A map answers for the centres of the texels round the point, on the visible plane, and stores positions in float32 and depths in
steps. A volume answers for the point itself, within the rasteriser's grid of 1/256 pixel and float32. The line sweep answers for
lines within a node's width of the point. Rays from samples all over that reach give truth there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from skugga.shadows.attached import attached
from skugga.shadows.maps.perspective_shadow_map import perspective_maps
from skugga.shadows.maps.settings import PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.maps.sun_disc import MIN_DISC_TAPS
from skugga.shadows.maps.windows import sun_maps
from skugga.shadows.plan import Step
from skugga.shadows.truth.metrics import MetricCoverage, metric_coverage
from skugga.shadows.truth.truth import ALL_KINDS, ray_scene
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.casting import caster_trees
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from tests.hard_cases.cases import Seen

STENCIL_PX = 2.0 / 256.0
"""Error of a stencil's faces in the picture: half a step of the grid for a corner, one step for the surface that hides them,
and another half for the rounding of either.
"""

GRID_TEXELS = 1.0 / 128.0
"""Lateral error of an edge in a map: half a step of the grid of 1/256 texel for either end, and as much again for rounding in
between.
"""

SIGNS = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
"""A place, and the places right and up of it by the rounding error."""

RING = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
"""Rows and columns from a node to its neighbours, counter-clockwise."""

EDGE_TOLERANCE = 1e-5
"""A point this near to an edge, in cells, belongs to the triangles on either side, as in ``shaders/receiver.glsl``."""

FLOAT_ULPS = 32.0 * 2.0**-24
"""Error of positions, their transformations and the start of truth's rays, as a share of the coordinates."""


SAMPLED_PX = 64
"""The number of cast shadow pixels that are sampled for the coverage."""


def beyond(seen: Seen) -> np.ndarray:
    """Return the wrong decidable pixels (rows, cols) under the sun that the algorithm's reach does not explain."""
    real = seen.truth
    wrong = real.decidable & (seen.dark == real.lit) & ~real.attached
    left = np.flatnonzero(wrong)
    wrong.ravel()[left] = _unexplained(seen, left, seen.dark.ravel()[left])
    return wrong


def beyond_sight(seen: Seen) -> MetricCoverage:
    """Return the coverage of the cast shadow by ``beyond``.

    It is the number of cast shadow pixels that the reach would not explain if they were lit, estimated from a sample.
    """
    whole = metric_coverage(seen.dark, seen.truth, seen.truth.decidable)
    cast = np.flatnonzero(seen.truth.decidable & ~seen.truth.lit & seen.truth.valid & ~seen.truth.attached)
    sample = cast[:: max(len(cast) // SAMPLED_PX, 1)]
    told = _unexplained(seen, sample, np.zeros(len(sample), bool))
    return replace(whole, covered_px=round(whole.cast_px * float(told.mean())) if len(sample) else 0)


def _unexplained(seen: Seen, left: np.ndarray, dark: np.ndarray) -> np.ndarray:
    """Return which pixels, flat indices (n,), have a class ``dark`` (n,) that truth has nowhere within the reach."""
    out = np.ones(len(left), bool)
    if len(left):
        seen = replace(seen, buffer=receivers_of(seen.buffer, seen.scene, seen.light))
        buffer = seen.buffer
        assert seen.scene.sun is not None
        towards = buffer.frame.frame_from_earth @ seen.scene.sun.to_sun_earth
        rays = ray_scene(buffer, seen.scene, seen.casters, ALL_KINDS)
        (step,) = seen.plan.steps_under(seen.light)
        facing = facing_normals(buffer, seen.scene.light_position(seen.light, buffer.frame))
        lifts = buffer.normal_frame if facing.lift_frame is None else facing.lift_frame
        points, normals, lift = (
            a.reshape(-1, 3)[left].astype(np.float64) for a in (buffer.position_frame_m, facing.normal_frame, lifts)
        )
        for moves in _moves(seen, step, left, towards, points, normals, facing.crease.ravel()[left]):
            out &= rays.blocked(points + moves + rays.offset_m * lift, towards) != dark
    return out


def _moves(
    seen: Seen, step: Step, left: np.ndarray, towards: np.ndarray, points: np.ndarray, normals: np.ndarray, crease: np.ndarray
) -> Iterator[np.ndarray]:
    """Return moves (n, 3) in the frame, metres, within the reach of an algorithm's error."""
    extent_m = float(np.nanmax(np.abs(seen.buffer.position_frame_m)))
    float_m = np.full(len(points), FLOAT_ULPS * extent_m)
    if isinstance(step.settings, ShadowMapSettings | PerspectiveMapSettings):
        yield from _map_moves(seen, step, left, towards, points, normals, crease)
        return
    if step.algorithm == "sweep":
        node_m = describe(seen.scene, seen.view).node_m
        for i, j in product(np.linspace(-node_m, node_m, 9), repeat=2):
            flat = np.array([i, j, 0.0])
            yield flat - (normals @ flat / normals[:, 2])[:, None] * [0.0, 0.0, 1.0]
        return
    reach_m = float_m + STENCIL_PX * _pixel_m(seen, points)
    for direction in product((-1.0, 0.0, 1.0), repeat=3):
        yield reach_m[:, None] * direction


def _pixel_m(seen: Seen, points: np.ndarray) -> np.ndarray:
    """Return the side of a pixel at points (n, 3), metres."""
    if isinstance(seen.view, PerspectiveView):
        eye, _ = seen.view.in_frame(seen.buffer.frame)
        return np.linalg.norm(points - eye, axis=1) * seen.view.pixel
    position = seen.buffer.position_frame_m
    steps = (np.linalg.norm(np.diff(position, axis=axis), axis=-1) for axis in (0, 1))
    return np.full(len(points), max(float(np.nanmax(step, initial=0.0)) for step in steps))


def _map_moves(
    seen: Seen, step: Step, left: np.ndarray, towards: np.ndarray, points: np.ndarray, normals: np.ndarray, crease: np.ndarray
) -> Iterator[np.ndarray]:
    """Return moves to the places that a map samples: the centres of its taps.

    The centres lie on the plane of the point's triangle and on those of the map's ground connected with it. Where no such ground is
    known, they lie at the depth of the point moved by its bias (``docs/shadow-maps.md`` derives it). Each appears as it is
    and moved towards the sun by the error of the map's depth steps and float32.

    The rasteriser's grid and float32 displace an edge by up to GRID_TEXELS and ``off``, which displaces the centre as well. By
    ``off`` the point may also have other taps.
    """
    settings = step.settings
    assert isinstance(settings, ShadowMapSettings | PerspectiveMapSettings)
    taps = MIN_DISC_TAPS if settings.filter == "sun" else int(settings.filter)
    beside = min(taps, 2) if settings.bias == "receiver_plane" else taps
    matrix, error_m = _maps(seen, step, left)
    frame_from_map, at = np.linalg.inv(matrix), _projected(matrix, points)
    w = _dot(matrix[:, 3, :3], points) + matrix[:, 3, 3]
    jacobian = (matrix[:, :3, :3] - at[:, :, None] * matrix[:, 3:, :3]) / w[:, None, None]
    right, up, _ = np.moveaxis(np.linalg.inv(jacobian), 2, 0)  # the move by one texel, at constant depth of the map
    widest = np.maximum(np.linalg.norm(right + up, axis=1), np.linalg.norm(right - up, axis=1))
    slack = np.abs(_dot(normals, right)) + np.abs(_dot(normals, up)) + crease * widest
    clear_m = (beside / 2.0 + GRID_TEXELS) * slack / np.maximum(1.0 - crease**2 / 2.0, 0.25)
    clear_m /= np.maximum(1.0 - clear_m * _dot(matrix[:, 3, :3], normals) / w, 0.25)
    clear = _projected(matrix, points + (clear_m + error_m)[:, None] * normals + error_m[:, None] * towards)
    off = error_m[:, None] * np.linalg.norm(jacobian[:, :2], axis=2)
    nearer = (2.0 / np.abs(jacobian[:, 2] @ towards) + error_m)[:, None] * towards
    around = [] if seen.buffer.surface is None else list(_connected(seen.buffer, left, towards))
    for sign in SIGNS:
        for count, known, place in ((taps, True, at), (beside, False, clear)):
            first = np.floor(place[:, :2] + sign * off - (count - 1) / 2.0)
            for tap in product(range(count), repeat=2):
                centre = first + np.array(tap) + 0.5 + sign * (GRID_TEXELS + off)
                move = _projected(frame_from_map, np.column_stack([centre, place[:, 2]])) - points
                if not known:
                    yield from (move, move + nearer)
                    continue
                own = _onto(points + move, points, normals, towards) - points  # along the sun's ray onto the plane
                yield from (own, own + nearer)
                for corners, connected in around:
                    inside = connected & _holds(np.stack([_projected(matrix, corner)[:, :2] for corner in corners]), centre)
                    if inside.any():
                        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
                        beside_m = np.where(inside[:, None], _onto(points + move, corners[0], normal, towards) - points, own)
                        yield from (beside_m, beside_m + nearer)


def _connected(buffer: GeometryBuffer, left: np.ndarray, towards: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return the map's ground triangles (3, n, 3) up to half round the nearest node from those of the pixels ``left`` (n,).

    The second result (n,) tells whether only triangles that face the sun lie in between: the sun sees others before or behind.
    """
    view, surface = buffer.view, buffer.surface
    assert isinstance(view, MapView) and surface is not None
    i, j = np.unravel_index(left, buffer.valid.shape)
    at = np.stack([view.row0 - surface.row0 + i * view.row_step, view.col0 - surface.col0 + j * view.col_step], axis=1)
    # The nearest node; half-way between nodes, the one nearest to the sun.
    low, high = np.ceil(at - 0.5 - EDGE_TOLERANCE).astype(int), np.floor(at + 0.5 + EDGE_TOLERANCE).astype(int)
    nearest = [np.column_stack([row[:, 0], col[:, 1]]) for row in (low, high) for col in (low, high)]
    height = [np.nan_to_num(surface.position_frame_m[tuple(each.T)] @ towards, nan=-np.inf) for each in nearest]
    node = np.stack(nearest)[np.argmax(height, axis=0), np.arange(len(left))]
    east, north = (at - node)[:, 1], (node - at)[:, 0]
    # Eighths of the circle; where a quad is cut beside the node, one triangle takes up two of them.
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    for k, (row, col) in enumerate(RING):
        next_row, next_col = RING[(k + 1) % 8]
        corner, side = ((row, col), k - 1) if k % 2 else ((next_row, next_col), k)  # of the quad that contains the eighth
        falls = surface.sheet.falls[node[:, 0] + min(corner[0], 0), node[:, 1] + min(corner[1], 0)]
        ends_here = falls == (corner[0] == corner[1])
        rim = np.array(RING[side]), np.array(RING[(side + 2) % 8])
        own = np.array((row, col)), np.array((next_row, next_col))
        ends.append(tuple(np.where(ends_here[:, None], one, other) for one, other in zip(own, rim, strict=True)))  # type: ignore[arg-type]
    middle = surface.position_frame_m[node[:, 0], node[:, 1]]
    corners = np.stack([[middle, *(surface.position_frame_m[tuple((node + end).T)] for end in pair)] for pair in ends])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # shape of corners: (8, 3, n, 3)
    towards_sun = np.nan_to_num(normal @ towards / np.linalg.norm(normal, axis=-1), nan=-np.inf)
    holds = np.array(
        [
            (start[:, 1] * north + start[:, 0] * east >= -EDGE_TOLERANCE)
            & (-east * end[:, 0] - north * end[:, 1] >= -EDGE_TOLERANCE)
            for start, end in ends
        ]
    )
    first, each = np.where(holds, towards_sun, -np.inf).argmax(axis=0), np.arange(len(left))
    for turn in (1, -1):
        connected = np.ones(len(left), bool)
        for steps in (1, 2, 3, 4):
            k = (first + turn * steps) % 8
            connected = connected & (towards_sun[k, each] > 0.0)
            yield np.moveaxis(corners[k, :, each], 0, 1), connected


def _onto(points: np.ndarray, place: np.ndarray, normals: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return points (n, 3) moved along the sun's rays onto one plane each, given by a place and a normal."""
    return points - (_dot(normals, points - place) / (normals @ towards))[:, None] * towards


def _holds(corners: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return whether triangles (3, n, 2) contain places (n, 2), in either winding order."""
    sides, away = np.roll(corners, -1, axis=0) - corners, at - corners
    turn = sides[..., 0] * away[..., 1] - sides[..., 1] * away[..., 0]
    return (turn >= 0.0).all(axis=0) | (turn <= 0.0).all(axis=0)


def _maps(seen: Seen, step: Step, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices (n, 4, 4) from the frame to columns, rows and depth steps of the maps of the pixels ``left`` (n,).

    The second result (n,) is the assumed error of positions, metres.
    """
    buffer, scene, settings = seen.buffer, seen.scene, step.settings
    trees = caster_trees(buffer, step.kinds)
    if isinstance(settings, PerspectiveMapSettings):
        receivers = buffer.valid & ~attached(buffer, scene, seen.light)
        assert buffer.corners_frame_m is not None
        farthest_m = np.linalg.norm(buffer.corners_frame_m.reshape(-1, 3, 3)[left], axis=2).max(axis=1)
        out = np.full((len(left), 4, 4), np.nan)
        for drawn in (each.drawn for each in perspective_maps(buffer, receivers, scene, seen.light, settings, trees)):
            units = np.array([1.0, 1.0, drawn.uniforms["depth_step"], 1.0])
            out[np.isin(left, drawn.pixels)] = np.reshape(drawn.uniforms["map_rows"], (4, 4)) / units[:, None]
        return out, drawn.uniforms["position_error"] * farthest_m
    assert isinstance(settings, ShadowMapSettings)
    out, error_m = np.full((len(left), 4, 4), np.nan), np.full(len(left), np.nan)
    for drawn in sun_maps(buffer, scene, settings, trees):
        known = drawn.uniforms
        unit_m = np.array([*known["texel_m"], known["window_m"][2] * known["depth_step"]])
        rows = np.eye(4)
        rows[:3, :3] = np.reshape(known["light_from_frame"], (3, 3)).T / unit_m[:, None]
        rows[:3, 3] = known["light_offset_m"] / unit_m
        here = slice(None) if drawn.pixels is None else np.isin(left, drawn.pixels)
        out[here], error_m[here] = rows, known["error_m"]
    return out, error_m


def _projected(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) transformed by matrices (n, 4, 4)."""
    through = np.einsum("nij,nj->ni", matrix[:, :, :3], points) + matrix[:, :, 3]
    return through[:, :3] / through[:, 3:]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products (n,) of vectors (n, 3), row by row."""
    return np.einsum("nk,nk->n", a, b)
