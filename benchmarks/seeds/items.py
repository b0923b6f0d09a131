"""The list of everything in the texts, with its state in Skugga: read from ``items.yaml``, checked, and formatted as tables."""

from __future__ import annotations

import ast
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ruamel.yaml import YAML

from benchmarks.seeds.claims import markdown_table

ITEMS_FILE = Path(__file__).parent / "items.yaml"

PAGE = Path("reports/seeds.md")
"""The page with the list, from the folder ``docs``."""

TEXT_TITLES = {
    "thesis": "J. Sindholt, A comparison of Shadow Algorithms (DTU 2005)",
    "spatialace": "A thesis on shadows in SpatialAce (Chalmers)",
    "copenhagen": "A bachelor's report on shadow volumes and shadow maps (Copenhagen)",
    "tutorial": "J. Tsiombikas, Volume Shadows Tutorial",
    "lecture": "I. Ragnemalm, lecture on shadows (Linköping)",
}
"""Titles of the texts, by their keys in the file."""

STATES = ("works", "partly", "left out")

LIST_TITLE, LIST_ANCHOR = "Everything in the texts", "everything-in-the-texts"
"""Heading of the list, and its anchor."""


@dataclass(frozen=True)
class Item:
    """A technique, wish, setting, scene or statement of a text, and its state.

    Attributes
    ----------
    item
        The item in our words.
    section
        The text's section, figure, table or key.
    state
        One of ``STATES``.
    figure
        The page below ``docs`` that has the figure, with an anchor; an anchor alone is a section of ``PAGE``.
    files, tests
        The files that do it and the tests that hold it (``path::name``), from the root of the repository.
    note
        What is missing, or the reason for leaving the item out.
    """

    item: str
    section: str
    state: str
    figure: str
    files: tuple[str, ...] = ()
    tests: tuple[str, ...] = ()
    note: str = ""


def read_items(path: Path = ITEMS_FILE) -> dict[str, list[Item]]:
    """Return the items of each text, by the keys of ``TEXT_TITLES``. A key that items do not have raises a ``TypeError``."""
    content = YAML(typ="safe").load(path)
    return {
        text: [Item(**{key: tuple(value) if isinstance(value, list) else value for key, value in row.items()}) for row in rows]
        for text, rows in content.items()
    }


def format_items(items: Mapping[str, Sequence[Item]]) -> str:
    """Format the list as a section in Markdown, with one table for each text."""
    counts = Counter(item.state for rows in items.values() for item in rows)
    summary = ", ".join(f"{counts[state]} {'work' if state == 'works' else state}" for state in STATES)
    parts = [
        f"## {LIST_TITLE}",
        f"{counts.total()} techniques, wishes, settings, scenes and statements of five texts: {summary}. The list is data, "
        "`benchmarks/seeds/items.yaml`; a test checks that each file, test and section exists. H22 and the like are "
        "[hard cases](../hard-cases.md).",
    ]
    for text, title in TEXT_TITLES.items():
        parts += [f"### {title}", "\n".join(markdown_table([_table_row(item) for item in items[text]]))]
    return "\n\n".join(parts) + "\n"


def find_problems(items: Mapping[str, Sequence[Item]], root: Path) -> Iterator[str]:
    """Yield a line for each error of the list: texts, states, missing parts, and names of what ``root`` does not have."""
    if list(items) != list(TEXT_TITLES):
        yield f"texts: {', '.join(items)}. Allowed: {', '.join(TEXT_TITLES)}."
    all_items = [item for rows in items.values() for item in rows]
    test_files = {root / test.partition("::")[0] for item in all_items for test in item.tests}
    pages = {root / "docs" / (item.figure.partition("#")[0] or PAGE) for item in all_items}
    functions = {path: _function_names(path) for path in test_files if path.is_file()}
    anchors = {path: _anchors(path) for path in pages if path.is_file()}
    for text, rows in items.items():
        for name, count in Counter(item.item for item in rows).items():
            if count > 1:
                yield f"{text}: {name}: occurs {count} times."
        for item in rows:
            prefix = f"{text}: {item.item}"
            if item.state not in STATES:
                yield f"{prefix}: no such state: {item.state}. Allowed: {', '.join(STATES)}."
            if item.state != "left out" and not (item.files and item.tests):
                yield f"{prefix}: names no file or no test."
            if item.state != "works" and not item.note:
                yield f"{prefix}: gives no reason."
            yield from (f"{prefix}: no such file: {file}" for file in item.files if not (root / file).is_file())
            for test in item.tests:
                path, _, function = test.partition("::")
                if function not in functions.get(root / path, ()):
                    yield f"{prefix}: no such test: {test}"
            page, _, anchor = item.figure.partition("#")
            if anchor not in anchors.get(root / "docs" / (page or PAGE), ()):
                yield f"{prefix}: no such section: {item.figure}"


def _function_names(path: Path) -> set[str]:
    """Return the names of a module's functions."""
    nodes = ast.parse(path.read_text("utf-8")).body
    return {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


def _anchors(path: Path) -> set[str]:
    """Return the anchors of a page: an empty one, and those of headings that GitHub and Python-Markdown write alike."""
    headings = re.findall(r"^#+ (.+)$", path.read_text("utf-8"), re.MULTILINE)
    words = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings]
    return {"", *(text.replace(" ", "-") for text in words if text.replace(" ", "-") == re.sub(r"[-\s]+", "-", text))}


def _table_row(item: Item) -> dict[str, str]:
    """Return an item's row by column."""
    page, mark, anchor = item.figure.partition("#")
    link = os.path.relpath(page, PAGE.parent) if page else ""
    return {
        "item": item.item,
        "section": item.section,
        "state": f"{item.state}: {item.note}" if item.note else item.state,
        "file": ", ".join(f"`{file}`" for file in item.files),
        "test": ", ".join(f"`{test}`" for test in item.tests),
        "figure": f"[{page.removesuffix('.md') or 'above'}]({link}{mark}{anchor})",
    }
