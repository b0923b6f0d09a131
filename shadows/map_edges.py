"""Anti-aliased edges in maps: a pixel through which an edge runs shows a mean of what it covers.

Masks, and all that accuracy is measured by, keep to the pixels' own points. Where heights alone say what is seen, all pixels show
means over nodes half a pixel apart, as those of coarse maps do (``skugga.shadows.coarse_pixels``). Elsewhere only pixels through
which edges run get more points: those of a finer view, cut from the same ground, which the plan's own steps fill, and which are
shaded one by one. Where nothing ends after all a pixel keeps its own.

Edges run where a light's visibility, or what kind of thing is seen, changes from a pixel to one beside it. That is told within a
block, whatever lies beside it: the pixels along its sides all get more points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from skugga.shadows.block_casters import casters_beside
from skugga.shadows.coarse_pixels import halved_pixels, looks_beside, mean_visibilities
from skugga.shadows.passes import GEOMETRY_PASS, PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.visibility import visibilities_at
from skugga.terrain.casters.horizon_bound import own_ground_faces_sun
from skugga.terrain.casters.reach import NO_CASTERS, Casters, casters_of
from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.antialias import SIDE, MultisampledBuffer
from skugga.terrain.gbuffer.covered_nodes import is_bare
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.picture import geometry_of
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

Arrays = dict[str, np.ndarray]

EDGE = 0.5
"""Change of a light's visibility from a pixel to one beside it above which an edge runs there: a penumbra changes by less."""

PART_PX = BLOCK_PX // SIDE
"""Pixels along the side of a part whose finer view is made at a time: as many points as a block's."""

EACH = SIDE * SIDE

SHADED_BY = ("there", "position_frame_m", "height_m", "shading_normal_frame", "kind", "albedo")
"""What shading takes of a geometry buffer."""


def anti_aliased(
    scene: Scene, plan: Plan, own: GeometryBuffer, visibilities: Arrays, log: PassLog
) -> tuple[MultisampledBuffer, Arrays]:
    """A map's block with samples below its own rows, if any, as far as shading takes them, and each light's visibility as it is
    shown. ``visibilities`` are those at the pixels' own points.
    """
    view = own.view
    assert isinstance(view, MapView)
    kept, wanted, log.wanted = log.take(), log.wanted, frozenset()
    pixels = halved_pixels(scene, view, plan)
    if pixels is None:
        shown = _edge_sampled(scene, plan, own, view, visibilities, log)
    else:
        shown = MultisampledBuffer(own, view.rows), mean_visibilities(pixels, own, log)
    log.layers, log.wanted = kept, wanted
    return shown


def _edge_sampled(
    scene: Scene, plan: Plan, own: GeometryBuffer, view: MapView, visibilities: Arrays, log: PassLog
) -> tuple[MultisampledBuffer, Arrays]:
    if _is_evenly_lit(scene, plan, own, visibilities):
        return MultisampledBuffer(own, view.rows), visibilities
    edges = edge_pixels(own, list(visibilities.values()))
    pixels, found = [], []
    for down, right in _parts(edges):
        part = edges[down, right]
        pixels.append(np.argwhere(part) + [down.start, right.start])
        finer = _finer(scene, own, view.part(down.start, right.start, *part.shape), part, log)
        beside = looks_beside(plan, own, (down, right))
        casters = casters_beside(scene, plan, finer, partial(_casters, scene, finer, beside), log)
        found.append(_samples(finer, visibilities_at(scene, plan, finer, casters, log), part))
    if not found:
        return MultisampledBuffer(own, view.rows), visibilities
    row, col = np.concatenate(pixels).T
    arrays = {name: np.concatenate([each[name] for each in found]) for name in found[0]}
    missing = ~arrays["there"]  # beside the ground's rim: there the pixel's own point counts again
    differ = arrays["kind"] != own.kind[row, col][:, None]
    for light, visibility in visibilities.items():
        differ |= arrays[light] != visibility[row, col][:, None]
    ends = (differ & ~missing).any(axis=1)
    row, col, missing, arrays = row[ends], col[ends], missing[ends], {name: value[ends] for name, value in arrays.items()}
    if not len(row):
        return MultisampledBuffer(own, view.rows), visibilities
    changes: dict[str, Any] = {}
    for name in SHADED_BY:
        value = getattr(own, name)
        if value is not None:
            changes[name] = _below(value, arrays[name], missing, row, col)
    seen = {light: _below(value, arrays[light], missing, row, col) for light, value in visibilities.items()}
    return MultisampledBuffer(replace(own, **changes), view.rows, (row, col), EACH), seen


