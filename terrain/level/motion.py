"""The parts of a level file that say how things move by the level's clock: models spin or follow a path, lamps follow one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from skugga.terrain.level.model import Coordinate, MapPosition, Model

LEAST_KEY_STEP_S = 0.001
"""Time between two keys of a path, at least."""

MOST_PATH_KEYS = 10_000
"""Of one path."""

ClockSeconds = Annotated[float, Field(ge=-1e9, le=1e9)]
"""Of the level's clock."""

Above = Literal["ground", "sea"]
"""What the heights of a path are counted from: the ground below, which it follows, or 0 in the heights as drawn."""

PathHeight = Annotated[float, Field(ge=-12000, le=1e6)]
PathPosition = tuple[Coordinate, Coordinate, PathHeight]

KeyPath = tuple[str | int, ...]
"""Keys and numbers on the way to a part of a part of a level file."""


def wrong_parts(title: str, wrong: Sequence[tuple[KeyPath, object, str]]) -> ValidationError:
    """The error of parts at places, each with its value and what is allowed."""
    return ValidationError.from_exception_data(
        title, [InitErrorDetails(type=PydanticCustomError("part", words), loc=at, input=was) for at, was, words in wrong]
    )


class _Key(Model):
    """A second of the level's clock, of which more is said."""

    seconds: ClockSeconds


class PathKey(_Key):
    """Where a model is at a second of the level's clock: as ``at``, and a height, metres (left out: on the ground)."""

    position: MapPosition | PathPosition

    @field_validator("position", mode="before")
    @classmethod
    def _two_or_three(cls, value: Any) -> Any:
        if isinstance(value, list | tuple) and len(value) not in (2, 3):
            raise PydanticCustomError("position", "two numbers for the place, and a third for a height")
        return value

    @property
    def place(self) -> tuple[float, float, float]:
        """Its position with a height."""
        return (*self.position[:2], self.position[2] if len(self.position) == 3 else 0.0)


class LampKey(_Key):
    """Where a lamp is at a second of the level's clock, and what a spot is turned to: what of both moves."""

    position: PathPosition | None = None
    target: PathPosition | None = None

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if self.position is None and self.target is None:
            raise PydanticCustomError("motion", "a position, a target or both beside its seconds")
        return self


class _Path(Model):
    """``path``: keys whose seconds rise. A ``loop`` ends where it begins, and begins again; else what moves rests before and after.
    Heights are metres ``above`` the ground, which is followed, or above the sea.
    """

    loop: bool = False
    above: Above = "ground"


def _wrong_keys(keys: Sequence[_Key], loop: bool) -> list[tuple[KeyPath, object, str]]:
    """What is wrong with the keys of a path: places in it, values, and what is allowed."""
    if len(keys) < 2:
        return [(("path",), [key.model_dump(exclude_none=True) for key in keys], "two keys at least")]
    wrong: list[tuple[KeyPath, object, str]] = []
    for number, (before, after) in enumerate(pairwise(keys), start=1):
        if not after.seconds - before.seconds >= LEAST_KEY_STEP_S:
            allowed = f"seconds that rise from key to key, by {LEAST_KEY_STEP_S} at least: the one before has {before.seconds:g}"
            wrong.append((("path", number, "seconds"), after.seconds, allowed))
    if loop:
        for name in ("position", "target"):
            first, last = (_with_height(getattr(key, name, None)) for key in (keys[0], keys[-1]))
            if first != last:
                allowed = f"the first key's, {list(first or ())}: a loop ends where it begins"
                wrong.append((("path", len(keys) - 1, name), getattr(keys[-1], name), allowed))
    return wrong


def _with_height(position: tuple[float, ...] | None) -> tuple[float, ...] | None:
    return (*position, 0.0) if position is not None and len(position) == 2 else position


class MeshMotion(_Path):
    """How a model moves by the level's clock.

    ``spin`` is in degrees per second, counter-clockwise about the up axis. ``face: along`` turns what of the model faces south (a
    glTF's front) along its path; ``fixed`` leaves it as it stands.
    """

    spin: float = Field(default=0.0, ge=-1e6, le=1e6)
    path: Annotated[tuple[PathKey, ...], Field(max_length=MOST_PATH_KEYS)] | None = None
    face: Literal["fixed", "along"] = "fixed"

    @model_validator(mode="after")
    def _right_path(self) -> Self:
        wrong: list[tuple[KeyPath, object, str]] = []
        if self.path is None:
            given = ("loop", "above", "face")
            wrong = [((key,), getattr(self, key), "no such key without a path") for key in given if key in self.model_fields_set]
        else:
            wrong = _wrong_keys(self.path, self.loop)
            if self.above == "sea":
                for number, key in enumerate(self.path):
                    if len(key.position) == 2:
                        wrong.append((("path", number, "position"), key.position, "three numbers: the height above the sea, too"))
        if wrong:
            raise wrong_parts("motion", wrong)
        return self

    @property
    def moves(self) -> bool:
        """Whether it moves anything."""
        return self.spin != 0.0 or self.path is not None


class LampMotion(_Path):
    """How a lamp moves by the level's clock: its keys say where its position, a spot's target or both are, all of them the same."""

    path: Annotated[tuple[LampKey, ...], Field(max_length=MOST_PATH_KEYS)]

    @model_validator(mode="after")
    def _right_path(self) -> Self:
        wrong = _wrong_keys(self.path, self.loop)
        for number, key in enumerate(self.path):
            if tuple(name for name in ("position", "target") if getattr(key, name) is not None) != self.moved:
                allowed = f"what the first key has: seconds, {', '.join(self.moved)}"
                wrong.append((("path", number), key.model_dump(exclude_none=True), allowed))
        if wrong:
            raise wrong_parts("motion", wrong)
        return self

    @property
    def moved(self) -> tuple[str, ...]:
        """What the keys place: ``position``, ``target`` or both."""
        return tuple(name for name in ("position", "target") if getattr(self.path[0], name) is not None) if self.path else ()
