"""Read small YAML or JSON files that a user names on the command line: camera files and style files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml.error import YAMLError

from skugga.terrain.errors import LevelError, Problem
from skugga.terrain.level.data_files import special_file_kind
from skugga.terrain.level.level_text import parse_level_text


def load_mapping(path: Path, contents: str, keys: str, max_characters: int) -> dict[str, Any]:
    """Return the mapping that a YAML or JSON file holds. Raises ``LevelError``.

    ``contents`` names what the file has and ``keys`` its keys, for messages. ``max_characters`` is the longest text.
    """
    readable_remedy = f"Use a readable YAML file of {contents}"
    if (kind := special_file_kind(path)) is not None:
        raise LevelError(str(path), Problem(f"{kind}, not a regular file"), readable_remedy)
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(max_characters + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not UTF-8 text"
        raise LevelError(str(path), Problem(reason), readable_remedy) from None
    if len(text) > max_characters:
        raise LevelError(str(path), Problem(f"more than {max_characters} characters"), "Use a shorter file")
    try:
        data = parse_level_text(text)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        location = f"{path}: line {mark.line + 1}" if mark else str(path)
        problem = Problem(getattr(error, "problem", None) or "malformed YAML")
        raise LevelError(location, problem, "Use well-formed YAML 1.2") from None
    except (ValueError, RecursionError) as error:  # an impossible date, or too deeply nested brackets
        raise LevelError(str(path), Problem(str(error)), "Use well-formed YAML 1.2") from None
    if not isinstance(data, dict):
        raise LevelError(str(path), data, f"a mapping with {keys}")
    return data
