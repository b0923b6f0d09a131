"""Style files: YAML or JSON files with the keys that ``style`` has in a level file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from skugga.terrain.level.level_errors import level_error
from skugga.terrain.level.parts import StyleSpec
from skugga.terrain.level.yaml_file import load_mapping

STYLE_FILE_SUFFIXES = ".yaml", ".yml", ".json"

MAX_FILE_CHARACTERS = 2**16
"""Maximum length of a style file: far more than the longest ramp needs."""


def load_style_keys(path: Path) -> dict[str, Any]:
    """Return the keys that a style file sets, with validated values. Raises ``LevelError``, which has a line for each wrong key."""
    data = load_mapping(path, "a style", f"keys of a style: {', '.join(StyleSpec.model_fields)}", MAX_FILE_CHARACTERS)
    try:
        spec = StyleSpec.model_validate(data)
    except ValidationError as error:
        raise level_error(str(path), data, error.errors()) from None
    return {key: value for key, value in dict(spec).items() if key in spec.model_fields_set}
