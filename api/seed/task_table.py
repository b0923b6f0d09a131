"""The task table of a run: one SQLite file, that says what is to be done, why, and what has been done."""

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

from skugga.api.seed.messages import Drawn
from skugga.terrain.errors import InputError, RenderError
from skugga.terrain.whole_files import disk_error

FORMAT = 1
"""Of the table: one that is of another is refused."""

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
    """A task as planned: its sun by name, its block, the first tile id of that, what its tiles hang on (``KeyParts``), how much of
    it shows data, and how long it is expected to take.
    """

    sun: str
    zoom: int
    x: int
    y: int
    first_tile: int
    parts: KeyParts
    share: float
    expected_s: float


class KeyParts(NamedTuple):
    """Digests of what a task's tiles hang on besides its place and sun, each named as the reason to draw it anew."""

    renderer: str
    settings: str
    plan: str
    range: str
    ground: str


REASONS = {
    "renderer": "the renderer is another one", "settings": "the level or what is asked has changed",
    "plan": "the plan is another one", "range": "the level's lowest or highest ground has changed",
    "ground": "ground that they hang on has changed",
}  # fmt: skip
"""Why tasks that were done are done again, by the part of their key that has changed."""

NEW, LOST = "not drawn yet", "the shard is lost or broken"


@dataclass(frozen=True)
class FailedTask:
    """A task that failed, and its error."""

    zoom: int
    x: int
    y: int
    sun: str
    error: str


