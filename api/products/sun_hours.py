"""The product ``sunhours``: hours of direct sun, first and last sun, and days with enough sun."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from skugga.api.color_scale import ColorScale
from skugga.api.products.product import Product, ProductInput, ProductOptions
from skugga.terrain.errors import UnsupportedError

if TYPE_CHECKING:
    from skugga.shadows.plan import Plan
    from skugga.shadows.sun_hours.sun_hours import SunHours, SunRules
    from skugga.terrain.geo.daily_windows import DailyWindow
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.geo.world import World
    from skugga.terrain.scene import Scene

PRODUCT_NAME = "sunhours"

TILE_STEP_MIN = 5.0
"""Minutes between two suns of a tile. The mean error is half a minute in mountains, and a block takes seconds."""

MAX_LEGEND_TICKS = 7
"""Approximate maximum number of ticks of a legend."""

BARE_BLOCK_SIDE_NODES = 2048
"""Side of a block of bare ground: twice that of a picture, because each sun reads the casters around the block again."""

LARGE_RASTER_CELLS = 16_000_000
"""Limit of the cells of a raster with large blocks. Smaller blocks bound memory, since casters around a block may exceed it."""

LARGE_RASTER_BLOCK_SIDE_NODES = 1024
"""Side of a block of bare ground of a raster with at least that many cells."""

MIN_BLOCK_SIDE_NODES = 64
"""Minimum side of a block of bare ground, where the curved earth limits blocks."""

COLOR_RANGE_PATTERN = r"^(day|fixed|\d{1,2}(\.\d{1,2})?,\d{1,2}(\.\d{1,2})?)$"

DAY_HOURS = 24.0

Date = datetime.date  # an alias, because the model has a field called ``date``

SunQuantity = Literal["hours", "first", "last", "longest", "days"]

QUANTITIES: dict[SunQuantity, tuple[str, str]] = {
    "hours": ("hours of direct sun, mean of the dates", "h"),
    "first": ("first sun of any date, minutes from midnight by the clock", "min"),
    "last": ("last sun of any date, minutes from midnight by the clock", "min"),
    "longest": ("longest unbroken sun of any date", "h"),
    "days": ("days with enough direct sun", "d"),
}
"""Description and unit by quantity. Cells are NaN without a surface; those of first and last sun also without sun."""


class SunHoursOptions(ProductOptions):
    """Options of hours of sun: the dates, the daily window and its clock, and the rules that decide which sun counts."""

    UNSERVED: ClassVar[Mapping[str, Any]] = {"to": None, "every_days": 1, "step_min": TILE_STEP_MIN, "threshold_h": 2.0}

    date: Date = Field(description="The date, as 2024-03-21.", examples=["2024-03-21"])
    to: Date | None = Field(default=None, description="The last of several dates.", examples=["2024-06-21"])
    every_days: int = Field(default=1, ge=1, le=366, description="Days between two of several dates.", examples=[7])
    quantity: SunQuantity = Field(default="hours", description="What is shown; default: `hours`.", examples=["first"])
    window: str = Field(
        default="00:00-24:00", max_length=20, description="Part of the date that counts, as 08:00-16:00.", examples=["08:00-16:00"]
    )
    clock: str = Field(
        default="solar", max_length=60, examples=["Europe/Oslo"],
        description="Clock of date and window: solar (the default), utc, +02:00 or Europe/Oslo.",
    )  # fmt: skip
    height: float = Field(default=0.0, ge=0.0, le=1000.0, description="Metres above the ground.", examples=[1.7])
    least_altitude: float = Field(
        default=0.0, ge=-1.0, lt=90.0, description="Minimum altitude of a sun that counts, degrees.", examples=[3]
    )
    color_range: str = Field(
        default="day", max_length=20, pattern=COLOR_RANGE_PATTERN, examples=["fixed"],
        description="Range of the colours: `day` (the default), 0 to the possible hours of the date, or sunrise to sunset; "
        "`fixed`, 0 to 24; or LOW,HIGH in hours.",
    )  # fmt: skip
    step_min: float | None = Field(default=None, ge=0.5, le=60.0, description="Minutes between two suns; default: as needed.")
    threshold_h: float = Field(default=2.0, ge=0.0, le=24.0, description="Minimum hours of sun of a day that counts.")

    @field_validator("color_range")
    @classmethod
    def _check_color_range(cls, value: str) -> str:
        limits = _hours_of_range(value)
        if limits is not None and not limits[0] < limits[1] <= DAY_HOURS:
            raise PydanticCustomError("color_range", "day, fixed, or LOW,HIGH: hours from 0 to 24, LOW below HIGH")
        return value

    @property
    def color_limits_h(self) -> tuple[float, float] | None:
        """Lowest and highest hours of the colours; ``None`` if they follow from the date."""
        return _hours_of_range(self.color_range)

    def windows(self, world: World) -> list[DailyWindow]:
        """Return the daily windows of the dates. Raises ``InputError``, also in a flat world."""
        from skugga.terrain.geo.clock import parse_clock
        from skugga.terrain.geo.daily_windows import parse_window, windows_between

        readings, clock = parse_window(self.window), parse_clock("clock", self.clock)
        return windows_between(world, self.date, self.to or self.date, self.every_days, readings, clock)

    @property
    def rules(self) -> SunRules:
        """The rules that decide which sun counts, such as its minimum altitude."""
        from skugga.shadows.sun_hours.sun_hours import SunRules

        return SunRules(self.step_min, self.threshold_h, self.least_altitude, self.height)


def _hours_of_range(color_range: str) -> tuple[float, float] | None:
    """Return the ends of a range of colours in hours; ``None`` for ``day``."""
    if color_range == "day":
        return None
    if color_range == "fixed":
        return 0.0, DAY_HOURS
    low, high = color_range.split(",")
    return float(low), float(high)


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return the requested quantity of sun, float32 (rows, cols), in the unit of ``QUANTITIES``."""
    values: np.ndarray = getattr(_sun_hours(product_input), product_input.options.quantity)
    return values


