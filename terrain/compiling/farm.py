"""Process that compiles loops ahead of time on several cores and stores them: ``python -m skugga.terrain.compiling.farm``.

- The process imports the modules of the loops once and then forks one worker per core.
- A loop is compiled after the loops that it calls are stored, so no two workers compile the same loop.
- Products are compiled in the order of the command line. Within a product the longest chain of calls goes first.
- The process prints a line ``done total product`` for each loop.
- If a worker is killed, only its current loop is lost. That loop is compiled on its first call.
"""

from __future__ import annotations

import argparse
import fcntl
import gc
import logging
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from graphlib import TopologicalSorter
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from types import CodeType
from typing import Any, NamedTuple

from numba.core.dispatcher import Dispatcher

from skugga.terrain.compiling.loop_cache import LoopCache, loop_store
from skugga.terrain.compiling.parent_process import end_with_parent
from skugga.terrain.compiling.signatures import recorded_signatures

LOWEST_PRIORITY = 19
"""Nice value of the lowest scheduling priority, see nice(2)."""


class Task(NamedTuple):
    """A loop to compile for given argument types.

    Attributes
    ----------
    loop
        The numba dispatcher.
    argument_types
        Types of its arguments.
    product_index
        Index of the first requested product that needs the loop.
    """

    loop: Any
    argument_types: tuple[Any, ...]
    product_index: int


def main(argv: Sequence[str] | None = None) -> None:
    """Compile the loops that some products need and that the cache lacks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--background", action="store_true", help="at the lowest priority")
    parser.add_argument("products", nargs="+")
    arguments = parser.parse_args(argv)
    logging.getLogger("skugga").setLevel(logging.ERROR)  # the process that uses the store logs its warnings once
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the waiting parent process handles Ctrl-C
    if arguments.background:
        os.nice(LOWEST_PRIORITY)
    try:
        with _compile_lock(arguments.background):
            tasks = missing_tasks(arguments.products)
            if tasks:
                print(0, len(tasks), arguments.products[min(task.product_index for task in tasks)], flush=True)
            for done_count, task in enumerate(compile_tasks(tasks, arguments.processes), 1):
                print(done_count, len(tasks), arguments.products[task.product_index], flush=True)
    except BrokenPipeError:  # the parent process has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError:  # the store is not writable: the caller of a loop compiles it and logs the reason
        return


@contextmanager
def _compile_lock(background: bool) -> Iterator[None]:
    """Hold a file lock within the block, one for foreground and another one for background compilation.

    Another process of the same kind may be compiling the same loops, so this one waits for it. Raises ``OSError`` if the store is
    not writable.
    """
    folder = loop_store().folder
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with (folder / f".{'background' if background else 'compiling'}.lock").open("a") as lock:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def missing_tasks(products: Sequence[str]) -> list[Task]:
    """Return the loops of some products that the store lacks."""
    return [task for task, name in named_tasks(products) if not loop_store().contains(name)]


def named_tasks(products: Sequence[str]) -> Iterator[tuple[Task, str]]:
    """Yield the loops of some products with the names of their cache entries.

    Recorded loops that no longer exist are left out, and so are loops that cannot be stored.
    """
    for signature in recorded_signatures(products):
        try:
            loop, args = signature.dispatcher(), signature.argument_types()
        except (ImportError, AttributeError):
            continue
        cache = getattr(loop, "_cache", None)
        name = cache.entry_name(args, loop.targetctx.codegen().magic_tuple()) if isinstance(cache, LoopCache) else None
        if name is not None:
            product_index = min(products.index(product) for product in signature.products if product in products)
            yield Task(loop, args, product_index), name


def compile_tasks(tasks: Sequence[Task], processes: int) -> Iterator[Task]:
    """Compile loops in forked workers, callees before their callers. Yield each task when it is done or its worker was killed."""
    queue = _Queue(tasks)
    children = _fork_workers(tasks, min(processes, len(tasks)))
    busy: dict[Connection, int] = {}
    while queue.is_active and children:
        for pipe in [pipe for pipe in children if pipe not in busy]:
            number = queue.take()
            if number is None:
                break
            busy[pipe] = number
            with suppress(OSError):  # the worker was killed; ``recv`` below detects it
                pipe.send(number)
        for pipe in [pipe for pipe in wait(list(busy)) if isinstance(pipe, Connection)]:
            number = busy.pop(pipe)
            try:
                pipe.recv()
            except (EOFError, OSError):
                children.remove(pipe)
                print(f"skugga: {loop_store().folder}: a worker that compiles loops was killed.", file=sys.stderr)
            queue.finish(number)
            yield tasks[number]


def _fork_workers(tasks: Sequence[Task], count: int) -> list[Connection]:
    """Fork workers that compile. Return the pipes to them; a worker ends when its pipe is closed."""
    gc.disable()  # collection takes a tenth of the compile time, and workers are short-lived
    gc.freeze()
    fork = get_context("fork")
    pipes: list[Connection] = []
    for _ in range(count):
        parent_end, child_end = fork.Pipe()
        fork.Process(target=_compile_until_closed, args=(child_end, tasks, [parent_end, *pipes]), daemon=True).start()
        child_end.close()
        pipes.append(parent_end)
    return pipes


class _Queue:
    """Priority queue of the tasks whose callees are done.

    The order is by product, then by the longest chain of callers. The length of a chain is the bytecode of its loops in bytes.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        callees = callees_of([task.loop for task in tasks])
        by_loop: dict[Any, list[int]] = {}
        for number, task in enumerate(tasks):
            by_loop.setdefault(task.loop, []).append(number)
        dependencies = {
            number: [n for callee_loop in callees[task.loop] for n in by_loop.get(callee_loop, ())]
            for number, task in enumerate(tasks)
        }
        self._tasks = tasks
        code_bytes = [_code_bytes(task.loop) + sum(map(_code_bytes, callees[task.loop])) for task in tasks]
        self._chain_bytes = list(code_bytes)
        for number in reversed([*TopologicalSorter(dependencies).static_order()]):  # callers first
            for callee in dependencies[number]:
                self._chain_bytes[callee] = max(self._chain_bytes[callee], code_bytes[callee] + self._chain_bytes[number])
        self._sorter = TopologicalSorter(dependencies)
        self._sorter.prepare()
        self._ready: list[int] = []

    def _priority(self, number: int) -> tuple[int, int]:
        """Return the sort key of a task: the task with the largest one is compiled first."""
        return -self._tasks[number].product_index, self._chain_bytes[number]

    @property
    def is_active(self) -> bool:
        """Whether any task is queued or running."""
        return self._sorter.is_active()

    def take(self) -> int | None:
        """Return the number of the next task, or ``None`` if all remaining tasks wait for their callees."""
        self._ready = sorted([*self._ready, *self._sorter.get_ready()], key=self._priority)
        return self._ready.pop() if self._ready else None

    def finish(self, number: int) -> None:
        """Mark a task as done, which makes its callers ready."""
        self._sorter.done(number)


