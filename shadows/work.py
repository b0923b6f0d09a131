"""What a step of a plan has to do, counted from the descriptor alone: pixels, texels, triangles, trees, faces of volumes.

The counts of each part of an algorithm (named after the algorithm, or after what several share, and after the kind of view or
light where the work is another one) are of things that take the same time whatever the scene, as far as may be: a device's time is
the sum of counts times its rates (``skugga.selector.cost.cost_model``). Counts of a map view are those of one block. Each algorithm
counts its own parts; here is what several of them count by.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from math import cos, erfc, log, pi, radians, sin, sqrt

import numpy as np

from skugga.terrain.facts.descriptor import Descriptor, LightKind
from skugga.terrain.facts.fact_types import CasterFacts, LightFacts
from skugga.terrain.gbuffer.antialias import SIDE, samples_per_pixel
from skugga.terrain.gbuffer.ground_mesh import WHOLE_TRIANGLES
from skugga.terrain.level.level import SUN, CasterKind

Counts = dict[str, float]
"""How often each thing is done, by name."""

Work = dict[str, Counts]
"""Counts by part of an algorithm."""

MAX_OPACITY = 0.98
"""No wood is taken to stop a larger share of the light."""

UNKNOWN_LIGHT = LightFacts()
"""What is taken of a light of which a descriptor says nothing."""


def is_decimated(descriptor: Descriptor) -> bool:
    """Whether the ground of a perspective view is drawn with fewer triangles than its nodes make, if that is known."""
    relief = next((its for its in descriptor.stands if its.kind == "relief"), None)
    return relief is not None and 2 * (relief.nodes or 0) > WHOLE_TRIANGLES


@dataclass(frozen=True)
class Workload:
    """A descriptor's work under a light for some kinds of casters, as quantities that several algorithms share."""

    descriptor: Descriptor
    light: str
    kinds: Collection[CasterKind]

    @cached_property
    def facts(self) -> LightFacts:
        return self.descriptor.lights.get(self.light, UNKNOWN_LIGHT)

    @property
    def light_kind(self) -> LightKind:
        return self.descriptor.light_kinds[self.light]

    @property
    def in_map(self) -> bool:
        return self.descriptor.view_kind == "map"

    @property
    def pixels(self) -> float:
        """Pixels, and the further samples that those get where something ends."""
        return self.descriptor.pixels * (1.0 + samples_per_pixel(self.descriptor.edge_share))

    @property
    def pictures(self) -> float:
        """How often what casts is drawn where it is drawn into whole pictures: that of the pixels, and the samples' finer one."""
        return 2.0 if self.descriptor.edge_share > 0.0 else 1.0

    @property
    def picture_pixels(self) -> float:
        """Pixels of these pictures."""
        return self.descriptor.pixels * (1.0 + (SIDE**2 if self.descriptor.edge_share > 0.0 else 0.0))

    @property
    def seen(self) -> float:
        """Pixels and samples that show a surface."""
        return self.pixels * self.descriptor.seen_share

    @property
    def facing(self) -> float:
        """Pixels and samples that show a surface which faces the light."""
        return self.seen * self.facts.facing_share

    @cached_property
    def turned_away(self) -> float:
        """The share of the ground that faces away from the light. What is seen does not tell, since an eye sees few far sides:
        under the sun gradients are taken to be normally distributed, of the level's mean slope, whatever their direction (so that
        their lengths have a Rayleigh distribution).
        """
        seen = 1.0 - self.facts.facing_share
        mean = np.tan(np.radians(min(self.descriptor.mean_slope_deg, 89.0)))
        if self.light != SUN or self.descriptor.sun_altitude_deg is None or mean <= 0.0:
            return seen
        rise = np.tan(np.radians(min(max(self.descriptor.sun_altitude_deg, 0.0), 89.0)))
        return max(seen, 0.5 * erfc(rise / (mean * sqrt(2.0 / pi)) / sqrt(2.0)))

    def caster_facts(self, kind: CasterKind) -> CasterFacts | None:
        """What there is of a kind of casters, if the step takes it on."""
        return next((its for its in self.descriptor.stands if its.kind == kind and kind in self.kinds), None)

    def triangles(self, kind: CasterKind) -> float:
        its = self.caster_facts(kind)
        return 0.0 if its is None else float(its.triangles)

    @property
    def outside_triangles(self) -> float:
        its = self.caster_facts("relief")
        return 0.0 if its is None else float(its.outside_triangles)

    @property
    def decimated(self) -> bool:
        """Whether a perspective view's ground is drawn with fewer triangles than its nodes make."""
        return is_decimated(self.descriptor)

    @property
    def ground_triangles(self) -> float:
        """Triangles of the ground that casts."""
        return self.triangles("relief") + self.outside_triangles

    @property
    def all_triangles(self) -> float:
        return self.ground_triangles + self.triangles("meshes") + self.triangles("forest")

    @property
    def nodes(self) -> float:
        """Nodes of a map's block, however many pixels they are."""
        return self.pixels * (self.descriptor.pixel_m / self.descriptor.node_m) ** 2

    @property
    def seen_light_m2(self) -> float:
        """What is seen across the light, square metres."""
        return self.level_light_m2 * self.facts.area_share

    def by_view(self, part: str) -> str:
        """A part's name with the kind of view, for what is another work in a map."""
        return f"{part}, {self.descriptor.view_kind}"

    @property
    def trees(self) -> float:
        its = self.caster_facts("forest")
        return 0.0 if its is None else float(its.count)

    @cached_property
    def level_light_m2(self) -> float:
        """The level's area across the sun's light; for a lamp, what its light falls on at the distance that it is meant for."""
        extent_m = self.descriptor.receivers_light_m
        if self.light == SUN and extent_m is not None:
            return max(extent_m[0] * extent_m[1] / max(self.facts.area_share, 1e-6), 1e-6)
        lamp = next(its for its in self.descriptor.lamps if its.name == self.light)
        across_m = 2.0 * lamp.reference_m * np.tan(np.radians(45.0 if lamp.kind == "omni" else lamp.cutoff_deg))
        return max(across_m**2, 1e-6)

    @cached_property
    def tree_layers(self) -> float:
        """How many times trees, as boxes seen from the light, cover what lies round the view in the mean: as often as their leaves
        stop its rays, if that is known (J. Ross 1981, "The radiation regime and architecture of plant stands": e to the power of
        minus the layers is let through), or as the level is wooded in the mean.
        """
        cast = self.facts.casts.get("forest")
        if cast is not None and self.facts.facing_share > 0.0:
            return -log(1.0 - min(cast.share / self.facts.facing_share, MAX_OPACITY))
        return self.trees * self.tree_light_m2 / self.level_light_m2

    @property
    def tree_light_m2(self) -> float:
        """The area of a tree as a box, seen from the light, square metres; 0 without trees."""
        its = self.caster_facts("forest")
        if its is None or its.height_m is None or its.width_m is None:
            return 0.0
        rise = radians((self.descriptor.sun_altitude_deg or 0.0) if self.light == SUN else 45.0)
        return its.width_m * (its.height_m * cos(rise) + its.width_m * sin(rise))

    def trees_within(self, light_m2: float) -> float:
        """How many trees are drawn for an area across the light."""
        return min(self.trees, self.tree_layers * light_m2 / max(self.tree_light_m2, 1e-9))