class TaskTable:
    """The table of a folder, for one process at a time. To be closed. Raises ``InputError`` where another run has it, or where it
    is none of ours, and ``OSError``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(path.with_suffix(".lock"))
        try:
            self._db = sqlite3.connect(path, isolation_level=None)
            with _as_os_errors(path):
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = NORMAL")
                self._db.executescript(_SCHEMA)
            self._db.create_function("why_changed", 2, _why_changed, deterministic=True)
            found = self.get("format")
            if found is not None and found != str(FORMAT).encode():
                raise InputError("--work", str(path), "a table that this version of Skugga made, or none")
            self.put(format=str(FORMAT).encode())
        except BaseException:
            self._lock.close()
            raise

    @property
    def folder(self) -> Path:
        """The folder that it lies in."""
        return self._path.parent

    def close(self) -> None:
        """Close the file, and leave it to others."""
        self._db.close()
        self._lock.close()

    def __enter__(self) -> TaskTable:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def get(self, name: str) -> bytes | None:
        """A value that was put."""
        row = self._db.execute("SELECT value FROM about WHERE name = ?", (name,)).fetchone()
        return None if row is None else bytes(row[0])

    def put(self, **values: bytes) -> None:
        """Put values by name."""
        with self._whole():
            self._db.executemany("INSERT OR REPLACE INTO about VALUES (?, ?)", values.items())

    def file_digest(self, path: str, stamp: str) -> str | None:
        """The digest that a file had when it had this stamp."""
        row = self._db.execute("SELECT digest FROM files WHERE path = ? AND stamp = ?", (path, stamp)).fetchone()
        return None if row is None else str(row[0])

    def put_file(self, path: str, stamp: str, digest: str) -> None:
        """Keep a file's digest."""
        with self._whole():
            self._db.execute("INSERT OR REPLACE INTO files VALUES (?, ?, ?)", (path, stamp, digest))

    def plan(self, sun: str, zoom: int, asked: str) -> str | None:
        """The plan of a zoom under a sun that was made for what is asked."""
        row = self._db.execute("SELECT plan FROM plans WHERE sun = ? AND zoom = ? AND asked = ?", (sun, zoom, asked)).fetchone()
        return None if row is None else str(row[0])

    def put_plan(self, sun: str, zoom: int, asked: str, plan: str) -> None:
        """Keep a plan."""
        with self._whole():
            self._db.execute("INSERT OR REPLACE INTO plans VALUES (?, ?, ?, ?)", (sun, zoom, asked, plan))

    def want(self, tasks: Iterable[PlannedTask]) -> None:
        """Let these be the tasks of the run: those that were done of the same key stay done, failed ones failed; others wait, each
        with its reason.
        """
        with self._whole():
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
        for task in tasks:
            parts = ":".join(task.parts)
            yield task.sun, task.zoom, task.x, task.y, task.first_tile, NEW, key_of(task), parts, task.share, task.expected_s

    def waiting(self) -> list[int]:
        """The tasks that are to be done, the heaviest first."""
        rows = self._db.execute("SELECT id FROM tasks WHERE wanted AND state = 'waiting' ORDER BY expected_s DESC, first_tile, sun")
        return [row[0] for row in rows]

    def place(self, task: int) -> tuple[str, int, int, int, str, float]:
        """Sun, zoom, block x and y, and key of a task, and the seconds that it is expected to take."""
        row = self._db.execute("SELECT sun, zoom, x, y, key, expected_s FROM tasks WHERE id = ?", (task,)).fetchone()
        return tuple(row)

    def finish(self, drawn: Sequence[Drawn]) -> None:
        """Note tasks that were drawn."""
        with self._whole():
            self._db.executemany(
                "UPDATE tasks SET state = 'done', seconds = ?, encode_s = ?, peak_bytes = ?, bytes = ?, tiles = ?, error = NULL "
                "WHERE id = ?",
                [(each.seconds, each.encode_s, each.peak_bytes, each.nbytes, each.index, each.id) for each in drawn],
            )

    def fail(self, task: int, error: str) -> None:
        """Note a task that failed."""
        with self._whole():
            self._db.execute("UPDATE tasks SET state = 'failed', error = ? WHERE id = ?", (error, task))

    def tried(self, task: int) -> int:
        """Note that a worker died of a task; how often that has happened."""
        with self._whole():
            self._db.execute("UPDATE tasks SET tries = tries + 1 WHERE id = ?", (task,))
        return int(self._db.execute("SELECT tries FROM tasks WHERE id = ?", (task,)).fetchone()[0])

    def retry(self, tasks: Iterable[int], why: str | None = None) -> None:
        """Let tasks be done again, for a reason or for that which they had."""
        with self._whole():
            self._db.executemany(
                "UPDATE tasks SET state = 'waiting', tries = 0, error = NULL, why = coalesce(?, why) WHERE id = ?",
                [(why, task) for task in tasks],
            )

    def failed(self) -> dict[int, FailedTask]:
        """The failed tasks by number."""
        rows = self._db.execute(
            "SELECT id, zoom, x, y, sun, error FROM tasks WHERE wanted AND state = 'failed' ORDER BY first_tile, sun"
        )
        return {row[0]: FailedTask(*row[1:]) for row in rows}

    def done(self, sun: str) -> list[tuple[int, str, bytes]]:
        """Number, key and index of the tasks under a sun that are done, in the order of their tile ids."""
        rows = self._db.execute(
            "SELECT id, key, tiles FROM tasks WHERE sun = ? AND wanted AND state = 'done' ORDER BY first_tile", (sun,)
        )
        return [(row[0], row[1], bytes(row[2])) for row in rows]

    def published(self, output: str) -> dict[int, tuple[str, bytes]]:
        """Of tasks whose tiles lie in a folder, by number: the key and the index of those."""
        rows = self._db.execute("SELECT task, key, tiles FROM published WHERE output = ?", (output,))
        return {row[0]: (row[1], bytes(row[2])) for row in rows}

    def note_published(self, output: str, task: int, key: str, tiles: bytes) -> None:
        """Note that a task's tiles lie in a folder."""
        with self._whole():
            self._db.execute("INSERT OR REPLACE INTO published VALUES (?, ?, ?, ?)", (output, task, key, tiles))

    def forget_published(self, output: str, task: int) -> None:
        """Note that they do not any more."""
        with self._whole():
            self._db.execute("DELETE FROM published WHERE output = ? AND task = ?", (output, task))

    def keys(self) -> set[str]:
        """The keys of all tasks, whether wanted or not."""
        return {row[0] for row in self._db.execute("SELECT key FROM tasks")}

    def with_shards(self) -> list[tuple[int, str]]:
        """Number and key of the wanted tasks that are done and have tiles."""
        return self._db.execute("SELECT id, key FROM tasks WHERE wanted AND state = 'done' AND bytes > 0").fetchall()

    def counts(self) -> dict[str, int]:
        """Wanted tasks by state."""
        return dict(self._db.execute("SELECT state, count(*) FROM tasks WHERE wanted GROUP BY state").fetchall())

    def outlook(self) -> list[tuple[str, int, str, int, float, float]]:
        """Of what waits: sun, zoom, reason, number of tasks, how many full ones they are worth, and the seconds that they are
        expected to take.
        """
        return self._db.execute(
            "SELECT sun, zoom, why, count(*), sum(share), sum(expected_s) FROM tasks WHERE wanted AND state = 'waiting' "
            "GROUP BY sun, zoom, why ORDER BY sun, zoom, why"
        ).fetchall()

    def measured(self) -> dict[int, tuple[float, float]]:
        """By zoom, of tasks that were done: seconds and bytes of one that is full of data."""
        rows = self._db.execute(
            "SELECT zoom, sum(seconds) / sum(share), sum(bytes) / sum(share) FROM tasks WHERE seconds IS NOT NULL GROUP BY zoom"
        )
        return {row[0]: (row[1], row[2]) for row in rows}

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """All of a change, or nothing of it."""
        with _as_os_errors(self._path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def key_of(task: PlannedTask) -> str:
    """The key of a task: 32 hexadecimal digits. Tasks of the same key have the same tiles."""
    said = (task.sun, task.zoom, task.x, task.y, *task.parts)
    return blake2b("\n".join(map(str, said)).encode(), digest_size=16).hexdigest()


def _why_changed(before: str, now: str) -> str:
    named = zip(KeyParts._fields, before.split(":"), now.split(":"), strict=True)
    return next((REASONS[name] for name, one, other in named if one != other), NEW)


def _locked(path: Path) -> IO[str]:
    """The lock of a table, for this process. Raises ``InputError`` where another one has it."""
    file = path.open("a+", encoding="ascii")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        owner = file.read().strip() or "another process"
        file.close()
        raise InputError("--work", str(path.parent), f"a folder that no other run uses; process {owner} does") from None
    file.seek(0)
    file.truncate()
    file.write(str(os.getpid()))
    file.flush()
    return file


@contextmanager
def _as_os_errors(path: Path) -> Iterator[None]:
    """Let what SQLite says of a disk be one line that names the file."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        name = getattr(error, "sqlite_errorname", "")
        if name.startswith(("SQLITE_FULL", "SQLITE_IOERR")) and (refused := disk_error(path)) is not None:
            raise refused from None
        if name.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")):
            raise InputError("--work", str(path), "a table of tasks that is whole; delete the folder to begin anew") from None
        raise RenderError(f"{path}: {error}") from None
