"""Internal loops are compiled into the loops that call them, and Python cannot call them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.compiled import compiled, internal

ROOT = Path(__file__).resolve().parents[3]


@internal
def _double_all(values, out):  # type: ignore[no-untyped-def]
    """Write doubled values to ``out``."""
    for n in range(values.size):
        out[n] = 2.0 * _element_at(values, n)


@internal
def _element_at(values, n):  # type: ignore[no-untyped-def]
    """Return one value."""
    return values[n]


@compiled
def _quadruple_all(values):  # type: ignore[no-untyped-def]
    """Return values times four."""
    doubled, quadrupled = np.empty(values.size), np.empty(values.size)
    _double_all(values, doubled)
    _double_all(doubled, quadrupled)
    return quadrupled


def test_internal_loops_work_within_compiled_ones() -> None:
    assert _quadruple_all(np.arange(5.0)).tolist() == [0.0, 4.0, 8.0, 12.0, 16.0]


def test_python_cannot_call_an_internal_loop() -> None:
    _quadruple_all(np.arange(5.0))
    with pytest.raises(TypeError, match="compiled loops only"):
        _element_at(np.arange(5.0), 1)


def test_python_code_names_no_internal_loop() -> None:
    references = [
        f"{path.relative_to(ROOT)}: {name}"
        for package in ("api", "benchmarks", "selector", "shadows", "terrain")
        for path in sorted((ROOT / package).rglob("*.py"))
        for name in _internal_loops_named_in_python(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not references


def _internal_loops_named_in_python(module: ast.Module) -> Iterator[str]:
    """Yield the internal loops of a module, defined there or imported, that code outside of loops names."""
    imported = {
        alias.asname or alias.name
        for node in ast.walk(module)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(("skugga.shadows", "skugga.terrain"))
        for alias in node.names
        if alias.name in _internal_loops_of(node.module)
    }
    internals = imported | {
        node.name for node in module.body if isinstance(node, ast.FunctionDef) and _loop_decorator(node) == "internal"
    }
    for node in module.body:
        if not (isinstance(node, ast.FunctionDef) and _loop_decorator(node)):
            yield from (name.id for name in ast.walk(node) if isinstance(name, ast.Name) and name.id in internals)


@cache
def _internal_loops_of(name: str) -> set[str]:
    """Return the names of a module's loops that only other loops call; empty if the module has no file."""
    path = ROOT / f"{name.replace('.', '/')}.py"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if "@internal" not in text:
        return set()
    body = ast.parse(text).body
    return {node.name for node in body if isinstance(node, ast.FunctionDef) and _loop_decorator(node) == "internal"}


def _loop_decorator(function: ast.FunctionDef) -> str | None:
    """Return the name of the decorator that makes a function a loop, or ``None``."""
    names = {decorator.id for decorator in function.decorator_list if isinstance(decorator, ast.Name)}
    return next((name for name in ("internal", "compiled") if name in names), None)
