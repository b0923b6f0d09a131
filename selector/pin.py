"""Pin choices: write chosen algorithms and settings into the level file, so that later plans use them.

They are written as keys under ``shadows`` for all views and suns, or as items of the list ``pins`` there for some views and suns.

- Only the affected part of the text changes. Comments, order, quotes, indentation and line ends of all other keys stay the same
  byte for byte.
- Lines that begin with ``#:`` are written by this module. The next write replaces them.
- The user's comments at a replaced value stay. A comment at an item of ``pins`` stays at the item for the same view and suns. All
  other comments move above the value's key.
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from skugga.selector.choices import PlanRequest
from skugga.selector.planner.planner import SETTING_NAMES, make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.errors import InputError, LevelError, Problem
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import SUN
from skugga.terrain.level.pin_scope import PinScope
from skugga.terrain.level.rasters import is_level_raster

POLICY_CHOSEN_KEYS = ("map_size",)
"""Settings that all policies except ``rules`` choose. They are written even if they equal those that ``rules`` would use."""

PINS = "pins"
"""Key, under ``shadows``, of the list of pins: algorithms and settings for some views and suns."""

PIN_COMMENT = "#: Pinned by skugga select"
"""Beginning of the first line of the comment above pinned keys."""

PINNED_KEYS_COMMENT = "#: Pinned keys: "
"""Beginning of the comment line that lists the pinned keys of ``shadows``."""

COMMENT_WIDTH = 116
"""Maximum length of a comment's line, characters."""

# Patterns of a level file's text: the comment above pinned keys, the line of it that lists them, the end of a YAML document, any
# comment, and an alias behind a key.
_PIN_BLOCK = re.compile(rf"^[ \t]*{PIN_COMMENT}.*(?:(?:\r\n|\r|\n)[ \t]*#:.*)*(?:\r\n|\r|\n)", re.MULTILINE)
_PINNED_KEYS = re.compile(rf"^[ \t]*{PINNED_KEYS_COMMENT}([a-z_, ]+)\.", re.MULTILINE)
_DOCUMENT_END = re.compile(r"^\.\.\.", re.MULTILINE)
_COMMENT = re.compile(r"#[^\r\n]*")
_ALIAS = re.compile(r"\s*:\s*(\*[^\s,\[\]{}]+)")

Pair = tuple[ScalarNode, Node]
"""A key of a YAML mapping, and its value."""

Edit = tuple[int, int, str]
"""A replacement in a text: the first index, the index after the last one, and the new text."""

Comment = tuple[int, str]
"""Index of a comment in the text, and the comment from its ``#`` on."""


class ItemComments(NamedTuple):
    """Comments at an item of a YAML list.

    Attributes
    ----------
    above
        Comments on the lines above the item.
    trailing
        Comments behind the item on its own line.
    """

    above: list[str]
    trailing: list[str]


def pins(plan: Plan, descriptor: Descriptor, plan_request: PlanRequest) -> dict[str, Any]:
    """Return the keys of ``shadows`` that make later plans equal to ``plan``, with their values.

    They are ``algorithm`` for all casters, and the settings that differ from those that follow from it. A level has one value of a
    setting for all lights and kinds of casters. A setting with several values in the plan is left out and stays automatic. Raises
    ``InputError`` if nothing casts shadows.
    """
    cast = {light: {kind: name for kind, name in kinds.items() if name != NO_SHADOWS} for light, kinds in plan.algorithm.items()}
    cast = {light: kinds for light, kinds in cast.items() if kinds}
    if not cast:
        raise InputError(
            "--write", Problem(f"nothing casts a shadow in view {plan.view}"), "Choose a view and a sun with a cast shadow"
        )
    chosen: dict[str, Any] = {"algorithm": cast[SUN] if list(cast) == [SUN] else cast}
    automatic = make_plan(descriptor, plan_request, chosen, choices={})
    for key in SETTING_NAMES:
        values = _setting_values(plan, key)
        is_chosen = values != _setting_values(automatic, key) or (plan.policy != "rules" and key in POLICY_CHOSEN_KEYS)
        if is_chosen and len(set(values.values())) == 1:
            chosen[key] = next(iter(values.values()))
    return chosen


