"""The product ``irradiation``: the energy of sunlight and skylight over dates, with the terrain in the way."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from skugga.api.color_scale import ColorScale
from skugga.api.file_stamps import file_stamps
from skugga.api.products.product import Product, ProductInput, ProductOptions
from skugga.api.raster_profile import RasterProfile
from skugga.terrain.errors import InputError, UnsupportedError
from skugga.terrain.geo.sun_path import SUPPORTED_YEARS

if TYPE_CHECKING:
    from skugga.api.month_folder import MonthFolder
    from skugga.shadows.irradiation.dates import Dates
    from skugga.shadows.irradiation.irradiation import IrradiationRules
    from skugga.shadows.irradiation.weather import Weather
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.geo.world import World
    from skugga.terrain.scene import Scene

PRODUCT_NAME = "irradiation"

UNIT = "kWh/m2"

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

PERIODS = ("period", "month", "day", "hour")

BYTES_PER_BAND = 8
"""Bytes of memory for each cell of a band: its sum, and that of the month that is being computed."""

MAX_CONVERGENCE_DEG = 0.5
"""Maximum turn of true north in a block.

The sun's direction is that at the block's centre, and sums over all azimuths do not depend on where north is. So only the azimuth
of tilted planes and the minutes of sunrise vary within a block. Wider blocks find fewer casters beside them.
"""

MAX_BANDS = 400
"""Limit of the bands of a raster: a value for each day of a year, or for each hour of two weeks."""


class IrradiationOptions(ProductOptions):
    """Options of irradiation: the dates, the part of the light, the plane that receives it, and the air and the ground around."""

    UNSERVED: ClassVar[Mapping[str, Any]] = {
        "to": None, "days": "mean", "per": "period", "by_part": False, "step_min": None, "weather": None,
        "weather_columns": None, "checkpoint": None,
    }  # fmt: skip

    date: Date | None = Field(default=None, description="The date, as 2024-03-21.", examples=["2024-03-21"])
    to: Date | None = Field(default=None, description="The last of several dates.", examples=["2024-06-21"])
    year: int | None = Field(
        default=None, ge=SUPPORTED_YEARS[0] + 1, le=SUPPORTED_YEARS[1] - 1, examples=[2023],
        description="A whole year instead of a date, from the mean days of its months.",
    )  # fmt: skip
    days: Literal["all", "mean"] = Field(
        default="all", description="`all`: every date (the default). `mean`: one day for each month, by its number of days."
    )
    per: Literal["period", "month", "day", "hour"] = Field(
        default="period", description="A band for all dates together (`period`, the default), or for each `month`, `day` or `hour`."
    )
    part: IrradiationPart = Field(default="total", description="The part of the light; default: `total`.", examples=["beam"])
    by_part: bool = Field(default=False, description="A band for each part of the light, too.")
    plane: Literal["ground", "level"] = Field(
        default="ground",
        description="The plane that receives light: `ground`, its own slope (the default), or `level`.",
        examples=["level"],
    )
    tilt: float | None = Field(
        default=None, ge=0.0, le=180.0, examples=[35],
        description="Tilt of a plane on every cell, degrees, instead of `plane`: 0 faces up, 90 is a wall, 180 faces down.",
    )  # fmt: skip
    plane_azimuth: float | None = Field(
        default=None, ge=-360.0, le=360.0, examples=[180],
        description="Azimuth that this plane faces, degrees clockwise from true north; default: 180.",
    )  # fmt: skip
    albedo: float = Field(default=0.2, ge=0.0, le=1.0, description="Albedo of the ground around.", examples=[0.6])
    linke: float | None = Field(
        default=None,
        ge=1.0,
        le=20.0,
        description="Linke's turbidity of the air; default: the place's monthly climate.",
        examples=[3],
    )
    transmissivity: float = Field(
        default=0.0, ge=0.0, le=1.0, description="Share of the light that comes through crowns of trees.", examples=[0.1]
    )
    clock: str = Field(
        default="solar", max_length=60, examples=["Europe/Oslo"],
        description="Clock of the dates: solar (the default), utc, +02:00 or Europe/Oslo.",
    )  # fmt: skip
    step_min: float | None = Field(
        default=None, ge=1.0, le=60.0, description="Minutes between two suns; default: 60 for 28 dates and more, else 10."
    )
    weather: Path | None = Field(
        default=None, description="Weather file instead of a clear sky: EPW, TMY3, PVGIS's TMY, or CSV with columns of its own."
    )
    weather_columns: str | None = Field(
        default=None, max_length=500, description="Columns of a CSV: time=Date,ghi=Global:kJ/m2,clock=+01:00,stamp=end."
    )
    checkpoint: Path | None = Field(default=None, description="Folder that keeps finished months, to continue after a stop.")

    @model_validator(mode="after")
    def _check_together(self) -> IrradiationOptions:
        """Raise ``InputError`` for options that exclude each other, and for more bands than are allowed."""
        if self.year is not None:
            for name in ("date", "to"):
                if getattr(self, name) is not None:
                    raise InputError.conflict(name, "year")
        elif self.date is None:
            raise InputError.missing("date", f"{PRODUCT_NAME} needs a date, as 2024-03-21, or a year")
        elif self.to is not None and self.to < self.date:
            raise InputError("to", self.to.isoformat(), f"{self.date.isoformat()} or later")
        if self.tilt is None and self.plane_azimuth is not None:
            raise InputError.missing("tilt", "An azimuth needs the tilt of the plane")
        if self.tilt is not None and self.plane != "ground":
            raise InputError.conflict("plane", "tilt")
        if self.days == "mean" and self.per in ("day", "hour"):
            raise InputError.conflict("per", "days=mean")
        if self.weather is None and self.weather_columns is not None:
            raise InputError.missing("weather", "Columns are those of a weather file")
        if self.weather is not None:
            for name, is_given in (("days", self.days == "mean"), ("linke", self.linke), ("step_min", self.step_min)):
                if is_given not in (None, False):
                    raise InputError.conflict(name, "weather", "Leave it out: the file has its own light and its own steps")
        if (bands := self._band_count) > MAX_BANDS:
            raise InputError.over_limit("per", f"{bands} bands", str(MAX_BANDS), "Choose fewer dates or a longer period")
        return self

    @property
    def first_and_last(self) -> tuple[Date, Date]:
        """The first and the last date."""
        if self.year is not None:
            return datetime.date(self.year, 1, 1), datetime.date(self.year, 12, 31)
        assert self.date is not None
        return self.date, self.to or self.date

    @property
    def date_weights(self) -> Mapping[Date, float] | None:
        """The days that each date stands for; ``None``: every date is one day."""
        from skugga.shadows.irradiation.dates import mean_days

        return mean_days(*self.first_and_last) if self.days == "mean" and self.first_and_last[0] < self.first_and_last[1] else None

    @property
    def date_count(self) -> int:
        """The number of dates whose suns are swept."""
        first, last = self.first_and_last
        weights = self.date_weights
        return (last - first).days + 1 if weights is None else len(weights)

    @property
    def parts(self) -> tuple[IrradiationPart, ...]:
        """The parts of the light, one band each."""
        return tuple(PARTS) if self.by_part else (self.part,)

    def dates(self, world: World) -> Dates:
        """Return the dates with their windows, which are whole days. Raises ``InputError``, also in a flat world."""
        from skugga.shadows.irradiation.dates import Dates, all_dates
        from skugga.terrain.geo.clock import parse_clock
        from skugga.terrain.geo.daily_windows import MINUTES_PER_DAY, windows_between

        clock, (first, last) = parse_clock("clock", self.clock), self.first_and_last
        if (weights := self.date_weights) is None:
            windows = windows_between(world, first, last, 1, (0.0, MINUTES_PER_DAY), clock)
            if self.per == "hour" and any(abs(window.length_min - MINUTES_PER_DAY) > 30.0 for window in windows):
                raise InputError("clock", self.clock, "one without summer time on these dates: solar, utc or an offset")
            return all_dates(windows, self.per)
        windows = [windows_between(world, day, day, 1, (0.0, MINUTES_PER_DAY), clock)[0] for day in weights]
        return Dates(tuple(windows), tuple(weights.values()), self.per)

    @property
    def rules(self) -> IrradiationRules:
        """The rules that decide what counts as irradiation."""
        from skugga.shadows.irradiation.irradiation import IrradiationRules
        from skugga.shadows.irradiation.planes import Plane, TiltedPlane

        azimuth_deg = 180.0 if self.plane_azimuth is None else self.plane_azimuth
        plane: Plane = self.plane if self.tilt is None else TiltedPlane(self.tilt, azimuth_deg)
        return IrradiationRules(
            self.parts, plane, self.albedo, self.linke, self.used_step_min, self.transmissivity, self.per != "hour"
        )

    @property
    def used_step_min(self) -> float:
        """The minutes between two suns: those given, or the default for the dates."""
        from skugga.shadows.irradiation.suns import LONG_STEP_MIN, default_step_min

        if self.step_min is not None:
            return self.step_min
        return default_step_min(self.date_count) if self.date_weights is None else LONG_STEP_MIN

    def blocks(self, scene: Scene, view: MapView) -> list[tuple[MapView, int, int]]:
        """Return the blocks of a map, in the form that ``blocks_of`` returns; all bands of a block are in memory."""
        from skugga.shadows.horizons.level_horizons import horizon_blocks

        return horizon_blocks(scene, view, BYTES_PER_BAND * len(self.band_names) // 4, MAX_CONVERGENCE_DEG)

    def store_of(self, scene: Scene, block: MapView) -> MonthFolder | None:
        """Return where finished months of a block are kept; ``None`` if they are not."""
        from skugga.api.month_folder import MonthFolder

        if self.checkpoint is None:
            return None
        stamps = () if self.weather is None else file_stamps([self.weather])
        options = f"{self.model_dump_json(exclude={'checkpoint'})} {stamps}"
        return MonthFolder.of_request(self.checkpoint, scene.loaded, block, options)

    def read_weather(self) -> Weather | None:
        """Return the weather; ``None`` for a clear sky. Raises ``InputError``."""
        from skugga.api.weather_file import weather_of_file

        return None if self.weather is None else weather_of_file(self.weather, self.weather_columns)

    def warnings(self, scene: Scene) -> tuple[str, ...]:
        """Return warnings of weather that does not fit the place or the dates. Raises ``InputError``."""
        from skugga.shadows.irradiation.weather import check_weather_place, missing_weather

        if (weather := self.read_weather()) is None or scene.world.off_earth_reason is not None:
            return ()
        lon, lat = scene.world.anchor_lon_deg, scene.world.anchor_lat_deg
        on_place = check_weather_place(weather, lon, lat, float(np.mean(scene.height_range_m)))
        return (*weather.warnings, *on_place, *missing_weather(weather, self.dates(scene.world).windows, lon, lat))

    @property
    def plane_text(self) -> str:
        """The plane in words."""
        if self.tilt is None:
            return self.plane
        return f"tilt {self.tilt:g}, azimuth {180.0 if self.plane_azimuth is None else self.plane_azimuth:g}"

    @property
    def _band_count(self) -> int:
        """The number of bands."""
        first, last = self.first_and_last
        days = (last - first).days + 1
        months = 12 * (last.year - first.year) + last.month - first.month + 1
        return {"period": 1, "month": months, "day": days, "hour": 24 * days}[self.per] * len(self.parts)

    @property
    def band_names(self) -> tuple[str, ...]:
        """A description of each band: its period and its part."""
        return tuple(f"{PARTS[part]} {period}".strip() for period in self._period_names for part in self.parts)

    @property
    def _period_names(self) -> list[str]:
        """The name of each period; empty for all dates together."""
        if self.per == "period":
            return [""]
        first, last = self.first_and_last
        days = [first + datetime.timedelta(days=n) for n in range((last - first).days + 1)]
        if self.per == "month":
            return list(dict.fromkeys(f"{day:%Y-%m}" for day in days))
        if self.per == "day":
            return [day.isoformat() for day in days]
        return [f"{day.isoformat()} {hour:02d}:00" for day in days for hour in range(24)]


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return irradiation, float32 (rows, cols) or (rows, cols, bands), kWh/m2."""
    from skugga.shadows.irradiation.irradiation import irradiation

    scene, view, options = product_input.scene, product_input.map_view, product_input.options
    _check_map(scene, view)
    store = options.store_of(scene, view)
    dates, weather = options.dates(scene.world), options.read_weather()
    bands = irradiation(scene, view, dates, options.rules, product_input.on_step, store, weather)
    return bands[0] if len(bands) == 1 else np.moveaxis(bands, 0, -1)


