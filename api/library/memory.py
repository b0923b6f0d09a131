"""Measure free memory, and check that arrays fit into it before they are allocated."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from skugga.terrain.errors import InputError, Problem

MEMINFO_PATH = Path("/proc/meminfo")
CGROUP_FILES = (
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""Folders of cgroups v2 and v1, the files with a container's limit and use, and the field for pages that the kernel may drop."""


def free_bytes() -> int | None:
    """Return the bytes of memory that this process can still allocate; ``None`` if the system does not report them."""
    return min(_free_byte_counts(), default=None)


def check_memory(name: str, rows: int, cols: int, bytes_per_cell: float, remedy: str) -> None:
    """Raise an error for arrays that do not fit into memory.

    Parameters
    ----------
    name
        The parameter that determines the number of cells.
    rows, cols
        The shape of the arrays.
    bytes_per_cell
        Bytes that the work takes for each cell.
    remedy
        A way to do the same with less memory: a sentence without a full stop.

    Raises
    ------
    InputError
        If they do not fit.
    """
    needed_bytes, available_bytes = rows * cols * bytes_per_cell, free_bytes()
    if available_bytes is not None and needed_bytes > available_bytes:
        problem = f"{rows} x {cols} cells take {needed_bytes / 1e9:.1f} GB of memory, and {available_bytes / 1e9:.1f} GB are free"
        raise InputError(name, Problem(problem), remedy)


def _free_byte_counts() -> Iterator[int]:
    """Yield the free bytes of the machine and of each cgroup with a limit, as far as the system reports them."""
    try:
        fields = dict(line.split(":", 1) for line in MEMINFO_PATH.read_text(encoding="ascii").splitlines())
        yield int(fields["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        try:
            yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, OSError, ValueError):
            pass
    for folder, limit, use, inactive in CGROUP_FILES:
        try:
            stat = dict(line.split() for line in (folder / "memory.stat").read_text(encoding="ascii").splitlines())
            used_bytes = int((folder / use).read_text(encoding="ascii")) - int(stat.get(inactive, 0))
            yield max(int((folder / limit).read_text(encoding="ascii")) - used_bytes, 0)  # "max": no limit
        except (OSError, ValueError):
            continue
