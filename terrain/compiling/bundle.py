"""Compiled loops bundled with a wheel, for any processor with the instructions of x86-64-v3. Imports no numba.

A wheel holds the loops of one version each of Python, numba and NumPy. They are used where these versions match and the processor
has the instructions of x86-64-v3. Elsewhere they are ignored, and loops are compiled for the local processor.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

BUNDLED_LOOPS_FOLDER = Path(__file__).with_name("bundled")
VERSIONS_FILE = "versions.json"

NUMBA_TARGET = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
"""Environment variables that make numba compile for any x86-64-v3 processor.

Given the name alone, numba would add the features of the local processor.
"""

X86_64_V3_CPU_FLAGS = frozenset({"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"})
"""Instruction sets that x86-64-v3 adds to v2, as named in ``/proc/cpuinfo``."""


def installed_versions() -> dict[str, str]:
    """Return the package versions that machine code depends on. Raises ``ImportError`` if one is not installed."""
    from importlib.metadata import version  # slow to import, and a clone does not need it

    versions = {"python": sys.implementation.cache_tag or ""}
    versions |= {name: version(name) for name in ("numba", "llvmlite")}
    return versions | {"numpy": ".".join(version("numpy").split(".")[:2])}


def use_bundled_loops(folder: Path = BUNDLED_LOOPS_FOLDER, cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Make numba use the bundled loops in this process and its children. Return whether they match this machine.

    Sets environment variables and must run before numba is imported. Only programs call it, never library code.
    """
    with suppress(OSError, ValueError, ImportError):  # ``PackageNotFoundError`` is an ``ImportError``
        is_compatible = json.loads(
            (folder / VERSIONS_FILE).read_text(encoding="utf-8")
        ) == installed_versions() and _supports_x86_64_v3(cpuinfo)
        if is_compatible and not any(name in os.environ for name in NUMBA_TARGET):
            os.environ.update(NUMBA_TARGET)
        return is_compatible and _is_numba_target_set(os.environ)
    return False


def _supports_x86_64_v3(cpuinfo: Path) -> bool:
    """Return whether the processor has the instructions of x86-64-v3, by the file ``cpuinfo`` (``/proc/cpuinfo``)."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return False
    flags = next(
        (line for line in cpuinfo.read_text(encoding="ascii", errors="replace").splitlines() if line.startswith("flags")), ""
    )
    return frozenset(flags.partition(":")[2].split()) >= X86_64_V3_CPU_FLAGS


def _is_numba_target_set(environment: Mapping[str, str]) -> bool:
    """Return whether the environment variables ``environment`` contain ``NUMBA_TARGET``."""
    return all(environment.get(name) == value for name, value in NUMBA_TARGET.items())
