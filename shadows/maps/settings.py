"""The settings of depth maps, resolved: the sun's, a lamp's, and those of a perspective map."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from skugga.shadows.algorithm import AlgorithmSettings, AreaSettings

MapFit = Literal["stable", "tight"]
"""Where a sun's map lies: on a fixed lattice, so that texels never move against the ground, or close round the receivers."""

MapBias = Literal["receiver_plane", "normal_offset", "polygon_offset"]
"""What keeps a surface from shading itself: derived in ``docs/shadow-maps.md``."""

MapFilter = Literal[1, 2, 3, 5, "sun"]
"""Taps a side of a map's look-up, or the penumbra of the light's disc or ball."""

Culling = Literal["none", "front"]
"""Faces of closed casters that are left out of a map."""


class Cascade(BaseModel):
    """One of a sun's maps: for what lies up to ``far_m`` from the eye and beyond the cascade before (``None``: for all the rest).

    ``texel_m`` are the sides of a texel in light space (right, up), ``depth_step_m`` the metres between two depths that the map
    can tell apart.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    far_m: float | None
    texel_m: tuple[float, float]
    depth_step_m: float = Field(gt=0)


class ShadowMapSettings(AlgorithmSettings):
    """Settings of a sun's shadow map, resolved: one for all blocks of a (level, zoom, sun).

    ``map_size`` are the texels a side of each of the ``cascades``, from the nearest on (one in map views), ``filter`` the taps a
    side, or ``sun`` for the penumbra of the sun's disc. ``bias_scale`` multiplies the derived offset (1 is right; less shows acne).
    """

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: MapFilter
    fit: MapFit = "stable"
    bias: MapBias = "receiver_plane"
    culling: Culling = "none"
    cascades: tuple[Cascade, ...] = Field(min_length=1, max_length=4)
    bias_scale: float = Field(default=1.0, ge=0)

    @property
    def asked_as(self) -> dict[str, Any]:
        """The same as a level's ``shadows`` would ask for them: of the cascades it has the number."""
        return super().asked_as | {"cascades": len(self.cascades)}

    @property
    def label(self) -> list[str]:
        """Texels a side, taps a side, bits, and what is not as it is by itself."""
        several = [f"{len(self.cascades)}cascades"] if len(self.cascades) > 1 else []
        return [str(self.map_size), str(self.filter), str(self.depth_bits), *several, *self.changed()]


class LampMapSettings(AreaSettings):
    """Settings of a spot's shadow map, or of each of an omni light's six: texels a side, bits of depth, taps a side, or ``sun`` for
    the penumbra of the lamp's ball: a map from each of many points of it.
    """

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: MapFilter
    bias: MapBias = "receiver_plane"
    culling: Culling = "none"
    bias_scale: float = Field(default=1.0, ge=0)

    @property
    def label(self) -> list[str]:
        """Texels a side, taps a side, bits, and what is not as it is by itself."""
        return [str(self.map_size), str(self.filter), str(self.depth_bits), *self.changed()]


class PerspectiveMapSettings(AreaSettings):
    """Settings of a perspective shadow map: texels a side, bits of depth, taps a side, or ``sun`` for the penumbra of the light's
    disc or ball: a map for each of many points of it.

    It is fitted closely, compared on triangles that are known, and drawn whole: these are no choices of its own.
    """

    bias: ClassVar[MapBias] = "receiver_plane"
    culling: ClassVar[Culling] = "none"

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: MapFilter
    bias_scale: float = Field(default=1.0, ge=0)

    @property
    def label(self) -> list[str]:
        """Texels a side, taps a side, bits."""
        return [str(self.map_size), str(self.filter), str(self.depth_bits), *self.changed()]
