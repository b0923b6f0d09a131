"""Convert pydantic's errors to the error of a level file, which names each wrong key with its value and the allowed values."""

from __future__ import annotations

import re
from difflib import get_close_matches
from typing import Any

from pydantic_core import ErrorDetails

from skugga.terrain.errors import LevelError, Problem, combined_error

MAX_EXAMINED_ERRORS = 1000
"""Maximum number of pydantic errors that are examined, because each is compared with every other."""

UNKNOWN_KEY = "unknown_key"
"""Type of pydantic error for an unknown key."""

_LEVEL_ERROR_KEYS = {"algorithm": ("shadows", "algorithm"), "blocks": ("terrain", "surface")}
"""Types of errors that validators of the whole ``Level`` raise, each with the keys of the wrong value in the file."""

_PHRASES_BY_TYPE = {
    "float_parsing": "a number", "int_parsing": "a whole number", "int_from_float": "a whole number",
    **dict.fromkeys(
        ("date_parsing", "date_from_datetime_parsing", "date_from_datetime_inexact"), "a date of the calendar, such as 2024-03-21"
    ),
    "path_type": "a path", "string_type": "a text",
}  # fmt: skip
"""Phrases of allowed values by pydantic's types of errors, where its messages are not meant for users."""

_PHRASES_BY_MESSAGE = (
    (r"(?:List|Tuple) should have (at (?:least|most) \d+ items?) after validation, not .*", r"a list of \1"),
    (r"String should have (at (?:least|most) \d+ characters?)", r"a string of \1"),
    (r"String should match pattern (.*)", r"a string that matches \1"),
    (r"Input should be a valid (?:list|tuple)", "a list"),
    (r"Input should be a valid dictionary(?: or instance of [A-Za-z]+)?", "a mapping of keys"),
    (r"Input should be (.*)", r"\1"),
)
"""Patterns of pydantic's messages, each with the phrase of allowed values that replaces the message."""

_Keys = tuple[str, ...]


def level_error(path: str, data: Any, errors: list[ErrorDetails]) -> LevelError:
    """Return one error that lists every wrong key of a file.

    ``path`` is the file, ``data`` its parsed content, ``errors`` are pydantic's errors. Pydantic may report several errors for one
    key, such as one for each type of a union. Errors of a mapping or list are dropped if a key within it has errors of its own.
    """
    if [error["loc"] for error in errors] == [()] and (error_keys := _LEVEL_ERROR_KEYS.get(errors[0]["type"])):
        part, key = error_keys
        errors = [{**errors[0], "loc": (part, key), "input": data[part][key]}]
    errors = errors[:MAX_EXAMINED_ERRORS]
    errors_by_key: dict[_Keys, list[ErrorDetails]] = {}
    for error in _drop_unlikely_branches(data, errors):
        errors_by_key.setdefault(_keys_to_error(data, error), []).append(error)
    deepest = [keys for keys in errors_by_key if not any(other[: len(keys)] == keys for other in errors_by_key if other != keys)]
    return combined_error([_key_error(path, keys, errors_by_key[keys]) for keys in deepest])


def _drop_unlikely_branches(data: Any, errors: list[ErrorDetails]) -> list[ErrorDetails]:
    """Drop errors of union branches (one of several allowed types of a value) that the author of the file probably did not mean.

    Of each union, the errors of the branches with the most deeply nested errors remain. For example, a list of points with one
    wrong coordinate is not reported as a point whose coordinates are lists.
    """
    depths: dict[_Keys, dict[str, int]] = {}
    for error in errors:
        for union, branch in _union_branches(data, error):
            branch_depths = depths.setdefault(union, {})
            branch_depths[branch] = max(branch_depths.get(branch, 0), len(_keys_to_error(data, error)))
    return [
        error
        for error in errors
        if all(depths[union][branch] == max(depths[union].values()) for union, branch in _union_branches(data, error))
    ]


def _union_branches(data: Any, error: ErrorDetails) -> list[tuple[_Keys, str]]:
    """Return the union branches that an error lies in: the keys of each union in the file, and pydantic's name of the branch."""
    return [(keys, step) for keys, step in _location_steps(data, error) if step is not None]


def _key_error(path: str, keys: _Keys, errors: list[ErrorDetails]) -> LevelError:
    """Return the error of one key from all pydantic errors of that key."""
    location, first, last = f"{path}: {'.'.join(keys)}", errors[0], errors[-1]
    if first["type"] == "union_tag_invalid":
        return LevelError(
            f"{location}.{first['ctx']['discriminator'].strip(chr(39))}", first["ctx"]["tag"], first["ctx"]["expected_tags"]
        )
    if first["type"] == UNKNOWN_KEY:
        allowed_keys = first["ctx"]["known"]
        matches = get_close_matches(keys[-1], allowed_keys.split(", "), 1)
        suggestion = f"Did you mean '{matches[0]}'? " if matches else ""
        return LevelError(location, Problem("unknown key"), f"{suggestion}Allowed keys: {allowed_keys}")
    if last["type"] == "missing" and isinstance(items := last["loc"][-1], int):  # a list that is too short
        return LevelError(location, last["input"], f"a list of {items + 1} items")
    if first["type"] == "missing":
        return LevelError.missing(location, "This key is required")
    return LevelError(location, first["input"], " or ".join(dict.fromkeys(map(allowed_phrase, errors))))


def allowed_phrase(error: ErrorDetails) -> str:
    """Return an error of pydantic as a phrase of allowed values, such as ``a list of at least 2 items``."""
    if (phrase := _PHRASES_BY_TYPE.get(error["type"])) is not None:
        return phrase
    message = error["msg"]
    for pattern, template in _PHRASES_BY_MESSAGE:
        if match := re.fullmatch(pattern, message):
            message = match.expand(template)
            break
    return message[:1].lower() + message[1:]


def _keys_to_error(data: Any, error: ErrorDetails) -> _Keys:
    """Return the keys that lead to an error in a file: pydantic's location without the names of union branches."""
    *_, (keys, _) = [((), None), *_location_steps(data, error)]
    return (*keys, error["ctx"]["key"]) if error["type"] == UNKNOWN_KEY else keys


def _location_steps(data: Any, error: ErrorDetails) -> list[tuple[_Keys, str | None]]:
    """Return the steps of an error's location: for each step the keys up to it, and the branch's name if it enters a union."""
    steps: list[tuple[_Keys, str | None]] = []
    keys: _Keys = ()
    location = error["loc"]
    for number, part in enumerate(location):
        inside = isinstance(data, dict) and part in data
        if inside or (isinstance(data, list | tuple) and isinstance(part, int) and part < len(data)):
            keys = (*keys, str(part))
            data = data[part]
            steps.append((keys, None))
        elif isinstance(data, dict) and number == len(location) - 1 and error["type"] == "missing":
            keys = (*keys, str(part))
            steps.append((keys, None))
        elif isinstance(part, str):
            steps.append((keys, part))
    return steps
