"""Hours of sun as a layer of tiles: what is asked of them, and the colours that they are shown in."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlencode

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from skugga.api.color_scale import ColorScale
from skugga.api.sun_quantities import QUANTITIES
from skugga.shadows.sun_hours.suns import window_suns
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.clock import clock_named
from skugga.terrain.geo.daily_windows import DailyWindow, clock_text, readings_of, windows_asked
from skugga.terrain.geo.world import World

if TYPE_CHECKING:
    from skugga.shadows.plan import Plan
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.scene import Scene

SUN_HOURS_LAYER = "sunhours"

STEP_MIN = 5.0
"""Time between two suns that are looked for: right to half a minute on average in mountains, and a block takes seconds."""

MOST_TICKS = 7

SunQuantity = Literal["hours", "first", "last", "longest"]

Date = datetime.date  # under this name the model's own field leaves it alone


class SunHoursQuery(BaseModel):
    """What is asked of a layer of hours of sun: a date, a quantity, the window of the date by a clock, the height of the eye above
    the ground (metres), and the least altitude of a sun that counts (degrees).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    date: Date
    quantity: SunQuantity = "hours"
    window: str = Field(default="00:00-24:00", max_length=20)
    clock: str = Field(default="solar", max_length=60)
    height: float = Field(default=0.0, ge=0.0, le=1000.0)
    least_altitude: float = Field(default=0.0, ge=-1.0, lt=90.0)

    def query(self) -> str:
        """The same as a query string, without what is left to the defaults."""
        return urlencode(self.model_dump(mode="json", exclude_defaults=True))

    def day_window(self, world: World) -> DailyWindow:
        """The window of the date. Raises ``InputError``, also in a flat world."""
        clock = clock_named("clock", self.clock)
        return windows_asked(world, self.date, self.date, 1, readings_of(self.window), clock)[0]

    def color_scale(self, world: World) -> ColorScale:
        """The colours of a whole level: from no hours to as many as the sun is up there, or from its rise to its set. Raises
        ``InputError``.
        """
        window = self.day_window(world)
        (sun,) = window_suns(world, [window])
        up_min = sun.times_min[sun.altitude_deg > self.least_altitude]
        on = f"{self.date.day} {self.date:%B %Y}"
        if self.quantity in ("hours", "longest"):
            high = float(max(np.ceil(len(up_min) / 60.0), 1.0))
            what = "Hours of sun" if self.quantity == "hours" else "Longest spell of sun, hours"
            return ColorScale(f"{what}, {on}", "inferno", 0.0, high, _ticks(0.0, high, 1.0, lambda value: f"{value:.0f}"))
        rise, set_ = (window.reading_min(float(end)) for end in (up_min[[0, -1]] if len(up_min) else (0.0, window.minutes)))
        low, high = float(np.floor(rise / 60.0) * 60.0), float(np.ceil(set_ / 60.0) * 60.0)
        what = f"{self.quantity.capitalize()} sun"
        return ColorScale(f"{what}, {on} ({self.clock})", "viridis", low, high, _ticks(low, high, 60.0, clock_text))


def sun_hours_picture(scene: Scene, view: MapView, query: SunHoursQuery) -> np.ndarray:
    """A block of the layer as RGBA (rows, cols, 4). Raises ``InputError``, and ``UnsupportedError`` where anything stands on the
    ground: each sun would be a picture.
    """
    from skugga.shadows.sun_hours.sun_hours import SunRules, sun_hours
    from skugga.terrain.gbuffer.covered_nodes import is_bare

    if not is_bare(scene):
        raise UnsupportedError(
            "layer", SUN_HOURS_LAYER, "something stands on this level's ground: skugga sunhours writes it as a raster"
        )
    rules = SunRules(step_min=STEP_MIN, least_altitude_deg=query.least_altitude, height_m=query.height)
    suns = window_suns(scene.world, [query.day_window(scene.world)])
    values = QUANTITIES[query.quantity](sun_hours(scene, view, suns, rules, _no_plan))
    return query.color_scale(scene.world).colored(values)


def _no_plan(scene: Scene) -> Plan:
    raise AssertionError("bare ground needs no plan")


def _ticks(low: float, high: float, unit: float, text: Any) -> tuple[tuple[float, str], ...]:
    every = next(each for each in (1, 2, 3, 4, 6, 12) if (high - low) / (each * unit) < MOST_TICKS)
    return tuple((float(value), text(float(value))) for value in np.arange(low, high + unit / 2.0, every * unit))
