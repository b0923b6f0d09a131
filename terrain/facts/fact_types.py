"""What a descriptor is made of: facts of a scene and a view as plain numbers, each with its unit and its bounds.

Anybody may write them by hand or send them as JSON: what is not known may be left out, what cannot be is refused by name.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from skugga.terrain.errors import InputError
from skugga.terrain.level.level import CasterKind

TEXEL_LADDER_PX = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Sides of texels, in pixels, for which it is told what a nearest look-up gets wrong."""

FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
AtLeastZero = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]
Slope = Annotated[float, Field(ge=0, le=90, allow_inf_nan=False)]
FinitePoint = tuple[FiniteNumber, FiniteNumber, FiniteNumber]

Fact = float | bool | str | None
"""A fact that an effect goes by besides; ``None``: not known."""

SHARE_SUM_TOLERANCE = 1e-6
"""How far shares that make up a whole may add up to more than one."""


class Facts(BaseModel):
    """A value that is never changed, whose keys are all known."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class LampFacts(Facts):
    """A light besides the sun: half angle of its cone (180: an omni light), the distance that it is meant for, and whether its
    light can be seen in the view, alone or with that of other dim lamps; ``radius_m`` is that of the ball that shines (0: a point).
    """

    name: Annotated[str, Field(min_length=1)]
    kind: Literal["spot", "omni"]
    cutoff_deg: Annotated[float, Field(gt=0, le=180, allow_inf_nan=False)]
    reference_m: Positive
    reaches: bool = True
    radius_m: AtLeastZero = 0.0


class Band(Facts):
    """What is seen at distances from ``near_m`` to ``far_m``, the next power of two: its share of all that is seen, and its bounds
    in light space, metres.
    """

    near_m: Positive
    far_m: Positive
    share: Share
    low_light_m: FinitePoint
    high_light_m: FinitePoint

    @model_validator(mode="after")
    def _in_order(self) -> Band:
        _ascending("far_m", self.near_m, self.far_m)
        for low, high in zip(self.low_light_m, self.high_light_m, strict=True):
            if high < low:
                raise PydanticCustomError(
                    "bounds", "high_light_m {high} is less than low_light_m {low}", {"high": high, "low": low}
                )
        return self


class CasterFacts(Facts):
    """What there is of a kind of casters, as it casts.

    ``count`` bodies or trees as the view draws them (1 for the relief) of ``triangles`` in all; of the relief of a map those of a
    block, and ``outside_triangles`` those of ground beyond it that is drawn to cast into it (an estimate); of the relief in
    perspective ``nodes`` are those of the level's ground, of which decimation leaves out many where there are many.
    ``closed_share`` of the triangles bound closed bodies, ``alpha_share`` are cut out by a texture. ``height_m`` and ``width_m``
    are a body's medians (of the relief: its range of heights); ``leaf_gap_m`` how wide leaves and the gaps between them are, in
    the mean.
    """

    kind: CasterKind
    count: Count = 1
    triangles: Count
    outside_triangles: Count = 0
    nodes: Count | None = None
    closed_share: Share = 0.0
    alpha_share: Share = 0.0
    height_m: AtLeastZero | None = None
    width_m: AtLeastZero | None = None
    leaf_gap_m: AtLeastZero | None = None


class CastBand(Facts):
    """The shadows of a kind of casters on what is seen from ``near_m`` to ``far_m`` away (a map: from 0, without end).

    ``share`` of all that is seen lies there, ``cast`` of that in these shadows. A pixel's side is ``pixel_m`` there, and the lamp
    ``light_m`` away (``None``: the sun). ``differs`` says for each texel of ``TEXEL_LADDER_PX`` how much of what is seen there
    differs in visibility from a point beside it, anywhere in a texel's square across the light: what a nearest look-up in a map of
    such texels gets wrong.
    """

    near_m: AtLeastZero
    far_m: Positive | None = None
    share: Share
    cast: Share
    pixel_m: Positive
    light_m: AtLeastZero | None = None
    differs: Annotated[tuple[Share, ...], Field(min_length=len(TEXEL_LADDER_PX), max_length=len(TEXEL_LADDER_PX))]

    @model_validator(mode="after")
    def _in_order(self) -> CastBand:
        if self.far_m is not None:
            _ascending("far_m", self.near_m, self.far_m)
        return self


class Casting(Facts):
    """The cast shadows of one kind of casters: their ``share`` of all that is seen, how much of that lies ``on_bodies`` and not on
    the ground (a share of all that is seen, too; ``None``: not known), by distance, nearest first, and how far they are thrown:
    ``thrown_m`` is the median distance from a point in shadow to what stands before the light (``None``: not known).
    """

    share: Share
    on_bodies: Share | None = None
    bands: tuple[CastBand, ...] = ()
    thrown_m: AtLeastZero | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Casting:
        _nearest_first(self.bands)
        return self


class LightFacts(Facts):
    """A light on what is seen.

    ``to_view_deg`` is the angle between the ways to the light and into the picture (``None``: no single way). ``facing_share`` of
    what is seen faces the light and lies in its cone, ``cast_share`` lies in cast shadow. ``area_share`` is what is seen as a share
    of all that the light's map would cover: of the level in the sun's light space, of a spot's cone, of an omni light's sphere.
    ``nearest_edge_m`` is how far from the eye the nearest edge of a shadow is seen (``None``: none is). ``silhouette_edges`` of the
    meshes are ``silhouette_px`` long where they fall into the picture, hidden or not, and a ray from the eye to what is seen passes
    ``volume_layers`` sides of their shadow volumes, in the mean. ``casts`` says what each kind of casters throws on what is seen.
    """

    to_view_deg: Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)] | None = None
    facing_share: Share = 1.0
    cast_share: Share = 0.0
    area_share: Share = 1.0
    nearest_edge_m: AtLeastZero | None = None
    silhouette_edges: Count = 0
    silhouette_px: AtLeastZero = 0.0
    volume_layers: AtLeastZero = 0.0
    casts: dict[CasterKind, Casting] = {}


def number(fact: Fact) -> float | None:
    """A fact that is a number; ``None``: not known. Raises ``InputError`` for a word that somebody has written in its place."""
    if isinstance(fact, str):
        raise InputError("facts", fact, "a number")
    return fact


def shares_add_up(shares: list[float], of: str) -> None:
    """Raise a ``PydanticCustomError`` where shares of one whole come to more than it."""
    if sum(shares) > 1.0 + SHARE_SUM_TOLERANCE:
        raise PydanticCustomError("shares", "the shares of {of} add up to {sum}, more than 1", {"of": of, "sum": sum(shares)})


def _nearest_first(bands: tuple[CastBand, ...]) -> None:
    shares_add_up([band.share for band in bands], "bands")
    for before, after in zip(bands, bands[1:], strict=False):
        if before.far_m is None or after.near_m < before.far_m:
            raise PydanticCustomError(
                "bands", "near_m {near} of a band is less than far_m of the band before", {"near": after.near_m}
            )


def _ascending(name: str, low: float, high: float) -> None:
    if high <= low:
        raise PydanticCustomError("order", "{name} {high} is not more than {low}", {"name": name, "high": high, "low": low})
