"""Versions of the algorithms' code, by which measured rows are told from rows of older code.

Each algorithm has a version (``Algorithm.version``), and each measured view says with which versions it was measured. A digest of
the code is a reminder: after a change of the code a test fails. Then somebody raises the version, so that the rows have to be
measured again, or accepts that times and errors are as they were.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from skugga.shadows.registry import ALGORITHM_MODULES, ALGORITHMS

ROOT = Path(__file__).resolve().parents[2]
ACCEPTED = Path(__file__).with_name("code_digests.json")
"""File with the accepted version and code digest of each algorithm."""

DECLARATIONS = {
    "skugga.shadows.algorithm",
    "skugga.shadows.algorithm_settings",
    "skugga.shadows.requirements",
    "skugga.shadows.plan",
    "skugga.shadows.registry",
}
"""Modules that declare algorithms and plans. Their text does not count in digests."""

METHODS = frozenset(name for kind in (np.ndarray, dict, list, set, str) for name in dir(kind))
"""Methods that keep their text in digests, whatever value they belong to."""

MAX_WORD = 24
"""Number of characters up to which a text without spaces counts as code: a key or a name. Other texts are messages."""


STEPS = ("compared", "timed", "probed")
"""Keys of a view's record with the origin of its errors, of its times, and of its probes."""

Figures = dict[str, Any]
"""A JSON object of a view's record (or a part of it) by key."""


def algorithms_of(rows: Mapping[str, Figures]) -> list[str]:
    """Return the sorted names of all algorithms in measured rows (plans of a view by name)."""
    return sorted({algorithm for row in rows.values() for algorithm in row["algorithms"]})


def origin_now(algorithms: Iterable[str]) -> Figures:
    """Return the origin of figures that are measured now: the commit, the time and the versions of the algorithms."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    commit = ""
    with suppress(FileNotFoundError):  # without git
        commit = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
    now = datetime.now(UTC).isoformat(timespec="minutes")
    return {
        "commit": commit or "unknown",
        "date": now,
        "versions": {name: ALGORITHMS[name].version for name in algorithms},
    }


def stale_algorithms(record: Figures, step: str) -> list[str]:
    """Return the algorithms of a view's rows whose present version differs from the version at ``step``, one of ``STEPS``."""
    versions = record.get(step, {}).get("versions", {})
    return [name for name in algorithms_of(record["rows"]) if versions.get(name) != ALGORITHMS[name].version]


def code_digests() -> dict[str, str]:
    """Return a digest of each algorithm's code, 16 hexadecimal digits, by the algorithm's name.

    Comments, docstrings, messages, imports and the names of variables do not count.
    """
    return {module.ALGORITHM.name: _digest(_files_of(module)) for module in ALGORITHM_MODULES if module.ALGORITHM.passes}


def unaccepted_algorithms() -> list[str]:
    """Return the algorithms whose code has changed while their version has not."""
    accepted = json.loads(ACCEPTED.read_text(encoding="utf-8")) if ACCEPTED.exists() else {}
    digests = code_digests()
    return [name for name, digest in digests.items() if accepted.get(name) != [ALGORITHMS[name].version, digest]]


def accept_code() -> None:
    """Write the present versions and digests: the rows that were measured with these versions hold for the present code."""
    entries = {name: [ALGORITHMS[name].version, digest] for name, digest in code_digests().items()}
    ACCEPTED.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


def _files_of(module: Any) -> list[Path]:
    """Return the files of an algorithm's code: its module, all modules of ``skugga.shadows`` that it imports, and their shaders.

    Modules that only declare algorithms and plans do not count.
    """
    pending, paths = [module.__name__], dict[str, Path]()
    while pending:
        name = pending.pop()
        if name not in paths and name not in DECLARATIONS:
            paths[name] = Path(sys.modules[name].__file__ or "").resolve()
            pending += _imported_modules(paths[name])
    shaders = {shader for path in paths.values() for shader in path.parent.glob("shaders/*.glsl")}
    return sorted({*paths.values(), *shaders})


def _imported_modules(path: Path) -> list[str]:
    """Return the names of the loaded modules of ``skugga.shadows`` that a file imports."""
    names = [
        name
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
    ]
    return [name for name in names if name.startswith("skugga.shadows.") and name in sys.modules]


def _digest(files: list[Path]) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 hash of normalized Python and GLSL files."""
    digest = hashlib.sha256()
    for file in files:
        text = file.read_text(encoding="utf-8")
        digest.update((_normalized_python(text) if file.suffix == ".py" else _normalized_shader(text)).encode())
    return digest.hexdigest()[:16]


def _normalized_shader(text: str) -> str:
    """Return GLSL source without comments and with single spaces."""
    without_comments = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.DOTALL)
    return " ".join(without_comments.split())


def _normalized_python(text: str) -> str:
    """Return the structure of a module's code, with its names numbered in the order of their appearance.

    Names of Python and of other packages keep their text: those that the module imports, what it reaches through them, built-in
    functions, and methods of arrays and containers.
    """
    tree = ast.parse(text)
    foreign = (set(dir(builtins)) - {"_"}) | {  # the prompt of Python, also that of doctests, sets "_"
        alias.asname or alias.name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import) or (isinstance(node, ast.ImportFrom) and not (node.module or "").startswith("skugga"))
        for alias in node.names
    }
    numbers: dict[str, int] = {}
    parts: list[str] = []

    def number(name: str) -> str:
        return f"${numbers.setdefault(name, len(numbers))}"

    def visit(node: ast.AST, calls_foreign: bool = False) -> None:
        if isinstance(node, ast.Import | ast.ImportFrom) or (isinstance(node, ast.Expr) and _is_text(node.value)):
            return
        parts.append(type(node).__name__)
        for name, value in ast.iter_fields(node):
            if name in ("id", "arg", "attr", "name") and isinstance(value, str):
                is_foreign = (
                    value in foreign if name == "id"
                    else value in METHODS or _root(node) in foreign if name == "attr"
                    else calls_foreign
                )  # fmt: skip
                parts.append(value if is_foreign else number(value))
            elif isinstance(node, ast.Constant) and name == "value" and not _is_message(value):
                parts.append(repr(value))
            else:
                for child in value if isinstance(value, list) else [value]:
                    if isinstance(child, ast.AST):
                        visit(child, isinstance(child, ast.keyword) and isinstance(node, ast.Call) and _root(node.func) in foreign)

    visit(tree)
    return " ".join(parts)


def _root(node: ast.AST) -> str | None:
    """Return the first name of a chain of attributes (``np`` of ``np.linalg.norm``); ``None`` if it does not begin with a name."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None


def _is_text(node: ast.AST) -> bool:
    """Return whether a node of the syntax tree is a constant string."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_message(value: object) -> bool:
    """Return whether a constant is a text for people: longer than ``MAX_WORD`` or with spaces."""
    return isinstance(value, str) and (len(value) > MAX_WORD or " " in value)
