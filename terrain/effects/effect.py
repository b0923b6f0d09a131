"""What an effect is: when a scene calls for it, the facts that this goes by, and its part in the making of a picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene

CHANNEL_STEP = 1.0 / 255.0
"""What can be seen at least: a step of an 8-bit channel. An effect that changes no pixel by more is not called for."""

Stage = Literal["albedo", "sunlight", "skylight", "lamplight", "color"]
"""What a part of an effect changes, in the order in which the stages run, on a buffer's rows and columns:

- ``albedo``: linear albedo (rows, cols, 3) of what is seen;
- ``sunlight``: the share of the sun's direct light (rows, cols) that arrives, shadows taken into account;
- ``skylight``: the share of the sky (rows, cols) that is seen;
- ``lamplight``: light besides the sun's and the sky's (rows, cols, 3), in the units of ``skugga.terrain.shading``;
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
class ShadingBlock:
    """A part of a picture while it is made: what is seen, and each light's visibility there (rows, cols).

    Rows of the buffer below the view's own are further samples of its pixels (``skugga.terrain.gbuffer.antialias``).
    """

    scene: Scene
    view: MapView | PerspectiveView
    buffer: GeometryBuffer
    visibilities: dict[str, np.ndarray]


class PixelSize(NamedTuple):
    """How wide pixels are where they show something: all ``width_m`` in a map; in perspective, where that is 0, ``tangent`` (0 in
    a map) at the distance 1 from the eye (3,).
    """

    eye_frame_m: np.ndarray
    tangent: float
    width_m: float


def pixel_size(block: ShadingBlock) -> PixelSize:
    """How wide a block's pixels are."""
    if isinstance(block.view, MapView):
        return PixelSize(np.zeros(3), 0.0, map_pixel_m(block.scene.world, block.view))
    return PixelSize(block.view.in_frame(block.buffer.frame)[0], block.view.pixel, 0.0)


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
        What it changes, and the function that does: a pass of the effect's name. ``None`` for switches of the pipeline
        (``skugga.terrain.effects.SWITCHES`` says what each of them switches, and where).
    needs
        Effects without which it has nothing to do.
    unknown
        The answer for descriptors without its facts, as somebody may have written them by hand; ``None``: the predicate copes.
    """

    about: str
    called_for: Callable[[Descriptor], Verdict]
    facts: Callable[[Scene, MapView | PerspectiveView, CoarseView | None], dict[str, Fact]] | None = None
    stage: Stage | None = None
    part: Callable[[np.ndarray, ShadingBlock], None] | None = None
    needs: tuple[str, ...] = ()
    unknown: Verdict | None = Verdict(False, "not in the descriptor")

    def verdict(self, name: str, descriptor: Descriptor) -> Verdict:
        """Whether a scene calls for it; ``name`` is its own."""
        if self.facts is not None and self.unknown is not None and name not in descriptor.facts:
            return self.unknown
        return self.called_for(descriptor)
