"""Styles: colours and light of shaded relief. A style changes a picture's appearance, never the shadows' positions.

**Tint.** The ground's colour depends on its height in metres, in ``natural`` also on its latitude (``skugga.terrain.climate``). It
is the same in every level, so that two maps side by side agree. Lightness (CIE L*) never falls with height: higher ground is
lighter.

**Light.** Direct sunlight is warm and sky light blue, as outdoors. In sky light alone, colours lose some of their saturation.
Shadows are then bluish instead of a dark shade of the ground's own colour (E. Imhof, Cartographic Relief Presentation, 1965,
chapters 9 and 13). A clear sky is brighter on the sun's side. Slopes in shadow that face it get more of its light than others,
which keeps relief readable inside a cast shadow.

**Aerial perspective.** Contrast grows with height: low ground lies under a thin veil of air (Imhof, chapter 13). This applies to
maps only. In a perspective view the air lies between the eye and the ground (``skugga.terrain.effects.haze``).

**Slopes.** Shading may exaggerate slopes for flat country. It may also limit them, since the edges of buildings are slopes of a
raster and would show as black and white rims. Cast shadows use the true ground in both cases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from pydantic import ValidationError

from skugga.terrain.cache import MIB, cached
from skugga.terrain.climate import climate_srgb, ramp_srgb
from skugga.terrain.color_ramp import ColorRamp
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import Level
from skugga.terrain.level.level_errors import allowed_phrase
from skugga.terrain.level.parts import SkyName, StyleSpec
from skugga.terrain.srgb import linear_of_srgb

TINT_MIN_HEIGHT_M, TINT_HEIGHT_STEP_M, TINT_HEIGHT_COUNT = -512.0, 8.0, 1193
"""Heights in metres at which a colour ramp is tabulated: -512 to 9,024 m. Beyond them its colours are constant."""

MAX_URBAN_CELL_M = 2.5
"""Ground with smaller cells counts as a city's surface, unless it is a wood."""

MIN_WOODED_CROWN_SHARE = 0.25
"""Share of the ground under crowns from which on it counts as a wood.

Canopy rasters give 0.02 in Gothenburg, 0.09 in Bilbao, and 0.34 in an open wood in Quebec.
"""

EXAGGERATION_EXPONENT, MAX_EXAGGERATION = 0.25, 3.0
"""Power by which slopes grow with a map's pixel size beyond ``min_exaggerated_pixel_m``, and the maximum factor."""

GENERALISED_PIXELS_M = 100.0, 400.0
"""Sides of a map's pixels from which on slopes are generalised, and fully so: zooms 10 and 8 of web maps in the Alps."""

UNLIMITED_SLOPE = 1e3
"""A slope limit without effect."""


