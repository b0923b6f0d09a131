"""The interface of rendering effects.

An effect has a predicate, which decides whether a scene needs it, the facts that the predicate needs, and a rendering function.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.gbuffer.antialias import MultisampledBuffer
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene

SRGB_CHANNEL_STEP = 1.0 / 255.0
"""Largest invisible change: one step of an 8-bit channel. An effect that changes no pixel by more than that is not needed."""

Stage = Literal["normal", "albedo", "sunlight", "skylight", "lamplight", "gloss", "color"]
"""Name of the array that an effect changes. Stages run in this order. Rows and columns are those of the geometry buffer:

- ``normal``: shading normals (rows, cols, 3), which all later stages use;
- ``albedo``: linear albedo of the visible surfaces (rows, cols, 3);
- ``sunlight``: share of the direct sunlight that reaches each pixel (rows, cols), shadows included;
- ``skylight``: visible share of the sky (rows, cols);
- ``lamplight``: light other than that of sun and sky (rows, cols, 3), in the units of ``skugga.terrain.shading``;
- ``gloss``: the share of the sun's light at normal incidence that the surface mirrors into the eye, in three channels, and the
  share that its direct diffuse light lacks (rows, cols, 4);
- ``color``: linear display colour (rows, cols, 3), with the sky of a perspective view.

All arrays are float32 and changed in place.
"""

STAGES_BEFORE_SHADING: tuple[Stage, ...] = ("normal", "albedo", "sunlight", "skylight", "lamplight", "gloss")


@dataclass(frozen=True)
class Verdict:
    """Decision whether a scene needs an effect.

    Attributes
    ----------
    is_needed
        Whether the scene needs the effect.
    reason
        The reason for either answer, as text for users.
    """

    is_needed: bool
    reason: str


@dataclass(frozen=True, eq=False)
class ShadingBlock:
    """A block of a picture during shading.

    Attributes
    ----------
    scene
        The scene.
    view
        The view of the block.
    buffer
        Geometry buffer of the visible surfaces. It may have more rows than the view, which hold anti-aliasing samples of the view's
        pixels (``skugga.terrain.gbuffer.antialias``).
    visibilities
        Visible share of each light, by name, in [0, 1], (rows, cols): 0 in shadow.
    picture
        The picture that the buffer belongs to, with the pixels of its samples. ``None`` if the buffer has no samples.
    sky_light_factor
        Function that returns the irradiance of a map's points from the whole sky, relative to level, open ground, float32
        (rows, cols). ``None`` where it is not known.
    """

    scene: Scene
    view: MapView | PerspectiveView
    buffer: GeometryBuffer
    visibilities: dict[str, np.ndarray]
    picture: MultisampledBuffer | None = None
    sky_light_factor: Callable[[ShadingBlock], np.ndarray] | None = None

    def pixels_of_points(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns (n,) of the view's pixels to which the buffer's points at ``row`` and ``col`` (n,) belong."""
        return (row, col) if self.picture is None else self.picture.pixels_of_points(row, col)


class PixelSize(NamedTuple):
    """Width of a view's pixels on the visible surface.

    Attributes
    ----------
    eye_frame_m
        Position of the eye (3,), metres; zeros in a map.
    pixel_tangent
        Width of a pixel at distance 1 from the eye; 0 in a map.
    width_m
        Width of all pixels of a map, metres; 0 in perspective.
    """

    eye_frame_m: np.ndarray
    pixel_tangent: float
    width_m: float


def pixel_size(block: ShadingBlock) -> PixelSize:
    """Return the width of a block's pixels."""
    if isinstance(block.view, MapView):
        return PixelSize(np.zeros(3), 0.0, map_pixel_m(block.scene.world, block.view))
    return PixelSize(block.view.in_frame(block.buffer.frame)[0], block.view.pixel_tangent, 0.0)


@dataclass(frozen=True)
class Effect:
    """An effect of the rendering pipeline. A module of ``skugga.terrain.effects`` registers one as its ``EFFECT``.

    Attributes
    ----------
    description
        Description in a few words.
    judge
        Predicate that decides from the descriptor (all facts of a scene and a view) whether a scene needs the effect.
    facts
        Function that returns the facts that only this predicate needs, by name; they become a part of the descriptor. Its arguments
        are the scene, the view and, for a perspective view, its coarse view (every few pixels of the view). It is evaluated once
        for each level, zoom and sun, or for each view, never for each tile. ``None`` if the predicate needs no such facts.
    stage
        Name of the array that the effect changes. ``None`` if the effect has no ``apply``.
    apply
        Function that changes this array in place. ``None`` if the effect switches a behaviour of other code instead
        (``skugga.terrain.effects.SWITCHES``).
    sky_colors
        Function that returns the linear colour (n, 3) of the sky of a scene in the pixels ``rows`` and ``cols`` (n,) of a
        perspective view, in place of ``skugga.terrain.sky.sky_pixel_colors``. ``None`` if the effect leaves the sky alone.
    required_effects
        Names of the effects that this effect depends on.
    verdict_without_facts
        Verdict for a descriptor without the effect's facts, for example one written by hand. ``None`` if the predicate works
        without these facts.
    """

    description: str
    judge: Callable[[Descriptor], Verdict]
    facts: Callable[[Scene, MapView | PerspectiveView, CoarseView | None], dict[str, Fact]] | None = None
    stage: Stage | None = None
    apply: Callable[[np.ndarray, ShadingBlock], None] | None = None
    sky_colors: Callable[[Scene, PerspectiveView, np.ndarray, np.ndarray], np.ndarray] | None = None
    required_effects: tuple[str, ...] = ()
    verdict_without_facts: Verdict | None = Verdict(False, "the descriptor has no facts of this effect")

    def verdict(self, name: str, descriptor: Descriptor) -> Verdict:
        """Return whether a scene needs the effect, with the reason.

        Parameters
        ----------
        name
            The name of the effect.
        descriptor
            The facts of the scene and the view.

        Returns
        -------
        Verdict
            The decision with its reason.
        """
        if self.facts is not None and self.verdict_without_facts is not None and name not in descriptor.facts:
            return self.verdict_without_facts
        return self.judge(descriptor)
