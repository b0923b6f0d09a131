"""Types of the ground that can shade a block of a map: receivers, patches, casters and the reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.columns import ColumnIndices
from skugga.terrain.ground.surface import NodeHeights

PATCH_QUADS = 256
"""Side of a patch in quads. A patch is a square of ground beside a block that may cast shadows on it.

The sides of patches lie on multiples of this number, counted from the grid's origin.
"""


@dataclass(frozen=True)
class Reach:
    """The distance towards the sun within which ground counts as a caster, in metres from the block's edge.

    Attributes
    ----------
    used_m
        The distance up to which ground was examined.
    needed_m
        The distance up to which ground can cast a shadow on the block. If the raster ends before that, unknown ground beyond it
        counts, up to the height ``skugga.terrain.casters.reach.UNKNOWN_RELIEF_M``.
    clipped
        Whether the raster ends before ``needed_m``, so that casters may be missing.
    """

    used_m: float
    needed_m: float
    clipped: bool


@dataclass(frozen=True)
class Patch:
    """A patch: a square of ground of ``PATCH_QUADS`` x ``PATCH_QUADS`` quads of a grid, which may cast shadows on a block.

    Attributes
    ----------
    lod
        Level of detail: the patch has every ``2**lod``-th node of the block's grid.
    row, col
        Row and column of the patch: its first node is ``PATCH_QUADS * (row, col)`` of the grid of these nodes.
    """

    lod: int
    row: int
    col: int


class Receivers(Protocol):
    """Points that can be shaded, and the ground of the map that they belong to.

    ``GeometryBuffer`` and ``BareNodes`` implement this protocol.

    Attributes
    ----------
    view, frame
        The view, and the local frame of the points.
    valid
        bool (rows, cols), whether a point can be shaded. Other points do not count.
    position_frame_m
        float64 (rows, cols, 3), the points, metres.
    surface
        The nodes of a map's smooth ground; ``None`` for other ground and in perspective.
    columns
        A map's ground of upright columns; ``None`` for other ground and in perspective.
    """

    @property
    def view(self) -> MapView | PerspectiveView: ...

    @property
    def frame(self) -> LocalFrame: ...

    @property
    def valid(self) -> np.ndarray: ...

    @property
    def position_frame_m(self) -> np.ndarray: ...

    @property
    def surface(self) -> NodeHeights | None: ...

    @property
    def columns(self) -> ColumnIndices | None: ...


@dataclass(frozen=True)
class Casters:
    """The ground outside a block that can shade it.

    Attributes
    ----------
    patches
        Patches of the ground that can shade the block.
    reach
        The distance up to which the ground was searched.
    culled_patches
        Patches that provably cast no shadow on the block (``skugga.terrain.casters.caster_culling``).
    """

    patches: tuple[Patch, ...]
    reach: Reach
    culled_patches: frozenset[Patch] = frozenset()

    @property
    def casting_patches(self) -> tuple[Patch, ...]:
        """The patches that may cast a shadow on the block."""
        return tuple(patch for patch in self.patches if patch not in self.culled_patches)


NO_CASTERS = Casters((), Reach(0.0, 0.0, False))
