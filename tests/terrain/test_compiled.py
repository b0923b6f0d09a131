"""Compiled loops and what numba keeps of them on disk."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from terrain import compiled as compiled_module
from terrain.compiled import in_shares

LOOP = """
from typing import NamedTuple
import numpy as np
from terrain.compiled import compiled

class {name}(NamedTuple):
    heights: np.ndarray
    factor: float

@compiled
def total(window):
    return window.factor * window.heights.sum()

print(total({name}(np.ones(4), {factor})))
"""


def test_a_cache_that_names_a_tuple_of_an_older_version_counts_as_empty(tmp_path: Path) -> None:
    def run(name: str, factor: float) -> str:
        """What the loop gives, in a process of its own, with the cache of the runs before."""
        (tmp_path / "loop.py").write_text(LOOP.format(name=name, factor=factor), encoding="utf-8")
        command = [sys.executable, "-c", "import loop"]
        root = str(Path(__file__).resolve().parents[2])
        done = subprocess.run(command, cwd=tmp_path, env={"PYTHONPATH": f"{tmp_path}:{root}"}, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert run("Window", 2.0) == "8.0"
    assert list((tmp_path / "__pycache__").glob("*.nbi"))
    assert run("GroundWindow", 3.0) == "12.0"
    assert run("GroundWindow", 3.0) == "12.0"


SAYS_SO = """
from terrain.compiled import compiled, told_of_compiling

@compiled
def one():
    return 1

@compiled
def two():
    return 2

with told_of_compiling(lambda: print("compiling")):
    print(one() + two())
"""


def test_a_process_says_once_that_it_compiles_and_one_that_finds_loops_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "loops.py").write_text(SAYS_SO, encoding="utf-8")

    def run() -> list[str]:
        command, root = [sys.executable, "-c", "import loops"], str(Path(__file__).resolve().parents[2])
        done = subprocess.run(command, cwd=tmp_path, env={"PYTHONPATH": f"{tmp_path}:{root}"}, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    assert run() == ["compiling", "3"]
    assert run() == ["3"]


KEPT_NOWHERE = """
import errno, numba
from numba.core import caching
from terrain import compiled as module

def full(self, overloads):
    raise OSError(errno.ENOSPC, "No space left on device")

def read_only(self, *arguments):
    raise RuntimeError("cannot cache function: no locator available")

if {read_only}:
    numba.core.dispatcher.Dispatcher.enable_caching = read_only
else:
    caching.IndexDataCacheFile._save_index = full

@module.compiled
def twice(number):
    return 2 * number

import another
print(twice(3), another.thrice(1.5), module.why_not_kept(), sep="|")
"""

ANOTHER = """
from terrain.compiled import compiled

@compiled
def thrice(number):
    return 3 * number
"""


@pytest.mark.parametrize(("read_only", "reason", "logged"), [(True, "no folder can be written", 0), (False, "No space left", 1)])
def test_a_loop_that_cannot_be_kept_runs_all_the_same_and_says_why(
    tmp_path: Path, read_only: bool, reason: str, logged: int
) -> None:
    (tmp_path / "loop.py").write_text(KEPT_NOWHERE.format(read_only=read_only), encoding="utf-8")
    (tmp_path / "another").mkdir()
    (tmp_path / "another" / "__init__.py").write_text(ANOTHER, encoding="utf-8")
    root = str(Path(__file__).resolve().parents[2])
    environment = {"PYTHONPATH": f"{tmp_path}:{root}"}
    done = subprocess.run([sys.executable, "-c", "import loop"], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    *numbers, said = done.stdout.strip().split("|")
    assert numbers == ["6", "4.5"]
    assert reason in said and "NUMBA_CACHE_DIR" in said
    assert done.stderr.count("NUMBA_CACHE_DIR") == logged, "once, not for each loop or folder"


@pytest.mark.parametrize("cores", [1, 2, 5])
@pytest.mark.parametrize("rows", [0, 1, 3, 7, 64, 1001])
def test_each_row_is_in_one_share(monkeypatch, cores, rows):
    monkeypatch.setattr(compiled_module, "CORES", cores)
    met = np.zeros(rows, np.int64)

    def meet(first: int, last: int, by: int) -> None:
        met[first:last] += by

    in_shares(rows, meet, 3)
    assert (met == 3).all()


def test_what_a_share_raises_is_raised(monkeypatch):
    monkeypatch.setattr(compiled_module, "CORES", 2)

    def fail(first: int, last: int) -> None:
        raise ValueError(f"row {first}")

    with pytest.raises(ValueError, match="row 0"):
        in_shares(100, fail)
