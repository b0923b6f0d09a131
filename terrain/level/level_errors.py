"""What is wrong with a level file, in the file's own terms: each wrong key with its value and what is allowed."""

from __future__ import annotations

import re
from difflib import get_close_matches
from typing import Any

from pydantic_core import ErrorDetails

from skugga.terrain.errors import MISSING_VALUE, Problem, LevelError, combined_error

MOST_ERRORS = 1000
"""Of pydantic's that are looked at, each beside each."""

UNKNOWN_KEY = "unknown_key"
"""Type of the errors of keys that a part of the file does not have."""

_OF_THE_WHOLE = {"algorithm": ("shadows", "algorithm"), "blocks": ("terrain", "surface")}
"""Kinds of errors that only the whole level can make, for what is in other parts of it, and the keys that they are about."""

_Keys = tuple[str, ...]


def level_error(path: str, data: Any, errors: list[ErrorDetails]) -> LevelError:
    """One error that tells of every wrong key of a file.

    Of pydantic's many (a union gives one for each of its branches) those count that lead deepest into the file: what is said of
    a key goes before what is said of a part that it lies in.
    """
    if [error["loc"] for error in errors] == [()] and (whole := _OF_THE_WHOLE.get(errors[0]["type"])):
        part, key = whole
        errors = [{**errors[0], "loc": (part, key), "input": data[part][key]}]
    errors = errors[:MOST_ERRORS]
    of_keys: dict[_Keys, list[ErrorDetails]] = {}
    for error in _of_meant_branches(data, errors):
        of_keys.setdefault(_keys(data, error), []).append(error)
    deepest = [keys for keys in of_keys if not any(other[: len(keys)] == keys for other in of_keys if other != keys)]
    return combined_error([_of_key(path, keys, of_keys[keys]) for keys in deepest])


def _of_meant_branches(data: Any, errors: list[ErrorDetails]) -> list[ErrorDetails]:
    """The errors without those of a union's branches that fail nearer to the union than another one does.

    The branch that follows a value deepest is the one that was meant: a list of points in which one coordinate is wrong is no
    point whose coordinates are lists.
    """
    depths: dict[_Keys, dict[str, int]] = {}
    for error in errors:
        for union, branch in _branches(data, error):
            of_union = depths.setdefault(union, {})
            of_union[branch] = max(of_union.get(branch, 0), len(_keys(data, error)))
    return [
        error
        for error in errors
        if all(depths[union][branch] == max(depths[union].values()) for union, branch in _branches(data, error))
    ]


def _branches(data: Any, error: ErrorDetails) -> list[tuple[_Keys, str]]:
    """The branches of unions that an error lies in: each union by its keys, and the branch by pydantic's name for it."""
    return [(keys, step) for keys, step in _steps(data, error) if step is not None]


def _of_key(path: str, keys: _Keys, errors: list[ErrorDetails]) -> LevelError:
    """What is wrong with one key, by all that was said of it."""
    where, first, last = f"{path}: {'.'.join(keys)}", errors[0], errors[-1]
    if first["type"] == "union_tag_invalid":
        return LevelError(
            f"{where}.{first['ctx']['discriminator'].strip(chr(39))}", first["ctx"]["tag"], first["ctx"]["expected_tags"]
        )
    if first["type"] == UNKNOWN_KEY:
        known = first["ctx"]["known"]
        near = get_close_matches(keys[-1], known.split(", "), 1)
        return LevelError(where, Problem(f"unknown key, did you mean '{near[0]}'?" if near else "unknown key"), known)
    if last["type"] == "missing" and isinstance(items := last["loc"][-1], int):  # a list that is too short
        return LevelError(where, last["input"], f"{items + 1} items")
    if first["type"] == "missing":
        return LevelError(where, MISSING_VALUE, "a value: it is required")
    allowed = " or ".join(dict.fromkeys(error["msg"][:1].lower() + error["msg"][1:] for error in errors))
    allowed = re.sub("a valid dictionary( or instance of [A-Za-z]+)?", "a mapping of keys", allowed)
    return LevelError(where, first["input"], allowed.replace("input should be ", ""))


def _keys(data: Any, error: ErrorDetails) -> _Keys:
    """The keys of a file on the way to an error: pydantic's location without the names of its own union branches."""
    *_, (keys, _) = [((), None), *_steps(data, error)]
    return (*keys, error["ctx"]["key"]) if error["type"] == UNKNOWN_KEY else keys


def _steps(data: Any, error: ErrorDetails) -> list[tuple[_Keys, str | None]]:
    """Pydantic's location of an error step by step: the keys so far, and the name of the branch where a union is entered."""
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