def pinned_keys(path: Path) -> tuple[str, ...]:
    """Return the keys of ``shadows`` that an earlier call of ``pin`` wrote into a level file.

    They are read from the comment that this call wrote. Raises ``LevelError`` if the file cannot be read.
    """
    match = _PIN_BLOCK.search(_read(path))
    return _keys_of(match.group()) if match else ()


def default_values(keys: Iterable[str]) -> dict[str, Any]:
    """Return the values that remove an earlier pin: those of keys of ``shadows`` that leave the choice to the planner."""
    return {key: [] if key == PINS else "auto" for key in keys}


def pin(path: Path, chosen: Mapping[str, Any], reasons: Sequence[str]) -> None:
    """Write chosen keys of ``shadows``, and a comment with the reasons, into a level file. They replace an earlier pin.

    The file is replaced by an atomic write. Raises ``LevelError`` if it cannot be written, or if the edit would change the meaning
    of other parts of the file.
    """
    path = path.resolve()
    before = _read(path)
    if not (path.stat().st_mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH) and os.access(path, os.W_OK)):
        raise LevelError(str(path), Problem("read-only"), "Make the file writable")
    after = pinned_text(before, chosen, reasons)
    if after is None:
        raise LevelError(
            f"{path}: shadows",
            Problem("this file's layout cannot be edited safely"),
            f"Write these keys by hand: {json.dumps(dict(chosen))}",
        )
    try:
        write_atomically(path, after)
    except OSError as error:
        raise LevelError(str(path), Problem(error.strerror or str(error)), "Use a folder in which files can be written") from None


def pinned_text(text: str, chosen: Mapping[str, Any], reasons: Sequence[str]) -> str | None:
    """Return a level file's text with the chosen keys under ``shadows``, and a comment with the reasons above.

    ``None`` means that the edit would change the meaning of other parts of the text.
    """
    before = _load(text)
    earlier = _PIN_BLOCK.search(text)
    unpinned = _PIN_BLOCK.sub("", text)
    new_values = {**default_values(_keys_of(earlier.group()) if earlier else ()), **chosen}
    with suppress(YAMLError, ValueError, IndexError):
        after = _rewritten_text(unpinned, new_values, [*reasons, f"{PINNED_KEYS_COMMENT[3:]}{', '.join(chosen)}."])
        expected = {**before, "shadows": {**before.get("shadows", {}), **new_values}}
        if _load(after) == expected:
            return after
    return None


def _rewritten_text(text: str, new_values: Mapping[str, Any], reasons: Sequence[str]) -> str:
    """Return a level file's YAML text with ``new_values`` set under ``shadows``, and ``reasons`` as comment lines above that key.

    The key ``shadows`` is appended if it is missing. The result may change the meaning of other keys, for which ``pinned_text``
    checks.
    """
    line_end = "\r\n" if "\r\n" in text else "\n"
    root = YAML(typ="safe", pure=True).compose(text)
    shadows_pair = next(((key, value) for key, value in root.value if key.value == "shadows"), None)
    quoted = root.flow_style and bool(root.value) and root.value[0][0].style == '"'
    head = root if root.flow_style or shadows_pair is None else shadows_pair[0]
    edits: list[Edit] = []
    if shadows_pair is None and root.flow_style:
        edits.append(_insert_edit(text, root.value, {"shadows": new_values}, quoted))
    elif shadows_pair is None:
        indent = " " * root.start_mark.column
        lines = [f"{indent}shadows:", *_block_lines(new_values, f"{indent}  ", line_end)]
        ended = _DOCUMENT_END.search(text)
        rest = text[ended.start() :] if ended else ""
        text = text.removesuffix(rest)
        gap = "" if text.endswith(("\n", "\r")) else line_end
        return f"{text}{gap}{line_end.join([*_comment(reasons, indent), *lines])}{'' if gap else line_end}{rest}"
    elif _is_alias(*shadows_pair):
        start, end = _span(text, shadows_pair)
        edits.append((start, end, _flow_text({**_load(text)["shadows"], **new_values}, quoted)))
    else:
        edits += _mapping_edits(text, shadows_pair[1], new_values, quoted, line_end)
    start = _line_start(text, head.start_mark.index)
    indent = " " * (head.start_mark.column if head is not root else 0)
    edits.append((start, start, "".join(f"{line}{line_end}" for line in _comment(reasons, indent))))
    for start, end, new in reversed(sorted(edits, key=lambda edit: edit[:2])):  # edits at one position keep their order
        text = text[:start] + new + text[end:]
    return text


