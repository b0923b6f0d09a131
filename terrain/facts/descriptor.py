"""The ``Descriptor``: all facts of a scene and a view in one value. ``skugga.terrain.describe`` computes it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from skugga.terrain.facts.fact_types import (
    AtLeastZero,
    Band,
    CasterFacts,
    Fact,
    Facts,
    LampFacts,
    LightFacts,
    Positive,
    Share,
    Slope,
    check_share_sum,
)
from skugga.terrain.geo.grid import BLOCK_PX
from skugga.terrain.geo.world import EARTH_RADIUS_M
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.level.parts import Weather

LightKind = Literal["sun", "spot", "omni"]


def _parse_infinity(fact: object) -> object:
    """Return the number for the text ``Infinity`` or ``-Infinity``, and any other fact unchanged."""
    return {"Infinity": np.inf, "-Infinity": -np.inf}.get(fact, fact) if isinstance(fact, str) else fact


def _reject_nan(fact: Fact) -> Fact:
    """Return the fact. Raises ``PydanticCustomError`` if it is NaN."""
    if isinstance(fact, float) and np.isnan(fact):
        raise PydanticCustomError("nan", "a number, not NaN")
    return fact


class Descriptor(Facts):
    """The facts of a scene and a view. For a map view they are a function of (level, zoom, sun).

    - ``view``, ``view_kind``: the name of the view and its kind.
    - ``flat_world``: whether the world is flat: an engineering CRS, or generated ground.
    - ``radius_m``: mean radius of the earth, or of the level's celestial body, metres; without effect in a flat world.
    - ``pixel_m``: side of a pixel on the ground, metres; in perspective at the median distance of the visible surfaces.
    - ``pixel``: side of a pixel as a tangent; perspective views only.
    - ``rows``, ``cols``, ``pixels``: rows, columns and number of pixels of a map's block or of a whole perspective view.
    - ``seen_share``: share of the pixels that show a surface and not the sky.
    - ``edge_share``: share of the pixels that contain an edge and get further samples (``skugga.terrain.gbuffer.antialias``);
      0 in a map.
    - ``node_m``: distance between the nodes of the drawn ground, metres.
    - ``pieces``: supersampling factor of a side of a coarse map's pixel, which shows the mean visibility of its sub-pixels
      (``skugga.terrain.gbuffer.supersampling``). If it is over 1, ``pixel_m``, ``node_m`` and the other fields describe sub-pixels,
      and ``pixels`` counts those of a block that show ground.
    - ``casters``: the kinds of casters in the scene: ``relief``, ``meshes`` and ``forest``.
    - ``stands``: the facts of each kind of casters.
    - ``lamps``: the lights other than the sun.
    - ``lights``: the facts of each light by name: of ``sun``, and of each lamp that reaches the view.
    - ``relief_m``, ``block_relief_m``: range of the ground's heights, metres, in the level and in a block or in the visible part.
    - ``mean_slope_deg``, ``p95_slope_deg``, ``highest_slope_deg``: slopes of the raster's overview, degrees.
    - ``sun_azimuth_deg``, ``sun_altitude_deg``: angles of the sun at the anchor, degrees; ``None`` without a sun.
    - ``highest_sun_deg``: maximum altitude of the sun anywhere in the level, degrees; ``None`` without a sun. Give all three angles
      of the sun, or none.
    - ``receivers_light_m``: maximum extent of a block's receivers in light space: right, up and along the light, metres; ``None``
      without a sun.
    - ``bands``: the surfaces that a perspective view shows under the sun, by distance.
    - ``bend_px``: maximum deviation of a map from the affine cameras that draw it, pixels (``skugga.terrain.casters.clip_space``).
    - ``row_width_ratio``: largest ratio of the widths, across the sun's rays, of two rows of nodes that are drawn at once
      (``skugga.terrain.facts.row_widths``). It is large near a pole of a map in degrees.
    - ``receiver_planes``: number of planes in which the visible ground and meshes lie, curved bodies left out
      (``skugga.terrain.facts.plane_facts``); of a map: in the whole level. 256 stands for more than 255. ``None`` if it is unknown,
      or if visible ground is not one plane.
    - ``plane_share``: share of the visible surfaces that lie in planes: neither leaves, nor curved bodies, nor other ground. A body
      of more than 64 planes is curved, apart from planes that have 5 % of its area.
    - ``tallest_m``: maximum height of any object above its ground, metres.
    - ``moves``: whether casters, lamps or clouds move with time.
    - ``camera_moves``: whether the view is a frame of a film whose camera moves.
    - ``weather``: visibility, cloud cover and snow.
    - ``facts``: further facts of effects, by effect. JSON has no infinity, so an infinite number is written there as the text
      ``"Infinity"``.
    """

    model_config = ConfigDict(ser_json_inf_nan="strings")

    view: str
    view_kind: Literal["map", "perspective"]
    flat_world: bool
    radius_m: Positive = EARTH_RADIUS_M
    pixel_m: Positive
    pixel: Positive | None = None
    rows: Annotated[int, Field(ge=1)] = BLOCK_PX
    cols: Annotated[int, Field(ge=1)] = BLOCK_PX
    pixels: Annotated[int, Field(ge=1)] = BLOCK_PX**2
    seen_share: Share = 1.0
    edge_share: Share = 0.0
    node_m: Positive
    pieces: Annotated[int, Field(ge=1)] = 1
    casters: tuple[CasterKind, ...]
    stands: tuple[CasterFacts, ...] = ()
    lamps: tuple[LampFacts, ...] = ()
    lights: dict[str, LightFacts] = {}
    relief_m: AtLeastZero
    block_relief_m: AtLeastZero
    mean_slope_deg: Slope = 0.0
    p95_slope_deg: Slope = 0.0
    highest_slope_deg: Slope = 0.0
    sun_azimuth_deg: Annotated[float, Field(ge=-360, le=720, allow_inf_nan=False)] | None
    sun_altitude_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] | None
    highest_sun_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] | None
    receivers_light_m: tuple[AtLeastZero, AtLeastZero, AtLeastZero] | None
    bands: tuple[Band, ...] = ()
    bend_px: AtLeastZero = 0.0
    row_width_ratio: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 1.0
    receiver_planes: Annotated[int, Field(ge=0)] | None = None
    plane_share: Share = 1.0
    tallest_m: AtLeastZero = 0.0
    moves: bool = False
    camera_moves: bool = False
    weather: Weather = Weather()
    facts: dict[str, dict[str, Annotated[Fact, BeforeValidator(_parse_infinity), AfterValidator(_reject_nan)]]] = {}

    @property
    def light_kinds(self) -> dict[str, LightKind]:
        """The kind of each light by name, in order. A level without lights gets the entry of the sun."""
        sun: dict[str, LightKind] = {SUN: "sun"} if self.highest_sun_deg is not None or not self.lamps else {}
        return sun | {lamp.name: lamp.kind for lamp in self.lamps}

    @model_validator(mode="before")
    @classmethod
    def _fill_pixels(cls, data: Any) -> Any:
        if isinstance(data, dict) and "pixels" not in data:
            rows, cols = (data.get(key, BLOCK_PX) for key in ("rows", "cols"))
            if isinstance(rows, int) and isinstance(cols, int) and min(rows, cols) > 0:
                return {**data, "pixels": rows * cols}
        return data

    @model_validator(mode="after")
    def _check_consistency(self) -> Descriptor:
        _check_unique("casters", list(self.casters), None)
        _check_unique("stands", [caster.kind for caster in self.stands], self.casters)
        _check_unique("lamps", [lamp.name for lamp in self.lamps], None)
        sun = () if self.highest_sun_deg is None else (SUN,)
        _check_unique("lights", list(self.lights), (*sun, *(lamp.name for lamp in self.lamps)))
        for name, light in self.lights.items():
            _check_unique(f"lights.{name}.casts", list(light.casts), self.casters)
        is_given = [value is not None for value in (self.sun_azimuth_deg, self.sun_altitude_deg, self.highest_sun_deg)]
        if any(is_given) != all(is_given):
            raise PydanticCustomError(
                "sun", "sun_azimuth_deg, sun_altitude_deg and highest_sun_deg: give all three, or none without a sun"
            )
        if not self.mean_slope_deg <= self.highest_slope_deg or not self.p95_slope_deg <= self.highest_slope_deg:
            raise PydanticCustomError(
                "slope",
                "highest_slope_deg {highest} is less than mean_slope_deg or p95_slope_deg",
                {"highest": self.highest_slope_deg},
            )
        check_share_sum([band.share for band in self.bands], "bands")
        return self


def _check_unique(key: str, names: list[str], allowed: tuple[str, ...] | None) -> None:
    """Raise a ``PydanticCustomError`` if a name is listed twice or is not in ``allowed``.

    ``key`` is the field's name, for the message. ``allowed`` is ``None`` if all names are allowed.
    """
    for number, name in enumerate(names):
        if name in names[:number]:
            raise PydanticCustomError("twice", "{key}: '{name}' is listed twice", {"key": key, "name": name})
        if allowed is not None and name not in allowed:
            allowed_names = ", ".join(allowed) or "nothing"
            raise PydanticCustomError(
                "unknown", "{key}: '{name}' is not allowed. Allowed: {what}", {"key": key, "name": name, "what": allowed_names}
            )


def join_bands(bands: tuple[Band, ...]) -> Band:
    """Merge neighbouring bands into one band."""
    low = np.min([band.low_light_m for band in bands], axis=0)
    high = np.max([band.high_light_m for band in bands], axis=0)
    bounds = {"low_light_m": tuple(low.tolist()), "high_light_m": tuple(high.tolist())}
    return Band(near_m=bands[0].near_m, far_m=bands[-1].far_m, share=min(sum(band.share for band in bands), 1.0), **bounds)
