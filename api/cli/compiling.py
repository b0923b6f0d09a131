"""``skugga compile``, and the progress bar of compilation in other commands."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from skugga.api.cli.progress import AdvanceCallback, ProgressBar
from skugga.terrain.atomic_files import disk_error
from skugga.terrain.compiling.ahead_of_time import PRODUCTS, compile_ahead
from skugga.terrain.cores import usable_cores
from skugga.terrain.errors import RenderError


def compile_for_command(products: Sequence[str]) -> int:
    """Compile the loops that a command needs and that the on-disk cache lacks. Return the number of compiled loops.

    ``products`` are groups of loops, of ``skugga.terrain.compiling.ahead_of_time.PRODUCTS``.
    """
    bars: list[AdvanceCallback] = []
    total_loops = 0
    with ExitStack() as stack:

        def report(task: str, done: int, total: int) -> None:
            nonlocal total_loops
            total_loops = total
            if not bars:
                bars.append(stack.enter_context(ProgressBar(f"First run: {task}")))
            bars[0](done, total)

        compile_ahead(products, usable_cores(), report)
    return total_loops


def compile_everything() -> str:
    """Compile all loops that the on-disk caches lack, and return a sentence for the user.

    Raises ``OSError`` if the cache folder cannot be written, and ``RenderError`` if loops are still missing afterwards.
    """
    from skugga.terrain.compiling.farm import missing_tasks
    from skugga.terrain.compiling.loop_cache import loop_store

    start = clock.perf_counter()
    folder = loop_store().folder
    if missing_tasks(PRODUCTS):
        _check_writable(folder)
    count = compile_for_command(PRODUCTS)
    missing = len(missing_tasks(PRODUCTS))
    if missing:
        _check_writable(folder)
        raise RenderError(f"{folder}: {missing} loops are still missing. Commands compile them on first use.")
    if not count:
        return f"Nothing to compile: all loops are in {folder}"
    return f"Compiled {count} loops in {clock.perf_counter() - start:.0f} s into {folder}"


def _check_writable(folder: Path) -> None:
    """Raise ``OSError``, which names the folder, if no file can be written to it."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if (error := disk_error(folder / "loops")) is not None:
        raise OSError(error.errno, error.strerror, str(folder))
