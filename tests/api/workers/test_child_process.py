"""A child process: its start, its answers, and its end in any state."""

import asyncio
import os
import time as clock
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import pytest

from skugga.api.workers.child_process import ChildProcess
from skugga.api.workers.piped_process import PipedProcess


def echo(pipe: Connection, word: str) -> None:
    """Send a word, then everything that is received, until the pipe closes."""
    pipe.send(word)
    try:
        while True:
            pipe.send(pipe.recv())
    except EOFError:
        return


def exit_with_status(pipe: Connection, status: int) -> None:
    """Exit at once."""
    os._exit(status)


def is_alive(pid: int) -> bool:
    """Return whether a process exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def run_with_child(scenario: Callable[[ChildProcess], Coroutine[Any, Any, None]], target: Callable[..., None], *args: Any) -> None:
    """Run a scenario with a child process, and end the child after it."""

    async def run(threads: ThreadPoolExecutor) -> None:
        child = ChildProcess(PipedProcess(target, *args, name="a test's"), threads)
        try:
            await scenario(child)
        finally:
            await child.end()
        assert child.pipe.closed
        assert child.pid is None or not is_alive(child.pid)

    with ThreadPoolExecutor(1) as threads:  # the pool waits for its thread, which ends with the process
        asyncio.run(run(threads))


def test_a_child_answers_and_is_gone_after_its_end():
    async def scenario(child: ChildProcess) -> None:
        await child.start()
        assert child.pid is not None and child.exitcode is None
        assert await child.run_in_thread(child.pipe.recv) == "ready"
        child.pipe.send(7)
        assert await child.run_in_thread(child.pipe.recv) == 7

    run_with_child(scenario, echo, "ready")


def test_a_child_that_never_answers_frees_its_thread():
    async def scenario(child: ChildProcess) -> None:
        await child.start()
        await child.run_in_thread(child.pipe.recv)
        waiting = child.run_in_thread(child.pipe.recv)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.shield(waiting), 0.05)

    run_with_child(scenario, echo, "ready")


def test_a_child_that_exits_leaves_its_status():
    async def scenario(child: ChildProcess) -> None:
        await child.start()
        with pytest.raises(EOFError):
            await child.run_in_thread(child.pipe.recv)
        await child.wait_for_end()
        assert child.exitcode == 3

    run_with_child(scenario, exit_with_status, 3)


def test_end_waits_for_a_start_that_timed_out(monkeypatch: pytest.MonkeyPatch):
    original_start = PipedProcess.start

    def slow_start(self: PipedProcess) -> None:
        clock.sleep(0.2)
        original_start(self)

    monkeypatch.setattr(PipedProcess, "start", slow_start)

    async def scenario(child: ChildProcess) -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(child.start(), 0.05)
        assert child.pid is None
        await child.end()
        assert child.pid is not None and not is_alive(child.pid)

    run_with_child(scenario, echo, "ready")


def test_a_child_that_cannot_start_leaves_no_open_pipe(monkeypatch: pytest.MonkeyPatch):
    def fail(self: PipedProcess) -> None:
        raise OSError("no process")

    monkeypatch.setattr(PipedProcess, "start", fail)

    async def scenario(child: ChildProcess) -> None:
        with pytest.raises(OSError, match="no process"):
            await child.start()

    run_with_child(scenario, echo, "ready")
