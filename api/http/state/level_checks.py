"""Looking whether levels, or archives, have changed, without keeping anybody waiting: one look at each at a time, in a thread of
its own, with a time limit; whoever asks meanwhile gets the level as it was."""

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
"""After how long a look that has not come back is left to itself, and another one is begun."""

MOST_LOST = 4
"""Looks that have not come back, of one level, after which no more are begun: each keeps a thread."""

log = logging.getLogger("skugga")


@dataclass
class _Look(Generic[LookedAt]):
    began_s: float
    future: Future[LookedAt]
    told: bool = False


@dataclass
class LevelCheck(Generic[LookedAt]):
    """A value that ``look()`` brings up to date or raises a ``SkuggaError`` for, and what came of it last.

    What came is fresh for ``fresh_s`` seconds; a look is waited for ``wait_s`` seconds at most. ``what`` it is, is said in logs.
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
        """The value, if it is known without a look, or if the look hangs; ``None`` where it is not, or is wrong."""
        return self.value if self.error is None and (self._is_fresh() or self._hangs()) else None

    def expire(self) -> None:
        """Look when it is next asked for."""
        self._looked_s = float("-inf")

    def now(self) -> LookedAt:
        """The value as it is now, waited for. Raises what the look raises."""
        return self._note(self._outcome(self.look))

    async def current(self) -> LookedAt:
        """The value as it is now, or as it was last if that takes too long. Raises what the look raises."""
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
            log.error("%s %s: its files have not been read within %g s; it is served as it was", self.what, self.name, self.wait_s)

    def _look_now(self) -> _Look[LookedAt] | None:
        """The look that is under way, or one that is begun now; ``None`` where no thread can be started for one."""
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
                if self._looking is begun:  # another look has begun since, which knows better
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
            if (exhausted := exhausted_error(error)) is not None:  # that says nothing of the files
                self._tell_exhausted(exhausted)
                return exhausted if self.error is None else self.error
            if isinstance(error, SkuggaError):
                return error
            # A bug, or what a library raises: the level is wrong, the service goes on.
            log.exception("%s %s cannot be read", self.what, self.name)
            return SkuggaError(f"{self.what} {self.name} cannot be read: {error!r}")
        self._is_exhausted = False
        return found

    def _tell_exhausted(self, error: Exception) -> None:
        if not self._is_exhausted:
            self._is_exhausted = True
            log.error("%s %s: its files cannot be looked at: %s; it is served as it was", self.what, self.name, error)

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
