"""The product ``irradiation``: the energy of sunlight and skylight over dates, with the terrain in the way."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from skugga.api.color_scale import ColorScale
from skugga.api.products.product import Product, ProductInput, ProductOptions
from skugga.terrain.errors import UnsupportedError

if TYPE_CHECKING:
    from skugga.shadows.irradiation.irradiation import IrradiationRules
    from skugga.terrain.geo.daily_windows import DailyWindow
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.geo.world import World
    from skugga.terrain.scene import Scene

PRODUCT_NAME = "irradiation"

UNIT = "kWh/m2"

STEP_MIN = 60.0
"""Default minutes between two suns."""

LEGEND_TICKS = 5
"""Number of ticks of a legend."""

SLOPE_GAIN = 1.25
"""End of the colour scale over the light on open level ground: slopes towards the sun receive more than that."""

Date = datetime.date  # an alias, because the model has a field called ``date``

IrradiationPart = Literal["total", "beam", "circumsolar", "sky", "horizon_band", "reflected"]

PARTS: dict[IrradiationPart, str] = {
    "total": "irradiation",
    "beam": "irradiation by direct sunlight",
    "circumsolar": "irradiation by the sky around the sun",
    "sky": "irradiation by the isotropic sky",
    "horizon_band": "irradiation by the sky's band at the horizon",
    "reflected": "irradiation reflected by the ground around",
}
"""Description by part."""

PLANES = ("ground", "level")


class IrradiationOptions(ProductOptions):
    """Options of irradiation: the dates, the part of the light, the plane that receives it, and the air and the ground around."""

    UNSERVED: ClassVar[Mapping[str, Any]] = {"to": None, "step_min": STEP_MIN}

    date: Date = Field(description="The date, as 2024-03-21.", examples=["2024-03-21"])
    to: Date | None = Field(default=None, description="The last of several dates.", examples=["2024-06-21"])
    part: IrradiationPart = Field(default="total", description="The part of the light; default: `total`.", examples=["beam"])
    plane: Literal["ground", "level"] = Field(
        default="ground",
        description="The plane that receives light: `ground`, its own slope (the default), or `level`.",
        examples=["level"],
    )
    albedo: float = Field(default=0.2, ge=0.0, le=1.0, description="Albedo of the ground around.", examples=[0.6])
    linke: float | None = Field(
        default=None,
        ge=1.0,
        le=20.0,
        description="Linke's turbidity of the air; default: the place's monthly climate.",
        examples=[3],
    )
    clock: str = Field(
        default="solar", max_length=60, examples=["Europe/Oslo"],
        description="Clock of the dates: solar (the default), utc, +02:00 or Europe/Oslo.",
    )  # fmt: skip
    step_min: float = Field(default=STEP_MIN, ge=1.0, le=60.0, description="Minutes between two suns.")

    def windows(self, world: World) -> list[DailyWindow]:
        """Return the windows of the dates, which are whole days. Raises ``InputError``, also in a flat world."""
        from skugga.terrain.geo.clock import parse_clock
        from skugga.terrain.geo.daily_windows import MINUTES_PER_DAY, windows_between

        clock = parse_clock("clock", self.clock)
        return windows_between(world, self.date, self.to or self.date, 1, (0.0, MINUTES_PER_DAY), clock)

    @property
    def rules(self) -> IrradiationRules:
        """The rules that decide what counts as irradiation."""
        from skugga.shadows.irradiation.irradiation import IrradiationRules

        return IrradiationRules(self.part, self.plane, self.albedo, self.linke, self.step_min)


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return the irradiation of a part of the light, float32 (rows, cols), kWh/m2."""
    from skugga.shadows.irradiation.irradiation import irradiation

    scene, options = product_input.scene, product_input.options
    _check_map(scene, product_input.map_view)
    return irradiation(scene, product_input.map_view, options.windows(scene.world), options.rules, product_input.on_step)


def _check(scene: Scene) -> None:
    """Raise ``UnsupportedError`` for a level with objects on its ground, or with flat tops of cells."""
    from skugga.terrain.gbuffer.supersampling import is_terrain_only

    if not is_terrain_only(scene):
        raise UnsupportedError("layer", PRODUCT_NAME, "only for bare ground without objects, lamps or flat tops of cells")


def _check_map(scene: Scene, view: MapView) -> None:
    """Raise ``UnsupportedError`` for a level or a map that irradiation is not computed for."""
    _check(scene)
    if not view.is_on_nodes:
        raise UnsupportedError("layer", PRODUCT_NAME, "only for maps whose pixels are nodes of a grid")


def _blocks(scene: Scene, view: MapView, options: IrradiationOptions) -> list[tuple[MapView, int, int]]:
    """Return the blocks of a map, in the form that ``blocks_of`` returns."""
    from skugga.shadows.horizons.level_horizons import horizon_blocks

    return horizon_blocks(scene, view)


def _color_scale(options: IrradiationOptions, world: World) -> ColorScale:
    """Return the colour scale of a whole level: from 0 to some more than the light on open ground at sea level."""
    from skugga.shadows.irradiation.irradiation import light_sums_kwh
    from skugga.shadows.irradiation.light import clear_sky_light
    from skugga.shadows.irradiation.suns import sun_intervals

    windows = options.windows(world)
    place = world.anchor_lon_deg, world.anchor_lat_deg
    suns = sun_intervals(windows, options.step_min, *place)
    sums = light_sums_kwh(clear_sky_light(suns, *place, np.zeros(1), options.linke), suns, options.albedo)
    high = _round_end(SLOPE_GAIN * float(np.abs(sums[options.part][0])))
    ticks = tuple((float(value), f"{value:g}") for value in np.linspace(0.0, high, LEGEND_TICKS))
    title = f"{PARTS[options.part].capitalize()}, {UNIT}, {options.date.day} {options.date:%B %Y}"
    return ColorScale(title, "inferno", 0.0, high, ticks)


def _round_end(value: float) -> float:
    """Return a round number, 1, 2, 4 or 8 times a power of ten, that is not below a value; 1 for 0."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(multiple * power for multiple in (1.0, 2.0, 4.0, 8.0, 10.0) if multiple * power >= value * (1.0 - 1e-9)))


def _tags(options: IrradiationOptions, scene: Scene) -> dict[str, str]:
    """Return the metadata tags of a raster: the dates, the part, the plane, and the models of light."""
    windows = options.windows(scene.world)
    first, last = windows[0], windows[-1]
    return {
        "part": options.part, "plane": options.plane, "date": first.date.isoformat(),
        "date_to": "" if len(windows) == 1 else last.date.isoformat(), "dates": str(len(windows)), "clock": options.clock,
        "step_min": f"{options.step_min:g}", "albedo": f"{options.albedo:g}",
        "linke_turbidity": "monthly climate" if options.linke is None else f"{options.linke:g}",
        "weather": "clear sky (Ineichen and Perez 2002)", "sky": "Perez-Driesse 2024",
    }  # fmt: skip


def _date_count(options: IrradiationOptions) -> int:
    """Return the number of dates."""
    return ((options.to or options.date) - options.date).days + 1


PRODUCT = Product(
    name=PRODUCT_NAME, description="irradiation of a `date` under a clear sky, with the terrain in the way",
    formats=("png", "webp", "tif", "npy"), compute=_compute, view_kinds=("map",), when="days", options=IrradiationOptions,
    unit=UNIT, color_scale=_color_scale, describe=lambda options: (f"{PARTS[options.part]} under a clear sky", UNIT),
    blocks=_blocks, step_count=_date_count, tags=_tags, check=_check,
)  # fmt: skip
