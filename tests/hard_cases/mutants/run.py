"""Run the mutants of a test module: ``python -m tests.hard_cases.mutants.run MODULE`` prints their records as JSON.

One process imports the module, and forks a process for each mutant. So mutants share what is imported, and nothing that a defect
changes reaches another mutant. Each process has its own folder of caches, since a defect may leave wrong data in it.

A case detects the defect if a figure exceeds its bound or if an assertion of the case fails.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import Phase, settings

from skugga.terrain.compiling.loop_cache import loop_store
from tests.hard_cases.cases import Case
from tests.hard_cases.mutants import MUTANTS
from tests.hard_cases.mutants.mutant import CaseName, Mutant

# The situations of the suite. A failure is enough here: the simplest one would take minutes to find.
settings.register_profile("mutants", deadline=None, derandomize=True, phases=(Phase.generate,))


def records_of_module(module: str) -> dict[str, list[dict[str, Any]] | None]:
    """Return the records of all mutants of a test module by name; ``None`` for a mutant that could not be applied or run."""
    settings.load_profile("mutants")
    os.environ.setdefault("NUMBA_CACHE_DIR", str(loop_store().folder))  # compiled loops are shared: their keys contain their code
    mutants = {name: mutant for name, mutant in MUTANTS.items() if mutant.module == module}
    for mutant in mutants.values():
        for name in mutant.detecting_cases:
            case_of(name)  # imports what the mutants share
    return {name: _in_fork(mutant) for name, mutant in mutants.items()}


def case_of(name: CaseName) -> Case:
    """Return the hard case with a name: module, test and algorithm."""
    module, test, _ = name
    case: Case = getattr(import_module(f"tests.hard_cases.{module}"), test).case
    return case


def records(mutant: Mutant) -> list[dict[str, Any]]:
    """Return the records of a mutant's cases, run in their quick way on the defective engine; ``error`` describes a failed one."""
    results, detecting_cases = [], [(case_of(name), name[2]) for name in mutant.detecting_cases]
    mutant.apply_defect()
    for case, algorithm in detecting_cases:
        with TemporaryDirectory() as folder:
            try:
                results.append(case.run(algorithm, False, Path(folder)))
            except AssertionError as error:  # an assertion failed before anything could be measured
                results.append({"id": case.id, "algorithm": algorithm, "error": str(error) or "an assertion failed"})
    return results


def _in_fork(mutant: Mutant) -> list[dict[str, Any]] | None:
    """Return the records of a mutant from a process of its own."""
    from skugga.terrain.gl import device

    assert device._device is None, "a forked process must not inherit an OpenGL context"
    sys.stderr.flush()
    read_end, write_end = os.pipe()
    process = os.fork()
    if process == 0:
        os.close(read_end)
        status = 1
        try:
            with TemporaryDirectory() as cache_folder, os.fdopen(write_end, "w", encoding="utf-8") as pipe:
                os.environ["XDG_CACHE_HOME"] = cache_folder
                pipe.write(json.dumps(records(mutant)))
            status = 0
        except BaseException:
            print(f"{mutant.description}:", file=sys.stderr)
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    os.close(write_end)
    with os.fdopen(read_end, encoding="utf-8") as pipe:
        text = pipe.read()
    _, wait_status = os.waitpid(process, 0)
    return json.loads(text) if wait_status == 0 else None


if __name__ == "__main__":
    print(json.dumps(records_of_module(sys.argv[1])))
