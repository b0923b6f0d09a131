"""Write the reference of level files from their schema: a section for each part, with its keys."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from scripts.markdown_tables import anchor, code, escape, table
from skugga.terrain.level.level import Level

ROOT_PART = "Level"


def level_schema() -> dict[str, Any]:
    """Return the JSON schema of level files, for editors that complete and check them."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Level.model_json_schema()}


def level_page() -> str:
    """Return the page of all keys, one section for each part of a level file in the order of the keys that lead to them."""
    schema = level_schema()
    parts = {ROOT_PART: schema, **schema["$defs"]}
    paths = key_paths(schema)
    sections = [
        "# Keys of a level file\n\nEvery key, from the schema that checks level files: [level.schema.json](level.schema.json), "
        "which editors can use, too. [Levels](../levels.md) explains them with examples.\n"
    ]
    for name, key_path in paths.items():
        rows = [
            (code(key), _type_text(value, paths), _default_text(value, key in parts[name].get("required", ())))
            for key, value in parts[name].get("properties", {}).items()
        ]
        descriptions = {
            key: value["description"] for key, value in parts[name].get("properties", {}).items() if "description" in value
        }
        explained = "".join(f"\n`{key}`: {escape(text)}\n" for key, text in descriptions.items())
        sections.append(
            f"## {_heading(key_path)}\n\n{escape(parts[name].get('description', ''))}\n\n"
            f"{table(('key', 'value', 'default'), rows)}{explained}"
        )
    return "\n".join(sections)


def key_paths(schema: dict[str, Any]) -> dict[str, str]:
    """Return the path of keys that leads to each part of a level file, by the part's name; the first one of several."""
    paths = {ROOT_PART: ""}
    queue = [ROOT_PART]
    while queue:
        name = queue.pop(0)
        part = schema if name == ROOT_PART else schema["$defs"][name]
        for key, value in part.get("properties", {}).items():
            for reference, suffix in _references(value):
                if reference not in paths:
                    kind = schema["$defs"][reference].get("properties", {}).get("kind", {}).get("const")
                    paths[reference] = f"{paths[name]}.{key}{suffix}".lstrip(".") + (f" of kind {kind}" if kind else "")
                    queue.append(reference)
    return paths


def _references(value: dict[str, Any], suffix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the parts that a key's value contains, each with what follows the key in a path: an item or a name."""
    if "$ref" in value:
        yield value["$ref"].rpartition("/")[2], suffix
    for choice in (*value.get("anyOf", ()), *value.get("oneOf", ())):
        yield from _references(choice, suffix)
    if isinstance(value.get("items"), dict):
        yield from _references(value["items"], f"{suffix}[]")
    named = [value["additionalProperties"]] if isinstance(value.get("additionalProperties"), dict) else []
    for item in (*named, *value.get("patternProperties", {}).values()):
        yield from _references(item, f"{suffix}.NAME")


def _heading(key_path: str) -> str:
    """Return the heading of a part's section."""
    return key_path or "The file"


def _type_text(value: dict[str, Any], paths: dict[str, str]) -> str:
    """Return the allowed values of a key in words, with links to the sections of parts."""
    if "$ref" in value:
        heading = _heading(paths[value["$ref"].rpartition("/")[2]])
        return f"[{heading}](#{anchor(heading)})".replace("[]]", "\\[\\]]")
    choices = [*value.get("anyOf", ()), *value.get("oneOf", ())]
    if choices:
        texts = dict.fromkeys(_type_text(choice, paths) for choice in choices if choice.get("type") != "null")
        return " or ".join(texts)
    if "enum" in value:
        return ", ".join(code(item) for item in value["enum"])
    if "const" in value:
        return code(value["const"])
    if "prefixItems" in value:
        items = [_type_text(item, paths) for item in value["prefixItems"]]
        same = len(set(items)) == 1
        return f"list of {len(items)}: {items[0]}" if same else f"list of: {', '.join(items)}"
    if value.get("type") == "array":
        return f"list of: {_type_text(value.get('items', {}), paths)}"
    if value.get("type") == "object":
        named = [*value.get("patternProperties", {}).values()]
        named += [value["additionalProperties"]] if isinstance(value.get("additionalProperties"), dict) else []
        return "by name: " + " or ".join(_type_text(item, paths) for item in named) if named else "keys and values"
    return _plain_type_text(value)


def _plain_type_text(value: dict[str, Any]) -> str:
    """Return the type and the limits of a number, text or boolean in words."""
    names = {"number": "number", "integer": "whole number", "string": "text", "boolean": "`true` or `false`"}
    limits = [
        f"{words} {value[key]:g}"
        for key, words in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if key in value
    ]
    return " ".join([names.get(value.get("type", ""), "any value"), *([f"({', '.join(limits)})"] if limits else [])])


def _default_text(value: dict[str, Any], is_required: bool) -> str:
    """Return the default of a key: a plain value as code, nothing for an empty or a nested one."""
    if is_required:
        return "required"
    default = value.get("default")
    return code(default) if isinstance(default, bool | int | float | str) and default != "" else "-"
