"""Types of the parts of a descriptor: facts of a scene and a view as plain numbers with units and validated ranges.

Users may write them by hand or send them as JSON. Unknown facts may be left out. An impossible value raises an error that names it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from skugga.terrain.errors import InputError
from skugga.terrain.level.level import CasterKind

TEXEL_SIZES_PX = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Texel sizes, in pixels, for which the descriptor states the error of nearest-neighbour shadow-map look-ups."""

FiniteNumber = Annotated[float, Field(allow_inf_nan=False)]
AtLeastZero = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]
Slope = Annotated[float, Field(ge=0, le=90, allow_inf_nan=False)]
FinitePoint = tuple[FiniteNumber, FiniteNumber, FiniteNumber]

Fact = float | bool | str | None
"""A further fact that an effect needs. ``None`` means unknown."""

SHARE_SUM_TOLERANCE = 1e-6
"""Tolerance by which the sum of shares of one whole may exceed 1."""


class Facts(BaseModel):
    """Base of facts: immutable, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class LampFacts(Facts):
    """A light other than the sun.

    - ``name``, ``kind``: the name of the lamp, and ``spot`` or ``omni``.
    - ``cutoff_deg``: half angle of its cone, degrees; 180 for an omni light.
    - ``reference_m``: the distance for which the lamp is designed, metres.
    - ``reaches``: whether its light is visible in the view, alone or together with other dim lamps.
    - ``radius_m``: radius of the luminous sphere, metres; 0 for a point light.
    """

    name: Annotated[str, Field(min_length=1)]
    kind: Literal["spot", "omni"]
    cutoff_deg: Annotated[float, Field(gt=0, le=180, allow_inf_nan=False)]
    reference_m: Positive
    reaches: bool = True
    radius_m: AtLeastZero = 0.0


class Band(Facts):
    """The visible surfaces in one band of distances from the eye.

    - ``near_m``, ``far_m``: limits of the band, metres; ``far_m`` is the next power of two.
    - ``share``: share of all visible surfaces.
    - ``low_light_m``, ``high_light_m``: bounds in light space, metres.
    """

    near_m: Positive
    far_m: Positive
    share: Share
    low_light_m: FinitePoint
    high_light_m: FinitePoint

    @model_validator(mode="after")
    def _validate_order(self) -> Band:
        _check_ascending("far_m", self.near_m, self.far_m)
        for low, high in zip(self.low_light_m, self.high_light_m, strict=True):
            if high < low:
                raise PydanticCustomError(
                    "bounds", "high_light_m {high} is less than low_light_m {low}", {"high": high, "low": low}
                )
        return self


class CasterFacts(Facts):
    """One kind of casters in a scene.

    - ``kind``: the kind of casters.
    - ``count``: number of bodies, or of trees as the view draws them; 1 for the relief.
    - ``triangles``: number of triangles that cast shadows: of the ground that the view draws (of a map: of a block), of the meshes,
      or of all trees.
    - ``outside_triangles``: number of ground triangles beyond a map's block that are drawn to cast into it, estimated from the
      sun's altitude and the relief.
    - ``nodes``: number of nodes of the level's ground; only for the relief in perspective. Decimation of large levels draws far
      fewer.
    - ``closed_share``: share of the triangles that belong to closed bodies.
    - ``alpha_share``: share of the triangles that are alpha-tested.
    - ``height_m``, ``width_m``: median size of a body, metres; ``height_m`` of the relief is the range of its heights.
    - ``leaf_gap_m``: mean width of leaves and of the gaps between them, at the size of the median tree, metres.
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
    """The shadows of one kind of casters on the visible surfaces in one band of distances from the eye.

    - ``near_m``, ``far_m``: limits of the band, metres; a map has one band from 0 without an upper limit (``None``).
    - ``share``: share of all visible surfaces that lies in the band.
    - ``cast``: share of the band that lies in these shadows.
    - ``pixel_m``: side of a pixel in the band, metres.
    - ``light_m``: distance of the lamp, metres; ``None`` for the sun.
    - ``differs``: for each texel size of ``TEXEL_SIZES_PX`` (0.25, 0.5, 1, 2, 4, 8, 16 and 32 pixels) the share of the band whose
      visibility differs from that of a point beside it. This point is drawn evenly from a texel-sized square perpendicular to the
      light, and compared on the plane of the visible surface. The share is the error of a nearest-neighbour look-up in a shadow map
      with such texels. Along a straight shadow edge it is a strip a quarter of a texel wide.
    """

    near_m: AtLeastZero
    far_m: Positive | None = None
    share: Share
    cast: Share
    pixel_m: Positive
    light_m: AtLeastZero | None = None
    differs: Annotated[tuple[Share, ...], Field(min_length=len(TEXEL_SIZES_PX), max_length=len(TEXEL_SIZES_PX))]

    @model_validator(mode="after")
    def _validate_order(self) -> CastBand:
        if self.far_m is not None:
            _check_ascending("far_m", self.near_m, self.far_m)
        return self


