"""What a process does when it first meets a loop that is stored nowhere. Imports no numba, so that light commands may set it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_first_compile: list[Callable[[], None]] = []


@contextmanager
def on_first_compile(call: Callable[[], None]) -> Iterator[None]:
    """Call a function once, before the first loop is compiled that is stored nowhere, if that happens within the block."""
    _first_compile.append(call)
    try:
        yield
    finally:
        if call in _first_compile:
            _first_compile.remove(call)


def report_compile() -> bool:
    """Call what waits for the first compilation, each function once; return whether there was any."""
    calls = list(_first_compile)
    _first_compile.clear()
    for call in calls:
        call()
    return bool(calls)
