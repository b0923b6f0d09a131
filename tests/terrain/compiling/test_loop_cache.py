"""The loop cache across processes: stored machine code is used where it is valid, and never where it is stale."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]

CALLEE_SOURCE = """
from typing import NamedTuple
from skugga.terrain.compiled import compiled

class Pair(NamedTuple):
    first: float
    second: float

FACTOR = 2.0
DOUBLED = 2.0 * FACTOR

@compiled
def g(x):
    return x * FACTOR

@compiled
def through(x):
    return g(x)
"""

CALLER_SOURCE = """
import b
from skugga.terrain.compiled import compiled
from skugga.terrain.compiling.loop_cache import compile_recorders

@compiled
def f(x):
    return b.through(x)

@compiled
def derived(x):
    return x * b.DOUBLED

@compiled
def difference(pair):
    return pair.first - pair.second

if __name__ == "__main__":
    compiled = []
    compile_recorders.append(lambda loop, args: compiled.append(loop.py_func.__name__))
    print(f(2.0), derived(2.0), difference(b.Pair(first=5.0, second=3.0)), *["compiling"] * bool(compiled))
"""


class ModulePair:
    """Two modules that share a loop store. ``run`` executes them in a new process and returns its output."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.write("a", CALLER_SOURCE)
        self.write("b", CALLEE_SOURCE)

    def write(self, name: str, text: str) -> None:
        """Write the text of the module ``name``."""
        (self.folder / f"{name}.py").write_text(text, encoding="utf-8")

    def run(self, *, code: str = "", **environment: str) -> str:
        """Run the first module, or Python code instead, in a new process with further environment variables. Return its output."""
        # Python takes a .pyc for fresh if the source has the same size and the same second of change.
        python_environment = {"PYTHONPATH": f"{self.folder}:{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
        base_environment = {**python_environment, "NUMBA_CACHE_DIR": str(self.folder / "store"), "PATH": os.environ["PATH"]}
        command = [sys.executable, *(["-c", code] if code else ["a.py"])]
        process = subprocess.run(command, cwd=self.folder, env=base_environment | environment, capture_output=True, text=True)
        assert process.returncode == 0, process.stderr
        return process.stdout.strip() + process.stderr


@pytest.fixture
def modules(tmp_path: Path) -> ModulePair:
    """Two modules of loops that share a store."""
    return ModulePair(tmp_path)


def test_the_second_process_compiles_nothing(modules: ModulePair) -> None:
    assert modules.run() == "4.0 8.0 2.0 compiling"
    assert modules.run() == "4.0 8.0 2.0"


@pytest.mark.parametrize(
    ("old", "new", "printed"),
    [
        ("x * FACTOR", "x * FACTOR + 198.0", "202.0 8.0 2.0 compiling"),  # the callee of a callee
        ("FACTOR = 2.0\n", "FACTOR = 3.0\n", "6.0 12.0 2.0 compiling"),  # a constant of another module, and a derived one
        ("first: float\n    second: float", "second: float\n    first: float", "4.0 8.0 2.0 compiling"),  # the order of fields
        ("first: float\n    second: float", "second: float\n    first: float\n    # a comment", "4.0 8.0 2.0 compiling"),
    ],
)
def test_a_change_in_a_callee_s_module_recompiles_the_caller(modules: ModulePair, old: str, new: str, printed: str) -> None:
    modules.run()
    assert old in CALLEE_SOURCE
    modules.write("b", CALLEE_SOURCE.replace(old, new))
    assert modules.run() == printed
    assert modules.run() == printed.removesuffix(" compiling")


def test_a_touched_file_and_an_edited_comment_compile_nothing(modules: ModulePair) -> None:
    modules.run()
    modules.write("b", CALLEE_SOURCE.replace("FACTOR = 2.0\n", "\n# how much larger\nFACTOR = 2.0\n"))
    modules.write("a", CALLER_SOURCE.replace("def f(x):", "def f(x):  # edited"))
    new_mtime_s = time.time() + 100.0
    for name in ("a.py", "b.py"):
        os.utime(modules.folder / name, (new_mtime_s, new_mtime_s))
    assert modules.run() == "4.0 8.0 2.0"


def test_compiler_settings_are_part_of_the_cache_key(modules: ModulePair) -> None:
    modules.run()
    assert modules.run(NUMBA_OPT="1").endswith("compiling")
    assert not modules.run(NUMBA_OPT="1").endswith("compiling")
    assert modules.run(NUMBA_CPU_NAME="x86-64-v3", NUMBA_CPU_FEATURES="").endswith("compiling")


def test_a_global_replaced_at_run_time_is_never_stored(modules: ModulePair) -> None:
    """``g`` is compiled for floats with the old value, and for integers with the new one; callers may hold either."""
    code = "import a, b; a.f(2.0); b.FACTOR = 50.0; print(a.f(2.0), a.f(2), b.g(2), a.derived(1.0))"
    assert modules.run(code=code) == "4.0 100.0 100.0 4.0"
    assert modules.run(code="import a, b; print(a.f(2.0), a.f(2), b.g(2))") == "4.0 4.0 4.0"


def test_a_truncated_entry_is_recompiled(modules: ModulePair) -> None:
    modules.run()
    for path in (modules.folder / "store").glob("*.loop"):
        path.write_bytes(path.read_bytes()[:100])
    printed = modules.run()
    assert printed.startswith("4.0 8.0 2.0 compiling") and printed.count("is damaged") == 1
    assert modules.run() == "4.0 8.0 2.0"


def test_a_file_in_place_of_the_folder_is_reported_once(modules: ModulePair) -> None:
    (modules.folder / "store").write_text("")
    printed = modules.run()
    assert printed.startswith("4.0 8.0 2.0 compiling") and printed.count(str(modules.folder / "store")) == 1


def test_concurrent_processes_lose_no_entry(modules: ModulePair) -> None:
    environment = {"PYTHONPATH": f"{modules.folder}:{ROOT}", "NUMBA_CACHE_DIR": str(modules.folder / "store")}
    arguments = ["2", "2.0", "b.np.float32(2)"]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", f"import a, b, numpy; b.np = numpy; a.f({argument})"], cwd=modules.folder, env=environment
        )
        for argument in arguments
    ]
    assert [process.wait() for process in processes] == [0, 0, 0]
    code = "import a, numpy as np; a.compile_recorders.append(lambda *_: print('compiling'))\n"
    code += "print(a.f(2), a.f(2.0), a.f(np.float32(2)))"
    assert modules.run(code=code) == "4.0 4.0 4.0"


def test_numba_disable_jit_runs_plain_python(modules: ModulePair) -> None:
    assert modules.run(NUMBA_DISABLE_JIT="1") == "4.0 8.0 2.0"
