"""Light through crowns: foliage transmits a part of the sunlight to the foliage behind it.

A tree is drawn as three crossed quads. Shadow algorithms compute the shadows of these quads on each other correctly, but a real
crown is not a cross. The shadows would draw a sharp line down each crown, and streaks under a low sun. In a real crown light passes
through and around the leaves from all directions. Most light passes one layer of leaves: a leaf transmits about a tenth of green
light and scatters as much, and much light passes through the gaps.

Therefore foliage passes the share ``LEAF_TRANSMITTANCE`` of the sunlight to foliage behind it. Ground and meshes block all
sunlight. Rays to the sun find the height up to which ground shades a column of leaves, and the cells that meshes shade. The visible
shape of a crown comes from its normals (``skugga.terrain.gbuffer.resolve``), its grain from the textures.

The effect changes the colours of a picture only, and not the visibility of the sun, shadow masks or measured values. Maps show the
horizontal quad of each tree from above, where no cross is visible.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.cast_shadows import find_visible_trees
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.haze import trees_in_view
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.facts.mesh_rays import first_mesh_hits
from skugga.terrain.facts.relief_rays import is_hidden_by_relief
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of

LEAF_TRANSMITTANCE = 0.65
"""Share of the sunlight that reaches leaves behind other leaves."""

MIN_LEAF_CELL_M = 2.0
"""Minimum side, metres, of the cubic cells in which leaves share one ray to the sun. The ray tests for shadows of meshes."""

MIN_LEAF_CELL_TANGENT = 0.004
"""Minimum angle of a cell as seen from the eye, as a tangent. Sides of distant cells are doubled until they reach it."""

COLUMN_BITS = 2
"""Binary logarithm of the cells of a column, in which leaves share the upper edge of the ground's shadow."""

COLUMN_HALVINGS = 4
"""Number of rays by which the edge in a column is found, to a quarter of a cell; two more tell whether a column has one."""

EDGE_CELLS = 0.5
"""Width of that edge, in sides of a cell. It hides the steps between columns, and the sun's disc makes real edges as wide."""

