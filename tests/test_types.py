"""Annotations: a function without any must be a compiled loop.

For the sake of compiled loops mypy accepts functions without any annotation (``tool.mypy`` in ``pyproject.toml``).
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("terrain", "shadows", "selector", "api")

Function = ast.FunctionDef | ast.AsyncFunctionDef


def _is_compiled(function: Function) -> bool:
    """Return whether numba compiles a function."""
    return any(
        isinstance(decorator, ast.Name) and decorator.id in ("compiled", "internal") for decorator in function.decorator_list
    )


def _is_unannotated(function: Function) -> bool:
    """Return whether a function has no annotation at all."""
    arguments = function.args
    all_arguments = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg)
    return function.returns is None and all(argument is None or argument.annotation is None for argument in all_arguments)


def unannotated_functions(node: ast.AST) -> Iterator[str]:
    """Yield the functions without annotations that are neither compiled loops nor helpers inside one."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Function):
            if _is_compiled(child):
                continue
            if _is_unannotated(child):
                yield f"{child.name} (line {child.lineno})"
        yield from unannotated_functions(child)


@pytest.mark.parametrize("package", PACKAGES)
def test_functions_without_annotations_are_compiled(package: str) -> None:
    paths = sorted((ROOT / package).rglob("*.py"))
    assert paths
    names_by_path = {
        str(path.relative_to(ROOT)): [*unannotated_functions(ast.parse(path.read_text(encoding="utf-8")))] for path in paths
    }
    assert {path: names for path, names in names_by_path.items() if names} == {}


def test_mypy_checks_every_package() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    assert settings["strict"] and "skugga" in settings["files"]
    assert all((ROOT / "skugga" / package).is_dir() for package in PACKAGES)


@pytest.mark.parametrize(
    "source",
    [
        "def planted(a, b):\n    return a + b\n",
        "def planted():\n    pass\n",
        "async def planted(*args, **kwargs):\n    pass\n",
        "@kept\ndef planted(a):\n    return a\n",
        "@compiled_elsewhere\ndef planted(a):\n    return a\n",
        "class A:\n    def planted(self):\n        pass\n",
        "class A:\n    @property\n    def planted(self):\n        return 1\n",
        "def outer(a: int) -> int:\n    def planted(b):\n        return b\n    return planted(a)\n",
        "if True:\n    def planted(a):\n        return a\n",
    ],
)
def test_a_planted_function_is_found(source: str) -> None:
    assert [name.split()[0] for name in unannotated_functions(ast.parse(source))] == ["planted"]


@pytest.mark.parametrize(
    "source",
    [
        "@compiled\ndef loop(a, b):\n    return a + b\n",
        "@compiled\ndef loop(a):\n    def helper(b):\n        return b\n    return helper(a)\n",
        "def annotated(a: int) -> int:\n    return a\n",
        "class A:\n    def method(self) -> None:\n        pass\n",
        "def outer() -> None:\n    @compiled\n    def loop(a):\n        return a\n",
        "each = lambda a: a\n",
    ],
)
def test_loops_and_annotated_functions_pass(source: str) -> None:
    assert [*unannotated_functions(ast.parse(source))] == []
