"""Versions of the algorithms' code, by which measured rows are told from rows of older code.

Each algorithm has a version (``Algorithm.version``), and each measured view says with which versions it was measured. A digest of
the code is a reminder: after a change of the code a test fails. Then somebody raises the version, so that the rows have to be
measured again, or accepts that times and errors are as they were.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skugga.shadows.registry import ALGORITHMS, MODULES

ROOT = Path(__file__).resolve().parents[2]
ACCEPTED = Path(__file__).with_name("code_digests.json")

MAX_WORD = 24
"""Length up to which a text without spaces counts as a part of the code: a key or a name. Other texts are messages."""


STEPS = ("compared", "timed", "probed")
"""Keys of a view's record with the origin of its errors, of its times, and of its probes."""

Figures = dict[str, Any]


def algorithms_of(rows: Mapping[str, Figures]) -> list[str]:
    """Return the names of the algorithms of measured rows."""
    return sorted({algorithm for row in rows.values() for algorithm in row["algorithms"]})


def origin_now(algorithms: Iterable[str]) -> Figures:
    """Return the origin of figures that are measured now: the commit, the time and the versions of the algorithms."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    now = datetime.now(UTC).isoformat(timespec="minutes")
    return {
        "commit": run.stdout.strip() or "unknown",
        "date": now,
        "versions": {name: ALGORITHMS[name].version for name in algorithms},
    }


def stale_algorithms(record: Figures, step: str) -> list[str]:
    """Return the algorithms of a view's rows whose code has another version than it had at a step of the measurement."""
    versions = record.get(step, {}).get("versions", {})
    return [name for name in algorithms_of(record["rows"]) if versions.get(name) != ALGORITHMS[name].version]


def code_digests() -> dict[str, str]:
    """Return a digest of each algorithm's code. Comments, docstrings, messages, imports and the names of variables do not count."""
    return {module.ALGORITHM.name: _digest(_files_of(module)) for module in MODULES if module.ALGORITHM.passes}


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
    """Return the files of an algorithm: its module, or all files of its package."""
    path = Path(sys.modules[module.__name__].__file__ or "")
    package = path.parent
    if package.name == "shadows":
        return [path]
    return sorted(file for file in package.rglob("*") if file.suffix in (".py", ".glsl"))


def _digest(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        text = file.read_text(encoding="utf-8")
        digest.update((_normalized_python(text) if file.suffix == ".py" else _normalized_shader(text)).encode())
    return digest.hexdigest()[:16]


def _normalized_shader(text: str) -> str:
    without_comments = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.DOTALL)
    return " ".join(without_comments.split())


def _normalized_python(text: str) -> str:
    """Return the structure of a module's code, with its names numbered in the order of their appearance."""
    numbers: dict[str, int] = {}
    parts: list[str] = []

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Import | ast.ImportFrom) or (isinstance(node, ast.Expr) and _is_text(node.value)):
            return
        parts.append(type(node).__name__)
        for name, value in ast.iter_fields(node):
            if name in ("id", "arg", "attr", "name") and isinstance(value, str):
                parts.append(f"${numbers.setdefault(value, len(numbers))}")
            elif isinstance(node, ast.Constant) and name == "value" and not _is_message(value):
                parts.append(repr(value))
            else:
                for child in value if isinstance(value, list) else [value]:
                    if isinstance(child, ast.AST):
                        visit(child)

    visit(ast.parse(text))
    return " ".join(parts)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_message(value: object) -> bool:
    return isinstance(value, str) and (len(value) > MAX_WORD or " " in value)
