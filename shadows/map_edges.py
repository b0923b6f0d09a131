"""Anti-alias edges in maps: a pixel that an edge crosses shows the mean over its samples.

Masks and measures of accuracy use each pixel's own point only. Where heights alone suffice, all pixels show means over nodes half a
pixel apart, as in coarse maps (``skugga.shadows.supersampling``). Elsewhere only pixels that an edge crosses get more samples. The
samples are the points of a finer view of the same ground. The plan's steps compute the visibility at each sample, and each sample
is shaded. A pixel whose samples all agree with its own point keeps that point.

An edge crosses a pixel where a light's visibility, or the kind of surface, changes from the pixel to a neighbour. Pixels beyond the
block's border are unknown, so all pixels along its sides get more samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from skugga.shadows.block_casters import find_outside_casters
from skugga.shadows.passes import GEOMETRY_PASS, PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.supersampling import edge_supersampling, mean_visibilities, needs_outside_casters
from skugga.shadows.visibility import visibilities_at
from skugga.terrain.casters.caster_culling import block_ground_faces_sun
from skugga.terrain.casters.caster_types import NO_CASTERS, Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.antialias import MultisampledBuffer
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.map_block import EDGE_SAMPLES_PER_SIDE, nodes_of_samples
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

NamedArrays = dict[str, np.ndarray]
"""Arrays by name: visibilities by light, or arrays of a geometry buffer by field."""

MIN_EDGE_VISIBILITY_CHANGE = 0.5
"""Threshold of the change of a light's visibility between neighbouring pixels that marks an edge. A penumbra changes by less."""

SAMPLED_PART_PX = BLOCK_PX // EDGE_SAMPLES_PER_SIDE
"""Side, in pixels, of the parts of a block that are sampled one at a time. A part has as many samples as a block has pixels."""

SAMPLES_PER_PIXEL = EDGE_SAMPLES_PER_SIDE * EDGE_SAMPLES_PER_SIDE
"""Number of samples of a pixel that an edge crosses."""

SHADING_ARRAYS = ("valid", "position_frame_m", "height_m", "shading_normal_frame", "surface_kind", "albedo")
"""Names of the arrays of a geometry buffer that shading reads."""


def anti_alias_block(
    scene: Scene, plan: Plan, block_buffer: GeometryBuffer, visibilities: NamedArrays, log: PassLog
) -> tuple[MultisampledBuffer, NamedArrays]:
    """Return a map's block with samples at its edges, and each light's visibility at its pixels and samples.

    Samples lie in extra rows below the block's own rows. They have only the arrays that shading reads (``SHADING_ARRAYS``).
    ``visibilities`` are the lights' visibilities at the pixels' own points. Where heights suffice, the block has no samples, and
    the visibilities are means over its pixels.
    """
    view = block_buffer.view
    assert isinstance(view, MapView)
    kept_layers, requested_layers, log.requested_layers = log.take_layers(), log.requested_layers, frozenset()
    pixels = edge_supersampling(scene, view, plan)
    if pixels is None:
        result = _sample_edges(scene, plan, block_buffer, view, visibilities, log)
    else:
        result = MultisampledBuffer(block_buffer, view.rows), mean_visibilities(pixels, block_buffer, log)
    log.layers, log.requested_layers = kept_layers, requested_layers
    return result


