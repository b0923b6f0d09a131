"""Compiled loops and what numba keeps of them on disk."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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
