"""Supersample maps whose pixels are larger than the data's cells: a pixel shows the mean visibility of the ground it covers.

The share of shadow therefore does not depend on the zoom. ``skugga.terrain.gbuffer.supersampling`` gives the nodes that a pixel
covers. The plan's own steps draw these sub-pixel nodes like the pixels of any finer map. A box filter averages their visibilities,
with attached shadow. Colours, heights and normals remain those of the pixel's own point. With the algorithm ``sweep``, bare ground
needs only its heights.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skugga.shadows.block_casters import find_outside_casters, needed_steps
from skugga.shadows.layer_collector import LayerCollector
from skugga.shadows.passes import ATTACHED_PASS, CASTERS_PASS, GEOMETRY_PASS, PIXEL_LAYERS, PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.visibility import visibilities_at
from skugga.terrain.casters.caster_types import NO_CASTERS, Casters
from skugga.terrain.casters.reach import find_casters, find_sun_casters
from skugga.terrain.gbuffer.bare_ground import BareGround
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.supersampling import (
    MAX_PARALLEL_RAYS_M,
    covered_nodes,
    is_terrain_only,
    max_in_pixels,
    means_in_pixels,
    subdivision_level,
    subpixel_grid,
)
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView, PixelWindow
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

MAX_BARE_NODES_PER_PART = 18 * BLOCK_PX**2
"""Upper bound of the nodes of bare ground in one part: about half a gigabyte."""

MAX_BUFFER_NODES_PER_PART = 5 * BLOCK_PX**2 // 4
"""Upper bound of the nodes in one part with a geometry buffer: about as many as in a block, half a gigabyte."""

Visibilities = dict[str, np.ndarray]
"""Visibility (rows, cols) by light."""


@dataclass(frozen=True)
class Supersampling:
    """The supersampling of a map's pixels under a plan.

    Attributes
    ----------
    scene, plan
        The scene and the plan.
    grid
        The finer grid whose nodes are averaged.
    nodes_per_pixel_side
        Approximate number of nodes along a pixel's side.
    uses_heights_only
        Whether the heights of bare ground suffice.
    """

    scene: Scene
    plan: Plan
    grid: Grid
    nodes_per_pixel_side: int
    uses_heights_only: bool

    def covered_nodes(self, view: MapView) -> MapView:
        """Return the nodes that the pixels of a map cover, as a map view with one node in each pixel."""
        return covered_nodes(view, self.grid)

    def max_nodes(self, nodes: MapView) -> tuple[int, int]:
        """Return two upper bounds of the nodes in one part: of their number in all, and of the number along a side."""
        if not self.uses_heights_only:
            return MAX_BUFFER_NODES_PER_PART, BLOCK_PX * 8
        max_side = BLOCK_PX * 8
        if not self.scene.world.is_flat:
            max_side = max(min(max_side, int(MAX_PARALLEL_RAYS_M / self.scene.surface(nodes.grid).step_m)), BLOCK_PX)
        return MAX_BARE_NODES_PER_PART, max_side


def supersampling(scene: Scene, view: MapView | PerspectiveView, plan: Plan) -> Supersampling | None:
    """Return the supersampling of a map under a plan.

    It is ``None`` where pixels show their own points: in perspective views, where pixels are no larger than the data's cells, and
    where nothing casts a shadow.
    """
    if not isinstance(view, MapView) or not plan.steps:
        return None
    count = subdivision_level(scene, view)
    if count == 0:
        return None
    return Supersampling(scene, plan, subpixel_grid(view, count), 2**count, uses_heights_only=needs_heights_only(scene, plan))


def edge_supersampling(scene: Scene, view: MapView, plan: Plan) -> Supersampling | None:
    """Return the supersampling that anti-aliases the edges of a map that is not coarse.

    Its nodes are half a pixel apart and include the pixels' own points. It is ``None`` where heights alone do not suffice, and
    where a block is too wide for parallel rays.
    """
    narrow = scene.world.is_flat or BLOCK_PX * map_pixel_m(scene.world, view) <= MAX_PARALLEL_RAYS_M
    if not (narrow and plan.steps and needs_heights_only(scene, plan)):
        return None
    return Supersampling(scene, plan, view.grid.refined(), 2, uses_heights_only=True)


def needs_heights_only(scene: Scene, plan: Plan) -> bool:
    """Return whether the steps of a plan need only the heights of bare ground, with the sun up."""
    fills = (ALGORITHMS[step.algorithm].lit_nodes_finder(step.settings) for step in plan.steps)
    return is_terrain_only(scene) and scene.sun_is_up and all(fills)


def mean_visibilities(sampling: Supersampling, block_buffer: GeometryBuffer | BareGround, log: PassLog) -> Visibilities:
    """Return each light's mean visibility (rows, cols) float32 in the pixels of a map's block.

    It is 1 in pixels whose nodes show no ground. Intermediate pictures of floats are means over the nodes, too. Those of integers
    (counts and marks) are the maximum.
    """
    view = block_buffer.view
    assert isinstance(view, MapView)
    visibilities = {light: np.ones(block_buffer.valid.shape, np.float32) for light in sampling.plan.lights}
    layers = LayerCollector(block_buffer.valid.shape)
    if isinstance(block_buffer, GeometryBuffer) and not block_buffer.valid.any():  # the plan's passes run without any work
        return visibilities_at(sampling.scene, sampling.plan, block_buffer, find_casters(sampling.scene, block_buffer), log)
    for window in _part_windows(sampling, block_buffer):
        part, search_outside = _part_view(view, window), needs_outside_casters(sampling.plan, block_buffer, window)
        nodes = sampling.covered_nodes(part)
        node_visibilities = (
            lit_nodes(sampling, nodes, search_outside, log)
            if sampling.uses_heights_only
            else _visibilities_at_nodes(sampling, nodes, search_outside, log)
        )
        valid, filled = node_visibilities
        with log.record_pass(ATTACHED_PASS):
            for light, values in filled.items():
                if values.dtype == np.bool_ and values.all():
                    continue  # the pixels are initialised with 1
                means = means_in_pixels(part, nodes, values, valid)
                np.copyto(visibilities[light][window], means, where=~np.isnan(means))
        block_layers = {
            key: [_values_in_pixels(part, nodes, picture, valid) if key[0] in PIXEL_LAYERS else picture for picture in pictures]
            for key, pictures in log.take_layers().items()
        }
        layers.add_block(block_layers, window, (slice(None), slice(None)))
    log.layers = layers.pictures
    return visibilities


def _part_view(view: MapView, window: PixelWindow) -> MapView:
    """Return a window of a map as a view."""
    down, right = window
    return view.part(down.start, right.start, down.stop - down.start, right.stop - right.start)


def _part_windows(sampling: Supersampling, block_buffer: GeometryBuffer | BareGround) -> Iterator[PixelWindow]:
    """Yield windows of a block that hold all of its pixels with a surface.

    Each window is small enough to process its nodes at once (``Supersampling.max_nodes``).
    """
    view = block_buffer.view
    assert isinstance(view, MapView)
    rows, cols = np.flatnonzero(block_buffer.valid.any(axis=1)), np.flatnonzero(block_buffer.valid.any(axis=0))
    if not len(rows):
        return
    pending = [(slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1))]
    while pending:
        window = pending.pop()
        if not block_buffer.valid[window].any():
            continue
        nodes, sides = sampling.covered_nodes(_part_view(view, window)), [side.stop - side.start for side in window]
        max_nodes, max_side = sampling.max_nodes(nodes)
        if (nodes.rows * nodes.cols <= max_nodes and max(nodes.rows, nodes.cols) <= max_side) or max(sides) == 1:
            yield window
            continue
        axis = int(sides[1] > sides[0])
        middle = window[axis].start + sides[axis] // 2
        for half in (slice(middle, window[axis].stop), slice(window[axis].start, middle)):
            pending.append((half, window[1]) if axis == 0 else (window[0], half))


def needs_outside_casters(plan: Plan, block_buffer: GeometryBuffer | BareGround, window: PixelWindow) -> bool:
    """Return whether casters beside a part of a map's block are searched.

    The effect ``outside_casters`` always searches them. Without it they are searched only where the block shows more than the part,
    since parts of one block cast on each other.
    """
    return CASTERS_PASS in plan.effect_names or bool(block_buffer.valid[window].sum() < block_buffer.valid.sum())


def lit_nodes(sampling: Supersampling, view: MapView, search_outside: bool, log: PassLog) -> tuple[np.ndarray, Visibilities]:
    """Return the valid mask of the nodes and the sun's visibility at them, bool (rows, cols), from heights alone.

    ``search_outside`` tells whether ground beside the nodes is searched for casters.
    """
    scene, plan = sampling.scene, sampling.plan
    with log.record_pass(GEOMETRY_PASS):
        nodes = bare_nodes(scene, view, sampling.nodes_per_pixel_side)

    def find_casters() -> Casters:
        return Casters(find_sun_casters(scene, nodes) if search_outside else (), NO_CASTERS.reach)

    casters = find_outside_casters(scene, plan, nodes, find_casters, log)
    lit = np.ones(nodes.shows_ground.shape, np.bool_)
    for step in needed_steps(scene, plan.steps_of_light(SUN), nodes, casters, log):
        fill = ALGORITHMS[step.algorithm].lit_nodes_finder(step.settings)
        assert fill is not None, step.algorithm
        lit &= fill(nodes, scene, step.light, step.kinds, casters, step.settings, log)
    return nodes.shows_ground, {SUN: lit}


def _visibilities_at_nodes(
    sampling: Supersampling, view: MapView, search_outside: bool, log: PassLog
) -> tuple[np.ndarray, Visibilities]:
    """Return the valid mask of the nodes and each light's visibility at them, from a geometry buffer.

    ``search_outside`` tells whether casters beside the nodes are searched.
    """
    scene, plan = sampling.scene, sampling.plan
    with log.record_pass(GEOMETRY_PASS):
        buffer = geometry_buffer(scene, view)
    casters = find_outside_casters(scene, plan, buffer, lambda: find_casters(scene, buffer) if search_outside else NO_CASTERS, log)
    return buffer.valid, visibilities_at(scene, plan, buffer, casters, log)


def _values_in_pixels(view: MapView, nodes: MapView, picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the means over the nodes in each pixel, or the maxima of integers.

    ``picture`` holds a value for each node of ``nodes``, and ``valid`` is the mask of the nodes that show a surface.
    """
    return means_in_pixels(view, nodes, picture, valid) if picture.dtype.kind == "f" else max_in_pixels(view, nodes, picture)
