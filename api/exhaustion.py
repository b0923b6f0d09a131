"""What happens where the machine has no thread, file descriptor or memory left: the work fails for a moment, and nothing is lost.

Whatever takes a place for such work gives it back, and requests of such a moment are told to come again.
"""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import Any, TypeVar

from skugga.api.errors import ExhaustedError

T = TypeVar("T")

NO_THREAD = "can't start new thread"
"""What Python says, in a plain ``RuntimeError``."""

NO_ROOM = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM, errno.EAGAIN}
"""Of descriptors, memory, and (``EAGAIN``, of fork(2)) processes."""


def exhausted_error(error: BaseException) -> ExhaustedError | None:
    """The error of a machine that has nothing left, where that is what an error, or one that led to it, is about."""
    for each in _chain(error):
        if isinstance(each, ExhaustedError):
            return each
        if isinstance(each, RuntimeError) and NO_THREAD in str(each):
            return ExhaustedError("no thread can be started")
        if isinstance(each, MemoryError):
            return ExhaustedError("there is no memory left")
        if isinstance(each, OSError) and each.errno in NO_ROOM:
            return ExhaustedError(each.strerror or str(each))
    return None


def in_thread(threads: Executor, function: Callable[..., T], *args: Any) -> asyncio.Future[T]:
    """Run a function in one of some threads. Raises ``ExhaustedError`` where none can be started; then it is never run."""
    call = _Call(function, args)
    try:
        return asyncio.get_running_loop().run_in_executor(threads, call)
    except RuntimeError as error:
        call.is_dropped = True  # the executor has it in its queue all the same, for the next thread that it has
        raise exhausted_error(error) or error from None


class _Call:
    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        self._function, self._args = function, args
        self.is_dropped = False

    def __call__(self) -> Any:
        return None if self.is_dropped else self._function(*self._args)


def _chain(error: BaseException) -> Iterator[BaseException]:
    seen: set[int] = set()
    following: BaseException | None = error
    while following is not None and id(following) not in seen:
        seen.add(id(following))
        yield following
        following = following.__cause__ or following.__context__