def _check(scene: Scene) -> None:
    """Raise ``UnsupportedError`` for a level whose ground is flat tops of cells."""
    if scene.elevation.surface != "smooth":
        raise UnsupportedError("layer", PRODUCT_NAME, "only for smooth ground, not for flat tops of cells")


def _check_map(scene: Scene, view: MapView) -> None:
    """Raise ``UnsupportedError`` for a level or a map that irradiation is not computed for."""
    _check(scene)
    if not view.is_on_nodes:
        raise UnsupportedError("layer", PRODUCT_NAME, "only for maps whose pixels are nodes of a grid")


def _profile(options: IrradiationOptions) -> RasterProfile:
    """Return the form of rasters: a band for each period and part."""
    names = options.band_names
    return RasterProfile(bands=len(names), band_names=names if len(names) > 1 else ())


def _color_scale(options: IrradiationOptions, world: World) -> ColorScale:
    """Return the colour scale of a whole level: from 0 to some more than the light on open ground at sea level."""
    from skugga.shadows.irradiation.irradiation import light_sums_kwh
    from skugga.shadows.irradiation.light import clear_sky_light
    from skugga.shadows.irradiation.suns import sun_intervals

    dates, place = options.dates(world), (world.anchor_lon_deg, world.anchor_lat_deg)
    suns = sun_intervals(dates.windows, options.used_step_min, *place)
    hours = suns.hours * dates.days_represented(suns.moments)
    sums = light_sums_kwh(clear_sky_light(suns, *place, np.zeros(1), options.linke), hours, options.albedo)
    high = _round_end(SLOPE_GAIN * float(np.abs(sums[options.part][0])))
    ticks = tuple((float(value), f"{value:g}") for value in np.linspace(0.0, high, LEGEND_TICKS))
    first, last = options.first_and_last
    date_text = f"{first.day} {first:%B %Y}" if first == last else f"{first.isoformat()} to {last.isoformat()}"
    title = f"{PARTS[options.part].capitalize()}, {UNIT}, {date_text if options.year is None else options.year}"
    return ColorScale(title, "inferno", 0.0, high, ticks)


