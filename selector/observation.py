"""The observed error and time of a choice of algorithms and settings that was drawn."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Observation(BaseModel):
    """The observed error and time of a choice of algorithms and settings that was drawn.

    ``choice`` is its name. ``error`` is the error that a target limits (``max_error``), in [0, 1]. ``interior`` is the share of
    pixels that are wrong far from shadow edges, in [0, 1]. ``ms`` is the time in milliseconds. ``error_noise``, ``interior_noise``
    and ``ms_noise`` are standard deviations of the logarithms of these values (``skugga.selector.cost.error_model.log_error``,
    ``log_interior``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    choice: str
    error: float = Field(ge=0, le=1)
    error_noise: float = Field(ge=0)
    interior: float = Field(ge=0, le=1)
    interior_noise: float = Field(ge=0)
    ms: float = Field(ge=0)
    ms_noise: float = Field(ge=0)