def _mapping_edits(text: str, shadows: MappingNode, new_values: Mapping[str, Any], quoted: bool, line_end: str) -> list[Edit]:
    """Return the edits that set keys of the mapping ``shadows``: existing keys change in their place, new keys are appended.

    ``quoted`` tells whether strings are quoted. ``line_end`` is the text's line end. ``new_values`` are the new values by key.
    """
    pairs: dict[str, Pair] = {key.value: (key, value) for key, value in shadows.value}
    comments = _comments_in(text)
    edits: list[Edit] = []
    for key in (key for key in pairs if key in new_values):
        if key == PINS and not shadows.flow_style and _is_list_of_lines(pairs[key]):
            replaced, orphaned_comments = _list_edits(text, pairs[key], new_values[key], line_end, comments)
        else:
            start, end = _span(text, pairs[key])
            gap = " " if text[start - 1] == ":" else ""
            replaced = [(start, end, f"{gap}{_flow_text(new_values[key], quoted)}")]
            orphaned_comments = [comment for at, comment in comments if start <= at < end]
        mark = (shadows if shadows.flow_style else pairs[key][0]).start_mark
        above = _line_start(text, mark.index)
        indent = text[above : mark.index] if not text[above : mark.index].strip() else ""
        edits += [(above, above, f"{indent}{comment}{line_end}") for comment in orphaned_comments]
        edits += replaced
    new = {key: value for key, value in new_values.items() if key not in pairs}
    if new and shadows.flow_style:
        edits.append(_insert_edit(text, shadows.value, new, quoted) if shadows.value else _fill_edit(shadows, new, quoted))
    elif new:
        first, last = shadows.value[0][0], _span(text, shadows.value[-1])[1]
        insert_at = _line_end(text, last)
        indent = " " * first.start_mark.column
        edits.append((insert_at, insert_at, "".join(f"{line_end}{line}" for line in _block_lines(new, indent, line_end))))
    return edits


def _is_list_of_lines(pair: Pair) -> bool:
    """Return whether the value of a key is a list with one item per line, or an empty one, without aliases."""
    key, value = pair
    if not isinstance(value, SequenceNode) or _is_alias(key, value) or (value.flow_style and value.value):
        return False
    return not any(_is_alias(key, item) for item in value.value)


