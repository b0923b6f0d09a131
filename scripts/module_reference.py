"""Write the reference of the repository's folders and modules from the first paragraphs of their docstrings."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from scripts.markdown_tables import code, escape, table

ROOT = Path(__file__).resolve().parents[1]

FOLDERS = ("api", "selector", "shadows", "terrain", "benchmarks", "scripts", "viewer/src")
"""Folders whose modules are listed: the layers of the package from the top one down, tools, and the viewer."""

SUFFIXES = (".py", ".ts")
"""Suffixes of modules: Python, and TypeScript of the viewer."""


def modules_page() -> str:
    """Return the page of all folders and modules, a section for each folder."""
    parts = [
        "# Folders and modules\n\nEvery folder of the package, of its tools and of the viewer, and every module in it, in the "
        "words of its own docstring. [Contributing](../contributing.md) has a short map, and says what a change touches.\n"
    ]
    for folder in module_folders():
        rows = [(code(path.name), summary_of(path)) for path in modules_of(folder)]
        parts.append(f"## {folder.relative_to(ROOT)}\n")
        if (folder / "__init__.py").exists():
            parts.append(f"{summary_of(folder / '__init__.py')}\n")
        if rows:
            parts.append(table(("module", "does"), rows))
    return "\n".join(parts)


def module_folders() -> Iterator[Path]:
    """Yield the folders with modules, each before the folders in it."""
    for name in FOLDERS:
        paths = (path for suffix in SUFFIXES for path in (ROOT / name).rglob(f"*{suffix}"))
        yield from sorted({path.parent for path in paths}, key=lambda path: path.parts)


def modules_of(folder: Path) -> list[Path]:
    """Return the files of the modules of a folder, without ``__init__.py``."""
    return sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES and path.name != "__init__.py")


def summary_of(path: Path) -> str:
    """Return the first paragraph of a module's docstring, or of its first comment, for Markdown.

    Raises ``ValueError`` without one.
    """
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        documentation = ast.get_docstring(ast.parse(text))
    else:
        comment = re.match(r"/\*\*(.*?)\*/", text, re.DOTALL)
        documentation = comment and re.sub(r"^ \* ?", "", comment[1], flags=re.MULTILINE).strip()
    if not documentation:
        raise ValueError(f"{path.relative_to(ROOT)}: a docstring is missing.")
    return escape(re.sub(r"``skugga\.([\w.]+)``", r"``\1``", " ".join(documentation.split("\n\n")[0].split())))
