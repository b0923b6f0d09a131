"""What is asked for together, by the request, the level's pins and the level itself, and who asks for what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from skugga.selector.choices import PlanRequest
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import LevelShadows, Pin, Shadows, override


@dataclass(frozen=True, eq=False)
class Asked:
    """What is asked of the shadows of one view under one sun. A request's ``overrides`` go before the level's first pin that holds
    there, and this before the level's own ``shadows``: key by key.
    """

    shadows: Shadows
    overrides: Mapping[str, Any]
    pin: Pin | None = None
    pin_number: int | None = None

    def who(self, key: str) -> str:
        """Who asks for a setting, as the subject of a sentence."""
        if key in self.overrides:
            return "the request"
        return "the level" if not self._is_pinned(key) else f"the level's pin for {self._where}"

    def because(self, key: str) -> str:
        """Why a setting is what it is, where somebody asks for it."""
        return f"pinned by the level for {self._where}" if self._is_pinned(key) else f"set by {self.who(key)}"

    def named(self, key: str) -> str:
        """Where a setting is asked for: a parameter, or a key of the level file."""
        if key in self.overrides:
            return key
        return f"shadows.pins.{self.pin_number}.{key}" if self._is_pinned(key) else f"shadows.{key}"

    @property
    def _where(self) -> str:
        return "" if self.pin is None else self.pin.where

    def _is_pinned(self, key: str) -> bool:
        return key not in self.overrides and self.pin is not None and key in self.pin.settings


def asked_of(descriptor: Descriptor, plan_request: PlanRequest, overrides: Mapping[str, Any] | None = None) -> Asked:
    """What is asked for a descriptor's view under its sun. Raises ``InputError`` for an override that is wrong."""
    given = {key: value for key, value in (overrides or {}).items() if value is not None}
    own = plan_request.shadows
    number = own.pin_for(descriptor.view, descriptor.sun_altitude_deg)
    pin = own.pins[number] if isinstance(own, LevelShadows) and number is not None else None
    pinned = {} if pin is None else pin.settings
    return Asked(override(own, {**pinned, **given}), given, pin, number)
