"""The list of mutants that each hard case catches.

``python -m tests.hard_cases.mutants.listing docs/reports/hard-cases.md`` writes it.
"""

from __future__ import annotations

import pkgutil
import sys
from importlib import import_module
from pathlib import Path

import tests.hard_cases
from tests.hard_cases.cases import Case
from tests.hard_cases.mutants import MUTANTS
from tests.hard_cases.mutants.run import case_of
from tests.hard_cases.table import COLUMNS, case_order, replace_section

SECTION = "mutants"
"""The name of the document's marks."""


def hard_cases() -> dict[str, Case]:
    """Return all hard cases by id, in the catalogue's order."""
    modules = [
        import_module(f"tests.hard_cases.{module.name}")
        for module in pkgutil.iter_modules(tests.hard_cases.__path__)
        if module.name.startswith("test_")
    ]
    cases = [test.case for module in modules for test in vars(module).values() if isinstance(getattr(test, "case", None), Case)]
    return {case.id: case for case in sorted(cases, key=lambda case: case_order(case.id))}


def caught_mutants() -> dict[str, dict[str, list[str]]]:
    """Return, for each case that catches a mutant, the algorithms by which it catches each mutant."""
    caught: dict[str, dict[str, list[str]]] = {}
    for name, mutant in MUTANTS.items():
        for case_name in mutant.detecting_cases:
            caught.setdefault(case_of(case_name).id, {}).setdefault(name, []).append(case_name[2])
    return caught


def as_markdown() -> str:
    """Return a table of the mutants that each case catches, with the algorithms in brackets, and the ids of all other cases."""
    caught, every_case = caught_mutants(), hard_cases()
    lines = ["| case | what is broken |", "| --- | --- |"]
    for case_id in every_case:
        broken = [
            f"{MUTANTS[name].description} ({', '.join(COLUMNS.get(algorithm, algorithm) for algorithm in algorithms)})"
            for name, algorithms in caught.get(case_id, {}).items()
        ]
        if broken:
            lines.append(f"| {case_id} | {'; '.join(broken)} |")
    missing = [case_id for case_id in every_case if case_id not in caught]
    lines += [
        "",
        f"{len(MUTANTS)} mutants are caught by {len(caught)} of {len(every_case)} cases. "
        + (f"No mutant shows that these can fail: {', '.join(missing)}." if missing else "No case is without one."),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    replace_section(Path(sys.argv[1]), SECTION, as_markdown())
