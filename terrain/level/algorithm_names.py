"""The names of shadow algorithms that a level may ask for. What they are is said by ``skugga.shadows.registry``, a floor above."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

ALGORITHM_NAMES = ["shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid", "planar", "sweep", "truth", "none"]
"""All names. ``skugga.shadows.registry.register_algorithm`` adds to them, so nobody keeps a copy."""


REFERENCE_NAMES = ["truth"]
"""Those of references, with which others are compared: no service draws by them. ``register_algorithm`` keeps them, too."""


def served_algorithms() -> tuple[str, ...]:
    """Return the names that a request over HTTP may ask for."""
    return tuple(name for name in ALGORITHM_NAMES if name not in REFERENCE_NAMES)


class _OneOfThem:
    """Holds a string to the names of the moment."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(_known, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": "string", "enum": list(ALGORITHM_NAMES)}


def _known(name: str) -> str:
    if name not in ALGORITHM_NAMES:
        *others, last = (f"'{each}'" for each in ALGORITHM_NAMES)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(others)} or {last}"})
    return name


AlgorithmName = Annotated[str, _OneOfThem()]
