"""Names of the shadow algorithms that a level file may use.

``skugga.shadows.registry``, a higher layer, registers the algorithms themselves.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

ALGORITHM_NAMES = [
    "shadow_map", "perspective_shadow_map", "light_space_perspective_map", "shadow_volume", "hybrid",
    "reconstructed_volume", "planar", "sweep", "truth", "none",
]  # fmt: skip
"""Names of all algorithms. ``skugga.shadows.registry.register_algorithm`` adds to this list in place, so do not copy it."""


REFERENCE_NAMES = ["truth"]
"""Names of reference algorithms, which serve to measure the errors of the others. HTTP requests cannot use them.

``skugga.shadows.registry.register_algorithm`` adds to this list in place.
"""


def served_algorithms() -> tuple[str, ...]:
    """Return the names that an HTTP request may use."""
    return tuple(name for name in ALGORITHM_NAMES if name not in REFERENCE_NAMES)


class _RegisteredName:
    """Validator that accepts a string only if it is in ``ALGORITHM_NAMES`` at the time of validation."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(_check_registered, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": "string", "enum": list(ALGORITHM_NAMES)}


def _check_registered(name: str) -> str:
    if name not in ALGORITHM_NAMES:
        *earlier_names, last = (f"'{registered_name}'" for registered_name in ALGORITHM_NAMES)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(earlier_names)} or {last}"})
    return name


AlgorithmName = Annotated[str, _RegisteredName()]
