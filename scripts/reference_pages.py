"""Write the pages of the reference from the code: commands, keys, HTTP, settings, products, rules, algorithms, effects.

``make docs`` puts them into the site; they are under no version control. ``REFERENCE_FILES`` names all of them.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import ModuleType
from typing import Any

import typer
from fastapi import FastAPI
from pydantic_core import PydanticUndefined
from pydantic_settings import PydanticBaseSettingsSource

from scripts.algorithm_reference import algorithms_page
from scripts.descriptor_reference import descriptor_page, list_items
from scripts.effect_reference import effects_page
from scripts.level_reference import level_page, level_schema
from scripts.markdown_tables import anchor, code, escape, table
from scripts.module_reference import modules_page
from skugga.api.catalogue import bundled_levels
from skugga.api.cli.lazy_commands import COMMANDS
from skugga.api.cli.main import app as command_line
from skugga.api.http.problems import problem_kinds
from skugga.api.http.server.app import create_app
from skugga.api.products import PRODUCTS, product_table
from skugga.api.settings import Settings
from skugga.selector.planner import advice_rules
from skugga.shadows import passes

PUBLIC_OBJECTS = ("skugga", "skugga.api.library.accessor.SkuggaAccessor")
"""Python objects of the public interface: the package with the names of ``__all__``, and the accessor of xarray's arrays."""

EXAMPLE_LEVEL = "jacksboro"
"""Bundled level whose addresses are the examples of the HTTP reference."""

MIN_SHARED_USES = 4
"""Minimum number of addresses with the same query parameter for which the parameter is described once for all."""


class _DefaultSettings(Settings):
    """Settings of the service that no environment variable changes: pages are the same wherever they are written."""

    @classmethod
    def settings_customise_sources(
        cls, settings_cls: Any, init_settings: PydanticBaseSettingsSource, *args: Any, **kwargs: Any
    ) -> Any:
        """Return the only source of settings, the arguments."""
        return (init_settings,)


def command_line_page() -> str:
    """Return the page of all commands with their arguments and options."""
    group: Any = typer.main.get_command(command_line)
    parts = [
        "# Commands and options\n\nEvery command, from its own help. [Examples](../command-line.md) show them at work.\n",
        "Exit statuses: 0 done, 1 the work failed, 2 the input is wrong. An error is one line on standard error.\n",
        _option_table(group, "skugga"),
    ]
    for name in COMMANDS:
        command = group.commands[name].loaded_command
        context = command.context_class(command, info_name=f"skugga {name}")
        usage = " ".join(command.get_usage(context).removeprefix("Usage:").split())
        parts += [f"## {name}\n\n{escape(command.help)}\n", f"```text\n{usage}\n```\n", _option_table(command, f"skugga {name}")]
    return "\n".join(parts)


def _option_table(command: Any, usage_name: str) -> str:
    """Return the table of the arguments and options of a command."""
    context = command.context_class(command, info_name=usage_name)
    records = [record for parameter in command.get_params(context) if (record := parameter.get_help_record(context))]
    return table(("argument or option", "meaning"), [(code(name), escape(" ".join(text.split()))) for name, text in records])


def openapi_document() -> dict[str, Any]:
    """Return the OpenAPI document of a service of ``EXAMPLE_LEVEL`` that starts no render process."""
    levels = [path for path in bundled_levels() if path.stem == EXAMPLE_LEVEL]
    application: FastAPI = create_app(_DefaultSettings(workers=1), levels)
    return application.openapi()


def http_page(document: dict[str, Any]) -> str:
    """Return the page of all addresses of the service, by subject.

    Query parameters with the same meaning at several addresses are described once, in a section of their own.
    """
    operations = [(method, path, operation) for path, methods in document["paths"].items() for method, operation in methods.items()]
    shared = _shared_parameters(operation for _, _, operation in operations)
    parts = [
        "# Addresses of the service\n\nEvery address, from the service's own OpenAPI document "
        "([openapi.json](openapi.json); a running service has it as `/openapi.json`, and as a page to try on `/docs`). "
        "[The map service](../map-service.md) explains them.\n"
    ]
    for tag in dict.fromkeys(operation["tags"][0] for _, _, operation in operations):
        parts.append(f"## {tag.capitalize()}\n")
        parts += [
            _operation_section(method, path, operation, shared)
            for method, path, operation in operations
            if operation["tags"][0] == tag
        ]
    parts.append("## Shared query parameters\n\nAddresses that name them as shared give them these meanings.\n")
    parts += [f"### {name}\n\n{meaning}\n" for name, meaning in sorted(shared.items())]
    parts.append(f"## Problems\n\nErrors are `application/problem+json` (RFC 9457).\n\n{problems_table()}\n")
    return "\n".join(parts)


