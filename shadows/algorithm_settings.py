"""The settings of algorithms: their base classes, and the request from which an algorithm resolves them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from skugga.shadows.penumbra import MAX_LIGHT_POINTS, MIN_LIGHT_POINTS, light_point_count
from skugga.shadows.requirements import is_area_light
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import SUN, Shadows


class NamedReason(BaseModel):
    """A setting, algorithm or layer by name, with the reason for it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    reason: str


class AlgorithmSettings(BaseModel):
    """Resolved settings of an algorithm, without any automatic values. A subclass declares the fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def as_overrides(self) -> dict[str, Any]:
        """The settings as keys and values of a level's ``shadows``, without fields that are no such keys."""
        return {key: getattr(self, key) for key in Shadows.model_fields if hasattr(self, key)}

    @property
    def label_parts(self) -> list[str]:
        """The values that distinguish these settings from others, as text: a part of a candidate's name.

        They are the values of all required fields, then those that differ from their defaults.
        """
        required = [str(getattr(self, name)) for name, field in type(self).model_fields.items() if field.is_required()]
        return [*required, *self.changed_values()]

    def changed_values(self, *excluded: str) -> list[str]:
        """Return the values that differ from their defaults, as text; numbers that are no integers with their names.

        Parameters
        ----------
        *excluded
            Names of fields that are left out. Fields that are no keys of a level's ``shadows`` are always left out.
        """
        defaults = {
            name: field_info.default for name, field_info in type(self).model_fields.items() if not field_info.is_required()
        }
        names = [name for name in defaults if name in Shadows.model_fields and name not in excluded]
        values = {name: getattr(self, name) for name in names if getattr(self, name) != defaults[name]}
        return [f"{name}_{value:g}" if isinstance(value, float) else str(value) for name, value in values.items()]


class AreaLightSettings(AlgorithmSettings):
    """Settings of an algorithm that draws an area light as the mean over ``light_points`` point lights."""

    light_points: int = Field(default=MAX_LIGHT_POINTS, ge=1)


@dataclass(frozen=True)
class SettingsRequest:
    """The input from which an algorithm resolves its settings.

    Attributes
    ----------
    descriptor
        The facts of a view.
    light
        The name of the light.
    shadows
        The shadow settings of the level, with those of the request in their place.
    hard_edges_reason
        The reason why the sun's shadows need hard edges; ``None`` if they do not.
    """

    descriptor: Descriptor
    light: str
    shadows: Shadows
    hard_edges_reason: str | None = None

    @property
    def effective_shadows(self) -> Shadows:
        """The requested shadow settings, with one tap if the sun's shadows need hard edges."""
        return self.shadows.model_copy(update={"filter": 1}) if self._forces_hard_edges else self.shadows

    @property
    def hard_edges_reasons(self) -> list[NamedReason]:
        """The reason for hard edges; empty if the requested filter is not changed."""
        return [NamedReason(name="filter 1", reason=f"hard edges: {self.hard_edges_reason}")] if self._forces_hard_edges else []

    @property
    def is_area_light(self) -> bool:
        """Whether the light is shown as an area light."""
        return is_area_light(self.descriptor, self.light, self.effective_shadows)

    @property
    def light_point_count(self) -> int:
        """The number of point lights that an area light is averaged over."""
        return max(light_point_count(self.descriptor, self.light), MIN_LIGHT_POINTS) if self.is_area_light else MAX_LIGHT_POINTS

    def ignored_filter_reasons(self, algorithm_name: str, *filters: int | str) -> list[NamedReason]:
        """Return the reason why a requested filter has no effect, for an algorithm that ignores it.

        Parameters
        ----------
        algorithm_name
            The name of the algorithm.
        *filters
            Filters that the algorithm has, besides ``auto`` and 1.

        Returns
        -------
        list of NamedReason
            One entry; empty if the algorithm has the requested filter.
        """
        requested_filter = self.effective_shadows.filter
        if requested_filter in ("auto", 1, *filters):
            return []
        return [NamedReason(name=f"filter {requested_filter}", reason=f"no effect: {algorithm_name} has hard edges only")]

    @property
    def _forces_hard_edges(self) -> bool:
        """Whether the sun's shadows need hard edges although another filter is requested."""
        return self.light == SUN and self.hard_edges_reason is not None and self.shadows.filter != 1


ResolvedSettings = tuple[AlgorithmSettings | None, list[NamedReason]]
"""The settings, if the algorithm has any, and the reasons for automatic values."""

Overrides = Mapping[str, Any]
"""Fields of ``Shadows`` with values, as in a request."""
