"""What a run of ``skugga seed`` is asked, as workers read it: everything that a task's number, place and sun leave open."""

from __future__ import annotations

from functools import cached_property

from pydantic import BaseModel, ConfigDict

from skugga.api.products.product import MapFormat
from skugga.api.request import ProductRequest
from skugga.shadows.plan import Plan
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec

MATRIX_SET = "WebMercatorQuad"
"""The tile matrix set of pyramids: archives of tiles know no other."""


class PlannedZoom(BaseModel):
    """The plan of all tiles of a zoom under a sun: the number of the sun, and the plan as JSON."""

    model_config = ConfigDict(frozen=True)

    sun: int
    zoom: int
    plan: str

    @cached_property
    def read(self) -> Plan:
        """The plan."""
        return Plan.model_validate_json(self.plan)


class RunSpec(BaseModel):
    """A run: a level, what is asked of it under suns (``None``: the level's own), a format, and the plans, made once.

    ``renderer`` is what the plans were made for: a worker that draws with another one is refused. ``ground`` is the version of
    the level's files.
    """

    model_config = ConfigDict(frozen=True)

    level: LevelSource
    ground: str
    renderer: str
    asked: ProductRequest
    format: MapFormat
    suns: tuple[SunSpec | None, ...]
    plans: tuple[PlannedZoom, ...]

    @property
    def layer(self) -> str:
        """The product by its name."""
        return self.asked.product

    def request(self, sun: int) -> ProductRequest:
        """The request that a service has the same tiles for."""
        return self.asked.under(self.suns[sun])

    @cached_property
    def plan_by_place(self) -> dict[tuple[int, int], Plan]:
        """Plans by sun and zoom."""
        return {(each.sun, each.zoom): each.read for each in self.plans}
