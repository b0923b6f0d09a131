"""Elements of HTML and SVG as text, with everything in them escaped at one place."""

from __future__ import annotations

import json
from html import escape
from typing import Any

VOID = frozenset({"img", "input", "br", "wbr"})
"""Elements of HTML that have no end tag."""


def tag(name: str, *content: str, **attributes: Any) -> str:
    """An element around markup; ``class_`` is ``class``, ``data_value`` is ``data-value``, an attribute of ``None`` is left out."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value))}"' for key, value in attributes.items() if value is not None
    )
    return f"<{name}{written}>" if name in VOID else f"<{name}{written}>{''.join(content)}</{name}>"


def definitions(pairs: dict[str, str], **attributes: Any) -> str:
    """A definition list of plain texts."""
    return tag(
        "dl", *(tag("div", tag("dt", escape(key)), tag("dd", escape(str(value)))) for key, value in pairs.items()), **attributes
    )


def breakable(text: str) -> str:
    """A text in which a line may be broken after a comma or a hyphen, as in names of rows."""
    return escape(text).replace(",", ",<wbr>").replace("-", "-<wbr>")


def script_json(value: Any) -> str:
    """JSON for a script element: no text in it can end the element or open a comment (HTML, 4.12.1.3)."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