def _sample_edges(
    scene: Scene, plan: Plan, block_buffer: GeometryBuffer, view: MapView, visibilities: NamedArrays, log: PassLog
) -> tuple[MultisampledBuffer, NamedArrays]:
    """Return the block with samples in the pixels that an edge crosses, and the visibilities with those of the samples."""
    if _is_evenly_lit(scene, plan, block_buffer, visibilities):
        return MultisampledBuffer(block_buffer, view.rows), visibilities
    edges = edge_pixels(block_buffer, list(visibilities.values()))
    pixels, samples = [], []
    for down, right in _windows_with_edges(edges):
        part = edges[down, right]
        pixels.append(np.argwhere(part) + [down.start, right.start])
        finer = _sample_buffer(scene, block_buffer, view.part(down.start, right.start, *part.shape), part, log)
        search_outside = needs_outside_casters(plan, block_buffer, (down, right))
        casters = find_outside_casters(scene, plan, finer, partial(_find_casters_of_samples, scene, finer, search_outside), log)
        samples.append(_arrays_of_samples(finer, visibilities_at(scene, plan, finer, casters, log), part))
    if not samples:
        return MultisampledBuffer(block_buffer, view.rows), visibilities
    row, col = np.concatenate(pixels).T
    arrays = {name: np.concatenate([part_arrays[name] for part_arrays in samples]) for name in samples[0]}
    missing = ~arrays["valid"]  # beyond the ground's rim the pixel's own point replaces the sample
    differ = arrays["surface_kind"] != block_buffer.surface_kind[row, col][:, None]
    for light, visibility in visibilities.items():
        differ |= arrays[light] != visibility[row, col][:, None]
    is_edge = (differ & ~missing).any(axis=1)
    row, col, missing, arrays = (
        row[is_edge],
        col[is_edge],
        missing[is_edge],
        {name: value[is_edge] for name, value in arrays.items()},
    )
    if not len(row):
        return MultisampledBuffer(block_buffer, view.rows), visibilities
    changes: dict[str, Any] = {}
    for name in SHADING_ARRAYS:
        value = getattr(block_buffer, name)
        if value is not None:
            changes[name] = _append_samples(value, arrays[name], missing, row, col)
    sampled_visibilities = {
        light: _append_samples(value, arrays[light], missing, row, col) for light, value in visibilities.items()
    }
    return MultisampledBuffer(replace(block_buffer, **changes), view.rows, (row, col), SAMPLES_PER_PIXEL), sampled_visibilities


def _is_evenly_lit(scene: Scene, plan: Plan, block_buffer: GeometryBuffer, visibilities: NamedArrays) -> bool:
    """Return whether no edge can cross a block or its sides.

    That holds where the block has bare ground, nothing casts, and all ground faces the sun. ``visibilities`` are those of the
    lights at the block's points.
    """
    if plan.casts_shadows or not is_terrain_only(scene) or not scene.sun_is_up:
        return False
    return bool((visibilities[SUN][block_buffer.valid] == 1.0).all()) and block_ground_faces_sun(scene, block_buffer)


def _find_casters_of_samples(scene: Scene, sample_buffer: GeometryBuffer, search_outside: bool) -> Casters:
    """Return the casters beside a part of a block; none unless ``search_outside``.

    ``sample_buffer`` holds the samples of the part's edge pixels.
    """
    return find_casters(scene, sample_buffer) if search_outside else NO_CASTERS


def edge_pixels(buffer: GeometryBuffer, visibilities: list[np.ndarray]) -> np.ndarray:
    """Return which pixels (rows, cols) of a map's block lie on either side of an edge, bool.

    They include all pixels along the block's sides, unless ``visibilities`` is empty.
    """
    edges = np.zeros(buffer.valid.shape, np.bool_)
    mark_changes(buffer.surface_kind, 0.0, edges)
    for visibility in visibilities:
        mark_changes(np.where(buffer.valid, visibility, np.float32(1.0)), MIN_EDGE_VISIBILITY_CHANGE, edges)
    if visibilities:
        for side in (edges[0], edges[-1], edges[:, 0], edges[:, -1]):
            side[:] = True
    return edges & buffer.valid


