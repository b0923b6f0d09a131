"""The text of a level file as plain values: YAML 1.2 of bounded size and depth, without what would harm whoever shows it."""

from __future__ import annotations

import re
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

MOST_VALUES = 100_000
"""Values and keys of a file, with every alias spelt out: some 30,000 places of a model. Nine aliases of nine aliases, nine times
over, are gigabytes."""

MOST_CHARACTERS = 2**24
"""Of a file's text."""

DEEPEST = 32
"""Lists and mappings inside of one another; levels have six."""

_HARMFUL = re.compile("[\x01-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters (a terminal takes them for commands), and surrogates, which no text can be encoded with."""


def parse_level_text(text: str) -> Any:
    """The values of a level file. Aliases and merges are understood.

    Raises ``YAMLError`` for what is no YAML, has more than ``MOST_VALUES`` values, is deeper than ``DEEPEST`` or has control
    characters; ``ValueError`` for a value that its type does not have.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer, yaml.Constructor = _BoundedComposer, _BoundedConstructor
    return yaml.load(text)


class _BoundedComposer(Composer):
    """Ends as soon as the text is too deep or too long: the scanner's time grows with the square of the depth."""

    _depth = _count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth, self._count = self._depth + 1, self._count + 1
        mark = self.parser.peek_event().start_mark
        if self._depth > DEEPEST:
            raise MarkedYAMLError(problem=f"more than {DEEPEST} lists and mappings inside of one another", problem_mark=mark)
        if self._count > MOST_VALUES:
            raise MarkedYAMLError(problem=f"more than {MOST_VALUES} values", problem_mark=mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, ScalarNode) and (found := _HARMFUL.search(node.value)):
            raise MarkedYAMLError(problem=f"the control character {ascii(found[0])}", problem_mark=mark)
        return node


class _BoundedConstructor(SafeConstructor):
    """Looks at how much the aliases stand for before anything is made of them."""

    def construct_document(self, node: Any) -> Any:
        _check_expanded(node, {})
        return super().construct_document(node)


def _check_expanded(node: Node, known: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """How many nodes a node stands for, and how deep they are, aliases spelt out; ``known`` of other nodes, ``None`` of those that
    it lies in. Raises ``MarkedYAMLError``.
    """
    if isinstance(node, ScalarNode):
        return 1, 0
    if id(node) in known:
        if (found := known[id(node)]) is None:
            raise MarkedYAMLError(problem="an alias of what it lies in", problem_mark=node.start_mark)
        return found
    known[id(node)] = None
    parts = [each for pair in node.value for each in pair] if isinstance(node, MappingNode) else node.value
    counts, depths = zip(*(_check_expanded(part, known) for part in parts), strict=True) if parts else ((), ())
    count, depth = 1 + sum(counts), 1 + max(depths, default=0)
    if depth > DEEPEST:
        raise MarkedYAMLError(problem=f"more than {DEEPEST} lists and mappings inside of one another", problem_mark=node.start_mark)
    if count > MOST_VALUES:
        raise MarkedYAMLError(problem=f"more than {MOST_VALUES} values, its aliases spelt out", problem_mark=node.start_mark)
    known[id(node)] = count, depth
    return count, depth
