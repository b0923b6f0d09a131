"""One name, one meaning: a public name is defined in one module, but for those that mean the same wherever they are defined."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("terrain", "shadows", "selector", "api")

SAME_BY_DESIGN = {
    "fill": "one interface: every algorithm's fill",
    "ALGORITHM": "one interface: every algorithm's record",
    "PASSES": "one interface: the passes that an algorithm runs",
    "EFFECT": "one interface: every effect's record",
    "called_for": "one interface: every effect's predicate",
    "facts": "one interface: what an effect's predicate needs to know",
    "router": "one interface: the routes of a module",
    "log": "the logger of the service or of its render processes",
    "calibrate": "the command, and the function that does it",
    "compare": "the command, and the function that does it",
    "select": "the command, and the function that does it",
    "serve": "the command, and the function that does it",
    "snapshot": "the route, and the function that draws one for the command line",
    "levels": "the command and the route that list levels",
    "Colour": "an sRGB colour: three numbers from 0 to 1",
    "PAINT": "a material's colour in a generated scene",
    "PLASTER": "a material's colour in a generated scene",
    "GRAZING": "one limit: a light that meets a surface at no more than this sine counts as below it",
    "P": "a parameter specification",
    "T": "a type variable",
}
"""Public names that several modules define, each with the one meaning that it has in all of them."""


def public_names(tree: ast.Module) -> Iterator[str]:
    """Classes, functions, constants and type aliases that a module defines at its top level, without a leading underscore."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = (part for target in targets for part in ast.walk(target))
            names = [part.id for part in parts if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)]
        elif node.__class__.__name__ == "TypeAlias":  # ``type X = ...``, from Python 3.12 on
            names = [node.name.id]  # type: ignore[attr-defined]
        else:
            continue
        yield from (name for name in names if not name.startswith("_"))


def shared_names(modules: dict[str, str]) -> dict[str, list[str]]:
    """Public names that more than one of some modules (path -> text) defines, with the paths."""
    paths = defaultdict(set)
    for path, text in modules.items():
        for name in public_names(ast.parse(text)):
            paths[name].add(path)
    return {name: sorted(where) for name, where in sorted(paths.items()) if len(where) > 1}


@pytest.fixture(scope="module")
def shared() -> dict[str, list[str]]:
    """The names that several modules of the packages define."""
    files = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    return shared_names({str(path.relative_to(ROOT)): path.read_text() for path in files})


def test_no_public_name_is_defined_in_two_modules_with_two_meanings(shared):
    ambiguous = {name: where for name, where in shared.items() if name not in SAME_BY_DESIGN}
    assert not ambiguous, "\n".join(f"{name}: {', '.join(where)}" for name, where in ambiguous.items())


def test_no_exception_is_left_over(shared):
    assert set(SAME_BY_DESIGN) <= set(shared)


def test_shared_names_are_found_in_every_kind_of_definition():
    one = "class A: ...\ndef b(): ...\nasync def c(): ...\nD = 1\nE: int = 2\nF, (G, *H) = 1, (2, 3)\n_own = 3\nimport os\n"
    other = "A = int\nb = c = None\ndef D(): ...\nclass E: ...\nF = G = H = 0\n_own = 4\nimport os\n"
    assert set(shared_names({"one.py": one, "other.py": other})) == set("AbcDEFGH")
    assert not shared_names({"one.py": one})