@dataclass(frozen=True)
class Style:
    """The parameters of shaded relief.

    Attributes
    ----------
    name
        The style's name.
    description
        A description in one phrase.
    ramp
        Heights in metres above the level's zero, ascending, and the ground's sRGB colour at each.
    has_latitude_tints
        Whether the ramp is that of middle latitudes, so that other latitudes get ice, tundra and deserts.
    water_albedo
        Linear albedo (3,) of standing water in a map.
    sunlight_color, sky_light_color
        Linear colours (3,) of direct light and of the sky's light.
    sky_light_desaturation
        Desaturation in the sky's light towards grey of the same luminance, 0 to 1.
    sky
        The sky of maps: ``even``; or ``clear`` or ``overcast``, a CIE sky with shadows (``skugga.terrain.effects.sky_light``).
    sunward_sky_light_share
        Share of the sky's light that comes from the sun's side, 0 to 1.
    terminator_light_share
        Share of level ground's direct light below which slopes fade into attached shadow; 0: Lambert's law alone.
    texture_strength
        Maximum share by which ridges and valleys of a map change the sky's light (``skugga.terrain.effects.texture_shading``).
    air_veil_share, air_veil_scale_height_m
        Share of the veil at height 0, and the height in metres over which it falls to 1/e.
    slope_exaggeration, max_shaded_slope
        Factor of slopes in shading, and the upper limit (a tangent) of exaggerated slopes.
    local_light
        Largest turn, in degrees, of the light that shades relief along it, in maps (``skugga.terrain.gbuffer.landforms``).
    generalisation
        Share of large landforms in slopes of maps of small scale, 0 to 1 (``generalisation_at``).
    min_exaggerated_pixel_m
        Side of a map's pixels in metres. In maps with larger pixels slopes are exaggerated more (``slope_exaggeration_at``). Pixels
        of a country's map are means over whole valleys, whose slopes are too gentle to see.
    has_natural_ground
        Whether the ground shows land. Otherwise it is stone, or a neutral base for other colours or for shadows alone.
    """

    name: str
    description: str
    ramp: ColorRamp
    has_latitude_tints: bool = False
    water_albedo: tuple[float, float, float] = (0.102, 0.246, 0.392)
    sunlight_color: tuple[float, float, float] = (1.0, 0.95, 0.86)
    sky_light_color: tuple[float, float, float] = (0.62, 0.76, 1.0)
    sky_light_desaturation: float = 0.6
    sky: SkyName = "even"
    sunward_sky_light_share: float = 0.75
    terminator_light_share: float = 0.5
    texture_strength: float = 0.55
    air_veil_share: float = 0.0
    air_veil_scale_height_m: float = 1500.0
    slope_exaggeration: float = 1.0
    max_shaded_slope: float = UNLIMITED_SLOPE
    local_light: float = 0.0
    generalisation: float = 0.0
    min_exaggerated_pixel_m: float = 60.0
    has_natural_ground: bool = True

    def slope_exaggeration_at(self, pixel_m: float) -> float:
        """Return the factor of slopes in a map whose pixels have a side of ``pixel_m`` metres."""
        pixel_factor = (pixel_m / self.min_exaggerated_pixel_m) ** EXAGGERATION_EXPONENT
        return self.slope_exaggeration * float(np.clip(pixel_factor, 1.0, MAX_EXAGGERATION))

    def generalisation_at(self, pixel_m: float) -> float:
        """Return the share of large landforms in the slopes of a map, 0 to 1.

        It grows with the logarithm of the pixels' side ``pixel_m`` in metres, from 0 at ``GENERALISED_PIXELS_M``'s first value.
        """
        first, last = np.log(GENERALISED_PIXELS_M)
        return self.generalisation * float(np.clip((np.log(pixel_m) - first) / (last - first), 0.0, 1.0))


STYLES = {
    style.name: style
    for style in (
        Style(
            "natural", "colours of land by its height and latitude, soft bluish shadows",
            ((0.0, "#a9be98"), (250.0, "#b7c79f"), (600.0, "#c7cea4"), (1100.0, "#d5d2aa"), (1700.0, "#dad2b0"),
             (2400.0, "#dcd3bd"), (3100.0, "#e0d9ce"), (3800.0, "#e9e6e1"), (4600.0, "#f6f6f6"), (6000.0, "#fdfdfe")),
            has_latitude_tints=True, air_veil_share=0.06,
        ),
        Style(
            "swiss", "after Swiss relief maps: warm light, violet-blue shade, air over the valleys",
            ((0.0, "#a9bdb4"), (400.0, "#b6c7b2"), (900.0, "#c9d2b4"), (1600.0, "#dcdabb"), (2400.0, "#ebe3c8"),
             (3200.0, "#f6efdd"), (4200.0, "#fffdf6")),
            sunlight_color=(1.0, 0.93, 0.76), sky_light_color=(0.60, 0.68, 1.0), sky_light_desaturation=0.7,
            sky="clear", sunward_sky_light_share=0.8, air_veil_share=0.22,
            slope_exaggeration=1.25, local_light=30.0, generalisation=0.65,
        ),
        Style(
            "grey", "neutral grey, as a base for other colours",
            ((0.0, "#e3e3e3"),),
            water_albedo=(0.36, 0.36, 0.36), sunlight_color=(1.0, 1.0, 1.0), sky_light_color=(0.78, 0.78, 0.78),
            sky_light_desaturation=1.0, has_natural_ground=False,
        ),
        Style(
            "urban", "light stone for streets and roofs; the edges of buildings are not exaggerated",
            ((0.0, "#e4e0d8"),),
            sky_light_desaturation=0.8, sunward_sky_light_share=0.3, texture_strength=0.0, max_shaded_slope=0.7,
            has_natural_ground=False,
        ),
        Style(
            "analysis", "white ground, plain Lambert's law, even blue shadow: to look at the shadows themselves",
            ((0.0, "#f4f4f4"),),
            sunlight_color=(1.0, 1.0, 1.0), sky_light_color=(0.42, 0.60, 1.0), sky_light_desaturation=1.0,
            sunward_sky_light_share=0.0, texture_strength=0.0,
            terminator_light_share=0.0, min_exaggerated_pixel_m=np.inf, has_natural_ground=False,
        ),
    )
}  # fmt: skip


