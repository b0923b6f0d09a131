"""Text of level files: bounded size after alias expansion, and no control characters in messages."""

from __future__ import annotations

import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml.error import YAMLError

from skugga.terrain.errors import InputError, LevelError, combined_error, printable
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_text import MAX_CHARACTERS, MAX_DEPTH, MAX_VALUES, parse_level_text

LEVEL_HEAD = "version: 1\nterrain: {flat: {size: [10, 10], cells: [2, 2]}}\n"

NESTED_LISTS = "a0: &a0 [1,1,1,1,1,1,1,1,1]\n" + "".join(f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
NESTED_MERGES = "a0: &a0 {x: 1, y: 2}\n" + "".join(f"a{n}: &a{n} {{<<: [{','.join([f'*a{n - 1}'] * 9)}]}}\n" for n in range(1, 12))
ALIAS_CHAIN = "a0: &a0 [1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}]\n" for n in range(1, MAX_DEPTH + 2))


@pytest.fixture
def level(tmp_path):
    """A function that writes a text as a level file and returns its path."""

    def write(text: str, name: str = "my.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize(
    ("text", "expected_text"),
    [
        (NESTED_LISTS, "after alias expansion"),
        (NESTED_MERGES, "after alias expansion"),
        (ALIAS_CHAIN, "nested lists and mappings"),
        ("a: &a [*a]\n", "an alias of a list or mapping that contains it"),
        ("a: " + "[" * 100_000, "nested lists and mappings"),
        ("a:\n  " + "- " * 100_000, "nested lists and mappings"),
        ("a: [" + "1," * (MAX_VALUES + 1) + "]", f"more than {MAX_VALUES} values"),
        ('title: "\\e[2J"', "control character '\\x1b'"),
        ('title: "\\ud800"', "control character '\\ud800'"),
        ('"\\u009b2J": 1', "control character '\\x9b'"),
    ],
    ids=["lists", "merges", "chain", "itself", "brackets", "dashes", "values", "escape", "surrogate", "key"],
)
def test_harmful_level_text_is_rejected_in_one_short_line(level, text, expected_text):
    with pytest.raises(LevelError) as caught:
        load_level(level(LEVEL_HEAD + text))
    message = str(caught.value)
    assert expected_text in message and "line " in message and len(message) < 500 and message.isprintable()


def test_anchors_aliases_and_merges_are_expanded():
    text = "a: &a {x: 1, y: [1, 2]}\nb: {<<: *a, x: 3}\nc: [*a, *a]\n"
    a = {"x": 1, "y": [1, 2]}
    assert parse_level_text(text) == {"a": a, "b": {"x": 3, "y": [1, 2]}, "c": [a, a]}


@given(st.lists(st.integers(1, 9), min_size=1, max_size=5))
def test_aliases_count_with_their_expanded_values(widths):
    lines, count = ["a0: &a0 1"], 1
    expected = 3  # the root mapping, the first key and its value
    for number, width in enumerate(widths, start=1):
        lines.append(f"a{number}: &a{number} [{','.join([f'*a{number - 1}'] * width)}]")
        count = 1 + width * count
        expected += 1 + count
    if expected <= MAX_VALUES:
        assert len(parse_level_text("\n".join(lines))) == len(widths) + 1
    else:
        with pytest.raises(YAMLError, match="aliases"):
            parse_level_text("\n".join(lines))


def test_level_text_has_a_maximum_length(level):
    with pytest.raises(LevelError, match="more than 16777216 characters"):
        load_level(level(LEVEL_HEAD + "title: " + "x" * MAX_CHARACTERS))


@pytest.mark.parametrize("kind", ["pipe.yaml", "folder.yaml", "device.yaml"])
def test_level_must_be_a_regular_file(tmp_path, kind):
    path = tmp_path / kind
    if kind == "pipe.yaml":
        os.mkfifo(path)
    elif kind == "folder.yaml":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(LevelError, match=f"a {kind.partition('.')[0]}, not a regular file"):
        load_level(path)


def test_error_message_escapes_control_characters():
    error = InputError("\x1b[31mname", "a\x9bvalue\u202e\ud800", "no \x07")
    assert str(error) == "\\x1b[31mname: 'a\\x9bvalue\\u202e\\ud800' is not allowed. Allowed: no \\x07."


@given(st.text(st.characters(), max_size=30))
def test_printable_text_is_encodable_and_one_line(text):
    escaped = printable(text)
    escaped.encode()
    assert len(escaped.splitlines()) <= 1 and "\x1b" not in escaped
    assert printable(escaped) == escaped


def test_printable_keeps_ordinary_text():
    for text in ("Großer Ötscher, 1893 m", "伊吹山", "a 'b' \\c", "🌲"):
        assert printable(text) == text


def test_level_name_of_an_undecodable_file_name_is_escaped(level, tmp_path):
    path = level(LEVEL_HEAD)
    undecodable_path = os.fsencode(tmp_path) + b"/\xff\x1b.yaml"
    os.rename(path, undecodable_path)
    loaded = load_level(os.fsdecode(undecodable_path))
    assert loaded.name == "\\udcff\\x1b"
    json.dumps(loaded.name, ensure_ascii=False).encode()


def test_at_most_a_hundred_errors_are_reported(level):
    with pytest.raises(LevelError) as caught:
        load_level(level(LEVEL_HEAD + "forest: [" + "{source: 1}," * 2_000 + "]"))
    lines = str(caught.value).split("\n")
    assert len(lines) == 101 and lines[0].startswith(str(level("", "x").parent)) and lines[-1].endswith("more errors")


def test_all_of_a_few_errors_are_reported():
    errors = [InputError(f"n{n}", n, "other") for n in range(100)]
    assert len(str(combined_error(errors)).split("\n")) == 100
