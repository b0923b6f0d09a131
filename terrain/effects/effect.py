"""What an effect is: when a scene calls for it, the facts that this goes by, and its part in the making of a picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from terrain.gbuffer.geometry import GeometryBuffer
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView
from terrain.scene import Scene

if TYPE_CHECKING:
    from terrain.descriptor import Descriptor

Fact = float | bool | str | None

STEP = 1.0 / 255.0
"""What can be seen at least: a step of an 8-bit channel. An effect that changes no pixel by more is not called for."""

Stage = Literal["albedo", "sunlight", "skylight", "lamplight", "color"]
"""What a part of an effect changes, in the order in which the stages run, on a buffer's rows and columns:

- ``albedo``: linear albedo (rows, cols, 3) of what is seen;
- ``sunlight``: the share of the sun's direct light (rows, cols) that arrives, shadows taken into account;
- ``skylight``: the share of the sky (rows, cols) that is seen;
- ``lamplight``: light besides the sun's and the sky's (rows, cols, 3), in the units of ``terrain.shading``;
- ``color``: linear display colour (rows, cols, 3), the sky of a perspective view included.

All are float32 and changed in place.
"""

BEFORE_SHADING: tuple[Stage, ...] = ("albedo", "sunlight", "skylight", "lamplight")


@dataclass(frozen=True)
class Verdict:
    """Whether an effect is called for, and the reason either way."""

    called_for: bool
    reason: str


@dataclass(frozen=True, eq=False)
class Crosses:
    """Some pixels of a perspective view, each with the four beside it: what decides whether something ends in it, but for trees.

    ``row`` and ``col`` (n,) are the pixels; ``number`` (n, 5) uint32 the triangles seen in each and beside it, in the order of
    ``terrain.gbuffer.antialias``, counted from 1 through the ground's (``ground`` of them) and the meshes', 0 where there is none;
    ``away_m`` (n, 5) float64 how far away along the axis of the view, infinite where there is none; ``normals`` (m, 3) float32
    those of the meshes' faces.
    """

    view: PerspectiveView
    row: np.ndarray
    col: np.ndarray
    number: np.ndarray
    away_m: np.ndarray
    ground: int
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class Look:
    """What a perspective view shows, coarsely: every few pixels, of everything but the trees.

    ``points_frame_m`` (n, 3) float64 are the points seen, ``away_m`` (n,) their distances from ``eye_frame_m``, ``height_m`` (n,)
    their heights, ``spacing`` the angle (a tangent) between neighbours. ``edge_share`` is the share of the view's own pixels in
    which something ends, ``crosses`` are some of those.
    """

    buffer: GeometryBuffer
    eye_frame_m: np.ndarray
    points_frame_m: np.ndarray
    away_m: np.ndarray
    height_m: np.ndarray
    spacing: float
    edge_share: float
    crosses: Crosses


@dataclass(frozen=True, eq=False)
class Block:
    """A part of a picture while it is made: what is seen, and each light's visibility there (rows, cols).

    Rows of the buffer below the view's own are further samples of its pixels (``terrain.gbuffer.antialias``).
    """

    scene: Scene
    view: MapView | PerspectiveView
    buffer: GeometryBuffer
    visibilities: dict[str, np.ndarray]


@dataclass(frozen=True)
class Effect:
    """An effect.

    Attributes
    ----------
    about
        What it is, in a few words.
    called_for
        Whether a scene calls for it: a predicate over the descriptor, its own facts among it.
    facts
        What the predicate needs to know besides: numbers of a scene and a view (and of what a perspective view shows), by name.
        Evaluated per (level, zoom, sun) or per view, never per tile.
    stage, part
        What it changes, and the function that does: a pass of the effect's name. ``None`` for effects that are a way of drawing
        shadows (``shadows`` does what they say) or of placing the sun.
    needs
        Effects without which it has nothing to do.
    unknown
        The answer for descriptors without its facts, as somebody may have written them by hand; ``None``: the predicate copes.
    """

    about: str
    called_for: Callable[[Descriptor], Verdict]
    facts: Callable[[Scene, MapView | PerspectiveView, Look | None], dict[str, Fact]] | None = None
    stage: Stage | None = None
    part: Callable[[np.ndarray, Block], None] | None = None
    needs: tuple[str, ...] = ()
    unknown: Verdict | None = Verdict(False, "the descriptor says nothing of it")

    def verdict(self, name: str, descriptor: Descriptor) -> Verdict:
        """Whether a scene calls for it; ``name`` is its own."""
        if self.facts is not None and self.unknown is not None and name not in descriptor.facts:
            return self.unknown
        return self.called_for(descriptor)