def has_directional_sky(style: Style) -> bool:
    """Return whether a style's maps are lit by a sky whose brightness depends on the direction."""
    return style.sky != "even"


def style_of(level: Level, spec: StyleSpec, cell_m: float, crown_area_share: Callable[[], float]) -> Style:
    """Return the requested style with the level's colour ramp and exaggeration of slopes.

    The style ``auto`` is ``urban`` on a raster with fine cells or upright blocks, unless the ground is a wood. Otherwise it is
    ``natural``. ``cell_m`` is the side of the raster's cells in metres. ``crown_area_share`` returns the share of ground under
    crowns. It is called only if it matters.
    """
    name = spec.name
    if name == "auto":
        is_fine = level.terrain.surface == "blocks" or (level.terrain.source is not None and cell_m < MAX_URBAN_CELL_M)
        name = "urban" if is_fine and crown_area_share() < MIN_WOODED_CROWN_SHARE else "natural"
    style = STYLES[name]
    if spec.ramp is not None:
        style = replace(style, ramp=spec.ramp, has_latitude_tints=False)
    if spec.sky is not None:
        style = replace(style, sky=spec.sky)
    if spec.local_light is not None:
        style = replace(style, local_light=spec.local_light)
    if spec.generalisation is not None:
        style = replace(style, generalisation=spec.generalisation)
    return replace(style, slope_exaggeration=style.slope_exaggeration * spec.slope_exaggeration)


def style_spec(
    level_style: StyleSpec,
    name: str | None,
    slope_exaggeration: float | None,
    sky: str | None = None,
    ramp: ColorRamp | None = None,
    local_light: float | None = None,
    generalisation: float | None = None,
) -> StyleSpec:
    """Return a level's style with a request's changes (``None``: no change). Raises ``InputError``.

    A style given by name does not use the level's colour ramp, but that of the request.
    """
    changes = {
        "name": name,
        "slope_exaggeration": slope_exaggeration,
        "sky": sky,
        "ramp": ramp,
        "local_light": local_light,
        "generalisation": generalisation,
    }
    changes = {key: value for key, value in changes.items() if value is not None}
    try:
        return StyleSpec.model_validate({**(level_style.model_dump(exclude={"ramp"} if name is not None else set())), **changes})
    except ValidationError as error:
        detail = error.errors()[0]
        key = str(detail["loc"][0])
        words = {"name": ("auto", *STYLES), "sky": get_args(SkyName)}
        allowed = ", ".join(words[key]) if key in words else allowed_phrase(detail)
        raise InputError("style" if key == "name" else key, changes[key], allowed) from None


@cached("process", 16 * MIB)
def tint_table(ramp: ColorRamp, has_latitude_tints: bool = False) -> np.ndarray:
    """Return the ground's linear colours (m, n, 3) by latitude and height.

    The m latitudes are ``TINT_LATITUDE_ROWS`` even steps of the latitude's sine; without a climate m is 1. The n heights are
    ``TINT_MIN_HEIGHT_M + k * TINT_HEIGHT_STEP_M``. Colours between a ramp's heights are mixed in sRGB.
    """
    heights = TINT_MIN_HEIGHT_M + TINT_HEIGHT_STEP_M * np.arange(TINT_HEIGHT_COUNT)
    return linear_of_srgb(climate_srgb(ramp, heights) if has_latitude_tints else ramp_srgb(ramp, heights)[None])


@cached("process", MIB)
def veil_table(share: float, scale_height_m: float) -> np.ndarray:
    """Return the share (n,) of the veil of air in the ground's colour, at the heights of ``tint_table``.

    It is ``share`` at height 0 and below, and falls to 1/e of it over ``scale_height_m`` metres.
    """
    heights = TINT_MIN_HEIGHT_M + TINT_HEIGHT_STEP_M * np.arange(TINT_HEIGHT_COUNT)
    return share * np.exp(-np.maximum(heights, 0.0) / scale_height_m)
