"""Validate the arguments of the library's functions. A wrong argument raises a ``SkuggaError`` that names it.

The decorator ``validate_arguments`` uses pydantic and a function's annotations. This module defines types that pydantic lacks.
"""

from __future__ import annotations

import datetime
import functools
import inspect
import operator
import typing
from collections.abc import Callable, Collection
from typing import Annotated, Any, NoReturn, ParamSpec, TypeVar

import numpy as np
from affine import Affine
from pydantic import ConfigDict, Field, PlainValidator, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError
from pyproj import CRS
from pyproj.exceptions import CRSError

from skugga.shadows.horizons.azimuths import MAX_AZIMUTHS, MIN_AZIMUTHS
from skugga.terrain.errors import InputError, Problem, SkuggaError
from skugga.terrain.geo.clock import parse_date
from skugga.terrain.level.level import Shadows
from skugga.terrain.level.level_errors import allowed_phrase
from skugga.terrain.level.parts import ALLOWED_TIMES

ParametersT = ParamSpec("ParametersT")
ResultT = TypeVar("ResultT")

PYDANTIC_CONFIG = ConfigDict(arbitrary_types_allowed=True, allow_inf_nan=False)

SHADOWS_PARAMETER = "shadows"
"""Name of the parameter ``**shadows``, which takes the keys of a level's ``shadows``."""


def validate_arguments(function: Callable[ParametersT, ResultT]) -> Callable[ParametersT, ResultT]:
    """Return a function that validates and converts its arguments by its annotations.

    Raises
    ------
    InputError
        For a wrong argument, an unknown key of ``**shadows``, and a validation error of a model inside the function.
    TypeError
        For arguments that the function does not have, as Python does.
    """
    signature = inspect.signature(function)
    adapters: dict[str, TypeAdapter[Any]] = {}

    @functools.wraps(function)
    def wrapper(*args: ParametersT.args, **kwargs: ParametersT.kwargs) -> ResultT:
        if not adapters:
            hints = typing.get_type_hints(function, include_extras=True)
            adapters.update(
                {name: TypeAdapter(hint, config=PYDANTIC_CONFIG) for name, hint in hints.items() if name in signature.parameters}
            )
        bound = signature.bind(*args, **kwargs)
        for name, value in bound.arguments.items():
            if signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD:
                if name == SHADOWS_PARAMETER:
                    _check_shadows(signature, value)
            elif name in adapters:
                try:
                    bound.arguments[name] = adapters[name].validate_python(value)
                except ValidationError as error:
                    _raise_input_error(error, {name: value}, name)
        try:
            return function(*bound.args, **bound.kwargs)
        except ValidationError as error:
            _raise_input_error(error, bound.arguments)

    return wrapper


def _raise_input_error(error: ValidationError, argument_values: dict[str, Any], name: str | None = None) -> NoReturn:
    """Raise a pydantic error as an ``InputError`` about a parameter.

    ``argument_values`` are the values by parameter, for the message. ``name`` is the parameter; ``None``: the one that
    pydantic names.
    """
    detail = error.errors()[0]
    cause = detail.get("ctx", {}).get("error")
    if isinstance(cause, SkuggaError):
        raise cause from None
    name = name or ".".join(str(part) for part in detail["loc"])
    allowed = "; ".join(dict.fromkeys(map(allowed_phrase, error.errors())))
    raise InputError(name, argument_values.get(name, detail["input"]), allowed) from None


def _check_shadows(signature: inspect.Signature, shadow_settings: dict[str, Any]) -> None:
    """Raise ``InputError`` for an argument of ``**shadows`` that is no shadow setting. The error lists all parameters."""
    for key in shadow_settings:
        if key not in Shadows.model_fields:
            parameter_names = [
                parameter.name for parameter in signature.parameters.values() if parameter.name not in ("self", SHADOWS_PARAMETER)
            ]
            raise InputError(
                key, Problem("unknown parameter"), f"Use one of {', '.join((*parameter_names, *Shadows.model_fields))}"
            )


DATETIME64_UNITS_WITHOUT_DAY = ("Y", "M", "W")
"""Units of datetime64 that are longer than a day."""

