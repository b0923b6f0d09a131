"""The main function of a render process. The rendering code is imported only inside that process."""

from __future__ import annotations

from multiprocessing.connection import Connection

from skugga.api.workers.worker_config import WorkerConfig


def worker_main(pipe: Connection, config: WorkerConfig) -> None:
    """Run a render process: answer jobs until the pipe is closed."""
    from skugga.api.workers.render_worker import run_worker

    run_worker(pipe, config)
