"""The record of what really ran, and the intermediate pictures that were asked for: both written by the passes themselves
while they run, never copied from a plan.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from skugga.terrain.gl.programs import recorded

GEOMETRY_PASS = "geometry"
CASTERS_PASS = "outside_casters"
ATTACHED_PASS = "attached"

PassLayer = Literal["shadow-map", "stencil", "silhouettes", "volumes", "shadow-height"]
"""Intermediate pictures: depth maps as drawn (float32 depths from 0, nearest the light, to 1), the stencil (uint8), silhouette
edges (uint8, 255 where one is seen; of a hybrid, the pixels that it leaves to its volumes), shadow volumes (uint8, how many of
their faces lie before the point), the height in metres above which the sun is seen (float32)."""

OF_PIXELS: frozenset[PassLayer] = frozenset({"stencil", "silhouettes", "volumes", "shadow-height"})
"""Those that hold a value for each pixel of the picture; the others are of a size of their own."""


@dataclass
class PassRecord:
    """One executed pass: its name, wall-clock milliseconds, draw calls, triangles, texels of shadow maps, the bytes of textures
    and buffers it held at a time, how many maps or volumes it found as they were made before, silhouette edges, marked pixels
    and tiles that hold one, of how many points of the light it is the mean, and what else there is to say of it; labels of the
    programs that it drew with, in the order of their first use, and the textures that these can read, by the alphabet
    (``skugga.terrain.gl.programs``); labels of what it did by loops on the processor instead.

    ``parts`` are the blocks, or parts of them, that the plan had it for, ``left_out`` those of them that provably need none of its
    work, and went without it; the ``note`` says why.
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

    def looked_up_by(self, loop: str, taps: int) -> None:
        """Put it on record that a loop on the processor looked points up by so many taps a side."""
        self.loops = tuple(dict.fromkeys([*self.loops, f"{loop} taps={taps}"]))

    @property
    def did_nothing(self) -> bool:
        """Whether all parts of the picture went without it."""
        return 0 < self.parts == self.left_out


@dataclass
class PassLog:
    """The passes of a frame in the order of their first run; blocks of one frame add up.

    ``wanted`` are the layers that passes shall leave behind, ``layers`` what they left, by layer and light, in order.
    """

    records: dict[str, PassRecord] = field(default_factory=dict)
    wanted: frozenset[PassLayer] = frozenset()
    layers: dict[tuple[PassLayer, str], list[np.ndarray]] = field(default_factory=dict)

    @contextmanager
    def run(self, name: str) -> Iterator[PassRecord]:
        """Time a pass and put it on record with all that is drawn in it."""
        record = self.records.setdefault(name, PassRecord(name))
        record.parts += 1
        start = time.perf_counter()
        with recorded() as calls:
            try:
                yield record
            finally:
                record.ms += (time.perf_counter() - start) * 1000.0
                record.draws += len(calls)
                drawn_with = dict.fromkeys(calls)
                record.programs = tuple(dict.fromkeys([*record.programs, *(program.label for program in drawn_with)]))
                record.textures = tuple(sorted({*record.textures, *(name for program in drawn_with for name in program.textures)}))

    def leave_out(self, names: Iterable[str], why: str) -> None:
        """Put it on record that a part of the picture goes without passes of the plan."""
        for name in names:
            record = self.records.setdefault(name, PassRecord(name))
            record.parts, record.left_out, record.note = record.parts + 1, record.left_out + 1, why

    def keep(self, layer: PassLayer, light: str, make: Callable[..., np.ndarray], *args: object) -> None:
        """Keep the picture ``made(*of)``, which is made only if it is wanted.

        One of ``OF_PIXELS`` has the rows and columns of the geometry buffer (rows of samples below its own do not count); of
        any other, row 0 is the upper one.
        """
        if layer in self.wanted:
            self.layers.setdefault((layer, light), []).append(make(*args))

    def take(self) -> dict[tuple[PassLayer, str], list[np.ndarray]]:
        """What was kept since the last call."""
        layers, self.layers = self.layers, {}
        return layers

    @property
    def names(self) -> list[str]:
        """Names of the passes that ran, in order."""
        return list(self.records)

    @staticmethod
    def named(light: str, kinds: tuple[str, ...], passes: tuple[str, ...]) -> list[str]:
        """The names of an algorithm's passes for a light and the kinds of casters it takes on together."""
        return [f"{light}/{'+'.join(kinds)}: {name}" for name in passes]
