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

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.perspective_shadow_map import perspective_maps
from skugga.shadows.maps.settings import PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.maps.sun_disc import MIN_DISC_TAPS
from skugga.shadows.maps.windows import sun_maps
from skugga.shadows.plan import Step
from skugga.shadows.truth.metrics import MetricCoverage, metric_coverage
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, ray_scene
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.casting import caster_trees
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from tests.hard_cases.cases import FIND_CANDIDATES, RenderedView

STENCIL_PX = 2.0 / 256.0
"""Error of a stencil's faces in the picture: half a step of the grid for a corner, one step for the surface that hides them,
and another half for the rounding of either.
"""

GRID_TEXELS = 1.0 / 128.0
"""Lateral error of an edge in a map: half a step of the grid of 1/256 texel for either end, and as much again for rounding in
between.
"""

ROUNDING_DIRECTIONS = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
"""Offsets right and up of a position, as multiples of the rounding error: none, and the four diagonals."""

NEIGHBOUR_OFFSETS = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
"""Rows and columns from a node to its neighbours, counter-clockwise."""

EDGE_TOLERANCE = 1e-5
"""A point this near to an edge, in cells, belongs to the triangles on either side, as in ``shaders/receiver.glsl``."""

FLOAT32_RELATIVE_ERROR = 32.0 * 2.0**-24
"""Error of positions, their transformations and the start of truth's rays, as a share of the coordinates."""


SAMPLE_COUNT = 64
"""The number of cast shadow pixels that are sampled for the coverage."""


def unexplained_errors(rendered: RenderedView) -> np.ndarray:
    """Return the wrong decidable pixels (rows, cols) under the sun that the algorithm's reach does not explain."""
    truth = rendered.truth
    wrong = truth.decidable & (rendered.dark == truth.lit) & ~truth.attached_shadow_mask
    pixel_indices = np.flatnonzero(wrong)
    wrong.ravel()[pixel_indices] = _unexplained(rendered, pixel_indices, rendered.dark.ravel()[pixel_indices])
    return wrong


