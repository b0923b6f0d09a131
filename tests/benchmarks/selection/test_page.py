"""The page agrees with the measured table, and the package's constants are fitted to it."""

import json
from pathlib import Path

import pytest

from benchmarks.selection.fit import cases_of, fit_model
from benchmarks.selection.page import END, START, page, with_tables
from benchmarks.selection.table import read_table
from skugga.selector.cost.error_model import ErrorModel
from skugga.selector.cost.error_model import packaged_model as of_the_package

PAGE = Path(__file__).parents[3] / "docs" / "reports" / "selection.md"


def test_only_the_tables_between_the_marks_change():
    text = f"before\n{START}old\n{END}after\n"
    assert with_tables(text, "new\n") == f"before\n{START}new\n{END}after\n"


@pytest.mark.thorough  # all choices of all policies are judged again, which takes several minutes
def test_the_page_agrees_with_the_measured_table():
    """``python -m benchmarks.selection judge --write`` updates the page."""
    text = PAGE.read_text(encoding="utf-8")
    assert with_tables(text, page(*read_table())) == text


@pytest.mark.long
def test_the_constants_are_fitted_to_the_measured_table():
    """``python -m benchmarks.selection fit`` updates the constants."""
    views, device = read_table()
    fitted, stored = (json.loads(model.model_dump_json()) for model in (_fitted(views, device), of_the_package()))
    assert _numbers(fitted) == pytest.approx(_numbers(stored), rel=1e-2, abs=1e-6)


def _fitted(views, device) -> ErrorModel:
    """Return the error model that fits the views without those that are held out."""
    return fit_model([case for view in views if not view.get("unseen") for case in cases_of(view)], device)


def _numbers(value) -> list[float]:
    """Return all values in nested dictionaries."""
    return [number for entry in value.values() for number in _numbers(entry)] if isinstance(value, dict) else [value]