def _shared_parameters(operations: Iterable[dict[str, Any]]) -> dict[str, str]:
    """Return the meaning of each query parameter that at least ``MIN_SHARED_USES`` operations describe in the same words."""
    uses = Counter(
        (parameter["name"], _described(parameter))
        for operation in operations
        for parameter in operation.get("parameters", [])
        if parameter["in"] == "query"
    )
    shared: dict[str, str] = {}
    for (name, meaning), count in uses.most_common():
        if count >= MIN_SHARED_USES:
            shared.setdefault(name, meaning)
    return shared


def _operation_section(method: str, path: str, operation: dict[str, Any], shared: dict[str, str]) -> str:
    """Return the section of one address: description, parameters, body and statuses."""
    parts = [f"### {method.upper()} `{path}`\n", f"**{escape(operation['summary'])}.** {escape(operation['description'])}\n"]
    own, names = [], []
    for parameter in operation.get("parameters", []):
        if shared.get(parameter["name"]) == _described(parameter):
            names.append(parameter["name"])
        else:
            own.append((f"{code(parameter['name'])} ({parameter['in']})", _described(parameter)))
    if own:
        parts.append(table(("parameter", "meaning"), own))
    if names:
        parts.append("Shared parameters: " + ", ".join(f"[`{name}`](#{anchor(name)})" for name in names) + ".\n")
    for media_type, content in operation.get("requestBody", {}).get("content", {}).items():
        example = content.get("example")
        if example is not None:
            parts.append(f"Body ({code(media_type)}), for example:\n\n```json\n{json.dumps(example, indent=1)}\n```\n")
    statuses = [f"{status} ({escape(response['description'].rstrip('.'))})" for status, response in operation["responses"].items()]
    parts.append("Statuses: " + ", ".join(statuses) + ".\n")
    return "\n".join(parts)


def _described(parameter: dict[str, Any]) -> str:
    """Return the description of a parameter with its allowed values and its default."""
    schema, notes = parameter["schema"], ["required"] if parameter.get("required") and parameter["in"] == "query" else []
    values = schema.get("enum") or next((item["enum"] for item in schema.get("anyOf", []) if "enum" in item), None)
    if values:
        notes.append("one of " + ", ".join(code(value) for value in values))
    if schema.get("default") is not None:
        notes.append(f"default {code(schema['default'])}")
    return escape(parameter.get("description", "")) + (f" ({'; '.join(notes)})" if notes else "")


def settings_page() -> str:
    """Return the page of all settings of the service."""
    return (
        "# Settings of the service\n\n`skugga serve` reads these environment variables. "
        f"[Operating the service](../operating.md) says when to change which.\n\n{settings_table()}\n"
    )


def settings_table() -> str:
    """Return the table of all settings: variable, default and meaning."""
    rows = ["| variable | default | what |", "| --- | --- | --- |"]
    for name, field in Settings.model_fields.items():
        default: Any = field.default
        if default is PydanticUndefined:
            default = "cores, at most 4"
        elif default is None or default == ():
            default = "-"
        elif isinstance(default, tuple):
            default = f"`{','.join(default)}`"
        else:
            default = f"`{str(default).lower() if isinstance(default, bool) else default}`"
        rows.append(f"| `SKUGGA_{name.upper()}` | {default} | {field.description} |")
    return "\n".join(rows)


def problems_table() -> str:
    """Return the table of all kinds of problems: status, code, meaning and when to try again."""
    rows = ["| status | `code` | what | `Retry-After` |", "| --- | --- | --- | --- |"]
    for kind in problem_kinds():
        rows.append(f"| {kind.status} | `{kind.code}` | {kind.description} | {kind.retry_after_s or '-'} |")
    return "\n".join(rows)


