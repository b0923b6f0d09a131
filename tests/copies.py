"""Modified copies of the repository: tests make a change on a copy and observe its effects."""

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
COPIED_FOLDERS = ("skugga", "terrain", "shadows", "selector", "api", "configs", "tests")

Edits = Mapping[str, tuple[tuple[str, str], ...]]
"""File -> pairs of a text that occurs once and its replacement. A missing file begins empty."""


def copy_with(folder: Path, edits: Edits) -> Path:
    """Copy all packages and the tests, change some files, and return the copy's folder."""
    copy_folder = folder / "house"
    for package in COPIED_FOLDERS:
        shutil.copytree(ROOT / package, copy_folder / package, symlinks=True, ignore=shutil.ignore_patterns("static", "golden"))
    for name, changes in edits.items():
        path = copy_folder / name
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        for old, new in changes:
            assert text.count(old) == 1, (name, old)
            text = text.replace(old, new)
        path.write_text(text, encoding="utf-8")
    return copy_folder


def run_module_json(copy_folder: Path, module: str, *arguments: str | Path) -> Any:
    """Run a module on a copy, and return the JSON that it prints."""
    environment = {**os.environ, "PYTHONPATH": str(copy_folder), "COLUMNS": "120", "TERM": "dumb"}
    command = [sys.executable, "-m", module, *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, text=True, check=False, cwd=copy_folder, env=environment, timeout=300)
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout)