def _list_edits(
    text: str, pair: Pair, items: Sequence[Any], line_end: str, comments: Sequence[Comment]
) -> tuple[list[Edit], list[str]]:
    """Return the edits that replace a list of pins by ``items``, one per line, and the texts of the comments that lose their place.

    ``pair`` is the list's key and value, ``line_end`` the text's line end, and ``comments`` are all comments of the text. A comment
    stays at the item for the same view and suns. Without such an item it loses its place. The comment behind the list's key stays
    there.
    """
    key, value = pair
    assert isinstance(value, SequenceNode)
    indent = " " * key.start_mark.column
    colon, end_of_line = text.index(":", key.end_mark.index) + 1, _line_end(text, key.end_mark.index)
    if value.flow_style:
        behind_key: list[Edit] = [(colon, value.end_mark.index, "" if items else " []")]
        orphaned_comments = [comment for at, comment in comments if colon <= at < value.end_mark.index]
        end_of_line = _line_end(text, value.end_mark.index)
        return [*behind_key, (end_of_line, end_of_line, _block_text(items, indent, line_end) if items else "")], orphaned_comments
    behind_key = [] if items else [(colon, colon, " []")]
    end = max(_line_end(text, _end(text, value)), end_of_line)
    old = list(zip(value.value, _load(text)["shadows"][PINS], strict=True))
    item_comments: dict[int, ItemComments] = {}
    orphaned_comments = []
    for at, comment in comments:
        if not end_of_line <= at < end:
            continue
        node, pin_before = next((node, item) for node, item in old if at < _line_end(text, _end(text, node)))
        number = next((number for number, item in enumerate(items) if _scope(item) == _scope(pin_before)), None)
        if number is None:
            orphaned_comments.append(comment)
            continue
        above, trailing = item_comments.setdefault(number, ItemComments([], []))
        is_behind = at >= _end(text, node) and _line_start(text, at) <= node.start_mark.index
        (trailing if is_behind and not trailing else above).append(comment)
    return [
        *behind_key,
        (end_of_line, end, _block_text(items, indent, line_end, item_comments) if items else ""),
    ], orphaned_comments


def _scope(pin_of_list: Mapping[str, Any]) -> list[Any]:
    """Return the view and the suns for which an item of the list of pins applies.

    ``pin_of_list`` is the item.
    """
    return [pin_of_list.get(key) for key in PinScope.model_fields]


def _comments_in(text: str) -> list[Comment]:
    """Return all comments of a YAML text in order, from the ``#`` on. They lie between the tokens of the parser."""
    comments, at = [], 0
    for token in YAML(typ="safe", pure=True).scan(text):
        comments += [(match.start(), match.group()) for match in _COMMENT.finditer(text, at, max(token.start_mark.index, at))]
        at = max(token.end_mark.index, at)
    return comments


def _insert_edit(text: str, pairs: list[Pair], new: Mapping[str, Any], quoted: bool) -> Edit:
    """Return the edit that appends keys and values to a mapping in flow style (``{...}``) with the entries ``pairs``, at least one.

    ``quoted`` tells whether keys and strings are quoted. ``new`` are the keys and their values.
    """
    insert_at = _span(text, pairs[-1])[1]
    return insert_at, insert_at, f", {_flow_text(new, quoted)[1:-1]}"


def _fill_edit(empty: MappingNode, new: Mapping[str, Any], quoted: bool) -> Edit:
    """Return the edit that inserts keys and values into an empty mapping ``{}``; ``quoted`` tells whether strings are quoted.

    ``new`` are the keys and their values.
    """
    insert_at = empty.end_mark.index - 1
    return insert_at, insert_at, _flow_text(new, quoted)[1:-1]


def _span(text: str, pair: Pair) -> tuple[int, int]:
    """Return the start and end index of a key's value in the text, or of the alias (``*name``) that stands for it.

    The parser counts comments and line ends behind a block as part of it. They are excluded.
    """
    key, value = pair
    if _is_alias(key, value):
        alias = _ALIAS.match(text, key.end_mark.index)
        if alias is None:
            raise ValueError("an alias that does not follow its key and a colon")
        return alias.span(1)
    start = value.start_mark.index
    if isinstance(value, MappingNode | SequenceNode) and not value.flow_style:  # it begins behind the colon, on the key's line
        start = text.index(":", key.end_mark.index) + 1
    return start, _end(text, value)


def _end(text: str, node: Node) -> int:
    """Return the index in the text behind a node's last character, without the comments and line ends behind a block."""
    if isinstance(node, MappingNode) and not node.flow_style and node.value:
        return _span(text, node.value[-1])[1]
    if isinstance(node, SequenceNode) and not node.flow_style and node.value:
        return _end(text, node.value[-1])
    return node.end_mark.index


def _is_alias(key: Node, value: Node) -> bool:
    """Return whether a key's value is an alias (``*name``).

    For an alias, the parser returns the node at the anchor, which stands before the key.
    """
    return value.start_mark.index < key.end_mark.index


