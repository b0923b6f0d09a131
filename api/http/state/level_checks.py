"""Check levels and archives for changes without blocking requests.

A check runs in its own thread and reads the files if they have changed. A level has one check at a time, which all of its requests
wait for. A request that has waited for the maximum time uses the last version that was read. A check that hangs is abandoned: its
thread continues, and another check starts.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from skugga.api.errors import ExhaustedError
from skugga.api.resource_exhaustion import exhausted_error
from skugga.terrain.errors import SkuggaError

Value = TypeVar("Value")

CHECK_ABANDON_DELAY_S = 30.0
"""Seconds after which a running check is abandoned. Its thread continues, and another check may start."""

MAX_ABANDONED_CHECKS = 4
"""Maximum number of abandoned checks of one level. Each occupies a thread."""

log = logging.getLogger("skugga")


@dataclass
class _Check(Generic[Value]):
    """A check that runs in a thread.

    Attributes
    ----------
    started_s : float
        Time of its start, seconds of ``time.monotonic``.
    future : Future
        Its outcome.
    is_logged : bool
        Whether the log already says that it takes too long.
    """

    started_s: float
    future: Future[Value]
    is_logged: bool = False


@dataclass
class FileCheck(Generic[Value]):
    """A value read from files, such as a level, that a check keeps up to date.

    Attributes
    ----------
    name : str
        Name of the level or archive, for logs.
    value : Value
        Result of the last check that raised no error.
    check : callable
        Function without arguments that reads the files. It returns the present value, or raises ``SkuggaError``.
    ttl_s : float
        Time to live of a result: seconds after a check without another check.
    max_wait_s : float
        Maximum seconds that a request waits for a check.
    kind : str
        Word for the kind of value in logs, such as ``level``.
    error : SkuggaError or None
        Error of the last check; ``None`` if it succeeded.
    """

    name: str
    value: Value
    check: Callable[[], Value]
    ttl_s: float
    max_wait_s: float
    kind: str = "level"
    error: SkuggaError | None = None
    _is_exhausted: bool = False
    _checked_s: float = float("-inf")
    _running: _Check[Value] | None = None
    _abandoned: list[_Check[Value]] = field(default_factory=list)

    def fresh_value(self) -> Value | None:
        """Return the value if it can be used without waiting, else ``None``.

        The last finished check must have succeeded. Also, it must be recent (``ttl_s``), or the present check must hang, which
        means that it runs for longer than ``max_wait_s``.
        """
        return self.value if self.error is None and (self._is_fresh() or self._is_overdue()) else None

    def expire(self) -> None:
        """Mark the value as not fresh, so that its next use runs a check."""
        self._checked_s = float("-inf")

    def check_now(self) -> Value:
        """Run the check in this thread and return the value. Raises the check's error."""
        return self._store(self._run_check(self.check))

    async def current(self) -> Value:
        """Return the present value, or the last one if the check takes longer than ``max_wait_s``. Raises the check's error."""
        if not self._is_fresh():
            running = self._start_check()
            if running is not None:
                await self._wait_for_check(running)
        if self.error is not None:
            raise self.error
        return self.value

    async def _wait_for_check(self, running_check: _Check[Value]) -> None:
        """Wait until a check ends, or for up to ``max_wait_s`` seconds from its start. Log once that a check takes longer."""
        left_s = running_check.started_s + self.max_wait_s - time.monotonic()
        if left_s > 0.0:
            await asyncio.wait({asyncio.wrap_future(running_check.future)}, timeout=left_s)
        if not running_check.future.done() and not running_check.is_logged:
            running_check.is_logged = True
            log.error(
                "%s %s: its files were not read within %g s. The last version is served.", self.kind, self.name, self.max_wait_s
            )

    def _start_check(self) -> _Check[Value] | None:
        """Return the running check or a new one; ``None`` if no thread can be started."""
        now_s = time.monotonic()
        running = self._running
        if running is not None and not running.future.done():
            self._abandoned = [abandoned for abandoned in self._abandoned if not abandoned.future.done()]
            if now_s - running.started_s < CHECK_ABANDON_DELAY_S or len(self._abandoned) >= MAX_ABANDONED_CHECKS:
                return running
        started: _Check[Value] = _Check(now_s, Future())
        self._running = started

        def run() -> None:
            try:
                outcome = self._run_check(self.check)
                if self._running is started:  # not superseded by a later check
                    self._store(outcome)
            except SkuggaError:
                pass
            finally:
                started.future.set_result(self.value)

        try:
            threading.Thread(target=run, name=f"check {self.name}", daemon=True).start()
        except (RuntimeError, MemoryError) as error:
            self._running = running
            self._log_exhausted(error)
            return None
        if running is not None and not running.future.done():
            self._abandoned.append(running)
        return started

    def _run_check(self, check: Callable[[], Value]) -> Value | SkuggaError:
        """Run a check in this thread, and return its value or its error as a ``SkuggaError``. Logs unexpected errors.

        Without threads, memory or file descriptors, the result is ``ExhaustedError``, or else the error of the last check.
        """
        try:
            value = check()
        except Exception as error:
            if (exhausted := exhausted_error(error)) is not None:  # a lack of resources, not a fault of the files
                self._log_exhausted(exhausted)
                return exhausted if self.error is None else self.error
            if isinstance(error, SkuggaError):
                return error
            # A bug or an error of a library: the level is broken, and the service continues.
            log.exception("%s %s cannot be read", self.kind, self.name)
            return SkuggaError(f"{self.kind} {self.name}: cannot be read: {error!r}.")
        self._is_exhausted = False
        return value

    def _log_exhausted(self, error: Exception) -> None:
        """Log once, until a check succeeds again, that the machine lacks the resources to check files."""
        if not self._is_exhausted:
            self._is_exhausted = True
            log.error("%s %s: its files cannot be checked: %s; the last version is served", self.kind, self.name, error)

    def _store(self, outcome: Value | SkuggaError) -> Value:
        """Store the outcome of a check and return the value. Raises the outcome if it is an error of the files.

        After ``ExhaustedError`` the last value is returned, and the next use checks again.
        """
        if isinstance(outcome, ExhaustedError):
            return self.value
        self._checked_s = time.monotonic()
        if isinstance(outcome, SkuggaError):
            self.error = outcome
            raise outcome
        self.value, self.error = outcome, None
        return outcome

    def _is_fresh(self) -> bool:
        """Return whether the last check ended less than ``ttl_s`` seconds ago."""
        return time.monotonic() - self._checked_s < self.ttl_s

    def _is_overdue(self) -> bool:
        """Return whether the running check takes longer than ``max_wait_s`` seconds."""
        running = self._running
        return running is not None and not running.future.done() and time.monotonic() - running.started_s > self.max_wait_s
