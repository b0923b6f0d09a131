"""A descriptor that a client sends: as ``Descriptor``, with a bound for all that can be many, and with facts typed by effect.

The predicates of effects take it that their facts are as the engine writes them. Of a client's that is checked here, and what is
wrong is told by its place, as ``facts.haze.visibility_m``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictBool, model_validator
from pydantic_core import PydanticCustomError

from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, LampFacts, LightFacts

MAX_LAMPS = 32
"""Lamps of a descriptor: a plan tells of each by itself."""

MAX_BANDS = 64
"""Bands of distances: each is a power of two."""

LEAST_EXTENT_M = 1e-6
"""Of what is seen, in light space: maps of nothing have no texels."""

LEAST_SIZE, MOST_SIZE = 1e-12, 1e15
"""Of a number that is neither 0 nor an infinity: with smaller and larger ones arithmetic ends in them."""

MAX_NAME = 200
"""Characters of a name, or of a reason."""


def _infinite(number: object) -> object:
    """JSON has no infinity: there it is written as text."""
    return {"Infinity": np.inf, "-Infinity": -np.inf}.get(number, number) if isinstance(number, str) else number


def _numbers(data: object, place: str = "") -> Iterator[tuple[str, float | int]]:
    """Every number of what JSON holds, and where it stands."""
    if isinstance(data, float | int) and not isinstance(data, bool):
        yield place, data
    elif isinstance(data, dict | list | tuple):
        for key, each in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _numbers(each, f"{place}.{key}" if place else str(key))


FactNumber = Annotated[float, BeforeValidator(_infinite), Field(strict=True, ge=-np.inf)]
"""A number or an infinity; NaN is no number, nor is true."""

FactShare = Annotated[float, Field(strict=True, ge=0.0, le=1.0)]
FactText = Annotated[str, Field(max_length=MAX_NAME)]


class _Facts(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


class HazeFacts(_Facts):
    """Of ``skugga.terrain.effects.haze``, metres."""

    visibility_m: Annotated[FactNumber, Field(gt=0.0)] | None = None
    farthest_m: FactNumber | None = None
    shows_from_m: FactNumber | None = None


class SnowFacts(_Facts):
    """Of ``skugga.terrain.effects.snow``."""

    lies: StrictBool
    on: StrictBool
    why: FactText | None


class WaterFacts(_Facts):
    """Of ``skugga.terrain.effects.water``, metres and steps of 255."""

    level_m: FactNumber | None
    covers: StrictBool
    change_steps: FactNumber | None
    glint: StrictBool


class CloudFacts(_Facts):
    """Of ``skugga.terrain.effects.clouds``, shares."""

    cover: FactShare
    taken: FactShare | None


class SkyViewFacts(_Facts):
    """Of ``skugga.terrain.effects.sky_view``, a share and steps of 255."""

    hidden: FactShare
    steps: FactNumber


class RefractionFacts(_Facts):
    """Of ``skugga.terrain.effects.refraction``, degrees and metres."""

    lift_deg: FactNumber | None = None
    moves_m: FactNumber | None = None


class CastShadowFacts(_Facts):
    """Of ``skugga.terrain.effects.cast_shadows``: differences of slopes, and what can stand before the sun."""

    least_slope: FactNumber | None = None
    most_slope: FactNumber | None = None
    meshes: StrictBool = True
    forest: StrictBool = True


class AlphaTestFacts(_Facts):
    """Of ``skugga.terrain.effects.alpha_test``."""

    drawn: StrictBool = True


class CrownFacts(_Facts):
    """Of ``skugga.terrain.effects.crowns``."""

    trees: FactNumber
    sunlit: StrictBool


class GroundDetailFacts(_Facts):
    """Of ``skugga.terrain.effects.ground_detail``, metres and a share of the albedo."""

    draped: StrictBool
    nearest_m: FactNumber | None
    share: FactNumber | None


class OutsideCasterFacts(_Facts):
    """Of ``skugga.terrain.effects.outside_casters``."""

    outside: StrictBool = True


class FactsByEffect(_Facts):
    """What effects go by besides, by effect; those of an effect that is not among them are not known."""

    haze: HazeFacts | None = None
    snow: SnowFacts | None = None
    water: WaterFacts | None = None
    clouds: CloudFacts | None = None
    sky_view: SkyViewFacts | None = None
    refraction: RefractionFacts | None = None
    cast_shadows: CastShadowFacts | None = None
    alpha_test: AlphaTestFacts | None = None
    outside_casters: OutsideCasterFacts | None = None
    crowns: CrownFacts | None = None
    ground_detail: GroundDetailFacts | None = None

    @model_validator(mode="before")
    @classmethod
    def _no_nulls(cls, data: object) -> object:
        for name, facts in data.items() if isinstance(data, dict) else ():
            if facts is None:
                raise PydanticCustomError("null", "an object of facts for {name}, or no such key", {"name": str(name)[:MAX_NAME]})
        return data


class SentDescriptor(Descriptor):
    """The facts of a scene and a view, as clients may send them."""

    view: Annotated[str, Field(max_length=MAX_NAME)]
    lamps: Annotated[tuple[LampFacts, ...], Field(max_length=MAX_LAMPS)] = ()
    lights: Annotated[dict[str, LightFacts], Field(max_length=MAX_LAMPS + 1)] = {}
    bands: Annotated[tuple[Band, ...], Field(max_length=MAX_BANDS)] = ()
    facts: FactsByEffect = FactsByEffect()  # type: ignore[assignment]

    @model_validator(mode="before")
    @classmethod
    def _of_a_size(cls, data: object) -> object:
        for place, number in _numbers(data):
            if number and number == number and abs(number) != np.inf and not LEAST_SIZE <= abs(number) <= MOST_SIZE:
                told = {"place": place[:MAX_NAME], "least": f"{LEAST_SIZE:g}", "most": f"{MOST_SIZE:g}"}
                raise PydanticCustomError("size", "{place} of 0, or of {least} to {most} in size", told)
        return data

    @model_validator(mode="after")
    def _bounded(self) -> SentDescriptor:
        for name, light in self.lights.items():
            for kind, casting in light.casts.items():
                if len(casting.bands) > MAX_BANDS:
                    place = {"place": f"lights.{name[:MAX_NAME]}.casts.{kind}.bands", "most": MAX_BANDS}
                    raise PydanticCustomError("many", "{place} of at most {most} bands", place)
        if any(len(lamp.name) > MAX_NAME for lamp in self.lamps):
            raise PydanticCustomError("long", "lamps.name of at most {most} characters", {"most": MAX_NAME})
        return self

    @model_validator(mode="after")
    def _complete(self) -> SentDescriptor:
        if self.highest_sun_deg is not None and max(self.receivers_light_m or (0.0,)) < LEAST_EXTENT_M:
            raise PydanticCustomError("receivers", "receivers_light_m of what is seen under a sun: metres, not all of them 0")
        haze, refraction = self.facts.haze, self.facts.refraction
        hazy = self.view_kind == "perspective" and haze is not None and haze.visibility_m is not None
        if hazy and (haze.farthest_m is None or haze.shows_from_m is None):  # type: ignore[union-attr]
            raise PydanticCustomError("haze", "facts.haze of a perspective view with visibility_m, farthest_m and shows_from_m")
        sunny = self.highest_sun_deg is not None and refraction is not None
        if sunny and not {"lift_deg", "moves_m"} <= refraction.model_fields_set:  # type: ignore[union-attr]
            raise PydanticCustomError("refraction", "facts.refraction under a sun with lift_deg and moves_m")
        return self

    def as_descriptor_json(self) -> str:
        """The same as JSON of a ``Descriptor``: what was not sent is left out."""
        return self.model_dump_json(exclude_unset=True)
