"""List the messages of all errors, warnings and log lines in the source, by kind.

    python -m benchmarks.messages                # all
    python -m benchmarks.messages InputError     # of one kind

Each line has the file, the line number and the texts of a call, with expressions in braces. Maintainers check the list against the
rule "NAME: problem. Remedy.".
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("terrain", "shadows", "selector", "api")
"""Folders of the packages whose source is searched."""
ERROR_KINDS = ("missing", "conflict", "over_limit")
"""Class methods that construct an error of a kind."""
LOG_LEVELS = ("warning", "error", "info")
"""Methods of ``log`` that write a line."""


@dataclass(frozen=True)
class Message:
    """A message in the source.

    Attributes
    ----------
    kind
        The error's class, with its kind if it is one of ``ERROR_KINDS``; ``warning`` or ``log``.
    path, line
        File and line number of the call.
    texts
        The arguments of the call, expressions in braces.
    """

    kind: str
    path: Path
    line: int
    texts: tuple[str, ...]


def messages(root: Path = ROOT) -> list[Message]:
    """Return all messages in the packages' source, ordered by kind, file and line."""
    result = []
    for layer in PACKAGES:
        for path in sorted((root / layer).rglob("*.py")):
            result += messages_of(path.read_text(encoding="utf-8"), path.relative_to(root))
    return sorted(result, key=lambda message: (message.kind, message.path, message.line))


def messages_of(source: str, path: Path) -> Iterator[Message]:
    """Yield the messages of a module. ``source`` is its text, and ``path`` its file relative to the root."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and (kind := _kind(node.func)) is not None:
            texts = (_text(argument) for argument in [*node.args, *(keyword.value for keyword in node.keywords)])
            yield Message(kind, path, node.lineno, tuple(text for text in texts if text))


def _kind(function: ast.expr) -> str | None:
    """Return the kind of message that a call of ``function`` makes, or ``None`` if it makes none."""
    if isinstance(function, ast.Name):
        return function.id if function.id.endswith("Error") else None
    if not isinstance(function, ast.Attribute) or not isinstance(function.value, ast.Name):
        return None
    owner, name = function.value.id, function.attr
    if owner.endswith("Error") and name in ERROR_KINDS:
        return f"{owner}.{name}"
    if (owner, name) == ("warnings", "warn"):
        return "warning"
    return "log" if owner == "log" and name in LOG_LEVELS else None


def _text(node: ast.expr) -> str:
    """Return a string as it is written in the source, with other expressions in braces."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        return f"{{{ast.unparse(node.value)}}}"
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Problem":
        return _text(node.args[0])
    return f"{{{ast.unparse(node)}}}"


def main(kinds: list[str]) -> None:
    """Print the messages of some kinds, or of all."""
    for message in messages():
        if not kinds or message.kind in kinds:
            print(f"{message.kind}  {message.path}:{message.line}  {' | '.join(message.texts)}")


if __name__ == "__main__":
    main(sys.argv[1:])
