"""A finished film: bytes in a file without a name, which is gone as soon as nobody reads it any more, however this process ends."""

from __future__ import annotations

import os
import threading
from pathlib import Path

CHUNK_BYTES = 2**18
"""Bytes that are read at a time: between them others have their turn, and a slow client's connection keeps no more."""


class FilmFile:
    """The film in a file, whose name may go from now on. It is there until it was closed, and every ``Reading`` of it. To be used
    from any thread.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._holders = 1
        self._lock = threading.Lock()
        self.nbytes = os.fstat(self._file.fileno()).st_size
        self.closed = False

    @property
    def gone(self) -> bool:
        """Whether nobody holds it any more."""
        return self._file.closed

    def reading(self, first: int, end: int) -> Reading:
        """Its bytes from ``first`` to before ``end``, for one client. It may not be closed yet."""
        with self._lock:
            self._holders += 1
        return Reading(self, first, end)

    def part(self, first: int, end: int) -> bytes:
        """Bytes of it, for whoever holds it. One descriptor serves all: there may be as many clients as connections."""
        return os.pread(self._file.fileno(), end - first, first)

    def close(self) -> None:
        """Let go of the film; more than once is as good as once."""
        if not self.closed:
            self.closed = True
            self.let_go()

    def let_go(self) -> None:
        """One holds it no more."""
        with self._lock:
            self._holders -= 1
            if not self._holders:
                self._file.close()


class Reading:
    """A part of a film as one client reads it, at its own place. It holds the film until it is closed."""

    def __init__(self, film: FilmFile, first: int, end: int) -> None:
        self._film: FilmFile | None = film
        self._place, self._end = first, end
        # A client that goes away closes it while a thread may be reading: the descriptor's number is soon another file's.
        self._lock = threading.Lock()

    def chunk(self) -> bytes:
        """The next bytes; none at the end, or once it is closed."""
        with self._lock:
            if self._film is None:
                return b""
            found = self._film.part(self._place, min(self._place + CHUNK_BYTES, self._end))
            self._place += len(found)
            return found

    def close(self) -> None:
        """Let go of the film; more than once is as good as once."""
        with self._lock:
            film, self._film = self._film, None
        if film is not None:
            film.let_go()
