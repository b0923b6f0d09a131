"""Validate descriptors from clients: limit lists and numbers, and check the facts of each effect (haze, snow, water and others).

A descriptor has the facts of a scene and a view that a plan is chosen by. The engine trusts its own descriptors, so ``Descriptor``
does not check the facts of effects. ``SentDescriptor`` does. Errors name the path of the faulty value, as
``facts.haze.visibility_m``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictBool, model_validator
from pydantic_core import PydanticCustomError

from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, LampFacts, LightFacts
from skugga.terrain.level.parts import SkyName

MAX_LAMPS = 32
"""Maximum number of lamps. A plan has an entry for each lamp."""

MAX_BANDS = 64
"""Maximum number of bands of distances from the eye. Each band ends at a power of two of metres."""

MIN_EXTENT_M = 1e-6
"""Minimum of the receivers' largest extent in light space, in metres. A shadow map needs a positive extent."""

MIN_MAGNITUDE, MAX_MAGNITUDE = 1e-12, 1e15
"""Smallest and largest allowed magnitude of numbers other than 0 and infinities.

Other numbers under- or overflow to 0 or infinity in calculations."""

MAX_NAME_CHARACTERS = 200
"""Maximum number of characters of a name or a reason."""


def _parse_infinity(number: object) -> object:
    """Convert the texts ``Infinity`` and ``-Infinity``, since JSON numbers have no infinity."""
    return {"Infinity": np.inf, "-Infinity": -np.inf}.get(number, number) if isinstance(number, str) else number


def _json_numbers(data: object, path: str = "") -> Iterator[tuple[str, float | int]]:
    """Yield the dotted path and the value of every number in JSON data."""
    if isinstance(data, float | int) and not isinstance(data, bool):
        yield path, data
    elif isinstance(data, dict | list | tuple):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _json_numbers(value, f"{path}.{key}" if path else str(key))


FactNumber = Annotated[float, BeforeValidator(_parse_infinity), Field(strict=True, ge=-np.inf)]
"""Type of a number or an infinity. NaN and booleans are rejected."""

FactFraction = Annotated[float, Field(strict=True, ge=0.0, le=1.0)]
FactText = Annotated[str, Field(max_length=MAX_NAME_CHARACTERS)]