def products_page() -> str:
    """Return the page of all products with their options."""
    parts = [
        "# Table of products\n\nA product is what is computed of a level. HTTP and files call it a layer. "
        f"[Products](../products.md) says how to add one.\n\n{product_table()}"
    ]
    values = pass_layer_values()
    view_rows = [
        (code(product.name), escape(product.description), escape(values.get(product.name, "")), ", ".join(product.formats))
        for product in PRODUCTS.values()
        if not (product.map_formats or product.is_raster)
    ]
    view_table = table(("product", "shows", "values", "formats"), view_rows)
    parts.append(f"## Layers of views\n\nViews have these products, too.\n\n{view_table}")
    for product in PRODUCTS.values():
        fields = product.options.model_fields
        if fields:
            defaults = {name: "required" if field.is_required() else code(field.default) for name, field in fields.items()}
            rows = [(code(name), defaults[name], escape(field.description or "")) for name, field in fields.items()]
            parts.append(f"## {product.name}\n\n{table(('option', 'default', 'meaning'), rows)}")
    return "\n".join(parts)


def pass_layer_values() -> dict[str, str]:
    """Return what the values of each intermediate picture of an algorithm mean, from the documentation of ``PassLayer``."""
    return {name: text for (name,), text in list_items(variable_documentation(passes)["PassLayer"])}


def variable_documentation(module: ModuleType) -> dict[str, str]:
    """Return the text behind each assignment of a module, by the variable's name."""
    body = ast.parse(inspect.getsource(module)).body
    return {
        statement.targets[0].id: inspect.cleandoc(documentation.value.value)
        for statement, documentation in zip(body, body[1:], strict=False)
        if isinstance(statement, ast.Assign)
        and isinstance(statement.targets[0], ast.Name)
        and isinstance(documentation, ast.Expr)
        and isinstance(documentation.value, ast.Constant)
        and isinstance(documentation.value.value, str)
    }


def rules_page() -> str:
    """Return the page of the planner's rules in order of precedence, and of their thresholds."""
    rows = [
        (str(number), escape(rule.name), code(rule.algorithm), escape(rule_condition(rule)), _with_links(rule.source))
        for number, rule in enumerate(advice_rules.RULES, 1)
    ]
    thresholds = [(code(name), code(f"{value:.4g}"), _with_links(text)) for name, value, text in rule_thresholds()]
    return (
        "# Rules of the planner\n\nThe policy `rules` takes the first rule that applies to a light and a kind of casters in a "
        "view, and whose algorithm can draw it; else `shadow_map`. [Select](../select.md) shows the policies.\n\n"
        f"{table(('', 'rule', 'algorithm', 'applies where', 'source'), rows)}\n"
        f"## Thresholds\n\n{table(('name', 'value', 'meaning and source'), thresholds)}"
    )


def _with_links(text: str) -> str:
    """Return a text for Markdown in which the pages that it names are links."""
    return re.sub(r"`?docs/(reports/)?([\w-]+)\.md`?", r"[\2](../\1\2.md)", escape(text))


def rule_condition(rule: advice_rules.Rule) -> str:
    """Return the condition of a rule in words: what follows the algorithm in the summary of its function."""
    summary = " ".join((inspect.getdoc(rule.reason_for) or "").split())
    match = re.match(r"Return the reason for [^:]+: (.+?)\.(?: |$)", summary)
    if match is None:
        raise ValueError(f"{rule.name}: the docstring does not begin with 'Return the reason for ALGORITHM: CONDITION.'")
    return match[1]


def rule_thresholds() -> Iterator[tuple[str, float, str]]:
    """Yield the name, the value and the documentation of each number that the rules compare with."""
    for name, documentation in variable_documentation(advice_rules).items():
        if isinstance(value := getattr(advice_rules, name), int | float):
            yield name, value, " ".join(documentation.split())


def python_page(objects: Sequence[str] = PUBLIC_OBJECTS) -> str:
    """Return the page of the Python interface. mkdocstrings puts the docstrings in the place of its lines ``:::``."""
    directives = "\n\n".join(f"::: {name}" for name in objects)
    return f"# Python\n\n[From Python](../python.md) shows how they are used.\n\n{directives}\n"


def _json_text(value: dict[str, Any]) -> str:
    """Return the text of a JSON file."""
    return json.dumps(value, indent=1, ensure_ascii=False) + "\n"


REFERENCE_FILES: dict[str, Callable[[], str]] = {
    "command-line.md": command_line_page,
    "level-file.md": level_page,
    "level.schema.json": lambda: _json_text(level_schema()),
    "http.md": lambda: http_page(openapi_document()),
    "openapi.json": lambda: _json_text(openapi_document()),
    "settings.md": settings_page,
    "products.md": products_page,
    "rules.md": rules_page,
    "algorithms.md": algorithms_page,
    "effects.md": effects_page,
    "descriptor.md": descriptor_page,
    "modules.md": modules_page,
    "python.md": python_page,
}
"""Files of the site's folder ``reference``: function that returns the text, by name."""
