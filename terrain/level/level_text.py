"""Parse the YAML 1.2 text of a level file, with limits on size and depth, and without control characters."""

from __future__ import annotations

import re
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

MAX_VALUES = 100_000
"""Maximum number of values and keys of a file after alias expansion: enough for some 30,000 positions of a model.

Without a limit, nine levels of nine aliases each expand to gigabytes.
"""

MAX_CHARACTERS = 2**24
"""Maximum length of a file's text."""

MAX_DEPTH = 32
"""Maximum depth of nested lists and mappings; levels need six."""

_CONTROL_CHARACTERS = re.compile("[\x01-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters, which terminals execute as commands, and surrogates, which cannot be encoded."""


def parse_level_text(text: str) -> Any:
    """Parse YAML text to Python values. Aliases and merge keys are expanded.

    Raises ``YAMLError`` for malformed YAML, more than ``MAX_VALUES`` values, a depth over ``MAX_DEPTH``, and control characters.
    Raises ``ValueError`` for text that looks like a typed value but is not one, such as an impossible date.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer, yaml.Constructor = _BoundedComposer, _BoundedConstructor
    return yaml.load(text)


class _BoundedComposer(Composer):
    """A composer that raises an error as soon as the text is nested too deeply or has too many values.

    Otherwise scanning would take time quadratic in the depth.
    """

    _depth = _count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth, self._count = self._depth + 1, self._count + 1
        mark = self.parser.peek_event().start_mark
        if self._depth > MAX_DEPTH:
            raise MarkedYAMLError(problem=f"more than {MAX_DEPTH} nested lists and mappings", problem_mark=mark)
        if self._count > MAX_VALUES:
            raise MarkedYAMLError(problem=f"more than {MAX_VALUES} values", problem_mark=mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, ScalarNode) and (match := _CONTROL_CHARACTERS.search(node.value)):
            raise MarkedYAMLError(problem=f"the control character {ascii(match[0])}", problem_mark=mark)
        return node


class _BoundedConstructor(SafeConstructor):
    """A constructor that checks the size after alias expansion before it builds any value."""

    def construct_document(self, node: Any) -> Any:
        _expanded_size(node, {})
        return super().construct_document(node)


def _expanded_size(node: Node, sizes: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """Return the number of nodes in a YAML node, and its depth, after alias expansion.

    ``sizes`` caches the results by ``id`` of the node; ``None`` marks the ancestors of the node. Raises ``MarkedYAMLError`` if a
    limit is exceeded, or if the node contains itself.
    """
    if isinstance(node, ScalarNode):
        return 1, 0
    if id(node) in sizes:
        if (size := sizes[id(node)]) is None:
            raise MarkedYAMLError(problem="an alias of a list or mapping that contains it", problem_mark=node.start_mark)
        return size
    sizes[id(node)] = None
    parts = [child for pair in node.value for child in pair] if isinstance(node, MappingNode) else node.value
    counts, depths = zip(*(_expanded_size(part, sizes) for part in parts), strict=True) if parts else ((), ())
    count, depth = 1 + sum(counts), 1 + max(depths, default=0)
    if depth > MAX_DEPTH:
        raise MarkedYAMLError(problem=f"more than {MAX_DEPTH} nested lists and mappings", problem_mark=node.start_mark)
    if count > MAX_VALUES:
        raise MarkedYAMLError(problem=f"more than {MAX_VALUES} values after alias expansion", problem_mark=node.start_mark)
    sizes[id(node)] = count, depth
    return count, depth
