"""Combine the shadow settings of the request, the level's pins and the level, and record the source of each setting.

A pin is an entry in a level file that sets algorithms or settings for some views and suns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from skugga.selector.choices import PlanRequest
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import LevelShadows, Pin, Shadows, override_settings


@dataclass(frozen=True, eq=False)
class ShadowRequest:
    """The shadow settings of one view under one sun.

    For each key, the request's ``overrides`` take precedence over the level's first pin that applies. A pin (settings for some
    views and suns) takes precedence over the level's own ``shadows``.

    Attributes
    ----------
    shadows
        The combined settings.
    overrides
        Settings of the request.
    pin
        The pin that applies, or ``None``.
    pin_number
        Index of this pin in the level's list of pins, or ``None``.
    """

    shadows: Shadows
    overrides: Mapping[str, Any]
    pin: Pin | None = None
    pin_number: int | None = None

    def requester(self, key: str) -> str:
        """Return who set a setting, in words: the request, the level, or a pin of the level.

        ``key`` is a field of ``Shadows``.
        """
        if key in self.overrides:
            return "the request"
        return "the level" if not self._is_pinned(key) else f"the level's pin for {self._pin_scope}"

    def reason_for(self, key: str) -> str:
        """Return who set a setting, the request or the level, as a reason in words.

        ``key`` is a field of ``Shadows``.
        """
        return f"pinned by the level for {self._pin_scope}" if self._is_pinned(key) else f"set by {self.requester(key)}"

    def key_path(self, key: str) -> str:
        """Return the name of the parameter, or the path of the key in the level file, that sets a setting.

        ``key`` is a field of ``Shadows``.
        """
        if key in self.overrides:
            return key
        return f"shadows.pins.{self.pin_number}.{key}" if self._is_pinned(key) else f"shadows.{key}"

    @property
    def _pin_scope(self) -> str:
        """The view and the suns for which the pin applies, in words; empty without a pin."""
        return "" if self.pin is None else self.pin.scope_text

    def _is_pinned(self, key: str) -> bool:
        """Return whether the pin sets the setting ``key``, and the request does not."""
        return key not in self.overrides and self.pin is not None and key in self.pin.settings


def resolve_shadow_request(
    descriptor: Descriptor, plan_request: PlanRequest, overrides: Mapping[str, Any] | None = None
) -> ShadowRequest:
    """Return the combined shadow settings for a descriptor's view under its sun.

    ``overrides`` are the settings of the request; values of ``None`` are ignored. Raises ``InputError`` for a wrong override.
    """
    request_overrides = {key: value for key, value in (overrides or {}).items() if value is not None}
    request_shadows = plan_request.shadows
    number = request_shadows.pin_number(descriptor.view, descriptor.sun_altitude_deg)
    pin = request_shadows.pins[number] if isinstance(request_shadows, LevelShadows) and number is not None else None
    pinned = {} if pin is None else pin.settings
    return ShadowRequest(override_settings(request_shadows, {**pinned, **request_overrides}), request_overrides, pin, number)