def _sun_hours(product_input: ProductInput) -> SunHours:
    """Return hours of sun, first and last sun, and the other quantities of a map, over the dates of the options."""
    from skugga.shadows.sun_hours.sun_hours import sun_hours
    from skugga.shadows.sun_hours.suns import window_suns

    scene, view, options = product_input.scene, product_input.map_view, product_input.options
    days = window_suns(scene.world, options.windows(scene.world))
    return sun_hours(scene, view, days, options.rules, _plan_of(scene, view), product_input.on_step)


def _plan_of(scene: Scene, view: MapView) -> Callable[[Scene], Plan]:
    """Return a function from a scene under a sun to the plan of a view, for ground with objects."""

    def plan(lit: Scene) -> Plan:
        from skugga.api.device_calibration import calibration_for
        from skugga.selector.select import plan_of_view

        return plan_of_view(lit, view, "map", {}, device=calibration_for(scene.loaded.level.shadows, {}))

    return plan


def _color_scale(options: SunHoursOptions, world: World) -> ColorScale:
    """Return the colour scale of a whole level: of ``color_range``, which by default follows from the sun of the date."""
    from skugga.shadows.sun_hours.suns import window_suns
    from skugga.terrain.geo.daily_windows import clock_text

    window = options.windows(world)[0]
    (sun,) = window_suns(world, [window])
    up_min = sun.times_minutes[sun.altitude_deg > options.least_altitude]
    date_text = f"{options.date.day} {options.date:%B %Y}"
    if options.quantity == "days":
        return ColorScale(f"Days with sun, {date_text}", "inferno", 0.0, 1.0, _ticks(0.0, 1.0, 1.0, lambda value: f"{value:.0f}"))
    limits_h = options.color_limits_h
    if options.quantity in ("hours", "longest"):
        low, high = limits_h or (0.0, float(max(np.ceil(len(up_min) / 60.0), 1.0)))
        quantity_title = "Hours of sun" if options.quantity == "hours" else "Longest spell of sun, hours"
        unit = 1.0 if limits_h is None else _hour_unit(low, high)
        return ColorScale(
            f"{quantity_title}, {date_text}", "inferno", low, high, _ticks(low, high, unit, lambda value: f"{value:g}")
        )
    quantity_title = f"{options.quantity.capitalize()} sun"
    title = f"{quantity_title}, {date_text} ({options.clock})"
    if limits_h is not None:
        low, high = (60.0 * limit for limit in limits_h)
        return ColorScale(title, "viridis", low, high, _ticks(low, high, 60.0 * _hour_unit(*limits_h), clock_text))
    rise, set_ = (window.clock_time_min(float(end)) for end in (up_min[[0, -1]] if len(up_min) else (0.0, window.length_min)))
    low, high = float(np.floor(rise / 60.0) * 60.0), float(np.ceil(set_ / 60.0) * 60.0)
    return ColorScale(title, "viridis", low, high, _ticks(low, high, 60.0, clock_text))


def _hour_unit(low: float, high: float) -> float:
    """Return the hours between two ticks, or a divisor of them: 1, or 0.25 where few whole hours lie in the range."""
    return 1.0 if high - low >= 2.0 and low.is_integer() else 0.25


def _ticks(low: float, high: float, unit: float, format_tick: Callable[[float], str]) -> tuple[tuple[float, str], ...]:
    """Return the ticks of a legend from ``low`` to ``high``: numbers and their labels.

    Ticks are 1, 2, 3, 4, 6, 12, 24 or 48 times ``unit`` apart, as few as ``MAX_LEGEND_TICKS`` needs.
    """
    tick_multiple = next(
        multiple for multiple in (1, 2, 3, 4, 6, 12, 24, 48) if (high - low) / (multiple * unit) < MAX_LEGEND_TICKS
    )
    return tuple((float(value), format_tick(float(value))) for value in np.arange(low, high + unit / 2.0, tick_multiple * unit))


