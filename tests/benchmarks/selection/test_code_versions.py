"""Measured figures and the code that they hold for: renamed variables change nothing, other numbers and shaders do."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter

import pytest

from benchmarks.selection.code_versions import (
    ROOT,
    STEPS,
    _files_of,
    _normalized_python,
    _normalized_shader,
    algorithms_of,
    origin_now,
    stale_algorithms,
    unaccepted_algorithms,
)
from benchmarks.selection.table import read_table
from skugga.shadows.hybrid import hybrid
from skugga.shadows.registry import ALGORITHMS

CODE = '''
"""A module."""
import numpy as np
from skugga.a import b

def f(x: int) -> int:
    """Return twice a number."""
    if x < 0:
        raise ValueError("the number must be positive")
    return b(np.maximum(x, 1).max(axis=0), "nearest") * min(x, 2) * 2  # why
'''


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("(x", "(number"), ("Return twice a number", "Double a number"), ("must be positive", "is negative"), ("  # why", ""),
        ("from skugga.a import b", "from skugga.c import b"),
    ],
)  # fmt: skip
def test_names_and_texts_are_not_code(old: str, new: str):
    changed = re.sub(r"\bx\b", "number", CODE) if new == "(number" else CODE.replace(old, new)
    assert changed != CODE and _normalized_python(changed) == _normalized_python(CODE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("* 2", "* 3"),
        ("* 2", "+ 2"),
        ("nearest", "linear"),
        ("maximum(x", "maximum(b"),
        ("x < 0", "x <= 0"),
        ("np.maximum", "np.minimum"),
        ("min(x", "max(x"),
        (".max(axis", ".min(axis"),
        ("axis=0", "axis=1"),
    ],
)
def test_numbers_operators_and_keys_are_code(old: str, new: str):
    assert _normalized_python(CODE.replace(old, new)) != _normalized_python(CODE)


def test_comments_of_shaders_are_not_code():
    shader = "float f() {  // half\n  return 0.5; /* of\n one */ }"
    assert _normalized_shader(shader) == _normalized_shader("float f() { return 0.5; }")
    assert _normalized_shader(shader) != _normalized_shader(shader.replace("0.5", "0.6"))


def test_shared_code_counts_for_each_algorithm_that_uses_it():
    names = {path.relative_to(ROOT).as_posix() for path in _files_of(hybrid)}
    assert {
        "shadows/hybrid/hybrid.py",
        "shadows/volumes/volumes.py",
        "shadows/maps/drawing.py",
        "shadows/attached_shadow.py",
    } <= names
    assert any(name.startswith("shadows/volumes/shaders/") for name in names)


def test_a_raised_version_makes_rows_stale(monkeypatch: pytest.MonkeyPatch):
    rows = {"a": {"algorithms": ["sweep", "shadow_map"]}, "b": {"algorithms": ["shadow_map"]}}
    record = {"rows": rows, "timed": origin_now(algorithms_of(rows))}
    assert stale_algorithms(record, "timed") == []
    assert stale_algorithms(record, "compared") == ["shadow_map", "sweep"], "its origin is unknown"
    newer = dataclasses.replace(ALGORITHMS["sweep"], version=ALGORITHMS["sweep"].version + 1)
    monkeypatch.setitem(ALGORITHMS, "sweep", newer)
    assert stale_algorithms(record, "timed") == ["sweep"]
    assert "sweep" in unaccepted_algorithms()


def test_changed_code_has_a_new_version_or_was_accepted():
    assert unaccepted_algorithms() == [], (
        "the code of these algorithms has changed: raise Algorithm.version and measure again if their times or errors change, "
        "else run `python -m benchmarks.selection accept`"
    )


@pytest.mark.parametrize("step", STEPS)
def test_measured_rows_hold_for_the_present_code(step: str):
    views, _ = read_table()
    stale = Counter(name for view in views for name in stale_algorithms(view, step))
    assert not stale, f"measure again (benchmarks/selection/__main__.py); views by algorithm with older code: {dict(stale)}"


def test_values_at_a_prompt_do_not_count(monkeypatch: pytest.MonkeyPatch):
    """Python's prompt, and a doctest, keep the last value as a built-in name."""
    code = "def f(pair):\n    _, last = pair\n    return last\n"
    before = _normalized_python(code)
    monkeypatch.setattr("builtins._", 1, raising=False)
    assert _normalized_python(code) == before
