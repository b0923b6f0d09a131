"""The product ``hourly_shade``: which hours of a month see the sun, a band for each hour and a bit for each day."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, field_validator

from skugga.api.products.product import Product, ProductInput, ProductOptions
from skugga.api.raster_profile import RasterProfile
from skugga.terrain.errors import InputError, UnsupportedError

if TYPE_CHECKING:
    from skugga.shadows.irradiation.dates import Dates
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.geo.world import World
    from skugga.terrain.scene import Scene

PRODUCT_NAME = "hourly_shade"

HOURS, NODATA = 24, -9999
"""Bands, and the number of cells without ground: those of the Solar API."""

BAND_NAMES = tuple(f"days with sun in the hour from {hour:02d}:00" for hour in range(HOURS))


class HourlyShadeOptions(ProductOptions):
    """Options of hourly shade: the month and its clock."""

    month: str = Field(description="The month, as 2023-06.", max_length=10, examples=["2023-06"])
    clock: str = Field(
        default="solar", max_length=60, examples=["Europe/Oslo"],
        description="Clock of the hours: solar (the default), utc, +02:00 or Europe/Oslo.",
    )  # fmt: skip

    @field_validator("month")
    @classmethod
    def _check_month(cls, month: str) -> str:
        """Raise ``InputError`` for a text that is no month."""
        try:
            datetime.datetime.strptime(month, "%Y-%m")
        except ValueError:
            raise InputError("month", month, "a month, as 2023-06") from None
        return month

    @property
    def days(self) -> list[datetime.date]:
        """The days of the month."""
        first = datetime.datetime.strptime(self.month, "%Y-%m").date()
        return [day for n in range(31) if (day := first + datetime.timedelta(days=n)).month == first.month]

    def dates(self, world: World) -> Dates:
        """Return the days with their windows, which are whole days. Raises ``InputError``, also in a flat world."""
        from skugga.shadows.irradiation.dates import all_dates
        from skugga.terrain.geo.clock import parse_clock
        from skugga.terrain.geo.daily_windows import MINUTES_PER_DAY, windows_between

        clock = parse_clock("clock", self.clock)
        return all_dates(windows_between(world, self.days[0], self.days[-1], 1, (0.0, MINUTES_PER_DAY), clock))


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return the bits of the days by hour, int32 (rows, cols, 24)."""
    from skugga.shadows.irradiation.hourly_shade import hourly_shade

    scene = product_input.scene
    _check(scene)
    bits = hourly_shade(scene, product_input.map_view, product_input.options.dates(scene.world), product_input.on_step)
    return np.moveaxis(bits, 0, -1)


def _check(scene: Scene) -> None:
    """Raise ``UnsupportedError`` for a level whose ground is flat tops of cells."""
    if scene.elevation.surface != "smooth":
        raise UnsupportedError("layer", PRODUCT_NAME, "only for smooth ground, not for flat tops of cells")


def _blocks(scene: Scene, view: MapView, _: HourlyShadeOptions) -> list[tuple[MapView, int, int]]:
    """Return the blocks of a map, in the form that ``blocks_of`` returns; all hours of a block are in memory."""
    from skugga.shadows.horizons.level_horizons import horizon_blocks

    return horizon_blocks(scene, view, HOURS)


PRODUCT = Product(
    name=PRODUCT_NAME, description="which hours of a `month` see the sun: a band for each hour, bit d - 1 for day d",
    formats=("tif", "npy"), compute=_compute, view_kinds=("map",), when="days", options=HourlyShadeOptions,
    profile=lambda _: RasterProfile("int32", HOURS, NODATA, band_names=BAND_NAMES), is_smooth=False, unit="bits",
    blocks=_blocks, step_count=lambda options: len(options.days), check=_check, is_served=False,
)  # fmt: skip
