"""Parse the camera of a request: eye, target and field of view."""

from __future__ import annotations

from inspect import signature
from typing import Annotated, Any

from fastapi import Query
from pydantic import ValidationError

from skugga.api.http.numbers import PLAIN_DECIMAL, parse_decimal
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.parts import PerspectiveSpec

MAX_EYE_OR_TARGET_HEIGHT_M = 100_000.0
"""Maximum height in metres of an eye or a target above the ground. Nobody views relief from higher up."""

POSITION_DESCRIPTION = (
    "three numbers: longitude and latitude in degrees (in a flat world metres east and north of its middle), "
    "and metres above the ground there, at most 100000"
)

EyeQuery = Annotated[
    str | None,
    Query(
        max_length=100,
        description="With `target`, instead of `view`: the eye point, as longitude,latitude,metres above the ground.",
        examples=["8.43,47.5,300"],
    ),
]
TargetQuery = Annotated[
    str | None,
    Query(
        max_length=100,
        description="With `eye`: the target point, as longitude,latitude,metres above the ground.",
        examples=["8.44,47.51,0"],
    ),
]
FovQuery = Annotated[
    float | None,
    PLAIN_DECIMAL,
    Query(
        ge=0.01, le=179, allow_inf_nan=False,
        description=f"With `eye`: vertical field of view, degrees; default: {PerspectiveSpec.model_fields['fov'].default:g}.",
        examples=[40],
    ),
]  # fmt: skip


async def camera_query(eye: EyeQuery = None, target: TargetQuery = None, fov: FovQuery = None) -> PerspectiveSpec | None:
    """Return the camera of a request (a FastAPI dependency); ``None`` if the query defines none. Raises ``InputError``."""
    texts: dict[str, Any] = {"eye": eye, "target": target}
    if eye is None and target is None:
        if fov is not None:
            remedy = "Give eye and target as well, or omit fov: a view of the level has its own"
            raise InputError("fov", Problem("given without eye and target"), remedy)
        return None
    for name, text in texts.items():
        if text is None:
            raise InputError.missing(name, "Give eye and target together")
    positions = {name: parse_position(name, text) for name, text in texts.items()}
    try:
        return PerspectiveSpec(kind="perspective", **positions, **({} if fov is None else {"fov": fov}))
    except ValidationError:  # each position is valid by itself, so they are equal
        raise InputError("target", target, "a target other than the eye") from None


def parse_position(name: str, text: str) -> tuple[float, float, float]:
    """Return a position from a text of three numbers with commas.

    They are longitude and latitude in degrees (in a flat world metres east and north), and metres above the ground. Raises
    ``InputError`` about the parameter ``name``.
    """
    values = [value for part in text.split(",") if (value := parse_decimal(part)) is not None]
    if len(values) != 3 or text.count(",") != 2 or max(map(abs, values[:2])) > 1e9 or abs(values[2]) > MAX_EYE_OR_TARGET_HEIGHT_M:
        raise InputError(name, text, POSITION_DESCRIPTION)
    return values[0], values[1], values[2]


CAMERA_PARAMETERS = tuple(signature(camera_query).parameters)
