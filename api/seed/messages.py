"""What a run and its render processes say to each other. Nothing is imported here that draws: a cluster's workers, which only pass
it on, start in no time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

LEAST_LIMIT_S = 600.0
"""For so long a process may draw any task: one whose loops nobody has compiled yet takes minutes."""


class Task(NamedTuple):
    """A metatile: a block (x, y) of a zoom under a sun, the name of the shard that its tiles go to, and after how many seconds
    the process that draws it counts as hung.
    """

    id: int
    sun: int
    zoom: int
    x: int
    y: int
    shard: str
    limit_s: float


@dataclass(frozen=True)
class Drawn:
    """What is told of a task that was drawn: its tiles' index (``ShardIndex.to_bytes``), bytes of its shard, seconds, of which
    ``encode_s`` for pictures' files, and the most memory that its process ever took.
    """

    id: int
    index: bytes
    nbytes: int
    seconds: float
    encode_s: float
    peak_bytes: int
    worker: str = ""


@dataclass(frozen=True)
class Begin:
    """Tells a process which run's tasks it will draw (``RunSpec`` as JSON), and where their shards go."""

    spec: str
    shards: str


@dataclass(frozen=True)
class Begun:
    """It is ready to draw."""

    renderer: str


@dataclass(frozen=True)
class NotDrawn:
    """A task that was not drawn, and why: it ``failed``, its worker ``died``, the run is ``stopped``, whatever the task, or a
    ``worker`` of a cluster is ``refused``.
    """

    id: int
    error: str
    how: Literal["failed", "died", "stopped", "refused"]
    worker: str = ""


@dataclass(frozen=True)
class NotBegun:
    """A process that cannot draw tasks of a run."""

    error: str