def _is_evenly_lit(scene: Scene, plan: Plan, own: GeometryBuffer, visibilities: Arrays) -> bool:
    """Whether no edge can run through a block or along its sides: nothing stands or casts there, and all ground faces the sun."""
    if plan.casts or not is_bare(scene) or not scene.sun_is_up:
        return False
    return bool((visibilities[SUN][own.there] == 1.0).all()) and own_ground_faces_sun(scene, own)


def _casters(scene: Scene, finer: GeometryBuffer, beside: bool) -> Casters:
    return casters_of(scene, finer) if beside else NO_CASTERS


def edge_pixels(buffer: GeometryBuffer, visibilities: list[np.ndarray]) -> np.ndarray:
    """Which pixels (rows, cols) of a map's block an edge runs through, both of those beside it; and all along the block's sides."""
    edges = np.zeros(buffer.there.shape, np.bool_)
    _mark_changes(buffer.kind, 0.0, edges)
    for visibility in visibilities:
        _mark_changes(np.where(buffer.there, visibility, np.float32(1.0)), EDGE, edges)
    if visibilities:
        for side in (edges[0], edges[-1], edges[:, 0], edges[:, -1]):
            side[:] = True
    return edges & buffer.there


def _parts(edges: np.ndarray) -> Iterator[tuple[slice, slice]]:
    """Parts of a block in which edges run."""
    for top in range(0, edges.shape[0], PART_PX):
        for left in range(0, edges.shape[1], PART_PX):
            down = slice(top, min(top + PART_PX, edges.shape[0]))
            right = slice(left, min(left + PART_PX, edges.shape[1]))
            if edges[down, right].any():
                yield down, right


def _finer(scene: Scene, own: GeometryBuffer, part: MapView, edges: np.ndarray, log: PassLog) -> GeometryBuffer:
    """The samples of some of a part's pixels."""
    with log.run(GEOMETRY_PASS):
        wanted = np.repeat(np.repeat(edges, SIDE, axis=0), SIDE, axis=1)
        return geometry_of(scene, part.finer(SIDE), own.frame, wanted=wanted)


def _samples(buffer: GeometryBuffer, visibilities: Arrays, edges: np.ndarray) -> Arrays:
    """What shading takes of the samples of some of a part's pixels, each array (pixels, ``EACH``, ...), and each light's
    visibility.
    """
    arrays = {name: value for name in SHADED_BY if (value := getattr(buffer, name)) is not None}
    arrays.update(visibilities)
    row, col = np.nonzero(edges)
    places = [(row * SIDE + k // SIDE, col * SIDE + k % SIDE) for k in range(EACH)]
    return {name: np.stack([value[place] for place in places], axis=1) for name, value in arrays.items()}


def _below(own: np.ndarray, samples: np.ndarray, missing: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """A buffer's array with those of samples (n, ``EACH``, ...) in rows below it; where they are missing, the pixel's own."""
    of_pixels = own[row, col][:, None]
    gone = missing.reshape(missing.shape + (1,) * (samples.ndim - 2))
    flat = np.where(gone, of_pixels, samples).reshape(-1, *own.shape[2:])
    spare = -len(flat) % own.shape[1]
    flat = np.concatenate([flat, flat[-1:].repeat(spare, axis=0)])
    return np.concatenate([own, flat.reshape(-1, *own.shape[1:])]).astype(own.dtype, copy=False)


@compiled
def _mark_changes(values, most, edges):
    """Mark the pixels (rows, cols) whose values differ by more than ``most`` from one of the eight beside them."""
    rows, cols = values.shape
    for i in range(rows):
        for j in range(cols):
            here = np.float64(values[i, j])
            for k in range(4):  # east, south-west, south, south-east
                a, b = i + (k > 0), j + (1 if k == 0 else k - 2)
                if a < rows and 0 <= b < cols and abs(np.float64(values[a, b]) - here) > most:
                    edges[i, j] = True
                    edges[a, b] = True
