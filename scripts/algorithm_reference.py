"""Write the reference of shadow algorithms from their records and settings: a section for each algorithm."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from scripts.markdown_tables import code, escape, table
from skugga.shadows.algorithm import Algorithm
from skugga.shadows.registry import ALGORITHM_MODULES


def algorithms_page() -> str:
    """Return the page of the algorithms that come with Skugga, in the order of their registration."""
    parts = [
        "# Algorithms and their settings\n\nWhat each algorithm refuses, and what `auto` chooses for its settings. "
        "[The algorithms](../algorithms.md) says when to use which.\n\nA setting is a key of `shadows` in a level file "
        "([values](level-file.md#shadows)), an option of the command line (`map_size` is `--map-size`), and mostly a query "
        "parameter.\n"
    ]
    for module in ALGORITHM_MODULES:
        algorithm = module.ALGORITHM
        path = module.__name__.removeprefix("skugga.").replace(".", "/") + ".py"
        parts.append(f"## {algorithm.name}\n\n{escape(_sentence(algorithm.description))}\n\n{_properties_list(algorithm, path)}")
        if rows := [(code(key), values, text) for key, values, text in setting_rows(algorithm)]:
            parts.append(table(("setting", "values", "meaning"), rows))
    return "\n".join(parts)


def setting_rows(algorithm: Algorithm) -> Iterator[tuple[str, str, str]]:
    """Yield the name, the values and the description of each documented setting of an algorithm.

    A setting that several of its settings' types declare counts once, in the words of the first.
    """
    seen: set[str] = set()
    for settings_type in algorithm.settings_types:
        for name, field in settings_type.model_fields.items():
            if field.description and name not in seen:
                seen.add(name)
                yield name, _values_text(field), escape(field.description)


def _properties_list(algorithm: Algorithm, module_path: str) -> str:
    """Return the list of what an algorithm refuses, of the layers that it keeps and of its module."""
    refusals = [f"- Refuses `{requirement}`: {escape(reason)}." for requirement, reason in algorithm.refusals.items()]
    layers = [f"- Layers: {', '.join(code(layer) for layer in algorithm.layers)}."] if algorithm.layers else []
    return "\n".join([*(refusals or ["- Refuses nothing."]), *layers, f"- Module: {code(module_path)}.", ""])


def _values_text(field: FieldInfo) -> str:
    """Return the values of a setting: those of a ``Literal`` or the range of a number, else nothing."""
    if get_origin(field.annotation) is Literal:
        return ", ".join(code(value) for value in get_args(field.annotation))
    limits = {name: value for item in field.metadata for name in ("ge", "le") if (value := getattr(item, name, None)) is not None}
    return f"{limits['ge']:g} to {limits['le']:g}" if len(limits) == 2 else ""


def _sentence(text: str) -> str:
    """Return a text as a sentence, with a capital letter and a full stop."""
    return f"{text[0].upper()}{text[1:].rstrip('.')}."
