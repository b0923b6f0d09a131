"""``skugga compile``, and the progress of compiling in other commands."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from contextlib import ExitStack

from api.cli.progress import Advance, ProgressBar
from terrain.compiling.ahead import PRODUCTS, compile_ahead
from terrain.cores import usable_cores


def compile_for_command(products: Sequence[str]) -> int:
    """Compile the loops that a command misses; return how many those were."""
    bars: list[Advance] = []
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
    """Compile all loops that are stored nowhere; return what was done, in a sentence."""
    start = clock.perf_counter()
    count = compile_for_command(PRODUCTS)
    from terrain.compiling.loop_cache import loop_store

    store = loop_store()
    if not count:
        return f"Nothing to compile: all loops are in {store.folder}"
    return f"Compiled {count} loops in {clock.perf_counter() - start:.0f} s into {store.folder}"