def unexplained_coverage(rendered: RenderedView) -> MetricCoverage:
    """Return the coverage of the cast shadow by ``unexplained_errors``.

    It is the number of cast shadow pixels that the reach would not explain if they were lit, estimated from a sample.
    """
    coverage = metric_coverage(rendered.dark, rendered.truth, rendered.truth.decidable)
    cast = np.flatnonzero(
        rendered.truth.decidable & ~rendered.truth.lit & rendered.truth.valid & ~rendered.truth.attached_shadow_mask
    )
    sample = cast[:: max(len(cast) // SAMPLE_COUNT, 1)]
    is_unexplained = _unexplained(rendered, sample, np.zeros(len(sample), bool))
    return replace(coverage, covered_px=round(coverage.cast_px * float(is_unexplained.mean())) if len(sample) else 0)


def _unexplained(rendered: RenderedView, pixel_indices: np.ndarray, dark: np.ndarray) -> np.ndarray:
    """Return which pixels, flat indices (n,), have a class ``dark`` (n,) that truth has nowhere within the reach."""
    unexplained = np.ones(len(pixel_indices), bool)
    if len(pixel_indices):
        rendered = replace(rendered, buffer=receivers_of(rendered.buffer, rendered.scene, rendered.light))
        buffer = rendered.buffer
        assert rendered.scene.sun is not None
        to_sun = buffer.frame.frame_from_earth @ rendered.scene.sun.to_sun_earth
        rays = ray_scene(buffer, rendered.scene, rendered.casters, ALL_CASTER_KINDS)
        (step,) = rendered.plan.steps_of_light(rendered.light)
        facing = facing_normals(buffer, rendered.scene.light_position(rendered.light, buffer.frame), with_lifts=True)
        lifts = buffer.normal_frame if facing.lift_frame is None else facing.lift_frame
        points, normals, lift = (
            a.reshape(-1, 3)[pixel_indices].astype(np.float64) for a in (buffer.position_frame_m, facing.normal_frame, lifts)
        )
        for moves in _candidate_moves(rendered, step, pixel_indices, to_sun, points, normals, facing.crease.ravel()[pixel_indices]):
            unexplained &= rays.is_blocked(points + moves + rays.offset_m * lift, to_sun) != dark
    return unexplained


def _candidate_moves(
    rendered: RenderedView,
    step: Step,
    pixel_indices: np.ndarray,
    to_sun: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    crease: np.ndarray,
) -> Iterator[np.ndarray]:
    """Return moves (n, 3) in the frame, metres, within the reach of an algorithm's error."""
    extent_m = float(np.nanmax(np.abs(rendered.buffer.position_frame_m)))
    float_m = np.full(len(points), FLOAT32_RELATIVE_ERROR * extent_m)
    if isinstance(step.settings, ShadowMapSettings | PerspectiveMapSettings):
        yield from _candidate_map_moves(rendered, step, pixel_indices, to_sun, points, normals, crease)
        return
    if step.algorithm == "sweep":
        node_m = describe(rendered.scene, rendered.view).node_m
        for i, j in product(np.linspace(-node_m, node_m, 9), repeat=2):
            flat = np.array([i, j, 0.0])
            yield flat - (normals @ flat / normals[:, 2])[:, None] * [0.0, 0.0, 1.0]
        return
    reach_m = float_m + STENCIL_PX * _pixel_m(rendered, points)
    for direction in product((-1.0, 0.0, 1.0), repeat=3):
        yield reach_m[:, None] * direction


def _pixel_m(rendered: RenderedView, points: np.ndarray) -> np.ndarray:
    """Return the side of a pixel at points (n, 3), metres."""
    if isinstance(rendered.view, PerspectiveView):
        eye, _ = rendered.view.in_frame(rendered.buffer.frame)
        return np.linalg.norm(points - eye, axis=1) * rendered.view.pixel_tangent
    position = rendered.buffer.position_frame_m
    steps = (np.linalg.norm(np.diff(position, axis=axis), axis=-1) for axis in (0, 1))
    return np.full(len(points), max(float(np.nanmax(step, initial=0.0)) for step in steps))


def _candidate_map_moves(
    rendered: RenderedView,
    step: Step,
    pixel_indices: np.ndarray,
    to_sun: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    crease: np.ndarray,
) -> Iterator[np.ndarray]:
    """Return moves to the places that a map samples: the centres of its taps.

    The centres lie on the plane of the point's triangle and on those of the map's ground connected with it. Where no such ground is
    known, they lie at the depth of the point moved by its bias (``docs/shadow-maps.md`` derives it). Each appears as it is
    and moved towards the sun by the error of the map's depth steps and float32.

    The rasteriser's grid and float32 displace an edge by up to GRID_TEXELS and ``displacement_texels``, which displaces the centre
    as well. By ``displacement_texels`` the point may also have other taps.
    """
    settings = step.settings
    assert isinstance(settings, ShadowMapSettings | PerspectiveMapSettings)
    taps = MIN_DISC_TAPS if settings.filter == "sun" else int(settings.filter)
    biased_taps = min(taps, 2) if settings.bias == "receiver_plane" else taps
    matrix, error_m = _map_matrices(rendered, step, pixel_indices)
    frame_from_map, position = np.linalg.inv(matrix), _transform_points(matrix, points)
    w = _dot(matrix[:, 3, :3], points) + matrix[:, 3, 3]
    jacobian = (matrix[:, :3, :3] - position[:, :, None] * matrix[:, 3:, :3]) / w[:, None, None]
    right, up, _ = np.moveaxis(np.linalg.inv(jacobian), 2, 0)  # the move by one texel, at constant depth of the map
    widest = np.maximum(np.linalg.norm(right + up, axis=1), np.linalg.norm(right - up, axis=1))
    slack = np.abs(_dot(normals, right)) + np.abs(_dot(normals, up)) + crease * widest
    clear_m = (biased_taps / 2.0 + GRID_TEXELS) * slack / np.maximum(1.0 - crease**2 / 2.0, 0.25)
    clear_m /= np.maximum(1.0 - clear_m * _dot(matrix[:, 3, :3], normals) / w, 0.25)
    biased_position = _transform_points(matrix, points + (clear_m + error_m)[:, None] * normals + error_m[:, None] * to_sun)
    displacement_texels = error_m[:, None] * np.linalg.norm(jacobian[:, :2], axis=2)
    towards_sun = (2.0 / np.abs(jacobian[:, 2] @ to_sun) + error_m)[:, None] * to_sun
    triangles = [] if rendered.buffer.surface is None else list(_connected_triangles(rendered.buffer, pixel_indices, to_sun))
    for sign in ROUNDING_DIRECTIONS:
        for count, has_known_plane, map_position in ((taps, True, position), (biased_taps, False, biased_position)):
            first = np.floor(map_position[:, :2] + sign * displacement_texels - (count - 1) / 2.0)
            for tap in product(range(count), repeat=2):
                centre = first + np.array(tap) + 0.5 + sign * (GRID_TEXELS + displacement_texels)
                move = _transform_points(frame_from_map, np.column_stack([centre, map_position[:, 2]])) - points
                if not has_known_plane:
                    yield from (move, move + towards_sun)
                    continue
                plane_move = (
                    _project_onto_planes(points + move, points, normals, to_sun) - points
                )  # along the sun's ray onto the plane
                yield from (plane_move, plane_move + towards_sun)
                for corners, connected in triangles:
                    inside = connected & _triangles_contain(
                        np.stack([_transform_points(matrix, corner)[:, :2] for corner in corners]), centre
                    )
                    if inside.any():
                        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
                        beside_m = np.where(
                            inside[:, None], _project_onto_planes(points + move, corners[0], normal, to_sun) - points, plane_move
                        )
                        yield from (beside_m, beside_m + towards_sun)


def _connected_triangles(
    buffer: GeometryBuffer, pixel_indices: np.ndarray, to_sun: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return the map's ground triangles (3, n, 3) up to half round the nearest node from those of the pixels ``pixel_indices``
    (n,).

    The second result (n,) tells whether only triangles that face the sun lie in between: the sun sees others before or behind.
    """
    view, surface = buffer.view, buffer.surface
    assert isinstance(view, MapView) and surface is not None
    i, j = np.unravel_index(pixel_indices, buffer.valid.shape)
    position = np.stack([view.row0 - surface.row0 + i * view.row_step, view.col0 - surface.col0 + j * view.col_step], axis=1)
    # The nearest node; half-way between nodes, the one nearest to the sun.
    low, high = np.ceil(position - 0.5 - EDGE_TOLERANCE).astype(int), np.floor(position + 0.5 + EDGE_TOLERANCE).astype(int)
    nearest = [np.column_stack([row[:, 0], col[:, 1]]) for row in (low, high) for col in (low, high)]
    height = [np.nan_to_num(surface.position_frame_m[tuple(indices.T)] @ to_sun, nan=-np.inf) for indices in nearest]
    node = np.stack(nearest)[np.argmax(height, axis=0), np.arange(len(pixel_indices))]
    east, north = (position - node)[:, 1], (node - position)[:, 0]
    # Eighths of the circle; where a quad is cut beside the node, one triangle takes up two of them.
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    for k, (row, col) in enumerate(NEIGHBOUR_OFFSETS):
        next_row, next_col = NEIGHBOUR_OFFSETS[(k + 1) % 8]
        corner, side = ((row, col), k - 1) if k % 2 else ((next_row, next_col), k)  # of the quad that contains the eighth
        is_cut_nw_se = surface.sheet.is_cut_nw_se[node[:, 0] + min(corner[0], 0), node[:, 1] + min(corner[1], 0)]
        cut_meets_node = is_cut_nw_se == (corner[0] == corner[1])
        rim_ends = np.array(NEIGHBOUR_OFFSETS[side]), np.array(NEIGHBOUR_OFFSETS[(side + 2) % 8])
        spoke_ends = np.array((row, col)), np.array((next_row, next_col))
        ends.append(
            tuple(  # type: ignore[arg-type]
                np.where(cut_meets_node[:, None], spoke_end, rim_end)
                for spoke_end, rim_end in zip(spoke_ends, rim_ends, strict=True)
            )
        )
    middle = surface.position_frame_m[node[:, 0], node[:, 1]]
    corners = np.stack([[middle, *(surface.position_frame_m[tuple((node + end).T)] for end in pair)] for pair in ends])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # shape of corners: (8, 3, n, 3)
    towards_sun = np.nan_to_num(normal @ to_sun / np.linalg.norm(normal, axis=-1), nan=-np.inf)
    contains_point = np.array(
        [
            (start[:, 1] * north + start[:, 0] * east >= -EDGE_TOLERANCE)
            & (-east * end[:, 0] - north * end[:, 1] >= -EDGE_TOLERANCE)
            for start, end in ends
        ]
    )
    first, indices = np.where(contains_point, towards_sun, -np.inf).argmax(axis=0), np.arange(len(pixel_indices))
    for direction in (1, -1):
        connected = np.ones(len(pixel_indices), bool)
        for steps in (1, 2, 3, 4):
            k = (first + direction * steps) % 8
            connected = connected & (towards_sun[k, indices] > 0.0)
            yield np.moveaxis(corners[k, :, indices], 0, 1), connected


def _project_onto_planes(points: np.ndarray, place: np.ndarray, normals: np.ndarray, to_sun: np.ndarray) -> np.ndarray:
    """Return points (n, 3) moved along the sun's rays onto one plane each, given by a place and a normal."""
    return points - (_dot(normals, points - place) / (normals @ to_sun))[:, None] * to_sun


def _triangles_contain(corners: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return whether triangles (3, n, 2) contain places (n, 2), in either winding order."""
    sides, to_point = np.roll(corners, -1, axis=0) - corners, at - corners
    cross_product = sides[..., 0] * to_point[..., 1] - sides[..., 1] * to_point[..., 0]
    return (cross_product >= 0.0).all(axis=0) | (cross_product <= 0.0).all(axis=0)


def _map_matrices(rendered: RenderedView, step: Step, pixel_indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices (n, 4, 4) from the frame to columns, rows and depth steps of the maps of the pixels ``pixel_indices`` (n,).

    The second result (n,) is the assumed error of positions, metres.
    """
    buffer, scene, settings = rendered.buffer, rendered.scene, step.settings
    trees = caster_trees(buffer, step.kinds)
    if isinstance(settings, PerspectiveMapSettings):
        receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, rendered.light)
        assert buffer.corners_frame_m is not None
        farthest_m = np.linalg.norm(buffer.corners_frame_m.reshape(-1, 3, 3)[pixel_indices], axis=2).max(axis=1)
        matrices = np.full((len(pixel_indices), 4, 4), np.nan)
        maps = perspective_maps(buffer, receivers, scene, rendered.light, settings, trees, FIND_CANDIDATES[step.algorithm])
        for depth_map in (perspective_map.depth_map for perspective_map in maps):
            units = np.array([1.0, 1.0, depth_map.uniforms["depth_step"], 1.0])
            matrices[np.isin(pixel_indices, depth_map.point_indices)] = (
                np.reshape(depth_map.uniforms["map_rows"], (4, 4)) / units[:, None]
            )
        return matrices, depth_map.uniforms["position_error"] * farthest_m
    assert isinstance(settings, ShadowMapSettings)
    matrices, error_m = np.full((len(pixel_indices), 4, 4), np.nan), np.full(len(pixel_indices), np.nan)
    for depth_map in sun_maps(buffer, scene, settings, trees):
        uniforms = depth_map.uniforms
        unit_m = np.array([*uniforms["texel_m"], uniforms["window_m"][2] * uniforms["depth_step"]])
        rows = np.eye(4)
        rows[:3, :3] = np.reshape(uniforms["light_from_frame"], (3, 3)).T / unit_m[:, None]
        rows[:3, 3] = uniforms["light_offset_m"] / unit_m
        map_pixels = slice(None) if depth_map.point_indices is None else np.isin(pixel_indices, depth_map.point_indices)
        matrices[map_pixels], error_m[map_pixels] = rows, uniforms["error_m"]
    return matrices, error_m


def _transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) transformed by matrices (n, 4, 4)."""
    homogeneous = np.einsum("nij,nj->ni", matrix[:, :, :3], points) + matrix[:, :, 3]
    return homogeneous[:, :3] / homogeneous[:, 3:]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products (n,) of vectors (n, 3), row by row."""
    return np.einsum("nk,nk->n", a, b)
