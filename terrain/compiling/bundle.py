"""Compiled loops that come with a wheel, for any processor of the level x86-64-v3. Imports no numba.

A wheel holds the loops of one version of Python, numba and NumPy. They fit where those are the same and the processor has the
instructions of x86-64-v3; elsewhere they are ignored, and loops are compiled for the processor that is there.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

FOLDER = Path(__file__).with_name("bundled")
VERSIONS = "versions.json"

TARGET = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
"""Variables by which numba compiles for any such processor: the name alone would be joined by the features of this one."""

FLAGS = frozenset({"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"})
"""Instructions of x86-64-v3 beyond those of v2, as ``/proc/cpuinfo`` names them."""


def installed_versions() -> dict[str, str]:
    """Return the versions that machine code depends on. Raises ``ImportError`` where one is not installed."""
    from importlib.metadata import version  # slow to import, and a clone has no use for it

    found = {"python": sys.implementation.cache_tag or ""}
    found |= {name: version(name) for name in ("numba", "llvmlite")}
    return found | {"numpy": ".".join(version("numpy").split(".")[:2])}


def use_bundled_loops(folder: Path = FOLDER, cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Let numba use the loops of the wheel where they fit, in this process and its children; return whether they do.

    It sets environment variables, and has to be called before numba is imported: by programs of ours, never by a library.
    """
    with suppress(OSError, ValueError, ImportError):  # a package that is not found is an ``ImportError``
        fits = json.loads((folder / VERSIONS).read_text(encoding="utf-8")) == installed_versions() and _is_v3(cpuinfo)
        if fits and not any(name in os.environ for name in TARGET):
            os.environ.update(TARGET)
        return fits and _is_set(os.environ)
    return False


def _is_v3(cpuinfo: Path) -> bool:
    if platform.machine() not in ("x86_64", "AMD64"):
        return False
    flags = next(
        (line for line in cpuinfo.read_text(encoding="ascii", errors="replace").splitlines() if line.startswith("flags")), ""
    )
    return frozenset(flags.partition(":")[2].split()) >= FLAGS


def _is_set(environment: Mapping[str, str]) -> bool:
    return all(environment.get(name) == value for name, value in TARGET.items())
