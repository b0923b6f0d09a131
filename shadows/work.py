"""Count the work of a plan's step from the descriptor alone: pixels, texels, triangles, trees, faces of volumes.

The counts are grouped in parts. A part is named after its algorithm, or after the code that several algorithms share. The name
includes the kind of view or light where this changes the work. As far as possible, each count is of things that take the same time
in every scene. A device's time is the sum of counts times rates (``skugga.selector.cost.cost_model``). Counts of a map view are
those of one block. Each algorithm counts its own parts. This module has the quantities that several of them share.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from math import cos, erfc, log, pi, radians, sin, sqrt
from typing import Literal, get_args

import numpy as np

from skugga.terrain.facts.descriptor import Descriptor, LightKind
from skugga.terrain.facts.fact_types import CasterFacts, LightFacts
from skugga.terrain.gbuffer.antialias import samples_per_pixel
from skugga.terrain.gbuffer.ground_mesh import MAX_UNDECIMATED_TRIANGLES
from skugga.terrain.gbuffer.map_block import EDGE_SAMPLES_PER_SIDE
from skugga.terrain.level.level import SUN, CasterKind

Counts = dict[str, float]
"""Count of each kind of thing, by name."""

Work = dict[str, Counts]
"""Counts by name of a part of the work."""

CachedResult = Literal["depth maps", "volumes", "conservative maps", "sun-aligned ground"]
"""Kinds of results that algorithms cache in perspective views, for the next frame."""

RESULTS_AT_REST: frozenset[CachedResult] = frozenset(get_args(CachedResult))
"""The results that caches still hold if light, casters and camera have not moved since the frame before."""

MAX_CASTER_OPACITY = 0.98
"""Upper bound of the share of light that a wood is assumed to block."""

UNKNOWN_LIGHT_FACTS = LightFacts()
"""Facts assumed for a light that a descriptor does not describe."""


def is_decimated(descriptor: Descriptor) -> bool:
    """Return whether the ground of a perspective view is known to be drawn with fewer triangles than its nodes make."""
    relief = next((facts for facts in descriptor.stands if facts.kind == "relief"), None)
    return relief is not None and 2 * (relief.nodes or 0) > MAX_UNDECIMATED_TRIANGLES


@dataclass(frozen=True)
class Workload:
    """Quantities of a step's work that several algorithms share.

    Attributes
    ----------
    descriptor
        The facts of a view.
    light
        The name of the light.
    kinds
        The kinds of casters that the step serves.
    cached
        The results that the frame before left in caches, so that their work is not counted. Empty for a frame that is made anew.
    """

    descriptor: Descriptor
    light: str
    kinds: Collection[CasterKind]
    cached: frozenset[CachedResult] = frozenset()

    def is_cached(self, result: CachedResult) -> bool:
        """Return whether a kind of results is in a cache. The results of a map's blocks never are: finished blocks are cached."""
        return result in self.cached and not self.is_map_view

    @cached_property
    def facts(self) -> LightFacts:
        """The facts of the light in the view."""
        return self.descriptor.lights.get(self.light, UNKNOWN_LIGHT_FACTS)

    @property
    def light_kind(self) -> LightKind:
        """The kind of the light."""
        return self.descriptor.light_kinds[self.light]

    @property
    def is_map_view(self) -> bool:
        """Whether the view is a map."""
        return self.descriptor.view_kind == "map"

    @property
    def pixel_count(self) -> float:
        """Number of pixels, and of their further samples at edges."""
        return self.descriptor.pixels * (1.0 + samples_per_pixel(self.descriptor.edge_share))

    @property
    def picture_count(self) -> float:
        """Number of pictures into which casters are drawn: one for the pixels, and a finer one for samples at edges, if any."""
        return 2.0 if self.descriptor.edge_share > 0.0 else 1.0

    @property
    def picture_pixel_count(self) -> float:
        """Number of pixels in all ``picture_count``."""
        return self.descriptor.pixels * (1.0 + (EDGE_SAMPLES_PER_SIDE**2 if self.descriptor.edge_share > 0.0 else 0.0))

    @property
    def visible_pixel_count(self) -> float:
        """Number of pixels and samples that show a surface."""
        return self.pixel_count * self.descriptor.seen_share

    @property
    def facing_pixel_count(self) -> float:
        """Number of pixels and samples that show a surface that faces the light."""
        return self.visible_pixel_count * self.facts.facing_share

    @cached_property
    def ground_casting_share(self) -> float:
        """The share of the ground's triangles that make shadow volumes: those that face away from the light.

        Where the descriptor does not have it, it is estimated. The share of the visible ground underestimates it, since slopes that
        face away are often hidden. Under the sun, gradients are assumed to be normally distributed with the level's mean slope, in
        every direction alike; their lengths then have a Rayleigh distribution.
        """
        if self.facts.ground_casting_share is not None:
            return self.facts.ground_casting_share
        away_share = 1.0 - self.facts.facing_share
        mean = np.tan(np.radians(min(self.descriptor.mean_slope_deg, 89.0)))
        if self.light != SUN or self.descriptor.sun_altitude_deg is None or mean <= 0.0:
            return away_share
        rise = np.tan(np.radians(min(max(self.descriptor.sun_altitude_deg, 0.0), 89.0)))
        return max(away_share, 0.5 * erfc(rise / (mean * sqrt(2.0 / pi)) / sqrt(2.0)))

    def caster_facts(self, kind: CasterKind) -> CasterFacts | None:
        """Return the facts of a kind of casters; ``None`` if the step does not serve it, or the level has none."""
        return next((facts for facts in self.descriptor.stands if facts.kind == kind and kind in self.kinds), None)

    def triangle_count(self, kind: CasterKind) -> float:
        """Return the number of triangles of a kind of casters."""
        facts = self.caster_facts(kind)
        return 0.0 if facts is None else float(facts.triangles)

    @property
    def outside_triangle_count(self) -> float:
        """Number of triangles of ground outside of a map's block."""
        facts = self.caster_facts("relief")
        return 0.0 if facts is None else float(facts.outside_triangles)

    @property
    def has_decimated_ground(self) -> bool:
        """Whether a perspective view's ground is drawn with fewer triangles than its nodes make."""
        return is_decimated(self.descriptor)

    @property
    def ground_triangle_count(self) -> float:
        """Number of triangles of the casting ground."""
        return self.triangle_count("relief") + self.outside_triangle_count

    @property
    def all_triangle_count(self) -> float:
        """Number of triangles of all casters."""
        return self.ground_triangle_count + self.triangle_count("meshes") + self.triangle_count("forest")

    @property
    def node_count(self) -> float:
        """Number of nodes of the ground under a map's block."""
        return self.pixel_count * (self.descriptor.pixel_m / self.descriptor.node_m) ** 2

    @property
    def visible_ground_projected_m2(self) -> float:
        """The visible ground's area, projected onto a plane perpendicular to the light, square metres."""
        return self.level_ground_projected_m2 * self.facts.area_share

    def part_name_in_view(self, part_name: str) -> str:
        """Return a part's name with the kind of view, for work that differs between maps and perspective views.

        ``part_name`` is that of a part of the work.
        """
        return f"{part_name}, {self.descriptor.view_kind}"

    @property
    def tree_count(self) -> float:
        """Number of trees that cast."""
        facts = self.caster_facts("forest")
        return 0.0 if facts is None else float(facts.count)

    @cached_property
    def level_ground_projected_m2(self) -> float:
        """The area of the level's ground, projected onto a plane perpendicular to the sun's light, square metres.

        For a lamp it is the area that the lamp lights at its reference distance.
        """
        extent_m = self.descriptor.receivers_light_m
        if self.light == SUN and extent_m is not None:
            return max(extent_m[0] * extent_m[1] / max(self.facts.area_share, 1e-6), 1e-6)
        lamp = next(lamp_facts for lamp_facts in self.descriptor.lamps if lamp_facts.name == self.light)
        across_m = 2.0 * lamp.reference_m * np.tan(np.radians(45.0 if lamp.kind == "omni" else lamp.cutoff_deg))
        return max(across_m**2, 1e-6)

    @cached_property
    def tree_layers(self) -> float:
        """The mean number of trees, as boxes, that a ray from the light crosses in or around the view.

        It follows from the share of rays that leaves block, if that is known. The share let through is e to the power of minus this
        number (J. Ross 1981, "The radiation regime and architecture of plant stands"). Otherwise it is the mean over the level.
        """
        cast = self.facts.casts.get("forest")
        if cast is not None and self.facts.facing_share > 0.0:
            return -log(1.0 - min(cast.share / self.facts.facing_share, MAX_CASTER_OPACITY))
        return self.tree_count * self.tree_projected_m2 / self.level_ground_projected_m2

    @property
    def tree_projected_m2(self) -> float:
        """The area of a tree as a box, seen from the light, square metres; 0 without trees."""
        facts = self.caster_facts("forest")
        if facts is None or facts.height_m is None or facts.width_m is None:
            return 0.0
        rise = radians((self.descriptor.sun_altitude_deg or 0.0) if self.light == SUN else 45.0)
        return facts.width_m * (facts.height_m * cos(rise) + facts.width_m * sin(rise))

    def trees_within(self, projected_m2: float) -> float:
        """Return the number of trees that are drawn for an area of ``projected_m2`` square metres perpendicular to the light."""
        return min(self.tree_count, self.tree_layers * projected_m2 / max(self.tree_projected_m2, 1e-9))
