"""A step of a plan as quantities that the work of several algorithms is counted in: pixels, casters, areas across the light."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selector.serves import kinds_of_lights
from shadows.registry import LightKind
from terrain.descriptor import CasterFacts, Descriptor, LightFacts
from terrain.level import SUN, CasterKind

UNKNOWN = LightFacts()
"""What is taken of a light of which a descriptor says nothing."""


@dataclass(frozen=True)
class Task:
    """A descriptor's work under a light for some kinds of casters, as quantities that several algorithms share."""

    descriptor: Descriptor
    light: str
    kinds: Collection[CasterKind]

    @cached_property
    def facts(self) -> LightFacts:
        return self.descriptor.lights.get(self.light, UNKNOWN)

    @property
    def light_kind(self) -> LightKind:
        return kinds_of_lights(self.descriptor)[self.light]

    @property
    def in_map(self) -> bool:
        return self.descriptor.view_kind == "map"

    @property
    def pixels(self) -> float:
        return float(self.descriptor.pixels)

    @property
    def seen(self) -> float:
        """Pixels that show a surface."""
        return self.pixels * self.descriptor.seen_share

    @property
    def facing(self) -> float:
        """Pixels that show a surface which faces the light."""
        return self.seen * self.facts.facing_share

    def stand(self, kind: CasterKind) -> CasterFacts | None:
        """What there is of a kind of casters, if the step takes it on."""
        return next((its for its in self.descriptor.stands if its.kind == kind and kind in self.kinds), None)

    def triangles(self, kind: CasterKind) -> float:
        its = self.stand(kind)
        return 0.0 if its is None else float(its.triangles)

    @property
    def outside_triangles(self) -> float:
        its = self.stand("relief")
        return 0.0 if its is None else float(its.outside_triangles)

    @property
    def trees(self) -> float:
        its = self.stand("forest")
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

    @property
    def tree_layers(self) -> float:
        """How many times the trees, as boxes seen from the light, cover the level in the mean."""
        its = self.stand("forest")
        if its is None or its.height_m is None or its.width_m is None:
            return 0.0
        rise = np.radians(self.descriptor.sun_altitude_deg or 0.0) if self.light == SUN else np.radians(45.0)
        tree_m2 = its.width_m * (its.height_m * np.cos(rise) + its.width_m * np.sin(rise))
        return float(its.count * tree_m2 / self.level_light_m2)
