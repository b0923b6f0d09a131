"""Write the reference of descriptors from the docstrings of their types: a section for each type, with its fields."""

from __future__ import annotations

import inspect
import re

from scripts.markdown_tables import code, escape, table
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, CastBand, CasterFacts, Casting, Facts, LampFacts, LightFacts

DESCRIPTOR_TYPES: dict[str, type[Facts]] = {
    "The descriptor": Descriptor,
    "bands[]": Band,
    "stands[]": CasterFacts,
    "lamps[]": LampFacts,
    "lights.NAME": LightFacts,
    "lights.NAME.casts.KIND": Casting,
    "lights.NAME.casts.KIND.bands[]": CastBand,
}
"""Types of the parts of a descriptor, by the key that leads to them."""


def descriptor_page() -> str:
    """Return the page of all fields of a descriptor, a section for each type."""
    parts = [
        "# Fields of a descriptor\n\nEvery field, from the docstrings of the types that check it. "
        "[The descriptor](../descriptor.md) says what it is for, and how facts are measured.\n\n"
        "Lengths are metres, angles degrees, shares lie between 0 and 1. `None` is `null` in JSON. "
        "The axes of light space point right, up, and away from the sun.\n"
    ]
    for heading, facts in DESCRIPTOR_TYPES.items():
        introduction, fields = field_texts(facts)
        rows = [(", ".join(code(name) for name in names), escape(text)) for names, text in fields]
        parts.append(f"## {heading}\n\n{escape(introduction)}\n\n{table(('field', 'meaning'), rows)}")
    return "\n".join(parts)


def field_texts(facts: type[Facts]) -> tuple[str, list[tuple[tuple[str, ...], str]]]:
    """Return what a type's docstring says first, and the names and the text of each item of its list of fields."""
    documentation = inspect.getdoc(facts) or ""
    return " ".join(documentation.partition("\n- ``")[0].split()), list_items(documentation)


def list_items(documentation: str) -> list[tuple[tuple[str, ...], str]]:
    """Return the names and the text of each item of the list with which a text ends."""
    items = []
    for item in re.split(r"\n+- (?=``)", documentation)[1:]:
        names, _, text = " ".join(item.split()).partition(": ")
        items.append((tuple(re.findall(r"``([\w-]+)``", names)), text))
    return items
