"""The digest of a loop changes with everything that its machine code depends on, and with nothing else."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable
from types import ModuleType

import pytest
from numba.core import types
from numba.core.dispatcher import Dispatcher

from skugga import shadows, terrain
from skugga.terrain.compiling.digest import UnknownValueError, describe_types
from skugga.terrain.compiling.loop_cache import LoopCache

MODULE_SOURCES = {
    "digest_base": """
from skugga.terrain.compiled import compiled

STEP = 2.0

@compiled
def deepest(x):
    return x * STEP

def helper(x):
    return x + 1.0
""",
    "digest_middle": """
from typing import NamedTuple

import numpy as np

import digest_base
from digest_base import STEP, deepest
from skugga.terrain.compiled import compiled

class Window(NamedTuple):
    height: float
    width: float

HALF = STEP / 2.0
TABLE = np.array([1.0, 2.0, 3.0])
SQUARE = Window(1.0, 1.0)

@compiled
def middle(x):
    return deepest(x) + HALF
""",
    "digest_top": """
import math

import numpy as np

import digest_middle
from digest_middle import SQUARE, TABLE, middle
from skugga.terrain.compiled import compiled

@compiled
def top(x):
    '''Add all that a loop may read.'''
    total = math.sqrt(np.abs(middle(x)))  # a comment
    for i in range(TABLE.size):
        total += TABLE[i] * SQUARE.width
    return total * digest_middle.HALF
""",
}


@pytest.fixture
def digest_of_top(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that digests ``top`` after replacing text of modules: ``digest_of_top((module, old, new), ...)``."""

    def digest_after_edits(*edits: tuple[str, str, str]) -> str:
        sources = dict(MODULE_SOURCES)
        for module, old, new in edits:
            assert old in sources[module], old
            sources[module] = sources[module].replace(old, new)
        for name in sources:
            monkeypatch.delitem(sys.modules, name, raising=False)
        for name, source in sources.items():
            module = ModuleType(name)
            monkeypatch.setitem(sys.modules, name, module)
            exec(compile(source, f"/somewhere/{len(edits)}/{name}.py", "exec"), vars(module))
        cache = sys.modules["digest_top"].top._cache
        assert isinstance(cache, LoopCache)
        return cache.digest()

    return digest_after_edits


@pytest.mark.parametrize(
    "edit",
    [
        pytest.param(("digest_top", "* digest_middle", "/ digest_middle"), id="the loop itself"),
        pytest.param(("digest_middle", "deepest(x) +", "deepest(x) -"), id="a callee"),
        pytest.param(("digest_base", "x * STEP", "x / STEP"), id="a callee of a callee"),
        pytest.param(("digest_base", "STEP = 2.0", "STEP = 4.0"), id="a constant, and one derived from it"),
        pytest.param(("digest_middle", "STEP / 2.0", "STEP / 3.0"), id="a constant that is read through its module"),
        pytest.param(("digest_middle", "2.0, 3.0]", "2.0, 3.5]"), id="an element of an array"),
        pytest.param(("digest_middle", "3.0])", "3.0], np.float32)"), id="the type of an array"),
        pytest.param(("digest_middle", "Window(1.0, 1.0)", "Window(1.0, 2.0)"), id="a field of a named tuple"),
        pytest.param(
            ("digest_middle", "height: float\n    width: float", "width: float\n    height: float"), id="the order of fields"
        ),
        pytest.param(("digest_base", "STEP = 2.0", "STEP = 2"), id="an integer for a float"),
        pytest.param(("digest_top", "math.sqrt", "math.exp"), id="a function of a library"),
        pytest.param(("digest_base", "@compiled\n", "import numba\n\n@numba.njit(fastmath=True)\n"), id="options of a callee"),
    ],
)
def test_digest_changes_with_inputs_of_the_machine_code(digest_of_top: Callable[..., str], edit: tuple[str, str, str]) -> None:
    assert digest_of_top(edit) != digest_of_top()


@pytest.mark.parametrize(
    "edits",
    [
        pytest.param([("digest_top", "# a comment", "# another one")], id="a comment"),
        pytest.param([("digest_top", "Add all that", "Sum everything that")], id="a docstring"),
        pytest.param([("digest_base", "STEP = 2.0", "\n\n# lines\n\nSTEP = 2.0")], id="line numbers, in a file of another path"),
        pytest.param([("digest_base", "x + 1.0", "x + 2.0")], id="a function that no loop calls"),
        pytest.param([], id="nothing"),
    ],
)
def test_digest_ignores_comments_and_uncalled_functions(
    digest_of_top: Callable[..., str], edits: list[tuple[str, str, str]]
) -> None:
    assert digest_of_top(*edits) == digest_of_top()


def test_digest_includes_plain_functions_that_a_loop_calls(digest_of_top: Callable[..., str]) -> None:
    helper_call_edit = ("digest_middle", "deepest(x) + HALF", "digest_base.helper(x) + HALF")
    assert digest_of_top(helper_call_edit, ("digest_base", "x + 1.0", "x + 2.0")) != digest_of_top(helper_call_edit)


def test_a_loop_that_reads_an_unknown_object_has_no_digest(digest_of_top: Callable[..., str]) -> None:
    with pytest.raises(UnknownValueError, match="digest_base"):
        digest_of_top(("digest_base", "STEP = 2.0", "class Odd:\n    pass\n\nSTEP = Odd()"), ("digest_middle", "STEP / 2.0", "1.0"))


def test_signatures_differ_by_the_fields_of_named_tuples(digest_of_top: Callable[..., str]) -> None:
    type_descriptions = []
    for edits in ([], [("digest_middle", "height: float\n    width: float", "width: float\n    height: float")]):
        digest_of_top(*edits)
        window = types.NamedUniTuple(types.float64, 2, sys.modules["digest_middle"].Window)
        type_descriptions.append(describe_types((types.UniTuple(window, 2), types.float64)))
    assert type_descriptions[0] != type_descriptions[1]


def test_every_loop_of_the_engine_has_a_digest() -> None:
    loops = {}
    for package in (terrain, shadows):
        for module_info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(module_info.name)
            loops |= {f"{module_info.name}.{name}": value for name, value in vars(module).items() if isinstance(value, Dispatcher)}
    assert len(loops) > 200
    for name, loop in loops.items():
        assert len(loop._cache.digest()) == 64, name
