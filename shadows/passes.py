"""The record of the executed passes and the requested intermediate pictures.

The passes write both while they run. Neither is copied from a plan.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from skugga.terrain.gl.programs import record_draw_calls

GEOMETRY_PASS = "geometry"
"""Name of the pass that makes the geometry buffer."""

CASTERS_PASS = "outside_casters"
"""Name of the pass that searches casters outside of the view."""

ATTACHED_PASS = "attached"
"""Name of the pass that computes attached shadow, and means over sub-pixel nodes."""

PassLayer = Literal[
    "shadow-map", "stencil", "silhouettes", "volumes", "shadow-height", "light-frustum", "light-bounds", "light-view",
    "post-perspective",
]  # fmt: skip
"""Intermediate pictures:

- ``shadow-map``: depth maps as drawn, float32 from 0 (nearest to the light) to 1 (nothing casts). Cascades from the nearest, or
  blocks row by row, side by side; the six of an omni light as 3 x 2, from straight down to straight up. Of a conservative map, its
  nearest bounds.
- ``stencil``: the stencil, uint8. Of ``shadow_volume``, the number of volumes that contain the point; of ``hybrid``, the same in
  marked pixels; of ``planar``, 0 for no receiving plane, 1 for lit, 2 for shadow.
- ``silhouettes``: silhouette edges, uint8, 255 where one is visible; of a hybrid, the pixels that its volumes decide.
- ``volumes``: the number of faces of shadow volumes in front of the point, uint8.
- ``shadow-height``: the height in metres above which the sun is visible, float32; on sunlit ground its own height.
- ``light-frustum``: the edges of the space that each map covers, float64 (n, 8), for n lines: both ends in the frame, metres, the
  number of the map, and the role of the line (``MAP_LINE`` and others).
- ``light-bounds``: the same for the boxes that maps are fitted to: of receivers (role 1, white) and of casters (role 2, red).
- ``light-view``: what the light sees in each map, float32: metres from a lamp, or along the sun's rays from the view's origin; NaN
  where nothing casts. At most 1024 texels a side, each the nearest of a block.
- ``post-perspective``: the scene in the space of a perspective map, float32 (rows, cols, 5): the point in the frame, metres, NaN
  where there is none, the opacity of the cube's edges, and that of rays to the light (yellow).
"""

LINE_LAYERS: frozenset[PassLayer] = frozenset({"light-frustum", "light-bounds"})
"""Layers that hold lines (n, 8) instead of pixels."""

MAP_LINE, RECEIVER_LINE, CASTER_LINE = 0.0, 1.0, 2.0
"""Roles of lines: edges of a map's space, of its receivers' box, and of its casters' box."""

PIXEL_LAYERS: frozenset[PassLayer] = frozenset({"stencil", "silhouettes", "volumes", "shadow-height"})
"""Layers with one value for each pixel of the picture. The others have a size of their own."""


@dataclass
class PassRecord:
    """The record of one executed pass.

    Attributes
    ----------
    name
        The name of the pass.
    ms
        Wall-clock time, milliseconds.
    draws, triangles
        Number of draw calls and of triangles.
    map_texels
        Number of texels of shadow maps.
    bytes
        Largest size of textures and buffers held at a time, bytes.
    kept
        Number of maps or volumes that were taken from a cache.
    edges
        Number of silhouette edges.
    marked, tiles
        Number of pixels that the map of ``hybrid`` leaves to shadow volumes, and of tiles with such a pixel.
    light_points
        Number of points of the light over which the result is averaged.
    note
        A remark, such as the reason for ``left_out``.
    parts
        Number of blocks, or parts of blocks, for which the plan has the pass.
    left_out
        Number of ``parts`` that left the pass out, since they provably need none of its work.
    programs
        Labels of the shader programs that drew, in the order of their first use.
    textures
        Names of the textures that these programs can read, sorted (``skugga.terrain.gl.programs``).
    loops
        Labels of the CPU loops that did the work of a shader program.
    """

    name: str
    ms: float = 0.0
    draws: int = 0
    triangles: int = 0
    map_texels: int = 0
    bytes: int = 0
    kept: int = 0
    edges: int = 0
    marked: int = 0
    tiles: int = 0
    light_points: int = 1
    note: str = ""
    parts: int = 0
    left_out: int = 0
    programs: tuple[str, ...] = ()
    textures: tuple[str, ...] = ()
    loops: tuple[str, ...] = ()

    def add_loop(self, loop: str, taps: int) -> None:
        """Record that the CPU loop ``loop`` sampled a depth map with ``taps`` x ``taps`` texels around each point."""
        self.loops = tuple(dict.fromkeys([*self.loops, f"{loop} taps={taps}"]))

    @property
    def is_left_out(self) -> bool:
        """Whether all parts of the picture left out the pass."""
        return 0 < self.parts == self.left_out


