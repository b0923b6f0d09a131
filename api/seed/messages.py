"""Messages between a run and its render processes.

This module imports nothing that draws: a cluster's workers only forward these messages and must start fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

MIN_TASK_TIMEOUT_S = 600.0
"""Minimum timeout of a task in seconds. A task whose loops are not compiled yet takes minutes."""


class Task(NamedTuple):
    """A task: draw a metatile, the block (x, y) of a zoom's tiles, under a sun.

    Attributes
    ----------
    id : int
        Number of the task in the table.
    sun : int
        Index of the sun in the run.
    zoom, x, y : int
        The block.
    shard : str
        Name of the shard for its tiles.
    timeout_s : float
        Timeout in seconds, after which the process that draws the task counts as hung.
    """

    id: int
    sun: int
    zoom: int
    x: int
    y: int
    shard: str
    timeout_s: float


@dataclass(frozen=True)
class TaskResult:
    """The result of a drawn task.

    Attributes
    ----------
    id : int
        Number of the task.
    index_bytes : bytes
        Index of its tiles (``ShardIndex.to_bytes``).
    nbytes : int
        Bytes of its shard.
    duration_s, encode_s : float
        Duration in seconds, in total and of encoding.
    peak_bytes : int
        Peak memory of the process so far.
    worker : str
        Address of the worker in a cluster.
    """

    id: int
    index_bytes: bytes
    nbytes: int
    duration_s: float
    encode_s: float
    peak_bytes: int
    worker: str = ""


@dataclass(frozen=True)
class StartRun:
    """Request to a process to prepare for the tasks of a run.

    Attributes
    ----------
    spec_json : str
        The ``RunSpec`` as JSON.
    store_address : str
        Folder or address of the shard store.
    """

    spec_json: str
    store_address: str


@dataclass(frozen=True)
class RunReady:
    """Answer of a process that it is ready to draw tasks of the run. ``renderer`` is OpenGL's name of its renderer."""

    renderer: str


@dataclass(frozen=True)
class TaskFailure:
    """A task that was not drawn, and the reason.

    Attributes
    ----------
    id : int
        Number of the task.
    error : str
        The reason.
    kind : str
        ``failed``: the task failed. ``died``: its worker died. ``stopped``: the run must stop, because no other task can succeed.
        ``refused``: the cluster's ``worker`` cannot draw this run.
    worker : str
        Address of the worker in a cluster.
    """

    id: int
    error: str
    kind: Literal["failed", "died", "stopped", "refused"]
    worker: str = ""


@dataclass(frozen=True)
class RunRefused:
    """Answer of a process that it cannot draw tasks of the run. ``error`` is the reason in words."""

    error: str
