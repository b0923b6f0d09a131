"""Whole pipeline on another rasteriser than that of the golden pictures, within the tolerance for other renderers."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.golden import REFERENCE_RENDERER
from tests.softpipe import SOFTPIPE, UNSUPPORTED_LEVELS

ROOT = Path(__file__).parents[2]

FEW_GOLDENS_FILTER = (
    "thesis_street-main or thesis_room_sun-close-perspective or thesis_rocks_sun-bounds0-hybrid or jacksboro-evening-mask"
)
ALL_GOLDENS_FILTER = " and ".join(f"not {name}" for name in UNSUPPORTED_LEVELS)


@pytest.mark.parametrize(
    ("test_filter", "count"),
    [
        pytest.param(FEW_GOLDENS_FILTER, 6, marks=pytest.mark.long),
        pytest.param(ALL_GOLDENS_FILTER, 28, marks=pytest.mark.thorough),
    ],
    ids=["few", "all"],
)
def test_goldens_on_softpipe(gl, test_filter, count):
    if not gl.renderer.startswith(REFERENCE_RENDERER):
        pytest.skip(f"softpipe needs a Mesa with {REFERENCE_RENDERER}. The renderer is {gl.renderer}.")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-n",
        "0",
        "-p",
        "tests.softpipe",
        "tests/shadows/test_snapshots.py",
        "-k",
        test_filter,
    ]
    process = subprocess.run(command, cwd=ROOT, env={**os.environ, **SOFTPIPE}, capture_output=True, text=True, timeout=600)
    assert process.returncode == 0, process.stdout
    assert re.search(rf"= {count} passed(, \d+ deselected)? in", process.stdout), "none is skipped"