@dataclass
class PassLog:
    """The log of a frame's passes, in the order of their first run. Records add up over the blocks of a frame.

    Attributes
    ----------
    records
        The records by name of the pass.
    requested_layers
        The layers that passes shall keep.
    layers
        The layers that passes kept, by layer and light, in order.
    fitted_maps
        The depth maps (``skugga.shadows.maps.windows.DepthMap``) that were fitted to the points of a perspective view last, by
        light and kinds of casters. Samples of the same view are looked up in them.
    """

    records: dict[str, PassRecord] = field(default_factory=dict)
    requested_layers: frozenset[PassLayer] = frozenset()
    layers: dict[tuple[PassLayer, str], list[np.ndarray]] = field(default_factory=dict)
    fitted_maps: dict[tuple[str, tuple[str, ...]], list[Any]] = field(default_factory=dict)

    @contextmanager
    def record_pass(self, name: str) -> Iterator[PassRecord]:
        """Time a pass within the ``with`` statement, and record its time and all draw calls."""
        record = self.records.setdefault(name, PassRecord(name))
        record.parts += 1
        start = time.perf_counter()
        with record_draw_calls() as calls:
            try:
                yield record
            finally:
                record.ms += (time.perf_counter() - start) * 1000.0
                record.draws += len(calls)
                drawn_with = dict.fromkeys(calls)
                record.programs = tuple(dict.fromkeys([*record.programs, *(program.label for program in drawn_with)]))
                record.textures = tuple(sorted({*record.textures, *(name for program in drawn_with for name in program.textures)}))

    def leave_out(self, names: Iterable[str], reason: str) -> None:
        """Record that a part of the picture leaves out some passes of the plan, and the reason."""
        for name in names:
            record = self.records.setdefault(name, PassRecord(name))
            record.parts, record.left_out, record.note = record.parts + 1, record.left_out + 1, reason

    def keep_layer(self, layer: PassLayer, light: str, make: Callable[..., np.ndarray], *args: object) -> None:
        """Keep the picture ``make(*args)`` of a layer and a light. ``make`` is called only if the layer is requested.

        A layer of ``PIXEL_LAYERS`` has the rows and columns of the geometry buffer, without the rows of samples below them. In any
        other layer, row 0 is the upper row.
        """
        if layer in self.requested_layers:
            self.layers.setdefault((layer, light), []).append(make(*args))

    def take_layers(self) -> dict[tuple[PassLayer, str], list[np.ndarray]]:
        """Return the layers kept since the last call, and clear them."""
        layers, self.layers = self.layers, {}
        return layers

    @property
    def names(self) -> list[str]:
        """The names of the passes that ran or were left out, in order."""
        return list(self.records)

    @staticmethod
    def pass_names(light: str, kinds: tuple[str, ...], passes: tuple[str, ...]) -> list[str]:
        """Return the names of an algorithm's passes for a light and the kinds of casters that it serves together.

        An example is ``sun/relief+meshes: depth map``.
        """
        return [f"{light}/{'+'.join(kinds)}: {name}" for name in passes]