CELL_INDEX_BITS = 18
"""Number of bits of a cell's index along each axis. Indices wrap around beyond that."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view with trees in it, and direct sunlight.

    Left out: maps; no tree in view; night, a covered sky.
    """
    facts = descriptor.facts["crowns"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows crowns from above")
    if not facts["trees"]:
        return Verdict(False, "no tree is in view")
    if not facts["sunlit"]:
        return Verdict(False, "there is no direct sunlight")
    return Verdict(True, f"sunlight comes through the crowns of {facts['trees']:.0f} trees")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of crowns.

    - ``trees``: upper bound of the number of trees in a perspective view.
    - ``sunlit``: whether direct sunlight reaches the level.
    """
    if isinstance(view, MapView) or coarse_view is None:
        return {"trees": 0, "sunlit": scene.sun_is_up}
    trees, in_frustum = trees_in_view(scene, view, coarse_view.buffer.frame)
    sunlit = scene.sun_is_up and bool(daylight_of(scene).sun_irradiance.any())
    any_in_view = trees is not None and find_visible_trees(scene.objects, view, coarse_view)[1]
    return {"trees": len(in_frustum) if any_in_view else 0, "sunlit": sunlit}


def apply_crowns(sunlight: np.ndarray, block: ShadingBlock) -> None:
    """Add the transmitted sunlight to leaves that other leaves shade. ``sunlight`` (rows, cols) is changed in place."""
    buffer, scene = block.buffer, block.scene
    if isinstance(block.view, MapView) or scene.sun is None or not scene.sun_is_up:
        return
    pixels = np.flatnonzero((buffer.surface_kind == FOREST) & (sunlight < 1.0))
    if not len(pixels):
        return
    points, to_sun = buffer.position_frame_m.reshape(-1, 3), scene.sun.in_frame(buffer.frame)
    key = np.empty(len(pixels), np.int64)
    run_in_chunks(len(pixels), _write_cell_keys, points, pixels, block.view.in_frame(buffer.frame)[0], key)
    keys, first, cell = np.unique(key, return_index=True, return_inverse=True)
    # Cells are fixed to the frame, so that the result does not depend on the origin of the picture.
    side_m = MIN_LEAF_CELL_M * 2.0 ** (keys >> 3 * CELL_INDEX_BITS)
    cell_number, is_lit = np.floor(points[pixels[first]] / side_m[:, None]), np.ones(len(keys), np.bool_)
    if scene.objects.solids is not None:
        start = (cell_number + 0.5) * side_m[:, None]
        distance_m, _ = first_mesh_hits(
            scene.objects, buffer.frame, start, np.broadcast_to(to_sun, start.shape), np.full(len(start), np.inf)
        )  # fmt: skip
        is_lit = ~np.isfinite(distance_m)
    # The index along the vertical axis has the lowest bits of a key.
    _, first, column = np.unique(keys >> COLUMN_BITS, return_index=True, return_inverse=True)
    half_height_m = 0.5 * 2**COLUMN_BITS * side_m[first]
    middle = (cell_number[first] + 0.5) * side_m[first, None]
    middle[:, 2] = (2.0 * np.floor(cell_number[first, 2] / 2**COLUMN_BITS) + 1.0) * half_height_m
    edge_m = _shadow_edges(scene, buffer.frame, middle, half_height_m, to_sun)[column.reshape(-1)]
    run_in_chunks(
        len(pixels), _transmit, sunlight, pixels, points, cell.reshape(-1), is_lit, edge_m, EDGE_CELLS * side_m,
        np.float32(LEAF_TRANSMITTANCE),
    )  # fmt: skip


def _shadow_edges(scene: Scene, frame: LocalFrame, middle: np.ndarray, half_height_m: np.ndarray, to_sun: np.ndarray) -> np.ndarray:
    """Return the height (k,) in a frame below which ground hides the sun in vertical columns.

    It is infinite where ground hides all of a column, minus infinity where it hides nothing. ``middle`` (k, 3) are the columns'
    middles, ``half_height_m`` (k,) is half their height, and ``to_sun`` (3,) is the direction to the sun.
    """

    def is_hidden(columns: np.ndarray, height_m: np.ndarray) -> np.ndarray:
        start = np.column_stack([middle[columns, :2], height_m])
        return is_hidden_by_relief(scene.world, scene.elevation, frame, start, to_sun)

    every = np.arange(len(middle))
    edge_m = np.where(is_hidden(every, middle[:, 2] + half_height_m), np.inf, -np.inf)
    below = np.flatnonzero(edge_m < 0.0)
    cut = below[is_hidden(below, (middle[:, 2] - half_height_m)[below])]
    ends_m = np.stack([(middle[:, 2] - half_height_m)[cut], (middle[:, 2] + half_height_m)[cut]])
    for _ in range(COLUMN_HALVINGS):
        centre_m = ends_m.mean(axis=0)
        hidden = is_hidden(cut, centre_m)
        ends_m = np.where([hidden, ~hidden], centre_m, ends_m)
    edge_m[cut] = ends_m.mean(axis=0)
    return edge_m


@compiled
def _write_cell_keys(first, last, points, pixels, eye, key):
    """Write the key of the cell of each leaf from ``first`` to ``last`` (exclusive) to ``key`` (n,), int64.

    Its bits are the number of times that the cell's side was doubled, then the cell's index along each axis. ``pixels`` (n,) are
    the leaves' indices in ``points`` (m, 3), and ``eye`` (3,) is the eye, in the frame.
    """
    for n in range(first, last):
        p = points[pixels[n]]
        x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
        distance_m, doublings, cell_side_m = np.sqrt(x * x + y * y + z * z), 0, MIN_LEAF_CELL_M
        while cell_side_m < distance_m * MIN_LEAF_CELL_TANGENT:
            doublings, cell_side_m = doublings + 1, 2.0 * cell_side_m
        number = doublings
        for k in range(3):
            number = number << CELL_INDEX_BITS | np.int64(np.floor(p[k] / cell_side_m)) & (1 << CELL_INDEX_BITS) - 1
        key[n] = number


@compiled
def _transmit(first, last, sunlight, pixels, points, cell, is_lit, edge_m, width_m, share):
    """Add the transmitted sunlight to the leaves from ``first`` to ``last`` (exclusive), in place.

    ``sunlight`` (rows, cols) is the share of the direct sunlight in each pixel, ``pixels`` (n,) the flat index of each leaf's
    pixel, also in ``points`` (m, 3). ``cell`` (n,) is the index of each leaf's cell, and ``is_lit`` (cells,) is false where meshes
    shade the cell. Above the height ``edge_m`` (cells,) the sun is seen, below it ground hides it; the edge is ``width_m`` (cells,)
    wide. A leaf gets ``share`` of the sunlight that other leaves take.
    """
    for n in range(first, last):
        k = cell[n]
        if is_lit[k]:
            row, col = divmod(pixels[n], sunlight.shape[1])
            received = sunlight[row, col]
            visible = np.float32(min(max((points[pixels[n], 2] - edge_m[k]) / width_m[k] + 0.5, 0.0), 1.0))
            sunlight[row, col] = received + max(visible - received, np.float32(0.0)) * share


EFFECT = Effect(
    "sunlight through foliage, which hides crossed quads",
    judge,
    facts,
    "sunlight",
    apply_crowns,
    required_effects=("cast_shadows",),
)