def _windows_with_edges(edge_mask: np.ndarray) -> Iterator[tuple[slice, slice]]:
    """Yield the parts of a block that contain edge pixels, as slices of its rows and columns.

    ``edge_mask`` (rows, cols) are the block's edge pixels.
    """
    for top in range(0, edge_mask.shape[0], SAMPLED_PART_PX):
        for left in range(0, edge_mask.shape[1], SAMPLED_PART_PX):
            down = slice(top, min(top + SAMPLED_PART_PX, edge_mask.shape[0]))
            right = slice(left, min(left + SAMPLED_PART_PX, edge_mask.shape[1]))
            if edge_mask[down, right].any():
                yield down, right


def _sample_buffer(
    scene: Scene, block_buffer: GeometryBuffer, part: MapView, edge_mask: np.ndarray, log: PassLog
) -> GeometryBuffer:
    """Return the geometry buffer of the samples of a part's pixels in the mask ``edge_mask``."""
    with log.record_pass(GEOMETRY_PASS):
        pixel_mask = np.repeat(np.repeat(edge_mask, EDGE_SAMPLES_PER_SIDE, axis=0), EDGE_SAMPLES_PER_SIDE, axis=1)
        samples, block = part.finer(EDGE_SAMPLES_PER_SIDE), block_buffer.view
        assert isinstance(block, MapView)
        nodes = nodes_of_samples(scene, block, samples)
        return geometry_buffer(scene, samples, block_buffer.frame, pixel_mask=pixel_mask, nodes=nodes)


def _arrays_of_samples(buffer: GeometryBuffer, visibilities: NamedArrays, edge_mask: np.ndarray) -> NamedArrays:
    """Return the arrays for shading and each light's visibility at the samples of the pixels in the mask ``edge_mask`` of a part.

    Each array is (pixels, ``SAMPLES_PER_PIXEL``, ...).
    """
    arrays = {name: value for name in SHADING_ARRAYS if (value := getattr(buffer, name)) is not None}
    arrays.update(visibilities)
    row, col = np.nonzero(edge_mask)
    positions = [
        (row * EDGE_SAMPLES_PER_SIDE + k // EDGE_SAMPLES_PER_SIDE, col * EDGE_SAMPLES_PER_SIDE + k % EDGE_SAMPLES_PER_SIDE)
        for k in range(SAMPLES_PER_PIXEL)
    ]
    return {name: np.stack([value[position] for position in positions], axis=1) for name, value in arrays.items()}


def _append_samples(
    pixel_values: np.ndarray, samples: np.ndarray, missing_mask: np.ndarray, row: np.ndarray, col: np.ndarray
) -> np.ndarray:
    """Return a buffer's array (rows, cols, ...) with samples as extra rows below it.

    ``samples`` (n, ``SAMPLES_PER_PIXEL``, ...) belong to the pixels ``row``, ``col`` (n,). Samples in the mask ``missing_mask``
    take their pixel's own value. ``pixel_values`` is the buffer's array.
    """
    of_pixels = pixel_values[row, col][:, None]
    is_missing = missing_mask.reshape(missing_mask.shape + (1,) * (samples.ndim - 2))
    flat = np.where(is_missing, of_pixels, samples).reshape(-1, *pixel_values.shape[2:])
    spare = -len(flat) % pixel_values.shape[1]
    flat = np.concatenate([flat, flat[-1:].repeat(spare, axis=0)])
    return np.concatenate([pixel_values, flat.reshape(-1, *pixel_values.shape[1:])]).astype(pixel_values.dtype, copy=False)


@compiled
def mark_changes(values, threshold, edge_mask):
    """Mark in ``edge_mask`` both pixels of each pair of neighbours whose values (rows, cols) differ by more than ``threshold``.

    A pixel has eight neighbours.
    """
    rows, cols = values.shape
    for i in range(rows):
        for j in range(cols):
            center = np.float64(values[i, j])
            for k in range(4):  # east, south-west, south, south-east
                a, b = i + (k > 0), j + (1 if k == 0 else k - 2)
                if a < rows and 0 <= b < cols and abs(np.float64(values[a, b]) - center) > threshold:
                    edge_mask[i, j] = True
                    edge_mask[a, b] = True