def _compile_until_closed(pipe: Connection, tasks: Sequence[Task], inherited_pipes: Sequence[Connection]) -> None:
    """Compile the tasks whose numbers arrive on a pipe, until it is closed.

    ``inherited_pipes`` are the inherited ends of the other pipes. They are closed here, since they would keep those pipes open.
    """
    end_with_parent()
    for end in inherited_pipes:
        end.close()
    while True:
        try:
            number = pipe.recv()
        except (EOFError, OSError):
            return
        loop, args, _ = tasks[number]
        try:
            loop.compile(args)
        except Exception as error:  # numba raises many types, for example if the recorded signature is out of date
            reason = str(error).partition("\n")[0]
            print(f"skugga: {loop.py_func.__module__}.{loop.py_func.__name__}: cannot be compiled ahead: {reason}", file=sys.stderr)
        try:
            pipe.send(number)
        except OSError:  # the parent process was killed
            return


def callees_of(loops: Iterable[Any]) -> dict[Any, set[Any]]:
    """Return the direct and indirect callees of each loop, and of every loop among these callees."""
    callees_by_loop: dict[Any, set[Any]] = {}

    def visit(loop: Any) -> set[Any]:
        if loop not in callees_by_loop:
            callees_by_loop[loop] = set()  # ends the recursion of a loop that calls itself
            function = loop.py_func
            cells = [cell.cell_contents for cell in function.__closure__ or ()]
            values = [*cells, *(function.__globals__.get(name) for name in _code_names(function.__code__))]
            for callee in values:
                if isinstance(callee, Dispatcher) and callee is not loop:
                    callees_by_loop[loop] |= {callee} | visit(callee)
        return callees_by_loop[loop]

    for loop in loops:
        visit(loop)
    return callees_by_loop


def _code_names(code: CodeType) -> Iterator[str]:
    """Yield the names of the globals and attributes that bytecode and the functions nested in it use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_names(constant)


def _code_bytes(loop: Any) -> int:
    """Return the size of a loop's bytecode, a rough estimate of its compile time."""
    return len(loop.py_func.__code__.co_code)


if __name__ == "__main__":
    main()