def _block_lines(pairs: Mapping[str, Any], indent: str, line_end: str) -> list[str]:
    """Return the lines of keys and values in block style, indented by ``indent``, without their last line ends.

    ``line_end`` separates the lines of a value that takes several. ``pairs`` are the keys with their values.
    """
    return [f"{indent}{key}:{_block_text(value, indent, line_end)}" for key, value in pairs.items()]


def _block_text(value: Any, indent: str, line_end: str, item_comments: Mapping[int, ItemComments] | None = None) -> str:
    """Return the text of a value, to be inserted behind its key and the colon.

    A list of mappings has one item per line, with ``item_comments`` by the index of the item. Any other value stands on the key's
    line. ``indent`` is that of the key, and ``line_end`` the text's line end.
    """
    if not (isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value)):
        return f" {_flow_text(value, quoted=False)}"
    lines: list[str] = []
    for number, item in enumerate(value):
        above, trailing = (item_comments or {}).get(number, ItemComments([], []))
        lines += [*above, "  ".join([f"- {_flow_text(item, quoted=False)}", *trailing])]
    return "".join(f"{line_end}{indent}  {line}" for line in lines)


def _flow_text(value: Any, quoted: bool) -> str:
    """Return a value as YAML on one line.

    Strings are quoted if ``quoted``, or if YAML would read them as another type.
    """
    if isinstance(value, list | tuple):
        return f"[{', '.join(_flow_text(item, quoted) for item in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_flow_text(key, quoted)}: {_flow_text(item, quoted)}' for key, item in value.items())}}}"
    if isinstance(value, str) and not quoted and re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", value) and _load(value) == value:
        return value
    return json.dumps(value, ensure_ascii=not (isinstance(value, str) and value.isprintable()))


def _comment(reasons: Sequence[str], indent: str) -> list[str]:
    """Return the indented comment lines (``#: ...``) of a pin: the reasons, wrapped at ``COMMENT_WIDTH``.

    Unprintable characters become spaces. Each line begins with ``indent``.
    """
    lines = ["".join(letter if letter.isprintable() else " " for letter in line) for line in reasons]
    return [f"{indent}#: {part}" for line in lines for part in wrap(line, COMMENT_WIDTH)]


def _setting_values(plan: Plan, key: str) -> dict[tuple[str, str], Any]:
    """Return the values of the setting ``key`` (a field of ``Shadows``) in a plan, by light and kind of casters."""
    values: dict[tuple[str, str], Any] = {}
    for light, kinds in plan.settings.items():
        for kind, settings in kinds.items():
            if (value := settings.as_overrides.get(key)) is not None:
                values[light, kind] = value
    return values


def _keys_of(comment: str) -> tuple[str, ...]:
    """Return the keys of ``shadows`` that the comment of a pin lists; empty if it lists none."""
    match = _PINNED_KEYS.search(comment)
    return tuple(key.strip() for key in match.group(1).split(",")) if match else ()


def _line_start(text: str, index: int) -> int:
    """Return the index of the first character of the line with character ``index``; a byte order mark is no part of the line."""
    start = max(text.rfind("\n", 0, index), text.rfind("\r", 0, index)) + 1
    return max(start, 1) if text.startswith("\ufeff") else start


def _line_end(text: str, index: int) -> int:
    """Return the index of the first line end at or after ``index``, or the length of the text."""
    match = re.compile(r"[\r\n]").search(text, index)
    return match.start() if match else len(text)


def _load(text: str) -> Any:
    """Return the content of a YAML text as plain dictionaries, lists and scalars."""
    return YAML(typ="safe", pure=True).load(text)


def _read(path: Path) -> str:
    """Return the text of a level file, with its line ends. Raises ``LevelError`` for a raster and for an unreadable file."""
    if is_level_raster(path):
        raise LevelError(str(path), Problem("a raster, not a level file"), "Use a YAML file with 'terrain: {source: ...}'")
    try:
        return path.read_bytes().decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not UTF-8 text"
        raise LevelError(str(path), Problem(reason), "Use a readable YAML file") from None
