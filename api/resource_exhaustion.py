"""Recognition of exhausted threads, file descriptors and memory.

Such a failure is temporary and loses no data. The caller releases any slot that it had reserved for the work, and clients are told
to retry.
"""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import Any, TypeVar

from skugga.api.errors import ExhaustedError

T = TypeVar("T")

NO_THREAD_MESSAGE = "can't start new thread"
"""Text of the plain ``RuntimeError`` that Python raises."""

LIBRARY_LOAD_MESSAGES = "failed to map segment", os.strerror(errno.ENOMEM), os.strerror(errno.EMFILE), os.strerror(errno.ENFILE)
"""Texts of ``ImportError`` without memory or descriptors for a shared library: dlopen(3) reports no error number."""

EXHAUSTION_ERRNOS = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM, errno.EAGAIN}
"""Error numbers of exhausted file descriptors, memory, and processes (``EAGAIN`` of fork(2))."""


def exhausted_error(error: BaseException) -> ExhaustedError | None:
    """Return an ``ExhaustedError`` if an error, or one of its causes, reports exhausted resources; else ``None``."""
    for cause in _error_chain(error):
        if isinstance(cause, ExhaustedError):
            return cause
        if isinstance(cause, RuntimeError) and NO_THREAD_MESSAGE in str(cause):
            return ExhaustedError("no thread can be started")
        if isinstance(cause, MemoryError):
            return ExhaustedError("no memory is left")
        if isinstance(cause, ImportError) and any(text in str(cause) for text in LIBRARY_LOAD_MESSAGES):
            return ExhaustedError(str(cause))
        if isinstance(cause, OSError) and cause.errno in EXHAUSTION_ERRNOS:
            return ExhaustedError(cause.strerror or str(cause))
    return None


def run_in_pool(threads: Executor, function: Callable[..., T], *args: Any) -> asyncio.Future[T]:
    """Run a function in a thread pool. Raises ``ExhaustedError`` if no thread can be started; the function then never runs."""
    call = _CancellableCall(function, args)
    try:
        return asyncio.get_running_loop().run_in_executor(threads, call)
    except RuntimeError as error:
        call.is_dropped = True  # the executor has queued the call nevertheless, for its next thread
        raise exhausted_error(error) or error from None


class _CancellableCall:
    """A call of ``function(*args)`` that does nothing and returns ``None`` once ``is_dropped`` is set."""

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        self._function, self._args = function, args
        self.is_dropped = False

    def __call__(self) -> Any:
        return None if self.is_dropped else self._function(*self._args)


def _error_chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and its causes, the error first."""
    seen_ids: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen_ids:
        seen_ids.add(id(current))
        yield current
        current = current.__cause__ or current.__context__
