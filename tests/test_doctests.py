"""The examples in the docstrings of public functions and classes run as they stand."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest

MODULES = ("skugga.api.library.arrays", "skugga.api.library.opened_level")
"""Modules whose docstrings have examples that run without files of the reader's own."""


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_run(name):
    failed, attempted = doctest.testmod(import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert failed == 0 and attempted > 0