def _tags(options: SunHoursOptions, scene: Scene) -> dict[str, str]:
    """Return the metadata tags of a raster: the quantity, its dates, window and clock, and the rules."""
    from skugga.terrain.geo.daily_windows import clock_text

    windows = options.windows(scene.world)
    first, last = windows[0], windows[-1]
    return {
        "quantity": options.quantity, "date": first.date.isoformat(),
        "date_to": "" if len(windows) == 1 else last.date.isoformat(), "dates": str(len(windows)),
        "window": f"{clock_text(first.start_clock_min)}-{clock_text(round(first.clock_time_min(first.length_min)))}",
        "clock": options.clock,
        "step_min": "auto" if options.step_min is None else f"{options.step_min:g}",
        "threshold_h": f"{options.threshold_h:g}" if options.quantity == "days" else "",
        "least_altitude_deg": f"{options.least_altitude:g}", "height_m": f"{options.height:g}",
    }  # fmt: skip


def _date_count(options: SunHoursOptions) -> int:
    """Return the number of dates."""
    return ((options.to or options.date) - options.date).days // options.every_days + 1


def _step_count(options: SunHoursOptions) -> int:
    """Return the number of steps of all dates that are reported as progress."""
    from skugga.shadows.sun_hours.sun_hours import STEPS_PER_DAY

    return STEPS_PER_DAY * _date_count(options)


def _check(scene: Scene) -> None:
    """Raise ``UnsupportedError`` for a level with objects on its ground, whose tiles would take too long under many suns."""
    from skugga.terrain.gbuffer.supersampling import is_terrain_only

    if not is_terrain_only(scene):
        raise UnsupportedError(
            "layer", PRODUCT_NAME, "objects stand on this level's ground; `skugga sunhours` writes it as a raster"
        )


def sun_blocks(scene: Scene, view: MapView) -> list[tuple[MapView, int, int]]:
    """Return the blocks of a map for hours of sun, in the form that ``blocks_of`` returns.

    Where no pictures are needed, the blocks are aligned with the grid of the cells, and end at the edge of the raster. On bare
    ground they are larger.
    """
    from skugga.shadows.sun_hours.solid_shadows import rays_find_all_shadows
    from skugga.terrain.casters.ground_extent import ground_extent
    from skugga.terrain.gbuffer.supersampling import MAX_PARALLEL_RAYS_M, is_terrain_only
    from skugga.terrain.geo.grid import BLOCK_PX, blocks_of, step_at_anchor_m

    has_terrain_only = is_terrain_only(scene)
    if not has_terrain_only and not rays_find_all_shadows(scene, view):
        return blocks_of(view)
    nodes = view.with_pixels_as_nodes()
    side = (
        BARE_BLOCK_SIDE_NODES if scene.elevation.rows * scene.elevation.cols < LARGE_RASTER_CELLS else LARGE_RASTER_BLOCK_SIDE_NODES
    )
    if not has_terrain_only:
        side = BLOCK_PX
    if not scene.world.is_flat:
        side = int(np.clip(MAX_PARALLEL_RAYS_M / step_at_anchor_m(scene.world, nodes.grid), MIN_BLOCK_SIDE_NODES, side))
    limits: Sequence[tuple[int, int]] = [
        (int(max(np.floor(low), -side)), int(min(np.ceil(high) + 1.0, count + side)))
        for (low, high), count in zip(ground_extent(scene, nodes), (view.rows, view.cols), strict=True)
    ]
    (top, bottom), (left, right) = limits
    blocks = []
    for row in range(-(int(nodes.row0) % side), view.rows, side):
        for col in range(-(int(nodes.col0) % side), view.cols, side):
            first_row, first_col = max(row, top), max(col, left)
            rows, cols = min(row + side, bottom) - first_row, min(col + side, right) - first_col
            is_inside = first_row + rows > 0 and first_row < view.rows and first_col + cols > 0 and first_col < view.cols
            if rows > 0 and cols > 0 and is_inside:
                blocks.append((nodes.part(first_row, first_col, rows, cols), first_row, first_col))
    return blocks


PRODUCT = Product(
    name=PRODUCT_NAME, description="how long the sun is seen on a `date`", formats=("png", "webp", "tif", "npy"), compute=_compute,
    view_kinds=("map",), when="days", options=SunHoursOptions, unit="h", color_scale=_color_scale,
    describe=lambda options: QUANTITIES[options.quantity],
    blocks=lambda scene, view, _: sun_blocks(scene, view), step_count=_step_count, tags=_tags, check=_check,
)  # fmt: skip
