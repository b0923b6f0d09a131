"""Copies of the house with something more in them: what a change touches is tried by making it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("skugga", "terrain", "shadows", "selector", "api", "configs", "tests")

Edits = Mapping[str, tuple[tuple[str, str], ...]]
"""File -> what stands there once, and what shall stand there. A file that is not there begins as an empty one."""


def copy_with(folder: Path, edits: Edits) -> Path:
    """A copy of all floors, and of the tests, with some files changed."""
    house = folder / "house"
    for floor in COPIED:
        shutil.copytree(ROOT / floor, house / floor, symlinks=True, ignore=shutil.ignore_patterns("static", "golden"))
    for name, changes in edits.items():
        path = house / name
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        for old, new in changes:
            assert text.count(old) == 1, (name, old)
            text = text.replace(old, new)
        path.write_text(text, encoding="utf-8")
    return house


def said_in(house: Path, module: str, *arguments: str | Path) -> Any:
    """What a module prints as JSON, run by itself on a copy."""
    environment = {**os.environ, "PYTHONPATH": str(house), "COLUMNS": "120", "TERM": "dumb"}
    command = [sys.executable, "-m", module, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=house, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