class _Facts(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


class HazeFacts(_Facts):
    """Facts of ``skugga.terrain.effects.haze``: metres, a share of the pixels, and steps of 255."""

    visibility_m: Annotated[FactNumber, Field(gt=0.0)] | None = None
    farthest_m: FactNumber | None = None
    shows_from_m: FactNumber | None = None
    changed_share: FactFraction | None = None
    max_steps: FactNumber | None = None


class SnowFacts(_Facts):
    """Facts of ``skugga.terrain.effects.snow``."""

    lies: StrictBool
    on: StrictBool
    why: FactText | None


class WaterFacts(_Facts):
    """Facts of ``skugga.terrain.effects.water``, in metres and in steps of 255."""

    level_m: FactNumber | None
    covers: StrictBool
    change_steps: FactNumber | None
    glint: StrictBool


class CloudFacts(_Facts):
    """Facts of ``skugga.terrain.effects.clouds``: shares of 0 to 1, and whether the sky shows clouds."""

    cover: FactFraction
    taken: FactFraction | None
    in_sky: StrictBool = False


class SkyViewFacts(_Facts):
    """Facts of ``skugga.terrain.effects.sky_view``: a share of 0 to 1, and steps of 255."""

    hidden: FactFraction
    steps: FactNumber
    is_in_sky_light: StrictBool = False


class AmbientOcclusionFacts(_Facts):
    """Facts of ``skugga.terrain.effects.ambient_occlusion``: a number, and steps of 255."""

    bodies: FactNumber
    steps: FactNumber


class SkyLightFacts(_Facts):
    """Facts of ``skugga.terrain.effects.sky_light``: a name, and metres."""

    sky: SkyName
    relief_m: FactNumber


class TextureShadingFacts(_Facts):
    """Facts of ``skugga.terrain.effects.texture_shading``: a share of 0 to 1, a factor, and a linear colour."""

    strength: FactFraction
    exaggeration: Annotated[FactNumber, Field(ge=0.0)]
    sky_lit: Annotated[FactNumber, Field(ge=0.0)]


class RefractionFacts(_Facts):
    """Facts of ``skugga.terrain.effects.refraction``, in degrees and metres."""

    lift_deg: FactNumber | None = None
    moves_m: FactNumber | None = None


class CastShadowFacts(_Facts):
    """Facts of ``skugga.terrain.effects.cast_shadows``: differences of slopes, and the kinds of casters."""

    least_slope: FactNumber | None = None
    most_slope: FactNumber | None = None
    meshes: StrictBool = True
    forest: StrictBool = True


class AlphaTestFacts(_Facts):
    """Facts of ``skugga.terrain.effects.alpha_test``."""

    drawn: StrictBool = True


class CrownFacts(_Facts):
    """Facts of ``skugga.terrain.effects.crowns``."""

    trees: FactNumber
    sunlit: StrictBool


class GroundDetailFacts(_Facts):
    """Facts of ``skugga.terrain.effects.ground_detail``: metres, a share of the albedo, and steps of 255."""

    draped: StrictBool
    natural: StrictBool = True
    nearest_m: FactNumber | None
    share: FactNumber | None
    steps: FactNumber | None = None


class GroundMaterialFacts(_Facts):
    """Facts of ``skugga.terrain.effects.ground_materials``: metres, and steps of 255."""

    natural: StrictBool
    nearest_m: FactNumber | None
    steps: FactNumber | None


class RoadFacts(_Facts):
    """Facts of ``skugga.terrain.effects.roads``: whether there are lines, and a share of 0 to 1."""

    lines: StrictBool
    styled: StrictBool
    share: FactFraction | None


class ModelTextureFacts(_Facts):
    """Facts of ``skugga.terrain.effects.textures`` and ``normal_maps``: steps of 255."""

    steps: FactNumber | None


class HighlightFacts(_Facts):
    """Facts of ``skugga.terrain.effects.highlights``."""

    glossy: FactNumber
    sunlit: StrictBool
    snow: StrictBool


class FacadeFacts(_Facts):
    """Facts of ``skugga.terrain.effects.facades``: whether there are buildings, metres, a share of 0 to 1, and steps of 255."""

    buildings: StrictBool
    styled: StrictBool
    nearest_m: FactNumber | None
    share: FactFraction | None
    steps: FactNumber | None = None


class OutsideCasterFacts(_Facts):
    """Facts of ``skugga.terrain.effects.outside_casters``."""

    outside: StrictBool = True


class PrecipitationFacts(_Facts):
    """Facts of ``skugga.terrain.effects.precipitation``."""

    kind: Literal["none", "rain", "snowfall"]


class FactsByEffect(_Facts):
    """Further facts of effects, by effect. A missing effect has unknown facts."""

    haze: HazeFacts | None = None
    snow: SnowFacts | None = None
    water: WaterFacts | None = None
    clouds: CloudFacts | None = None
    sky_view: SkyViewFacts | None = None
    ambient_occlusion: AmbientOcclusionFacts | None = None
    sky_light: SkyLightFacts | None = None
    texture_shading: TextureShadingFacts | None = None
    refraction: RefractionFacts | None = None
    cast_shadows: CastShadowFacts | None = None
    alpha_test: AlphaTestFacts | None = None
    outside_casters: OutsideCasterFacts | None = None
    crowns: CrownFacts | None = None
    ground_detail: GroundDetailFacts | None = None
    ground_materials: GroundMaterialFacts | None = None
    precipitation: PrecipitationFacts | None = None
    roads: RoadFacts | None = None
    textures: ModelTextureFacts | None = None
    normal_maps: ModelTextureFacts | None = None
    highlights: HighlightFacts | None = None
    facades: FacadeFacts | None = None

    @model_validator(mode="before")
    @classmethod
    def _check_no_nulls(cls, data: object) -> object:
        for name, facts in data.items() if isinstance(data, dict) else ():
            if facts is None:
                raise PydanticCustomError("null", "an object for {name}, or no such key", {"name": str(name)[:MAX_NAME_CHARACTERS]})
        return data


class SentDescriptor(Descriptor):
    """The facts of a scene and a view, as clients send them."""

    view: Annotated[str, Field(max_length=MAX_NAME_CHARACTERS)]
    lamps: Annotated[tuple[LampFacts, ...], Field(max_length=MAX_LAMPS)] = ()
    lights: Annotated[dict[str, LightFacts], Field(max_length=MAX_LAMPS + 1)] = {}
    bands: Annotated[tuple[Band, ...], Field(max_length=MAX_BANDS)] = ()
    facts: FactsByEffect = FactsByEffect()  # type: ignore[assignment]

    @model_validator(mode="before")
    @classmethod
    def _check_magnitudes(cls, data: object) -> object:
        for path, number in _json_numbers(data):
            if number and number == number and abs(number) != np.inf and not MIN_MAGNITUDE <= abs(number) <= MAX_MAGNITUDE:
                context = {"place": path[:MAX_NAME_CHARACTERS], "least": f"{MIN_MAGNITUDE:g}", "most": f"{MAX_MAGNITUDE:g}"}
                raise PydanticCustomError("size", "0, or a magnitude of {least} to {most}, for {place}", context)
        return data

    @model_validator(mode="after")
    def _check_lengths(self) -> SentDescriptor:
        for name, light in self.lights.items():
            for kind, casting in light.casts.items():
                if len(casting.bands) > MAX_BANDS:
                    context = {"place": f"lights.{name[:MAX_NAME_CHARACTERS]}.casts.{kind}.bands", "most": MAX_BANDS}
                    raise PydanticCustomError("many", "at most {most} bands in {place}", context)
        if any(len(lamp.name) > MAX_NAME_CHARACTERS for lamp in self.lamps):
            raise PydanticCustomError("long", "at most {most} characters in lamps.name", {"most": MAX_NAME_CHARACTERS})
        return self

    @model_validator(mode="after")
    def _check_required_facts(self) -> SentDescriptor:
        if self.highest_sun_deg is not None and max(self.receivers_light_m or (0.0,)) < MIN_EXTENT_M:
            raise PydanticCustomError("receivers", "extents in receivers_light_m under a sun (metres, not all 0)")
        haze, refraction = self.facts.haze, self.facts.refraction
        hazy = self.view_kind == "perspective" and haze is not None and haze.visibility_m is not None
        if hazy and (haze.farthest_m is None or haze.shows_from_m is None):  # type: ignore[union-attr]
            raise PydanticCustomError("haze", "visibility_m, farthest_m and shows_from_m in facts.haze of a perspective view")
        sunny = self.highest_sun_deg is not None and refraction is not None
        if sunny and not {"lift_deg", "moves_m"} <= refraction.model_fields_set:  # type: ignore[union-attr]
            raise PydanticCustomError("refraction", "both lift_deg and moves_m in facts.refraction, as the descriptor has a sun")
        return self

    def as_descriptor_json(self) -> str:
        """Return JSON that ``Descriptor`` parses, without the keys that the client did not send."""
        return self.model_dump_json(exclude_unset=True)
