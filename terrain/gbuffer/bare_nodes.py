"""Nodes of a map's ground on which nothing stands, by their heights alone: a geometry buffer takes ten times as long to make."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.surface import NodeHeights, RefinedWindow, Surface
from skugga.terrain.scene import Scene

HALO = 2
"""Rows and columns of nodes round a view whose heights are read with it."""

BOUNDING_NODES = 33
"""Rows and columns of nodes whose points stand for all: the earth bends by less than a metre between them."""


@dataclass(frozen=True, eq=False)
class BareNodes:
    """A view (rows, cols) of nodes of a map's ground.

    ``per_pixel`` of them lie along the side of a pixel that shows their mean. ``surface`` holds their heights and those round them.
    What bounds them are points of some: ``position_frame_m`` (2, n, 3) float64 in the frame, at the lowest and the highest of the
    heights; ``there`` (2, n) says which are known.
    """

    view: MapView
    per_pixel: int
    frame: LocalFrame
    surface: NodeHeights
    position_frame_m: np.ndarray
    there: np.ndarray

    @property
    def height_m(self) -> np.ndarray:
        """Heights (rows, cols) float32, NaN where there is no ground."""
        return self.surface.height_m[HALO:-HALO, HALO:-HALO]

    @property
    def columns(self) -> None:
        """None of them lie on columns."""

    @property
    def shown(self) -> np.ndarray:
        """Which nodes (rows, cols) show ground."""
        return self.surface.there[HALO:-HALO, HALO:-HALO]


def bare_nodes(scene: Scene, view: MapView, per_pixel: int) -> BareNodes:
    """The nodes of a view whose every pixel is one. The last ones are kept: they are the same under every sun."""
    return _bare_nodes(scene.world, scene.elevation, view, per_pixel)


@cached("scene", 64 * MIB)
def _bare_nodes(world: World, elevation: Elevation, view: MapView, per_pixel: int) -> BareNodes:
    frame, surface = world.frame_near(view.grid.crs, *view.centre), Surface(world, elevation, view.grid)
    row0, col0 = int(view.row0), int(view.col0)
    heights = surface.height_window(row0 - HALO, col0 - HALO, view.rows + 2 * HALO, view.cols + 2 * HALO)
    row, col = (
        np.unique(np.rint(np.linspace(first, first + count - 1, BOUNDING_NODES)).astype(np.int64))
        for first, count in ((row0, view.rows), (col0, view.cols))
    )
    row, col = (axis.ravel() for axis in np.meshgrid(row, col, indexing="ij"))
    known = heights.coarser.height_m if isinstance(heights, RefinedWindow) else heights.height_m
    ends = np.nanmin(known), np.nanmax(known)
    position = np.stack([surface.positions(row, col, np.full(row.size, end, np.float32), frame) for end in ends])
    return BareNodes(view, per_pixel, frame, heights, position, np.isfinite(position[..., 2]))
