"""The suite can fail: with a deliberate defect in the engine the named hard cases fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.hard_cases.cases import failures
from tests.hard_cases.mutants import MUTANTS
from tests.hard_cases.mutants.listing import SECTION, as_markdown
from tests.hard_cases.mutants.mutant import DefectError, constant, edited, edited_shader, wrapped
from tests.hard_cases.table import section_of

ROOT = Path(__file__).resolve().parents[2]


@cache
def run_mutants(module: str) -> subprocess.CompletedProcess[str]:
    """Run all mutants of a test module in one process, which prints their records."""
    command = [sys.executable, "-m", "tests.hard_cases.mutants.run", module]
    return subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, timeout=600, check=False)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(MUTANTS, key=lambda name: MUTANTS[name].module))
def test_a_broken_engine_is_noticed(name):
    mutant = MUTANTS[name]
    process = run_mutants(mutant.module)
    assert process.returncode == 0, process.stderr
    records = json.loads(process.stdout.splitlines()[-1])[name]
    assert records is not None, process.stderr
    assert len(records) == len(mutant.detecting_cases)
    for record in records:
        assert record.get("error") or failures(record), f"{mutant.description}: {record} holds all the same"


@pytest.mark.parametrize(
    "defect",
    [
        constant("shadows.planar:NO_SUCH_NAME", 1),
        constant("shadows.no_such_module:PASSES", 1),
        wrapped("terrain.gl.stencil:Stencil.no_such_method", lambda method: method),
        edited("shadows.planar:plane_projection", ("np.eye(5)", "np.eye(4)")),
        edited_shader("shadows/planar", ("no such text", "")),
    ],
)
def test_a_defect_of_what_the_engine_lacks_is_an_error(defect):
    with pytest.raises(DefectError, match=r"no |0 times"):
        defect()


def test_the_document_lists_what_each_case_catches():
    """``python -m tests.hard_cases.mutants.listing docs/reports/hard-cases.md`` writes the list."""
    assert section_of(ROOT / "docs/reports/hard-cases.md", SECTION) == as_markdown()
