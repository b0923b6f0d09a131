"""Write Markdown: tables, code, and text that contains no markup of its own."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from typing import Any


def escape(text: str) -> str:
    """Return a text for Markdown, with backticks around what reStructuredText calls code, and without HTML tags.

    Text between backticks is left as it is. Lines stay, since blank lines part paragraphs.
    """
    pieces = re.split(r"(`[^`]*`)", text.replace("``", "`"))
    return "".join(piece if piece.startswith("`") else _escape_plain(piece) for piece in pieces)


def _escape_plain(text: str) -> str:
    """Return a text without code for Markdown."""
    return re.sub(r"([\[\]*])", r"\\\1", text.replace("&", "&amp;").replace("<", "&lt;")).replace("|", "&#124;")


def code(value: Any) -> str:
    """Return a value as code: text as it is, other values as in JSON or Python."""
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f"`{text}`" if text else "empty"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table. Cells are Markdown on one line."""
    lines = [header, ["---"] * len(header), *([_without_bars(" ".join(cell.split())) for cell in row] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _without_bars(cell: str) -> str:
    """Return a cell whose vertical bars do not end it. In code they become HTML: GitHub and the site read a backslash there."""

    def html_code(match: re.Match[str]) -> str:
        return f"<code>{html.escape(match[1], quote=False)}</code>".replace("|", "&#124;")

    return re.sub(r"`([^`]*\|[^`]*)`", html_code, cell).replace("|", "\\|")


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as GitHub and the site make it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
