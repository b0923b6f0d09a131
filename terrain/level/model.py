"""Base class of all parts of a level file, and types of positions."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from skugga.terrain.level.level_errors import UNKNOWN_KEY

Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
MapPosition = tuple[Coordinate, Coordinate]
Position = tuple[Coordinate, Coordinate, Coordinate]


class Model(BaseModel):
    """A part of a level file: immutable, without unknown keys, infinities or NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="wrap")
    @classmethod
    def _report_unknown_keys(cls, data: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Report unknown keys, with the allowed keys, together with the errors of the known keys."""
        unknown = [key for key in data if key not in cls.model_fields] if isinstance(data, dict) else []
        if not unknown:
            return validate(data)
        allowed_keys = ", ".join(cls.model_fields)
        errors = [
            InitErrorDetails(
                type=PydanticCustomError(UNKNOWN_KEY, "unknown key", {"key": str(key), "known": allowed_keys}), input=data[key]
            )
            for key in unknown
        ]
        try:
            validate({key: value for key, value in data.items() if key not in unknown})
        except ValidationError as error:
            errors += [
                InitErrorDetails(
                    type=PydanticCustomError(detail["type"], detail["msg"], detail.get("ctx")),
                    loc=detail["loc"],
                    input=detail["input"],
                )
                for detail in error.errors()
            ]
        raise ValidationError.from_exception_data(cls.__name__, errors)