DATETIME64_UNITS_WITHOUT_TIME = (*DATETIME64_UNITS_WITHOUT_DAY, "D")
"""Units of datetime64 without a time of day."""


def _as_datetime64(value: Any, rejected_units: Collection[str]) -> np.ndarray | None:
    """Return a datetime64 as an array without dimensions; ``None`` for other types, for NaT and for ``rejected_units``.

    ``rejected_units`` are codes of numpy's units, such as ``D``.
    """
    if getattr(getattr(value, "dtype", None), "kind", "") != "M" or np.ndim(value) != 0:
        return None
    moment = np.asarray(value)
    return None if np.isnat(moment) or np.datetime_data(moment.dtype)[0] in rejected_units else moment


def _parse_time(value: Any) -> str:
    """Return a time as ISO 8601 text. A text stays as it is, for the engine to check."""
    moment = _as_datetime64(value, DATETIME64_UNITS_WITHOUT_TIME)
    if moment is not None:
        return f"{np.datetime_as_string(moment.astype('datetime64[s]'))}Z"
    if isinstance(value, datetime.datetime):
        return value.isoformat()
    if not isinstance(value, str):
        raise PydanticCustomError("time", ALLOWED_TIMES)
    return value


def _parse_day(value: Any) -> datetime.date:
    """Return the date of a date, a time, a datetime64 or a text. Raises a pydantic error for other values."""
    moment = _as_datetime64(value, DATETIME64_UNITS_WITHOUT_DAY)
    if moment is not None:
        value = str(moment.astype("datetime64[D]"))
    if isinstance(value, datetime.datetime):
        value = value.isoformat()[:10]  # NaT of pandas is a datetime, without a date but with this text
    if isinstance(value, datetime.date):
        return value
    if not isinstance(value, str):
        raise PydanticCustomError("date", "a date of the calendar, such as 2024-03-21")
    try:
        return parse_date("date", value)
    except InputError as error:
        raise PydanticCustomError("date", "{words}", {"words": error.allowed}) from None


def _parse_bounds(value: Any) -> tuple[float, float, float, float]:
    """Return west, south, east and north. Raises a pydantic error for anything but four numbers."""
    try:
        numbers = [] if isinstance(value, str) else [float(number) for number in value]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != 4:
        raise PydanticCustomError("bounds", "four numbers: west, south, east, north")
    west, south, east, north = numbers
    return west, south, east, north


def _parse_crs(value: Any) -> CRS:
    """Return a CRS of pyproj. Raises a pydantic error for an unknown CRS, and for one without x and y."""
    try:
        if isinstance(value, str) and value.isascii() and value.strip().isdigit():
            value = int(value)
        crs = CRS.from_user_input(value.to_wkt() if hasattr(value, "to_wkt") else value)
    except (CRSError, TypeError, ValueError):
        raise PydanticCustomError("crs", "a CRS that PROJ knows, such as EPSG:32616") from None
    if crs.type_name == "Vertical CRS":  # a GeoTIFF of GDAL would make a flat world of it
        raise PydanticCustomError("crs", "a CRS with x and y, such as EPSG:32616; this one is a vertical CRS")
    return crs


def _parse_transform(value: Any) -> Affine:
    """Return a geotransform from its six numbers. Raises a pydantic error for other values."""
    try:
        numbers = [float(number) for number in tuple(value)[:6]]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise PydanticCustomError("transform", "the six numbers of an affine transform, as in rasterio")
    return Affine(*numbers)


def _parse_size(value: Any) -> tuple[int, int]:
    """Return (columns, rows). Raises a pydantic error for anything but two whole numbers up to ``MAX_PICTURE_PX``."""
    try:
        sides = [] if isinstance(value, str) else [operator.index(number) for number in value]
    except (TypeError, ValueError, OverflowError):
        sides = []
    if len(sides) != 2 or not all(1 <= side <= MAX_PICTURE_PX for side in sides):
        raise PydanticCustomError("size", "(columns, rows): two whole numbers, 1 to {most}", {"most": MAX_PICTURE_PX})
    return sides[0], sides[1]


