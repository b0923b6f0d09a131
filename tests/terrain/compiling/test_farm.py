"""Loops are compiled ahead in several processes: callees first, in the order of products, even if a child process dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from skugga.terrain.compiling import ahead_of_time, hooks
from skugga.terrain.compiling.ahead_of_time import PRODUCTS, compile_ahead
from skugga.terrain.compiling.farm import Task, _Queue
from skugga.terrain.compiling.hooks import compile_needed_products, declare_product, missing_loop_compiler
from skugga.terrain.compiling.signatures import decode_type, encode_type, recorded_signatures

ROOT = Path(__file__).resolve().parents[3]

LOOPS_MODULE_SOURCE = """
from skugga.terrain.compiled import compiled

@compiled
def leaf(x):
    return x + 1.0

@compiled
def middle(x):
    return leaf(x) * 2.0

@compiled
def top(x):
    return middle(x) - leaf(x)

@compiled
def other(x):
    return x * 3.0
"""

FARM_SCRIPT = """
import os, signal, sys
import loops
from numba.core import types
from skugga.terrain.compiling import farm
from skugga.terrain.compiling.loop_cache import compile_recorders

if {deadly}:  # a child that compiles ``middle`` is killed
    compile_recorders.append(lambda loop, args: loop.py_func.__name__ == "middle" and os.kill(os.getpid(), signal.SIGKILL))
ranks = {{loops.top: 0, loops.leaf: 0, loops.middle: 0, loops.other: 1}}
tasks = [farm.Task(loop, (types.float64,), rank) for loop, rank in ranks.items()]
for task in farm.compile_tasks(tasks, {processes}):
    print(task.loop.py_func.__name__)
missing = [task.loop.py_func.__name__ for task in tasks if not farm.loop_store().contains(
    task.loop._cache.entry_name(task.argument_types, task.loop.targetctx.codegen().magic_tuple()))]
print("missing:", *missing)
"""


def run(folder: Path, processes: int, deadly: bool = False) -> tuple[list[str], str]:
    """Compile the test's loops in ``processes`` processes. Return the lines of the output, and the errors.

    If ``deadly``, the process that compiles the loop ``middle`` is killed.
    """
    (folder / "loops.py").write_text(LOOPS_MODULE_SOURCE, encoding="utf-8")
    environment = {"PYTHONPATH": f"{folder}:{ROOT}", "NUMBA_CACHE_DIR": str(folder / "store"), "PATH": os.environ["PATH"]}
    code = FARM_SCRIPT.format(processes=processes, deadly=deadly)
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    return process.stdout.split("\n")[:-1], process.stderr


def test_callees_are_compiled_before_their_callers(tmp_path: Path) -> None:
    *order, missing = run(tmp_path, processes=2)[0]
    assert order.index("leaf") < order.index("middle") < order.index("top") and len(order) == 4
    assert missing == "missing:"


def test_killed_children_lose_only_the_loop_that_kills_and_its_caller(tmp_path: Path) -> None:
    (*order, missing), log_text = run(tmp_path, processes=2, deadly=True)
    assert sorted(order) == ["leaf", "middle", "other", "top"]
    assert log_text.count("was killed") == 2 and str(tmp_path / "store") in log_text, (
        "the other child compiles middle again, as a callee of top"
    )
    assert "leaf" not in missing and "other" not in missing, "only the loop that kills, and its caller, may be missing in the store"


def test_queue_takes_first_products_then_longest_chains() -> None:
    class Loop:
        def __init__(self, code: str) -> None:
            self.py_func = eval(f"lambda x: {code}")

    short_loop, long_loop = Loop("x"), Loop("x + x * x - x / x + x")
    queue = _Queue([Task(short_loop, (), 1), Task(long_loop, (), 1), Task(short_loop, ("int",), 0), Task(long_loop, ("int",), 0)])
    assert [queue.take() for _ in range(5)] == [3, 2, 1, 0, None]


@pytest.fixture
def no_needed_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the products that a process needs and has compiled."""
    monkeypatch.setattr(hooks, "_needed_products", [])
    monkeypatch.setattr(hooks, "_compiled_products", set())


def test_needed_products_are_compiled_once(no_needed_products: None) -> None:
    requested_products: list[list[str]] = []
    with missing_loop_compiler(lambda products: requested_products.append(list(products))):
        assert not compile_needed_products(), "nothing is needed yet"
        declare_product("masks")
        declare_product("masks")
        assert compile_needed_products() and not compile_needed_products()
        declare_product("points")
        assert compile_needed_products()
    declare_product("hours of sun")
    assert not compile_needed_products(), "nobody compiles any more"
    assert requested_products == [["masks"], ["points"]]


def test_recorded_signatures_survive_encoding() -> None:
    recorded = recorded_signatures()
    assert {product for signature in recorded for product in signature.products} == set(PRODUCTS)
    for signature in recorded:
        types = signature.argument_types()
        assert tuple(map(decode_type, map(encode_type, types))) == types
        assert signature.dispatcher().py_func.__name__ in signature.loop


def test_recorded_signatures_are_filtered_by_product() -> None:
    filtered = recorded_signatures(["points"])
    assert filtered and all("points" in signature.products for signature in filtered) and len(filtered) < len(recorded_signatures())


def test_compile_ahead_logs_a_process_that_cannot_start(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(ahead_of_time.sys, "executable", "/nonexistent/python")
    compile_ahead(["points"], 1)
    assert "cannot be compiled ahead" in caplog.text


def test_an_interrupt_kills_the_compiling_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "store"))
    processes: list[subprocess.Popen[str]] = []

    def interrupt(task: str, done: int, total: int) -> None:
        assert task == "compiling loops for points" and done == 0 < total
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compile_ahead(["points"], 1, interrupt, on_start=processes.append)
    assert processes[0].returncode == -signal.SIGKILL


def test_an_unwritable_store_compiles_nothing_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    progress: list[int] = []
    compile_ahead(["points"], 1, lambda task, done, total: progress.append(done))
    assert progress == []


KILLED_COMMAND_SCRIPT = """
from skugga.terrain.compiling.ahead_of_time import PRODUCTS, compile_ahead
farms = []
compile_ahead(PRODUCTS, 2, lambda task, done, total: print(farms[0], flush=True), on_start=lambda farm: farms.append(farm.pid))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="prctl is Linux's own")
def test_compiling_processes_end_with_a_killed_command(tmp_path: Path) -> None:
    """A killed command must not leave compiling processes behind."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path), "SKUGGA_TEST_RUN": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", KILLED_COMMAND_SCRIPT], env=environment, stdout=subprocess.PIPE, text=True
    ) as command:
        assert command.stdout is not None and int(command.stdout.readline()) in processes_of(tmp_path)
        command.kill()
    deadline_s = time.monotonic() + 10.0
    while processes_of(tmp_path):
        assert time.monotonic() < deadline_s, "they outlived the command"
        time.sleep(0.05)


def processes_of(run_folder: Path) -> list[int]:
    """Return the ids of processes that have the environment of a run."""
    process_ids = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            if entry.name.isdigit() and f"SKUGGA_TEST_RUN={run_folder}".encode() in (entry / "environ").read_bytes():
                process_ids.append(int(entry.name))
    return process_ids
