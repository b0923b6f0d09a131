"""The suite can fail: with a deliberate defect in the engine the named hard cases fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hard_cases.cases import failures
from tests.hard_cases.mutants import MUTANTS


@pytest.mark.long
@pytest.mark.parametrize("name", MUTANTS)
def test_a_broken_engine_is_noticed(name):
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-m", "tests.hard_cases.mutants", name]
    process = subprocess.run(command, cwd=root, env=os.environ, capture_output=True, text=True, timeout=600)
    assert process.returncode == 0, process.stderr
    records = json.loads(process.stdout.splitlines()[-1])
    assert len(records) == len(MUTANTS[name].detecting_cases)
    for record in records:
        assert record.get("error") or failures(record), f"{MUTANTS[name].description}: {record} holds all the same"