class Casting(Facts):
    """The cast shadows of one kind of casters on the visible surfaces, as if the other kinds were absent.

    - ``share``: share of all visible surfaces that lies in these shadows.
    - ``on_bodies``: share of all visible surfaces that lies in these shadows and is not ground; ``None`` if unknown.
    - ``bands``: the shadows by distance from the eye, nearest first.
    - ``thrown_m``: median distance from a point in shadow to its occluder, metres; ``None`` if unknown, as of relief.
    """

    share: Share
    on_bodies: Share | None = None
    bands: tuple[CastBand, ...] = ()
    thrown_m: AtLeastZero | None = None

    @model_validator(mode="after")
    def _validate_order(self) -> Casting:
        _check_order(self.bands)
        return self


class LightFacts(Facts):
    """The effect of one light on the visible surfaces.

    - ``to_view_deg``: angle between the direction to the light and the view axis, degrees; ``None`` without a single direction,
      as in maps and for omni lights.
    - ``eye_to_lamp_m``: distance from the eye to the lamp, metres; ``None`` for the sun and in a map view.
    - ``facing_share``: share of the visible surfaces that faces the light and lies in its cone.
    - ``cast_share``: share of the visible surfaces that lies in cast shadow.
    - ``area_share``: extent of the visible surfaces as a share of the area of the light's shadow map. A map of the sun covers the
      level in light space, a map of a spot its cone, a map of an omni light its sphere.
    - ``nearest_edge_m``: distance from the eye to the nearest visible shadow edge, metres; ``None`` if no edge is visible.
    - ``silhouette_edges``: number of edges of the meshes' silhouettes.
    - ``silhouette_px``: total length of these edges in the picture, hidden ones included, pixels.
    - ``ground_casting_share``: share of the triangles of a perspective view's ground that make shadow volumes: those that face away
      from the light, or all if the ground has gaps; ``None`` if unknown.
    - ``volume_layers``: mean number of sides of the meshes' shadow volumes between the eye and the visible surface; perspective
      views only.
    - ``casts``: the cast shadows of each kind of casters.
    """

    to_view_deg: Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)] | None = None
    eye_to_lamp_m: AtLeastZero | None = None
    facing_share: Share = 1.0
    cast_share: Share = 0.0
    area_share: Share = 1.0
    nearest_edge_m: AtLeastZero | None = None
    silhouette_edges: Count = 0
    silhouette_px: AtLeastZero = 0.0
    ground_casting_share: Share | None = None
    volume_layers: AtLeastZero = 0.0
    casts: dict[CasterKind, Casting] = {}


def numeric_fact(fact: Fact) -> float | None:
    """Return a fact as a number, or ``None`` if it is unknown. Raises ``InputError`` for text."""
    if isinstance(fact, str):
        raise InputError("facts", fact, "a number")
    return fact


def check_share_sum(shares: list[float], parts_name: str) -> None:
    """Raise a ``PydanticCustomError`` if shares of one whole add up to more than 1."""
    if sum(shares) > 1.0 + SHARE_SUM_TOLERANCE:
        raise PydanticCustomError(
            "shares", "the shares of {of} add up to {sum}, more than 1", {"of": parts_name, "sum": sum(shares)}
        )


def _check_order(bands: tuple[CastBand, ...]) -> None:
    """Raise a ``PydanticCustomError`` if bands overlap, do not ascend, or have shares that add up to more than 1."""
    check_share_sum([band.share for band in bands], "bands")
    for before, after in zip(bands, bands[1:], strict=False):
        if before.far_m is None or after.near_m < before.far_m:
            raise PydanticCustomError(
                "bands", "near_m {near} of a band is less than far_m of the band before", {"near": after.near_m}
            )


def _check_ascending(name: str, low: float, high: float) -> None:
    """Raise a ``PydanticCustomError`` unless ``high``, the value of the field ``name``, exceeds ``low``."""
    if high <= low:
        raise PydanticCustomError("order", "{name} {high} is not more than {low}", {"name": name, "high": high, "low": low})
