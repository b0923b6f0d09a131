"""Nodes of bare ground (ground without objects) for shadow algorithms that need heights only.

A geometry buffer takes ten times as long to compute.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.surface import NodeHeights, RefinedWindow, Surface
from skugga.terrain.scene import Scene

HALO_NODES = 2
"""Extra rows and columns of nodes on each side of a view."""

MAX_BOUNDING_NODES_PER_SIDE = 33
"""Maximum number of rows and of columns of the nodes that bound a view's ground. The earth bends by less than a metre between them.
"""


@dataclass(frozen=True, eq=False)
class BareNodes:
    """The nodes of a map's bare ground in a view (rows, cols).

    Attributes
    ----------
    view, frame
        The view, with one node in each pixel, and its local frame.
    nodes_per_pixel
        Number of nodes along the side of a displayed pixel, which shows the mean of its nodes.
    surface
        The nodes' heights, with ``HALO_NODES`` more nodes on each side. They include the rim, ground for one node beyond the
        raster. The rim casts shadows, but is not visible (not ``valid``).
    position_frame_m
        float64 (2, n, 3), points whose bounds contain the ground, metres: some of the nodes, at the lowest and at the highest
        height of all nodes.
    valid
        bool (2, n), valid mask of ``position_frame_m``.
    """

    view: MapView
    nodes_per_pixel: int
    frame: LocalFrame
    surface: NodeHeights
    position_frame_m: np.ndarray
    valid: np.ndarray

    @property
    def height_m(self) -> np.ndarray:
        """Heights (rows, cols) float32, metres, of the ground that casts shadows; NaN without such ground."""
        return self.surface.height_m[HALO_NODES:-HALO_NODES, HALO_NODES:-HALO_NODES]

    @property
    def columns(self) -> None:
        """``None``: bare nodes never lie on columns."""

    @property
    def shows_ground(self) -> np.ndarray:
        """bool (rows, cols), whether a node shows ground."""
        return self.surface.valid[HALO_NODES:-HALO_NODES, HALO_NODES:-HALO_NODES]


def bare_nodes(scene: Scene, view: MapView, nodes_per_pixel: int) -> BareNodes:
    """Return the nodes of a view that has a node in every pixel. They are cached, since they are the same under every sun.

    ``nodes_per_pixel`` is the number of nodes along the side of a displayed pixel.
    """
    return _bare_nodes(scene.world, scene.elevation, view, nodes_per_pixel)


@cached("scene", 64 * MIB)
def _bare_nodes(world: World, elevation: Elevation, view: MapView, nodes_per_pixel: int) -> BareNodes:
    """Return the result of ``bare_nodes``. The world and the elevation are the scene's."""
    frame, surface = world.frame_near(view.grid.crs, *view.centre), Surface(world, elevation, view.grid)
    row0, col0 = int(view.row0), int(view.col0)
    heights = surface.height_window(
        row0 - HALO_NODES, col0 - HALO_NODES, view.rows + 2 * HALO_NODES, view.cols + 2 * HALO_NODES, includes_rim=True
    )
    source_height = heights.coarser_window.height_m if isinstance(heights, RefinedWindow) else heights.height_m
    ends = float(np.nanmin(source_height)), float(np.nanmax(source_height))
    return BareNodes(view, nodes_per_pixel, frame, heights, *bounding_positions(surface, view, frame, ends))


def bounding_positions(
    surface: Surface, view: MapView, frame: LocalFrame, height_range_m: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``BareNodes.position_frame_m`` and ``BareNodes.valid`` of a view whose surface lies between two heights, metres."""
    row, col = (
        np.unique(np.rint(np.linspace(first, first + count - 1, MAX_BOUNDING_NODES_PER_SIDE)).astype(np.int64))
        for first, count in ((int(view.row0), view.rows), (int(view.col0), view.cols))
    )
    row, col = (axis.ravel() for axis in np.meshgrid(row, col, indexing="ij"))
    ends = (np.full(row.size, end, np.float32) for end in height_range_m)
    position = np.stack([surface.node_positions(row, col, heights, frame) for heights in ends])
    return position, np.isfinite(position[..., 2])