def _parse_cells(value: Any) -> tuple[slice, slice]:
    """Return the slices of rows and of columns unchanged. Raises a pydantic error for other values, and for steps other than 1."""
    parts = value if isinstance(value, tuple) else ()
    ends = [end for part in parts if isinstance(part, slice) for end in (part.start, part.stop) if end is not None]
    if len(parts) != 2 or not all(isinstance(part, slice) and part.step in (None, 1) for part in parts):
        raise PydanticCustomError("cells", "rows and columns as two slices, np.s_[:512, 512:1024]")
    if not all(hasattr(end, "__index__") for end in ends):
        raise PydanticCustomError("cells", "slices of whole numbers")
    return parts


def _parse_cell_sides(value: Any) -> tuple[float, float]:
    """Return the row side and the column side of a cell, metres, from one number or two.

    Raises a pydantic error for other values.
    """
    try:
        sides = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        sides = np.empty(0)
    if sides.shape not in ((), (2,)) or not ((sides >= MIN_CELL_SIDE_M) & (sides <= MAX_CELL_SIDE_M)).all():
        raise PydanticCustomError(
            "cell",
            "{least} to {most} metres: the side of a cell, or (row side, column side), such as (abs(transform.e), transform.a)",
            {"least": f"{MIN_CELL_SIDE_M:f}", "most": f"{MAX_CELL_SIDE_M:,.0f}"},
        )
    down, right = np.broadcast_to(sides, (2,))
    return float(down), float(right)


MIN_CELL_SIDE_M, MAX_CELL_SIDE_M = 1e-6, 1e6
"""Smallest and largest side of a cell that is accepted, metres."""

MAX_PICTURE_PX = 16384
"""Largest side of a picture in pixels, as for ``--size``."""

Time = Annotated[datetime.datetime | np.datetime64 | str, PlainValidator(_parse_time)]
"""A time with an offset from UTC, or datetime64 in UTC with a time of day. The function receives ISO 8601 text."""

Date = Annotated[datetime.date | str, PlainValidator(_parse_day)]
"""A date. The function receives a ``datetime.date``."""

CrsLike = Annotated[Any, PlainValidator(_parse_crs)]
"""A CRS in any form that pyproj accepts, or one of rasterio. The function receives a pyproj CRS."""

Bounds = Annotated[tuple[float, float, float, float], PlainValidator(_parse_bounds)]
"""West, south, east, north."""

Transform = Annotated[Affine, PlainValidator(_parse_transform)]
"""A geotransform, or its six numbers."""

CellSides = Annotated[float | tuple[float, float], PlainValidator(_parse_cell_sides)]
"""The side of a cell in metres, or its (row, column) sides. The function receives both sides."""

AzimuthDeg = Annotated[float, Field(ge=-360.0, le=720.0)]
AltitudeDeg = Annotated[float, Field(ge=-90.0, le=90.0)]
LineCount = Annotated[int, Field(ge=1, le=64)]
CoreCount = Annotated[int, Field(ge=1, le=1024)]
AzimuthCount = Annotated[int, Field(ge=MIN_AZIMUTHS, le=MAX_AZIMUTHS)]
LatitudeDeg = Annotated[float, Field(ge=-90.0, le=90.0)]
LongitudeDeg = Annotated[float, Field(ge=-540.0, le=540.0)]
DayCount = Annotated[int, Field(ge=1)]
StepMinutes = Annotated[float, Field(ge=0.5, le=60.0)]
ThresholdHours = Annotated[float, Field(ge=0.0, le=24.0)]
MinAltitudeDeg = Annotated[float, Field(ge=-1.0, lt=90.0)]
HeightM = Annotated[float, Field(ge=0.0, le=1000.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Resolution = Annotated[float, Field(gt=0.0)]
Size = Annotated[tuple[int, int], PlainValidator(_parse_size)]
"""Columns and rows of a picture, in pixels."""

Cells = Annotated[tuple[slice, slice], PlainValidator(_parse_cells)]
"""Slices of rows and columns."""
