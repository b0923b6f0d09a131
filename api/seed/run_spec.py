"""The specification of a run of ``skugga seed`` for workers. A task adds only its number, its block and its sun."""

from __future__ import annotations

from functools import cached_property

from pydantic import BaseModel, ConfigDict

from skugga.api.products.product import MapFormat
from skugga.api.request import ProductRequest
from skugga.shadows.plan import Plan
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec

MATRIX_SET = "WebMercatorQuad"
"""The tile matrix set of pyramids, the only one that PMTiles archives support."""


class PlannedZoom(BaseModel):
    """The plan, as JSON, of all tiles of a zoom under one of the run's suns, given by its index."""

    model_config = ConfigDict(frozen=True)

    sun: int
    zoom: int
    plan: str

    @cached_property
    def parsed_plan(self) -> Plan:
        """The plan."""
        return Plan.model_validate_json(self.plan)


class RunSpec(BaseModel):
    """A run: level, product, suns (``None``: the level's own sun), format of the tiles, and plans, which are made once.

    ``renderer`` is the OpenGL renderer for which the plans are made. Workers with another one are refused. ``ground`` is the
    version of the level's files.
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
        """Name of the product."""
        return self.asked.product

    def request(self, sun_index: int) -> ProductRequest:
        """Return the request by which a service would draw the same tiles. ``sun_index`` is the index of the run's sun."""
        return self.asked.with_sun(self.suns[sun_index])

    @cached_property
    def plan_by_sun_and_zoom(self) -> dict[tuple[int, int], Plan]:
        """Plans by index of the sun and zoom."""
        return {(planned_zoom.sun, planned_zoom.zoom): planned_zoom.parsed_plan for planned_zoom in self.plans}
