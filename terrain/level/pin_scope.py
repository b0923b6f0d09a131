"""Scopes of pins, and the search for pins that can never apply.

A pin holds shadow settings of a level file for a scope: one view or all views, and a range of sun altitudes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Annotated

from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from skugga.terrain.level.model import Model

Degrees = Annotated[float, Field(ge=-90, le=90)]
AltitudeRange = tuple[float, float]

ALL_ALTITUDES: AltitudeRange = (-90.0, 90.0)


class PinScope(Model):
    """Scope of a pin: the views and sun altitudes to which its settings apply.

    ``view`` is the name of a view; ``map`` includes the map's tiles. ``sun_altitude_deg`` is the minimum and maximum altitude of
    the sun at the level's anchor, degrees. A missing key does not restrict the scope. Without a sun only pins without a range
    apply.
    """

    view: str | None = None
    sun_altitude_deg: tuple[Degrees, Degrees] | None = None

    @field_validator("sun_altitude_deg")
    @classmethod
    def _check_range(cls, value: AltitudeRange | None) -> AltitudeRange | None:
        if value is not None and not value[0] < value[1]:
            raise PydanticCustomError("range", "[minimum, maximum] in degrees, with minimum < maximum")
        return value

    @property
    def scope_text(self) -> str:
        """The scope in words, such as ``view village, sun 5 to 20 degrees high``."""
        parts = ["all views" if self.view is None else f"view {self.view}"]
        if self.sun_altitude_deg is not None:
            low, high = self.sun_altitude_deg
            parts.append(f"sun {low:g} to {high:g} degrees high")
        return ", ".join(parts)

    def applies_to(self, view: str, sun_altitude_deg: float | None) -> bool:
        """Return whether the pin applies to a view and a sun altitude (``None``: no sun)."""
        if self.view is not None and self.view != view:
            return False
        if self.sun_altitude_deg is None:
            return True
        return sun_altitude_deg is not None and self.sun_altitude_deg[0] <= sun_altitude_deg <= self.sun_altitude_deg[1]


def uncovered_altitudes(scopes: Sequence[PinScope], pin_index: int, view: str) -> list[AltitudeRange]:
    """Return the ranges of sun altitudes, degrees, in which a pin applies to a view and no earlier pin does.

    ``pin_index`` is the pin's index in ``scopes``, which holds the scopes of all pins in the order of the file.
    """
    scope = scopes[pin_index]
    if scope.view not in (None, view):
        return []
    uncovered = [scope.sun_altitude_deg or ALL_ALTITUDES]
    for earlier in scopes[:pin_index]:
        if earlier.view in (None, view):
            low, high = earlier.sun_altitude_deg or ALL_ALTITUDES
            uncovered = [part for a, b in uncovered for part in ((a, min(b, low)), (max(a, high), b)) if part[0] < part[1]]
    return uncovered


def covered_pins(scopes: Sequence[PinScope], views: Collection[str], has_no_sun: bool) -> Iterator[tuple[int, list[int]]]:
    """Yield the index of each pin that can never apply, with the indices of the earlier pins that apply instead.

    ``views`` are the names of the level's views, ``has_no_sun`` says whether the level has no sun.
    """
    for number, scope in enumerate(scopes):
        scope_views = [view for view in views if scope.view in (None, view)]
        earlier_pins = [
            earlier_number
            for earlier_number, earlier in enumerate(scopes[:number])
            if scope.view is None or earlier.view in (None, scope.view)
        ]
        sunless_views = [view for view in scope_views if has_no_sun and scope.sun_altitude_deg is None]
        applies_without_sun = any(
            not any(scopes[earlier_number].applies_to(view, None) for earlier_number in earlier_pins) for view in sunless_views
        )
        if not applies_without_sun and not any(uncovered_altitudes(scopes, number, view) for view in scope_views):
            yield number, earlier_pins
