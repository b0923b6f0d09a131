"""``skugga compile``, and the progress of compiling in other commands."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from api.settings import cores
from terrain.compiling.ahead import PRODUCTS, compile_ahead

ProgressBar = Callable[[str], Any]
"""Makes a progress bar for a task: a context manager that yields ``advance(done, total)``."""


def compile_for_command(products: Sequence[str], progress_bar: ProgressBar) -> int:
    """Compile the loops that a command misses; return how many those were."""
    bars: list[Any] = []
    total_loops = 0
    with ExitStack() as stack:

        def report(task: str, done: int, total: int) -> None:
            nonlocal total_loops
            total_loops = total
            if not bars:
                bars.append(stack.enter_context(progress_bar(f"First run: {task}")))
            bars[0](done, total)

        compile_ahead(products, cores(), report)
    return total_loops


def compile_everything(progress_bar: ProgressBar) -> str:
    """Compile all loops that are stored nowhere; return what was done, in a sentence."""
    start = clock.perf_counter()
    count = compile_for_command(PRODUCTS, progress_bar)
    from terrain.compiling.loop_cache import loop_store

    store = loop_store()
    if not count:
        return f"Nothing to compile: all loops are in {store.folder}"
    return f"Compiled {count} loops in {clock.perf_counter() - start:.0f} s into {store.folder}"