def _round_end(value: float) -> float:
    """Return a round number, 1, 2, 4 or 8 times a power of ten, that is not below a value; 1 for 0."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(multiple * power for multiple in (1.0, 2.0, 4.0, 8.0, 10.0) if multiple * power >= value * (1.0 - 1e-9)))


def _tags(options: IrradiationOptions, scene: Scene) -> dict[str, str]:
    """Return the metadata tags of a raster: the dates, the part, the plane, and the models of light."""
    first, last = options.first_and_last
    return {
        "part": "all" if options.by_part else options.part, "plane": options.plane_text, "date": first.isoformat(),
        "date_to": "" if first == last else last.isoformat(), "dates": str(options.date_count),
        "days": "" if options.date_weights is None else "mean day of each month (Klein 1977)", "per": options.per,
        "clock": options.clock, "step_min": f"{options.used_step_min:g}", "albedo": f"{options.albedo:g}",
        "linke_turbidity": "monthly climate" if options.linke is None else f"{options.linke:g}",
        "transmissivity": f"{options.transmissivity:g}" if scene.loaded.level.forest else "",
        "weather": "clear sky (Ineichen and Perez 2002)" if options.weather is None else options.weather.name,
        "sky": "Perez-Driesse 2024",
    }  # fmt: skip


def _described(options: IrradiationOptions) -> tuple[str, str]:
    """Return the description and the unit."""
    sky = "a clear sky" if options.weather is None else f"the sky of {options.weather.name}"
    return f"{PARTS[options.part]} under {sky}", UNIT


PRODUCT = Product(
    name=PRODUCT_NAME, description="irradiation of a `date` or a `year` under a clear sky, with the terrain in the way",
    formats=("png", "webp", "tif", "npy"), compute=_compute, view_kinds=("map",), when="days", options=IrradiationOptions,
    unit=UNIT, color_scale=_color_scale, describe=_described,
    profile=_profile,
    blocks=lambda scene, view, options: options.blocks(scene, view), step_count=lambda options: options.date_count, tags=_tags,
    check=_check, warnings=lambda options, scene: options.warnings(scene),
)  # fmt: skip
