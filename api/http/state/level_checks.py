"""Check levels and archives for changes without blocking requests.

Each level has at most one check at a time, in its own thread and with a time limit. Requests that exceed the limit get the
last version."""

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
from skugga.api.exhaustion import exhausted_error
from skugga.terrain.errors import SkuggaError

LookedAt = TypeVar("LookedAt")

LOOK_AGAIN_S = 30.0
"""Time after which a check that still runs is abandoned and another check starts."""

MOST_LOST = 4
"""Maximum number of abandoned checks of one level: each occupies a thread."""

log = logging.getLogger("skugga")


@dataclass
class _Look(Generic[LookedAt]):
    began_s: float
    future: Future[LookedAt]
    told: bool = False


@dataclass
class LevelCheck(Generic[LookedAt]):
    """A value that a check of files keeps up to date.

    Attributes
    ----------
    name : str
        Name of the level or archive, for logs.
    value : LookedAt
        The last value without an error.
    look : callable
        The check: returns the value as it is now, or raises ``SkuggaError``.
    fresh_s : float
        Seconds for which a result is used without another check.
    wait_s : float
        Maximum seconds that a request waits for a check.
    what : str
        Kind of the value, for logs.
    error : SkuggaError or None
        Error of the last check.
    """

    name: str
    value: LookedAt
    look: Callable[[], LookedAt]
    fresh_s: float
    wait_s: float
    what: str = "level"
    error: SkuggaError | None = None
    _is_exhausted: bool = False
    _looked_s: float = float("-inf")
    _looking: _Look[LookedAt] | None = None
    _lost: list[_Look[LookedAt]] = field(default_factory=list)

    def known(self) -> LookedAt | None:
        """Return the value if it is fresh or its check hangs; ``None`` if a check is due or the last one failed."""
        return self.value if self.error is None and (self._is_fresh() or self._hangs()) else None

    def expire(self) -> None:
        """Make the value stale: its next use runs a check."""
        self._looked_s = float("-inf")

    def now(self) -> LookedAt:
        """Run the check in this thread and return the value. Raises the check's error."""
        return self._note(self._outcome(self.look))

    async def current(self) -> LookedAt:
        """Return the value as it is now, or the last value if the check takes too long. Raises the check's error."""
        if not self._is_fresh():
            looking = self._look_now()
            if looking is not None:
                await self._wait(looking)
        if self.error is not None:
            raise self.error
        return self.value

    async def _wait(self, looking: _Look[LookedAt]) -> None:
        left_s = looking.began_s + self.wait_s - time.monotonic()
        if left_s > 0.0:
            await asyncio.wait({asyncio.wrap_future(looking.future)}, timeout=left_s)
        if not looking.future.done() and not looking.told:
            looking.told = True
            log.error("%s %s: its files were not read within %g s. The last version is served.", self.what, self.name, self.wait_s)

    def _look_now(self) -> _Look[LookedAt] | None:
        """Return the running check or a new one; ``None`` if no thread can be started."""
        now_s = time.monotonic()
        looking = self._looking
        if looking is not None and not looking.future.done():
            self._lost = [lost for lost in self._lost if not lost.future.done()]
            if now_s - looking.began_s < LOOK_AGAIN_S or len(self._lost) >= MOST_LOST:
                return looking
        begun: _Look[LookedAt] = _Look(now_s, Future())
        self._looking = begun

        def run() -> None:
            try:
                outcome = self._outcome(self.look)
                if self._looking is begun:  # not superseded by a later check
                    self._note(outcome)
            except SkuggaError:
                pass
            finally:
                begun.future.set_result(self.value)

        try:
            threading.Thread(target=run, name=f"look at {self.name}", daemon=True).start()
        except (RuntimeError, MemoryError) as error:
            self._looking = looking
            self._tell_exhausted(error)
            return None
        if looking is not None and not looking.future.done():
            self._lost.append(looking)
        return begun

    def _outcome(self, look: Callable[[], LookedAt]) -> LookedAt | SkuggaError:
        try:
            found = look()
        except Exception as error:
            if (exhausted := exhausted_error(error)) is not None:  # a lack of resources, not a fault of the files
                self._tell_exhausted(exhausted)
                return exhausted if self.error is None else self.error
            if isinstance(error, SkuggaError):
                return error
            # A bug or an error of a library: the level is broken, and the service continues.
            log.exception("%s %s cannot be read", self.what, self.name)
            return SkuggaError(f"{self.what} {self.name}: cannot be read: {error!r}.")
        self._is_exhausted = False
        return found

    def _tell_exhausted(self, error: Exception) -> None:
        if not self._is_exhausted:
            self._is_exhausted = True
            log.error("%s %s: its files cannot be checked: %s; the last version is served", self.what, self.name, error)

    def _note(self, outcome: LookedAt | SkuggaError) -> LookedAt:
        if isinstance(outcome, ExhaustedError):
            return self.value
        self._looked_s = time.monotonic()
        if isinstance(outcome, SkuggaError):
            self.error = outcome
            raise outcome
        self.value, self.error = outcome, None
        return outcome

    def _is_fresh(self) -> bool:
        return time.monotonic() - self._looked_s < self.fresh_s

    def _hangs(self) -> bool:
        looking = self._looking
        return looking is not None and not looking.future.done() and time.monotonic() - looking.began_s > self.wait_s
