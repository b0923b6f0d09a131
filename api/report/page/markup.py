"""HTML and SVG elements as text, with escaping in one place."""

from __future__ import annotations

import json
from html import escape
from typing import Any

VOID_ELEMENTS = frozenset({"img", "input", "br", "wbr"})
"""HTML elements without an end tag."""


def tag(name: str, *content: str, **attributes: Any) -> str:
    """Return an element with markup as content.

    ``class_`` stands for ``class`` and ``data_value`` for ``data-value``. Attributes of ``None`` are omitted.
    """
    attribute_text = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"' for key, value in attributes.items() if value is not None
    )
    return f"<{name}{attribute_text}>" if name in VOID_ELEMENTS else f"<{name}{attribute_text}>{''.join(content)}</{name}>"


def definition_list(pairs: dict[str, str], **attributes: Any) -> str:
    """Return a definition list of plain texts."""
    return tag(
        "dl", *(tag("div", tag("dt", escape(key)), tag("dd", escape(str(value)))) for key, value in pairs.items()), **attributes
    )


def breakable_text(text: str) -> str:
    """Return escaped text that may break after a comma or a hyphen, for names of rows."""
    return escape(text).replace(",", ",<wbr>").replace("-", "-<wbr>")


def script_json(value: Any) -> str:
    """Return JSON for a script element. No text in it can end the element or open a comment (HTML, 4.12.1.3)."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
