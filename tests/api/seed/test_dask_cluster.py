"""Seeding on a real Dask cluster of separate processes on this machine: dying workers, a slow worker, a restarted
scheduler.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skugga.api.seed.dask_cluster import DaskCluster
from skugga.api.seed.planning import plan_run
from skugga.api.seed.running import TaskCompletion
from skugga.api.seed.seeding import draw_and_publish
from skugga.api.seed.storage import open_store
from skugga.api.seed.task_table import TaskTable
from skugga.terrain.errors import GraphicsError, InputError, RenderError
from tests.api.seed.runs import Run, rough_ground, write_ground
from tests.api.seed.test_deaths import render_processes
from tests.api.seed.test_storage import object_store

pytestmark = pytest.mark.long

distributed = pytest.importorskip("distributed")

__all__ = ["object_store"]

ZOOMS = 11, 14


class Cluster:
    """A scheduler and workers, each a separate process."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as port_socket:
            port_socket.bind(("127.0.0.1", 0))
            self.port = int(port_socket.getsockname()[1])
        self.address, self._folder = f"tcp://127.0.0.1:{self.port}", folder
        self.scheduler = self._scheduler()
        self.workers: list[subprocess.Popen[bytes]] = []

    def _scheduler(self) -> subprocess.Popen[bytes]:
        """Start a scheduler on the cluster's port."""
        return self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard", "--no-show")

    def add_worker(self, before: str = "", **environment: str) -> subprocess.Popen[bytes]:
        """Start a worker that first runs some Python code."""
        arguments = [
            self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(self._folder),
            "--host", "127.0.0.1",
        ]  # fmt: skip
        self.workers.append(self._start("worker", *arguments, before=before, **environment))
        return self.workers[-1]

    def restart_scheduler(self) -> None:
        """Kill the scheduler, and start another one at the same address."""
        self.scheduler.send_signal(signal.SIGKILL)
        self.scheduler.wait()
        self.scheduler = self._scheduler()

    def close(self) -> None:
        """Kill all processes."""
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()

    def _start(self, kind: str, *arguments: str, before: str = "", **environment: str) -> subprocess.Popen[bytes]:
        """Start a process of Dask: a ``scheduler`` or a ``worker``. ``before`` is Python code that it runs first."""
        code = f"{before}\nimport sys\nfrom distributed.cli.dask_{kind} import main\nsys.argv[0] = 'dask'\nmain()"
        log = (self._folder / f"{kind}.log").open("ab")
        with log:
            return subprocess.Popen(
                [sys.executable, "-W", "ignore", "-c", code, *arguments], stdout=log, stderr=log,
                env={**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s", **environment},
            )  # fmt: skip


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A Dask cluster, which is closed after the test."""
    new_cluster = Cluster(tmp_path)
    yield new_cluster
    new_cluster.close()


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of rough ground."""
    return write_ground(tmp_path_factory.mktemp("ground") / "dem.tif", rough_ground(120))


@pytest.fixture
def run(tmp_path: Path, ground: Path) -> Run:
    """A run over rough ground that has not started."""
    return Run(ground, tmp_path / "out.pmtiles", ZOOMS)


@pytest.fixture(scope="module")
def local_archive(tmp_path_factory: pytest.TempPathFactory, ground: Path) -> bytes:
    """Content of the archive that the run writes without a cluster."""
    run = Run(ground, tmp_path_factory.mktemp("local") / "here.pmtiles", ZOOMS)
    run()
    return run.output.read_bytes()


def seed_on_cluster(
    run: Run,
    cluster: Cluster,
    on_end: Callable[[TaskCompletion], None] = lambda end: None,
    shards: str = "",
    cluster_timeout_s: float = 300.0,
) -> list[str]:
    """Seed on a cluster, and return the name of the worker that drew each task."""
    worker_names: list[str] = []
    place = shards or str(run.work / "shards")

    def note(end: TaskCompletion) -> None:
        worker_names.append(end.outcome.worker)
        on_end(end)

    with TaskTable(run.work / "tasks.sqlite") as table:
        planned = plan_run(table, run.request, lambda text: None)
        draw_and_publish(
            table, planned, open_store(place), place, {planned.sun_names[0]: run.output},
            lambda: DaskCluster(cluster.address, cluster_timeout_s).prepare_run(planned.spec, place), note,
        )  # fmt: skip
    return worker_names


def test_dead_workers_are_replaced_and_the_archive_is_the_same(run, cluster, local_archive, object_store):
    """The shards are in an object store, from where the archive is written."""
    first = cluster.add_worker()
    cluster.add_worker()
    ends = 0

    def kill(end: TaskCompletion) -> None:
        nonlocal ends
        ends += 1
        if ends == 2:
            first.kill()
            cluster.add_worker()

    seed_on_cluster(run, cluster, kill, shards=f"{object_store}/dask")
    assert first.wait() == -signal.SIGKILL and run.output.read_bytes() == local_archive
    assert not (run.work / "shards").exists()
    assert all(name.endswith(".tiles") for name in open_store(f"{object_store}/dask").names())


def test_a_restarted_scheduler_gets_its_tasks_again(run, cluster, local_archive):
    cluster.add_worker()
    ends = 0

    def restart(end: TaskCompletion) -> None:
        nonlocal ends
        ends += 1
        if ends == 2:
            cluster.restart_scheduler()
            cluster.add_worker()  # a worker ends with its scheduler

    seed_on_cluster(run, cluster, restart)
    assert run.output.read_bytes() == local_archive


def test_a_slow_worker_gets_fewer_tasks(run, cluster):
    run.zooms = 11, 15
    cluster.add_worker()
    slow = (
        "import skugga.api.seed.dask_worker as c, time\ndraw = "
        "c.persistent_process.draw\nc.persistent_process.draw = lambda *a: (time.sleep(6), draw(*a))[1]"
    )
    cluster.add_worker(before=slow)
    wait_until(lambda: workers_of(cluster) == 2)  # a worker that joins late may find no task left
    counts = sorted(Counter(seed_on_cluster(run, cluster)).values())
    assert len(counts) == 2 and counts[0] < counts[1]


def test_a_worker_with_another_renderer_is_refused(run, cluster):
    other = "import skugga.api.seed.dask_worker as c\nfrom skugga.terrain.errors import GraphicsError\n"
    other += (
        "def refuse(*a): raise GraphicsError('this worker draws with another renderer')\nc.PersistentProcess._process_for = refuse"
    )
    cluster.add_worker(before=other)
    with pytest.raises(GraphicsError, match="no worker of the cluster can draw this run.*another renderer"):
        seed_on_cluster(run, cluster)
    cluster.add_worker()
    wait_until(lambda: workers_of(cluster) == 2)  # with the other worker alone, no worker could draw
    assert len(set(seed_on_cluster(run, cluster))) == 1, "the worker that can draw draws all tasks"


def test_render_processes_start_early_and_end_with_the_run(cluster):
    first = cluster.add_worker()
    wait_until(lambda: workers_of(cluster) == 1)
    waiting = DaskCluster(cluster.address)
    try:
        wait_until(lambda: len(render_processes(first.pid)) == 1)
        late_worker = cluster.add_worker()
        wait_until(lambda: len(render_processes(late_worker.pid)) == 1)
    finally:
        waiting.close()
    wait_until(lambda: not render_processes(first.pid) and not render_processes(late_worker.pid))
    third = cluster.add_worker()
    wait_until(lambda: workers_of(cluster) == 3)
    assert render_processes(third.pid) == [], "no run needs a render process of the third worker"


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds. Fail after five minutes: processes of a busy machine start slowly."""
    end = time.monotonic() + 300.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def workers_of(cluster: Cluster) -> int:
    """Return the number of workers that the scheduler knows."""
    with distributed.Client(cluster.address, timeout=30.0, set_as_default=False) as client:
        return len(client.nthreads())


def test_a_missing_scheduler_or_worker_is_an_error(run, cluster):
    with pytest.raises(RenderError, match="no worker joined within 3 s. Run the same command again to resume"):
        seed_on_cluster(run, cluster, cluster_timeout_s=3.0)
    cluster.close()
    with pytest.raises(InputError, match=r"--scheduler.*no Dask scheduler answers at tcp://127.0.0.1:\d+"):
        seed_on_cluster(run, cluster)


def test_a_lost_scheduler_ends_the_run_with_an_error(run, cluster):
    cluster.add_worker()

    def end_it(end: TaskCompletion) -> None:
        cluster.scheduler.kill()

    with pytest.raises(RenderError, match="the scheduler did not return within 3 s.*Run the same command again to resume"):
        seed_on_cluster(run, cluster, end_it, cluster_timeout_s=3.0)
