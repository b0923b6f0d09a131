"""Tests of ``scripts/check_words.py``: forbidden names, and the form of commit subjects."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run_check(*arguments: str) -> tuple[int, str]:
    """Return the exit status and the messages of the check."""
    command = [sys.executable, str(ROOT / "scripts/check_words.py"), *arguments]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return run.returncode, run.stderr


@pytest.mark.parametrize(
    ("source", "name", "term"),
    [
        ("there = mask\n", "there", "valid"),
        ("def f(x):\n    return x.there\n", "there", "valid"),
        ("MOST_TILES = 3\n", "MOST_TILES", "MAX_"),
        ("f(LEAST_GAIN)\n", "LEAST_GAIN", "MIN_"),
        ("class SetAside: ...\n", "SetAside", "CircuitBreaker"),
        ("pool.tally.drawn += 1\n", "tally", "counters"),
    ],
)
def test_a_planted_name_is_found(tmp_path, source, name, term):
    (tmp_path / "planted.py").write_text("x = 1\n" + source)
    status, messages = run_check(str(tmp_path / "planted.py"))
    assert status == 1 and f"'{name}'" in messages and term in messages and "planted.py:" in messages


def test_comments_texts_and_longer_names_are_allowed(tmp_path):
    (tmp_path / "plain.py").write_text('# there\nx = "there"\nis_there_yet = 1\nALMOST_DONE = 2\n')
    assert run_check(str(tmp_path / "plain.py")) == (0, "")


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("Bound the plan cache in bytes\n\nIt grew.\n", None),
        ("x" * 72, None),
        ("x" * 73, "73 characters"),
        ("Two lines\nof subject\n", "empty line"),
    ],
)
def test_commit_subjects_are_short_and_separated(tmp_path, message, fault):
    (tmp_path / "message").write_text(message)
    status, messages = run_check("--commit-message", str(tmp_path / "message"))
    assert (status == 0) == (fault is None) and (fault or "") in messages
