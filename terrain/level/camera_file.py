"""Camera files: YAML files of key positions with times, as validated values.

``skugga.terrain.camera_path`` interpolates between the keys.
"""

from __future__ import annotations

from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from skugga.terrain.level.durations import parse_duration
from skugga.terrain.level.level_errors import level_error
from skugga.terrain.level.model import Model, Position
from skugga.terrain.level.parts import PixelCount, parse_time
from skugga.terrain.level.yaml_file import load_mapping

MAX_KEYS = 1000
"""Maximum number of keys of a camera path."""

MAX_FILE_CHARACTERS = 2**20
"""Maximum length of a camera file: far more than ``MAX_KEYS`` keys need."""

ALLOWED_KEY_TIMES = "a time since the first frame, such as 0s, 90s or 10m, or an ISO 8601 time with an offset"
"""The allowed times of a key, for messages."""


def _validate_time(value: Any) -> Any:
    """Return the time of a key as text. YAML parses an unquoted date to a ``datetime``, which is converted back to text.

    Raises ``PydanticCustomError`` if the text is not one of ``ALLOWED_KEY_TIMES``.
    """
    text = value.isoformat() if isinstance(value, datetime) else value
    if not isinstance(text, str) or (_elapsed_s(text) is None and _parse_date(text) is None):
        raise PydanticCustomError("at", ALLOWED_KEY_TIMES)
    return text


def _elapsed_s(text: str) -> float | None:
    """Return the seconds of a duration such as 90s; ``None`` for any other text."""
    try:
        return parse_duration(text).total_seconds()
    except ValueError:
        return None


def _parse_date(text: str) -> datetime | None:
    """Return the moment of an ISO 8601 time with an offset; ``None`` for any other text."""
    try:
        moment = parse_time(text)
    except ValueError:
        return None
    return None if moment.tzinfo is None else moment


class CameraKey(Model):
    """A key of a camera path: the camera's position at the time ``at``.

    ``eye``, ``target`` and ``fov`` have the meaning that they have in a level's perspective views.
    """

    at: Annotated[str, BeforeValidator(_validate_time)]
    eye: Position
    target: Position
    fov: float = Field(default=50.0, ge=0.01, le=179)

    @model_validator(mode="after")
    def _check_target(self) -> CameraKey:
        if self.eye == self.target:
            raise PydanticCustomError("target", "a target other than the eye")
        return self

    @property
    def elapsed_s(self) -> float | None:
        """Seconds since the film's first frame; ``None`` if the key has a date."""
        return _elapsed_s(self.at)

    @property
    def moment(self) -> datetime | None:
        """Date and time of the key; ``None`` if its time counts from the first frame."""
        return None if self.elapsed_s is not None else _parse_date(self.at)


class CameraPathSpec(Model):
    """A camera path: keys in the order of their times.

    Either all times count from the first frame, or all are dates. ``size`` is the size of the film's pictures, (width, height) in
    pixels.
    """

    keys: Annotated[tuple[CameraKey, ...], Field(min_length=2, max_length=MAX_KEYS)]
    size: tuple[PixelCount, PixelCount] = (1280, 1024)

    @model_validator(mode="after")
    def _check_order(self) -> CameraPathSpec:
        has_dates = self.keys[0].moment is not None
        for number, (key, following) in enumerate(pairwise(self.keys), start=1):
            if (following.moment is not None) != has_dates:
                words = f"{'a date' if has_dates else 'a time since the first frame'}, as in the first key"
            elif following.moment is not None and key.moment is not None and following.moment > key.moment:
                continue
            elif following.elapsed_s is not None and key.elapsed_s is not None and following.elapsed_s > key.elapsed_s:
                continue
            else:
                words = f"a time later than {key.at}, the time of the previous key"
            problem = InitErrorDetails(type=PydanticCustomError("at", words), loc=("keys", number, "at"), input=following.at)
            raise ValidationError.from_exception_data("CameraPathSpec", [problem])
        return self

    def times_s(self, start: datetime | None) -> tuple[float, ...]:
        """Return the times of the keys in seconds since the first frame.

        ``start`` is the date of the first frame. Raises ``ValueError`` if it is ``None`` and the keys have dates.
        """
        out = []
        for key in self.keys:
            if key.elapsed_s is not None:
                out.append(key.elapsed_s)
            elif key.moment is not None and start is not None:
                out.append((key.moment - start).total_seconds())
            else:
                raise ValueError("start: missing. Keys with dates need the date of the first frame.")
        return tuple(out)


def load_camera_path(path: Path) -> CameraPathSpec:
    """Read and validate a camera file. Raises ``LevelError``, whose message has one line for each wrong key."""
    data = load_mapping(path, "camera keys", "the key 'keys'", MAX_FILE_CHARACTERS)
    try:
        return CameraPathSpec.model_validate(data)
    except ValidationError as error:
        raise level_error(str(path), data, error.errors()) from None
