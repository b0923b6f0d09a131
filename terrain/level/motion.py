"""Motion in a level file: models that spin or follow a path, and lamps that follow a path.

Positions are functions of the level's clock, a time in seconds (``seconds`` of a level or a request).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from skugga.terrain.level.model import Coordinate, MapPosition, Model

MIN_KEY_STEP_S = 0.001
"""Minimum time between two keys of a path, seconds."""

MAX_PATH_KEYS = 10_000
"""Maximum number of keys of a path."""

ClockSeconds = Annotated[float, Field(ge=-1e9, le=1e9)]
"""A time of the level's clock, seconds."""

HeightReference = Literal["ground", "sea"]
"""Reference of a path's heights: the ground below each point of the path, or sea level (height 0)."""

PathHeight = Annotated[float, Field(ge=-12000, le=1e6)]
PathPosition = tuple[Coordinate, Coordinate, PathHeight]

KeyPath = tuple[str | int, ...]
"""Keys and list indices that lead to a nested part of a level file."""


def nested_values_error(title: str, problems: Sequence[tuple[KeyPath, object, str]]) -> ValidationError:
    """Return one error for several wrong values: for each one its key path, the value and the allowed values in words."""
    return ValidationError.from_exception_data(
        title,
        [
            InitErrorDetails(type=PydanticCustomError("part", words), loc=location, input=value)
            for location, value, words in problems
        ],
    )


class _Key(Model):
    """A key of a path: a time of the level's clock. Subclasses add the position at that time."""

    seconds: ClockSeconds


class PathKey(_Key):
    """A key of a model's path: its position at a time of the level's clock.

    The coordinates are those of ``at`` in ``MeshSpec``. A third number is the height in metres; without it the model stands on the
    ground.
    """

    position: MapPosition | PathPosition

    @field_validator("position", mode="before")
    @classmethod
    def _check_dimensions(cls, value: Any) -> Any:
        if isinstance(value, list | tuple) and len(value) not in (2, 3):
            raise PydanticCustomError("position", "two numbers, or three with a height")
        return value

    @property
    def position_3d(self) -> tuple[float, float, float]:
        """The position with its height, metres; 0 if the key has none."""
        return (*self.position[:2], self.position[2] if len(self.position) == 3 else 0.0)


class LampKey(_Key):
    """A key of a lamp's path: at a time of the level's clock the lamp's position, the target of a spot, or both."""

    position: PathPosition | None = None
    target: PathPosition | None = None

    @model_validator(mode="after")
    def _check_not_empty(self) -> Self:
        if self.position is None and self.target is None:
            raise PydanticCustomError("motion", "a position, a target or both, besides seconds")
        return self


class _Path(Model):
    """A path: keys (positions with times) with increasing ``seconds``.

    With ``loop`` the path repeats, and the last key has the position of the first. Otherwise the model or lamp rests before the
    first and after the last key. ``above`` says whether heights are metres above the ground or above the sea.
    """

    loop: bool = False
    above: HeightReference = "ground"


def _key_errors(keys: Sequence[_Key], loop: bool) -> list[tuple[KeyPath, object, str]]:
    """Return the wrong keys of a path: their key paths, values and allowed values."""
    if len(keys) < 2:
        return [(("path",), [key.model_dump(exclude_none=True) for key in keys], "at least two keys")]
    problems: list[tuple[KeyPath, object, str]] = []
    for number, (previous, following) in enumerate(pairwise(keys), start=1):
        if not following.seconds - previous.seconds >= MIN_KEY_STEP_S:
            allowed = f"seconds that increase by at least {MIN_KEY_STEP_S} from key to key: the previous has {previous.seconds:g}"
            problems.append((("path", number, "seconds"), following.seconds, allowed))
    if loop:
        for name in ("position", "target"):
            first, last = (_with_height(getattr(key, name, None)) for key in (keys[0], keys[-1]))
            if first != last:
                allowed = f"the {name} of the first key, {list(first or ())}: a loop ends where it begins"
                problems.append((("path", len(keys) - 1, name), getattr(keys[-1], name), allowed))
    return problems


def _with_height(position: tuple[float, ...] | None) -> tuple[float, ...] | None:
    """Return a position of two numbers with the height 0 appended, and any other position unchanged."""
    return (*position, 0.0) if position is not None and len(position) == 2 else position


class MeshMotion(_Path):
    """The motion of a model as a function of the level's clock.

    ``spin`` is in degrees per second, counter-clockwise about the up axis. ``face: along`` turns the model so that its south side,
    the front of a glTF model, points along the path. ``fixed`` does not turn it.
    """

    spin: float = Field(default=0.0, ge=-1e6, le=1e6)
    path: Annotated[tuple[PathKey, ...], Field(max_length=MAX_PATH_KEYS)] | None = None
    face: Literal["fixed", "along"] = "fixed"

    @model_validator(mode="after")
    def _check_path(self) -> Self:
        problems: list[tuple[KeyPath, object, str]] = []
        if self.path is None:
            path_keys = ("loop", "above", "face")
            problems = [
                ((key,), getattr(self, key), "no value without a path") for key in path_keys if key in self.model_fields_set
            ]
        else:
            problems = _key_errors(self.path, self.loop)
            if self.above == "sea":
                for number, key in enumerate(self.path):
                    if len(key.position) == 2:
                        problems.append(
                            (("path", number, "position"), key.position, "three numbers, with the height above the sea")
                        )
        if problems:
            raise nested_values_error("motion", problems)
        return self

    @property
    def moves(self) -> bool:
        """Whether the model moves at all."""
        return self.spin != 0.0 or self.path is not None


class LampMotion(_Path):
    """The motion of a lamp as a function of the level's clock.

    Either all keys have a position, or all have a spot's target, or all have both.
    """

    path: Annotated[tuple[LampKey, ...], Field(max_length=MAX_PATH_KEYS)]

    @model_validator(mode="after")
    def _check_path(self) -> Self:
        problems = _key_errors(self.path, self.loop)
        for number, key in enumerate(self.path):
            if tuple(name for name in ("position", "target") if getattr(key, name) is not None) != self.moved_fields:
                allowed = f"the keys of the first one: seconds, {', '.join(self.moved_fields)}"
                problems.append((("path", number), key.model_dump(exclude_none=True), allowed))
        if problems:
            raise nested_values_error("motion", problems)
        return self

    @property
    def moved_fields(self) -> tuple[str, ...]:
        """Names of the fields that the path moves: ``position``, ``target`` or both."""
        return tuple(name for name in ("position", "target") if getattr(self.path[0], name) is not None) if self.path else ()
