"""Observed error and time of a choice that was drawn."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Observation(BaseModel):
    """Observation of a drawn choice.

    ``choice`` is its name, ``error`` the error that targets limit, ``interior`` the interior error, and ``ms`` the time. The noises
    are standard deviations of their logarithms (``skugga.selector.cost.error_model.log_error``, ``log_interior``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    choice: str
    error: float = Field(ge=0, le=1)
    error_noise: float = Field(ge=0)
    interior: float = Field(ge=0, le=1)
    interior_noise: float = Field(ge=0)
    ms: float = Field(ge=0)
    ms_noise: float = Field(ge=0)
