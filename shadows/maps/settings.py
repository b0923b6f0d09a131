"""The resolved settings of depth maps: the sun's, a lamp's, and those of a perspective shadow map.

A perspective shadow map is the method of Stamminger and Drettakis 2002, "Perspective shadow maps".
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from skugga.shadows.algorithm_settings import AlgorithmSettings, AreaLightSettings

MapFit = Literal["stable", "tight"]
"""Position of a sun's map: ``stable`` on a lattice fixed to the ground, where texels never move, or ``tight`` around receivers."""

MapBias = Literal["receiver_plane", "normal_offset", "polygon_offset", "slope_clamped"]
"""Bias that keeps a surface from shading itself; ``docs/shadow-maps.md`` derives each.

``polygon_offset`` has the factor 1.1. On a slope, the centres of n taps a side, texels of side t, are nearer to the light by up to
(n/2) t (|dz/dx| + |dz/dy|) <= n t max(|dz/dx|, |dz/dy|), so n would be needed.

Rounding adds e for float32 positions (8 units in the last place of the largest coordinate), half a depth step and another e for the
map, and on known triangles the slope times (t/128 + e).
"""

SLOPE_BIAS, SLOPE_BIAS_LIMIT = 0.0005, 0.005
"""The bias ``slope_clamped`` on a slope of 45 degrees to the light, and its upper bound, as shares of the map's depth.

The bound is that of shaders of textbooks, in which the factor is tuned for each scene.
"""

MapFilter = Literal[1, 2, 3, 5, "sun"]
"""Taps along a side of a map's look-up; ``sun``: the penumbra of the light's disc or ball."""

Culling = Literal["none", "front"]
"""Faces of closed casters that a map leaves out."""


class Cascade(BaseModel):
    """One of a sun's maps.

    It serves points up to ``far_m`` from the eye, beyond the previous cascade (``None``: all remaining points). ``texel_m`` are the
    sides of a texel in light space (right, up). ``depth_step_m`` is the smallest difference of depths that the map resolves, in
    metres.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    far_m: float | None
    texel_m: tuple[float, float]
    depth_step_m: float = Field(gt=0)


class ShadowMapSettings(AlgorithmSettings):
    """Resolved settings of a sun's shadow map, shared by all blocks of a level, a zoom and a sun.

    ``map_size`` are the texels along a side of each of the ``cascades``, from the nearest on (one in map views). ``filter`` are the
    taps along a side, or ``sun`` for the penumbra of the sun's disc. ``bias_scale`` multiplies the derived offset (1 is right; less
    shows acne).
    """

    map_size: int = Field(
        ge=64,
        le=8192,
        description="Texels along a side. `auto`: 512 to 4096, so that a texel covers 0.4 pixels of a map, 2 of a perspective "
        "view at its worst, 3 where trees cast. Use more where edges show stairs.",
    )
    depth_bits: Literal[16, 24, 32] = Field(
        description="Bits of depth. `auto`: 16 where a step moves a shadow by at most a quarter pixel, else 24; 32 for lamps, "
        "whose depths are uneven."
    )
    filter: MapFilter = Field(
        description="Taps along a side, or `sun` for penumbrae. `auto`: 3 where texels are finer than most penumbrae, else 1. "
        "More taps make edges smoother, and wider by texels. A lamp with a radius has penumbrae, one without 3 "
        "taps."
    )
    fit: MapFit = Field(
        default="stable",
        description="`auto`: `stable`, where texels keep to a lattice on the ground, so that nothing crawls and blocks join. "
        "`tight` spends every texel on visible surfaces. It is for stills; services refuse it.",
    )
    bias: MapBias = Field(
        default="receiver_plane",
        description="`auto`: `receiver_plane`, which works at any slope. The others are for comparison: `slope_clamped` "
        "shows acne on coarse maps, and peter-panning in deep ones.",
    )
    culling: Culling = Field(
        default="none",
        description="`auto`: `none`. `front` omits lit faces of closed meshes. With `receiver_plane` it gains nothing.",
    )
    cascades: tuple[Cascade, ...] = Field(
        min_length=1,
        max_length=4,
        description="Maps of a perspective view, each for a range of distances. `auto`: the number (1 to 4) with the fewest "
        "texels in total; 1 in map views. Each draws the casters once more.",
    )
    bias_scale: float = Field(
        default=1.0,
        ge=0,
        description="Factor of the derived bias; 1 is right. 0 shows acne: surfaces shade themselves, in bands across slopes. "
        "20 with `normal_offset` or `polygon_offset` shows peter-panning: shadows begin late, and thin ones are "
        "lost. With `receiver_plane` any factor but 1 shows acne.",
    )

    @property
    def as_overrides(self) -> dict[str, Any]:
        """The settings as keys and values of a level's ``shadows``, with the number of cascades."""
        return super().as_overrides | {"cascades": len(self.cascades)}

    @property
    def label_parts(self) -> list[str]:
        """Texels and taps along a side, bits, the number of cascades, and other values that differ from their defaults."""
        several = [f"{len(self.cascades)}cascades"] if len(self.cascades) > 1 else []
        return [str(self.map_size), str(self.filter), str(self.depth_bits), *several, *self.changed_values()]


class LampMapSettings(AreaLightSettings):
    """Settings of a spot's shadow map, or of each of an omni light's six.

    They are texels along a side, bits of depth, and taps along a side. The filter ``sun`` shows the penumbra of the lamp's ball, by
    a map from each of many points of it.
    """

    map_size: int = Field(ge=64, le=8192)
    depth_bits: Literal[16, 24, 32]
    filter: MapFilter
    bias: MapBias = "receiver_plane"
    culling: Culling = "none"
    bias_scale: float = Field(default=1.0, ge=0)

    @property
    def label_parts(self) -> list[str]:
        """Texels and taps along a side, bits, and other values that differ from their defaults."""
        return [str(self.map_size), str(self.filter), str(self.depth_bits), *self.changed_values()]


class PerspectiveMapSettings(AreaLightSettings):
    """Settings of a perspective shadow map: texels along a side, bits of depth, and taps along a side.

    The filter ``sun`` shows the penumbra of the light's disc or ball, by a map for each of many points of it. The map always has a
    tight fit, the bias ``receiver_plane`` and no culling. ``slide_back`` ``off`` leaves the virtual camera at the real one.
    """

    bias: ClassVar[MapBias] = "receiver_plane"
    culling: ClassVar[Culling] = "none"

    map_size: int = Field(ge=64, le=8192, description="Texels along a side. `auto`: 1024.")
    depth_bits: Literal[16, 24, 32] = Field(description="Bits of depth. `auto`: 24 under the sun, 32 under a spot.")
    filter: MapFilter = Field(
        description="Taps along a side, or `sun` for penumbrae, the mean of maps from points of the light. `auto`: 3, or 1 "
        "where no penumbra is a pixel wide."
    )
    bias_scale: float = Field(default=1.0, ge=0, description="Factor of the derived bias. 1 is right, others show acne.")
    slide_back: Literal["auto", "off"] = Field(
        default="auto",
        description="`auto`: the virtual camera slides back to where texels are smallest. `off` leaves it at the real one: "
        "texels without a slide-back. It has no effect on `light_space_perspective_map`.",
    )

    @property
    def label_parts(self) -> list[str]:
        """Texels and taps along a side, bits, and other values that differ from their defaults."""
        no_slide_back = ["no_slide_back"] if self.slide_back == "off" else []
        return [
            str(self.map_size), str(self.filter), str(self.depth_bits), *self.changed_values("slide_back"), *no_slide_back,
        ]  # fmt: skip
