"""The page says what was measured, and the package goes by what was fitted to it."""

import json
from pathlib import Path

import pytest

from benchmarks.selection.fit import cases_of, fit_model
from benchmarks.selection.page import END, START, page, with_tables
from benchmarks.selection.table import read_table
from skugga.selector.cost.error_model import ErrorModel
from skugga.selector.cost.error_model import packaged_model as of_the_package

PAGE = Path(__file__).parents[3] / "docs" / "selection.md"


def test_tables_go_between_their_marks_and_nothing_else_changes():
    text = f"before\n{START}old\n{END}after\n"
    assert with_tables(text, "new\n") == f"before\n{START}new\n{END}after\n"


@pytest.mark.long
def test_the_page_has_the_tables_of_what_was_measured():
    """`python -m benchmarks.selection judge --write` mends it."""
    text = PAGE.read_text(encoding="utf-8")
    assert with_tables(text, page(*read_table())) == text


@pytest.mark.long
def test_the_constants_are_those_that_fit_what_was_measured():
    """`python -m benchmarks.selection fit` mends it."""
    views, device = read_table()
    again, kept = (json.loads(model.model_dump_json()) for model in (_fitted(views, device), of_the_package()))
    assert _numbers(again) == pytest.approx(_numbers(kept), rel=1e-2, abs=1e-6)


def _fitted(views, device) -> ErrorModel:
    return fit_model([case for view in views if not view.get("unseen") for case in cases_of(view)], device)


def _numbers(value) -> list[float]:
    return [number for each in value.values() for number in _numbers(each)] if isinstance(value, dict) else [value]
