"""A machine without threads, descriptors or memory: failed work does not run later, and nothing is lost."""

from __future__ import annotations

import asyncio
import errno
import inspect
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NoReturn

import pytest
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute

from skugga.api.animations.animations import Animations
from skugga.api.errors import ExhaustedError, error_report_of
from skugga.api.resource_exhaustion import exhausted_error, run_in_pool
from skugga.api.settings import Settings
from skugga.api.workers import background_compile, render_worker
from skugga.api.workers.background_compile import BackgroundCompile
from skugga.api.workers.idle_work import IdleJob, IdleWork
from skugga.api.workers.jobs import Failure
from skugga.api.workers.pool import Pool
from skugga.api.workers.worker_state import WorkerState
from skugga.terrain.errors import SourceError
from tests.api.animations.test_animations import animation_spec
from tests.api.http.test_level_checks import no_threads
from tests.api.http.test_openapi import ROUTERS
from tests.api.workers.test_pool import block, run_with_pool, wait_until


def _caused_by(cause: Exception) -> Exception:
    """Return an error of an unreadable source whose context is ``cause``."""
    try:
        try:
            raise cause
        except Exception:
            raise SourceError("dem.tif", "unreadable", "a raster") from None
    except SourceError as error:
        return error


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("can't start new thread"),
        MemoryError(),
        OSError(errno.EMFILE, "Too many open files"),
        BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"),
        ImportError("libgfortran.so.5: failed to map segment from shared object"),
        ImportError("libz.so.1: cannot open shared object file: Too many open files"),
        _caused_by(OSError(errno.ENOMEM, "Cannot allocate memory")),
    ],
)
def test_exhaustion_errors_are_503(error: Exception):
    exhausted = exhausted_error(error)
    assert exhausted is not None
    assert (error_report_of(exhausted).status, error_report_of(exhausted).retry_after_s) == (503, 5)


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libz.so.1: cannot open shared object file: No such file or directory"),
        RuntimeError("no running event loop"),
        OSError(errno.ENOENT, "No such file"),
        _caused_by(ValueError("a bug")),
    ],
)
def test_other_errors_are_no_exhaustion(error: Exception):
    assert exhausted_error(error) is None


def test_routes_are_coroutines():
    """The framework calls plain functions in threads. With them even the health check would fail on a machine without
    threads.
    """

    def dependency_calls(dependant: Dependant) -> Iterator[object]:
        yield dependant.call
        for dependency in dependant.dependencies:
            yield from dependency_calls(dependency)

    routes = [route for router in ROUTERS for route in router.routes if isinstance(route, APIRoute)]
    assert {"/healthz", "/readyz"} <= {route.path for route in routes}
    functions = {part for route in routes for part in dependency_calls(route.dependant)}
    assert not [part for part in functions if not inspect.iscoroutinefunction(part)]


def test_work_rejected_for_lack_of_threads_never_runs(monkeypatch: pytest.MonkeyPatch):
    """An executor puts the work into its queue even if it cannot start a thread."""
    calls: list[str] = []

    async def scenario() -> None:
        with ThreadPoolExecutor(1) as threads:
            with no_threads(monkeypatch), pytest.raises(ExhaustedError):
                run_in_pool(threads, calls.append, "dropped")
            await run_in_pool(threads, calls.append, "run")

    asyncio.run(scenario())
    assert calls == ["run"]


def test_a_lack_of_threads_keeps_the_render_process(monkeypatch: pytest.MonkeyPatch):
    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: pool.is_ready)
        pids = set(pool.ready_pids)
        pool.supervisor._threads.shutdown(wait=False)
        with monkeypatch.context() as patch:
            patch.setattr(pool.supervisor, "_threads", ThreadPoolExecutor(2))
            for worker in pool.supervisor.workers:
                patch.setattr(worker._child, "_threads", pool.supervisor._threads)
            for number in range(3):
                with no_threads(monkeypatch), pytest.raises(ExhaustedError):
                    await pool.run(block(number))
            assert (await pool.run(block(0))).tiles
        assert pool.ready_pids == pids and pool.counters.processes_started == 1

    run_with_pool(scenario)


def test_idle_work_that_cannot_start_closes_its_files(monkeypatch: pytest.MonkeyPatch):
    async def scenario() -> None:
        failed: list[str] = []

        async def fail_on_result(result: object) -> None:
            raise AssertionError(result)

        work = IdleWork(lambda: False)
        monkeypatch.setattr(work, "_is_idle", lambda: True)
        work.start()
        open_file_count = len(os.listdir("/proc/self/fd"))
        with no_threads(monkeypatch):
            for _ in range(5):
                work.add(IdleJob(os.getpid, (), fail_on_result, failed.append))
            await wait_until(lambda: len(failed) == 5)
        assert "no thread can be started" in failed[0]
        # Files of earlier tests may be closed meanwhile, when Python collects their objects. So the number may also be smaller.
        assert len(os.listdir("/proc/self/fd")) <= open_file_count
        await work.close()

    asyncio.run(scenario())


def test_failed_compilation_is_retried_later(monkeypatch: pytest.MonkeyPatch):
    compiled = threading.Event()
    monkeypatch.setattr(background_compile, "compile_ahead", lambda *args, **kwargs: compiled.set())

    async def scenario() -> None:
        compiling = BackgroundCompile(1, lambda preparing: None)
        with no_threads(monkeypatch):
            compiling.start_if_needed(7)
            await wait_until(lambda: not compiling.is_running)
        compiling.start_if_needed(7)
        assert not compiling.is_running, "the next try waits for some seconds"
        monkeypatch.setattr(compiling, "_retry_at_s", 0.0)
        compiling.start_if_needed(7)
        await wait_until(lambda: not compiling.is_running)
        assert compiled.is_set()
        compiling.start_if_needed(7)
        assert not compiling.is_running, "finished compilation is not repeated"
        await compiling.close()

    asyncio.run(scenario())


def test_a_film_without_a_thread_is_not_drawn_later(monkeypatch: pytest.MonkeyPatch):
    draw_calls: list[int] = []

    async def draw(film_request: object):
        draw_calls.append(1)
        yield None

    async def scenario() -> None:
        animations = Animations(Settings(), draw, lambda path, frames, film_request: path.write_bytes(bytes(len(list(frames)))))
        with no_threads(monkeypatch):
            first = animations.request(animation_spec(1), 1.0)
            await wait_until(lambda: first.has_ended)
        assert isinstance(first.error, ExhaustedError) and not draw_calls
        second = animations.request(animation_spec(2), 1.0)
        await wait_until(lambda: second.has_ended)
        assert second.status == "successful" and len(draw_calls) == 1
        await animations.close()

    asyncio.run(scenario())


@pytest.mark.parametrize(
    "error", [MemoryError("Unable to allocate 8 GiB"), _caused_by(OSError(errno.EMFILE, "Too many open files"))]
)
def test_exhausted_jobs_are_retried_later(monkeypatch: pytest.MonkeyPatch, error: Exception):
    """A render process tells exhaustion from faults: 503 with a time to wait, and not 500."""

    def raise_error(job: object, state: object) -> NoReturn:
        raise error

    monkeypatch.setattr(render_worker, "run_job", raise_error)
    answer = render_worker._try_job(block(0), WorkerState("a device"))
    assert isinstance(answer, Failure) and isinstance(answer.to_error(), ExhaustedError)
    assert error_report_of(answer.to_error()).status == 503
