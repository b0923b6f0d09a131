"""The task table of a run: an SQLite file with the waiting tasks, the reasons for them, and the finished tasks."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any, NamedTuple

from skugga.api.seed.messages import TaskResult
from skugga.terrain.atomic_files import disk_error
from skugga.terrain.errors import InputError, Problem, RenderError

TABLE_FORMAT_VERSION = 1
"""Version of the table's format. Other versions are refused."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value BLOB) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS files (path TEXT PRIMARY KEY, stamp TEXT, digest TEXT) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS plans (
    sun TEXT, zoom INTEGER, asked TEXT, plan TEXT, PRIMARY KEY (sun, zoom)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS tasks (
    id INTEGER PRIMARY KEY, sun TEXT NOT NULL, zoom INTEGER NOT NULL, x INTEGER NOT NULL, y INTEGER NOT NULL,
    first_tile INTEGER NOT NULL, wanted INTEGER NOT NULL, state TEXT NOT NULL, why TEXT NOT NULL,
    key TEXT NOT NULL, parts TEXT NOT NULL, share REAL NOT NULL, expected_s REAL NOT NULL, tries INTEGER NOT NULL DEFAULT 0,
    seconds REAL, encode_s REAL, peak_bytes INTEGER, bytes INTEGER, tiles BLOB, error TEXT,
    UNIQUE (sun, zoom, x, y)
);
CREATE TABLE IF NOT EXISTS published (
    output TEXT, task INTEGER, key TEXT, tiles BLOB, PRIMARY KEY (output, task)
) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS heaviest ON tasks (wanted, state, expected_s DESC, first_tile);
CREATE INDEX IF NOT EXISTS in_order ON tasks (sun, wanted, first_tile);
"""


class PlannedTask(NamedTuple):
    """A task as planned.

    Attributes
    ----------
    sun : str
        Name of the sun.
    zoom, x, y : int
        The zoom, and the column and row of the block, counted in blocks.
    first_tile : int
        Smallest PMTiles tile id of the block.
    parts : InputDigests
        Digests of the inputs of its tiles.
    data_share : float
        Approximate fraction of the block's area that lies on the raster, up to 1. A minimum stands for the overhead of a task.
    expected_s : float
        Expected duration in seconds.
    """

    sun: str
    zoom: int
    x: int
    y: int
    first_tile: int
    parts: InputDigests
    data_share: float
    expected_s: float


class InputDigests(NamedTuple):
    """Digests of the inputs of a task's tiles, except block and sun. A task is drawn again if one of them changes.

    Attributes
    ----------
    renderer : str
        Digest of this package's renderer version and of the OpenGL renderer.
    settings : str
        Digest of the level without its ground, and of the request.
    plan : str
        Digest of the plan's algorithms, settings and effects.
    height_range : str
        Digest of the level's lowest and highest ground.
    ground : str
        Digest of the ground that the block's tiles depend on.
    """

    renderer: str
    settings: str
    plan: str
    height_range: str
    ground: str


REASONS = {
    "renderer": "the renderer has changed", "settings": "the level or the request has changed",
    "plan": "the plan has changed", "height_range": "the level's lowest or highest ground has changed",
    "ground": "ground that affects the tiles has changed",
}  # fmt: skip
"""Reasons to draw finished tasks again, by the changed input."""

NEW_REASON, SHARD_LOST_REASON = "not drawn yet", "the shard is missing or corrupt"
"""Further reasons to draw a task."""


@dataclass(frozen=True)
class FailedTask:
    """A failed task with its error.

    Attributes
    ----------
    zoom, x, y : int
        The zoom, and the column and row of the block, counted in blocks.
    sun : str
        Name of the sun.
    error : str
        The reason in words.
    """

    zoom: int
    x: int
    y: int
    sun: str
    error: str


class TaskTable:
    """The task table of a folder, for one process at a time. Close it after use.

    Raises ``InputError`` if another run uses it, or if the file is no table of this version. Raises ``OSError``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = _acquire_lock(path.with_suffix(".lock"))
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            with _as_os_errors(path):
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = NORMAL")
                self._db.executescript(_SCHEMA)
            self._db.create_function("why_changed", 2, _reason_of_change, deterministic=True)
            stored_format = self.get("format")
            if stored_format is not None and stored_format != str(TABLE_FORMAT_VERSION).encode():
                raise InputError(
                    "--work", Problem(f"{path} was made by another version of Skugga"), "Delete the folder to start again"
                )
            self.put(format=str(TABLE_FORMAT_VERSION).encode())
        except BaseException:
            self._lock.close()
            raise

    @property
    def folder(self) -> Path:
        """The folder of the table."""
        return self._path.parent

    def close(self) -> None:
        """Close the file and release the lock."""
        self._db.close()
        self._lock.close()

    def __enter__(self) -> TaskTable:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def get(self, name: str) -> bytes | None:
        """Return a stored value by name; ``None`` without one."""
        row = self._db.execute("SELECT value FROM about WHERE name = ?", (name,)).fetchone()
        return None if row is None else bytes(row[0])

    def put(self, **values: bytes) -> None:
        """Store values by name."""
        with self._transaction():
            self._db.executemany("INSERT OR REPLACE INTO about VALUES (?, ?)", values.items())

    def file_digest(self, path: str, stamp: str) -> str | None:
        """Return the stored digest of a file, if it was stored with this stamp (times, size and inode); otherwise ``None``."""
        row = self._db.execute("SELECT digest FROM files WHERE path = ? AND stamp = ?", (path, stamp)).fetchone()
        return None if row is None else str(row[0])

    def put_file(self, path: str, stamp: str, digest: str) -> None:
        """Store a file's digest with the file's stamp (times, size and inode)."""
        with self._transaction():
            self._db.execute("INSERT OR REPLACE INTO files VALUES (?, ?, ?)", (path, stamp, digest))

    def plan(self, sun: str, zoom: int, request_digest: str) -> str | None:
        """Return the stored plan of a zoom under a sun for a request, as JSON; ``None`` without one.

        ``sun`` is the sun's name, and ``request_digest`` is a digest of the level's settings and the request's.
        """
        row = self._db.execute(
            "SELECT plan FROM plans WHERE sun = ? AND zoom = ? AND asked = ?", (sun, zoom, request_digest)
        ).fetchone()
        return None if row is None else str(row[0])

    def put_plan(self, sun: str, zoom: int, request_digest: str, plan: str) -> None:
        """Store the plan of a zoom under a sun, as JSON. The parameters are those of ``plan``."""
        with self._transaction():
            self._db.execute("INSERT OR REPLACE INTO plans VALUES (?, ?, ?, ?)", (sun, zoom, request_digest, plan))

    def set_tasks(self, tasks: Iterable[PlannedTask]) -> None:
        """Set the tasks of the run.

        Tasks with an unchanged key (digest of all inputs) keep their state, done or failed. All other tasks wait to be drawn, and
        the table stores the reason.
        """
        with self._transaction():
            self._db.execute("UPDATE tasks SET wanted = 0")
            self._db.executemany(
                """
                INSERT INTO tasks (sun, zoom, x, y, first_tile, wanted, state, why, key, parts, share, expected_s)
                VALUES (?, ?, ?, ?, ?, 1, 'waiting', ?, ?, ?, ?, ?)
                ON CONFLICT (sun, zoom, x, y) DO UPDATE SET
                    wanted = 1, share = excluded.share, expected_s = excluded.expected_s,
                    key = excluded.key, parts = excluded.parts,
                    why = CASE WHEN key = excluded.key OR state != 'done' THEN why ELSE why_changed(parts, excluded.parts) END,
                    tries = CASE WHEN key = excluded.key THEN tries ELSE 0 END,
                    error = CASE WHEN key = excluded.key THEN error END,
                    state = CASE WHEN key = excluded.key THEN state ELSE 'waiting' END
                """,
                self._rows(tasks),
            )

    def _rows(self, tasks: Iterable[PlannedTask]) -> Iterator[tuple[Any, ...]]:
        """Yield the row of the table for each planned task, in the order of the columns that ``set_tasks`` writes."""
        for task in tasks:
            parts = ":".join(task.parts)
            yield (
                task.sun,
                task.zoom,
                task.x,
                task.y,
                task.first_tile,
                NEW_REASON,
                task_key(task),
                parts,
                task.data_share,
                task.expected_s,
            )

    def waiting_tasks(self) -> list[int]:
        """Return the numbers of the tasks that wait to be drawn, the heaviest first."""
        rows = self._db.execute("SELECT id FROM tasks WHERE wanted AND state = 'waiting' ORDER BY expected_s DESC, first_tile, sun")
        return [row[0] for row in rows]

    def task_row(self, task_number: int) -> tuple[str, int, int, int, str, float]:
        """Return sun, zoom, block x and y, key and expected duration in seconds of a task, by its number in the table."""
        row = self._db.execute("SELECT sun, zoom, x, y, key, expected_s FROM tasks WHERE id = ?", (task_number,)).fetchone()
        return tuple(row)

    def record_results(self, results: Sequence[TaskResult]) -> None:
        """Record drawn tasks."""
        with self._transaction():
            self._db.executemany(
                "UPDATE tasks SET state = 'done', seconds = ?, encode_s = ?, peak_bytes = ?, bytes = ?, tiles = ?, error = NULL "
                "WHERE id = ?",
                [
                    (result.duration_s, result.encode_s, result.peak_bytes, result.nbytes, result.index_bytes, result.id)
                    for result in results
                ],
            )

    def record_failure(self, task_number: int, error: str) -> None:
        """Record a failed task."""
        with self._transaction():
            self._db.execute("UPDATE tasks SET state = 'failed', error = ? WHERE id = ?", (error, task_number))

    def record_worker_death(self, task_number: int) -> int:
        """Record that a worker died while it drew a task, and return how often this has happened to the task."""
        with self._transaction():
            self._db.execute("UPDATE tasks SET tries = tries + 1 WHERE id = ?", (task_number,))
        return int(self._db.execute("SELECT tries FROM tasks WHERE id = ?", (task_number,)).fetchone()[0])

    def retry(self, task_numbers: Iterable[int], reason: str | None = None) -> None:
        """Queue tasks again, with a new reason, or with the stored one if ``reason`` is ``None``."""
        with self._transaction():
            self._db.executemany(
                "UPDATE tasks SET state = 'waiting', tries = 0, error = NULL, why = coalesce(?, why) WHERE id = ?",
                [(reason, task) for task in task_numbers],
            )

    def failed_tasks(self) -> dict[int, FailedTask]:
        """Return the failed tasks by number."""
        rows = self._db.execute(
            "SELECT id, zoom, x, y, sun, error FROM tasks WHERE wanted AND state = 'failed' ORDER BY first_tile, sun"
        )
        return {row[0]: FailedTask(*row[1:]) for row in rows}

    def finished_tasks(self, sun: str) -> list[tuple[int, str, bytes]]:
        """Return number, key and shard index of the finished tasks under a sun, ordered by tile id."""
        rows = self._db.execute(
            "SELECT id, key, tiles FROM tasks WHERE sun = ? AND wanted AND state = 'done' ORDER BY first_tile", (sun,)
        )
        return [(row[0], row[1], bytes(row[2])) for row in rows]

    def published_tasks(self, output: str) -> dict[int, tuple[str, bytes]]:
        """Return key and shard index of the tasks whose tiles lie in an output folder, by number."""
        rows = self._db.execute("SELECT task, key, tiles FROM published WHERE output = ?", (output,))
        return {row[0]: (row[1], bytes(row[2])) for row in rows}

    def record_published(self, output: str, task_number: int, key: str, tiles: bytes) -> None:
        """Record that a task's tiles lie in an output folder.

        ``key`` is the digest of the task's inputs, and ``tiles`` is the index of its shard.
        """
        with self._transaction():
            self._db.execute("INSERT OR REPLACE INTO published VALUES (?, ?, ?, ?)", (output, task_number, key, tiles))

    def remove_published(self, output: str, task_number: int) -> None:
        """Record that a task's tiles no longer lie in an output folder."""
        with self._transaction():
            self._db.execute("DELETE FROM published WHERE output = ? AND task = ?", (output, task_number))

    def keys(self) -> set[str]:
        """Return the keys (digests of the inputs) of all tasks, including those of earlier requests."""
        return {row[0] for row in self._db.execute("SELECT key FROM tasks")}

    def tasks_with_shards(self) -> list[tuple[int, str]]:
        """Return number and key of the run's finished tasks that have tiles."""
        return self._db.execute("SELECT id, key FROM tasks WHERE wanted AND state = 'done' AND bytes > 0").fetchall()

    def counts(self) -> dict[str, int]:
        """Return the number of the run's tasks by state."""
        return dict(self._db.execute("SELECT state, count(*) FROM tasks WHERE wanted GROUP BY state").fetchall())

    def waiting_totals(self) -> list[tuple[str, int, str, int, float, float]]:
        """Return a summary of the waiting tasks by sun, zoom and reason.

        Each row holds sun, zoom, reason, number of tasks, the sum of their fractions with data, and expected seconds.
        """
        return self._db.execute(
            "SELECT sun, zoom, why, count(*), sum(share), sum(expected_s) FROM tasks WHERE wanted AND state = 'waiting' "
            "GROUP BY sun, zoom, why ORDER BY sun, zoom, why"
        ).fetchall()

    def measured_costs(self) -> dict[int, tuple[float, float]]:
        """Return by zoom the seconds and bytes of a task whose block is full of data, measured on finished tasks."""
        rows = self._db.execute(
            "SELECT zoom, sum(seconds) / sum(share), sum(bytes) / sum(share) FROM tasks WHERE seconds IS NOT NULL GROUP BY zoom"
        )
        return {row[0]: (row[1], row[2]) for row in rows}

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Run the block of a ``with`` statement as an SQLite transaction."""
        with _as_os_errors(self._path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def task_key(task: PlannedTask) -> str:
    """Return the key of a task, a digest of 32 hexadecimal digits. Tasks with equal keys have equal tiles."""
    key_fields = (task.sun, task.zoom, task.x, task.y, *task.parts)
    return blake2b("\n".join(map(str, key_fields)).encode(), digest_size=16).hexdigest()


def _reason_of_change(old_digests_json: str, new_digests_json: str) -> str:
    """Return why a task is drawn again: the text of ``REASONS`` for the first input whose digest differs.

    Both parameters hold the digests of ``InputDigests`` in order, separated by colons.
    """
    pairs = zip(InputDigests._fields, old_digests_json.split(":"), new_digests_json.split(":"), strict=True)
    return next((REASONS[name] for name, old, new in pairs if old != new), NEW_REASON)


def _acquire_lock(path: Path) -> IO[str]:
    """Acquire the lock of a table for this process. Raises ``InputError`` if another process holds it."""
    file = path.open("a+", encoding="ascii")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        owner = file.read().strip() or "(unknown)"
        file.close()
        raise InputError(
            "--work", Problem(f"{path.parent} is in use by process {owner}"), "Wait until that run ends, or choose another folder"
        ) from None
    file.seek(0)
    file.truncate()
    file.write(str(os.getpid()))
    file.flush()
    return file


@contextmanager
def _as_os_errors(path: Path) -> Iterator[None]:
    """Convert SQLite's disk errors to one-line errors that name the file."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        name = getattr(error, "sqlite_errorname", "")
        if name.startswith(("SQLITE_FULL", "SQLITE_IOERR")) and (refused := disk_error(path)) is not None:
            raise refused from None
        if name.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")):
            raise InputError(
                "--work", Problem(f"{path} is corrupt, or no table of tasks"), "Delete the folder to start again"
            ) from None
        raise RenderError(f"{path}: {error}") from None
