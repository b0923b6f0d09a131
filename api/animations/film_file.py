"""A finished film: bytes in a file without a name, which is gone as soon as nobody reads it any more, however this process ends."""

from __future__ import annotations

import os
import threading
from pathlib import Path

CHUNK_BYTES = 2**18
"""Bytes that are read at a time: between them others have their turn, and a slow client's connection keeps no more."""


class FilmFile:
    """The film in a file, whose name may go from now on. ``close`` lets go of it; a ``Reading`` that has begun goes on."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self.nbytes = os.fstat(self._file.fileno()).st_size

    @property
    def closed(self) -> bool:
        """Whether it was let go."""
        return self._file.closed

    def reading(self, first: int, end: int) -> Reading:
        """Its bytes from ``first`` to before ``end``."""
        return Reading(os.dup(self._file.fileno()), first, end)

    def close(self) -> None:
        """Let go of the film."""
        self._file.close()


class Reading:
    """A part of a film as one client reads it. It goes at its own place, and holds the film until it is closed. To be used from any
    thread.
    """

    def __init__(self, descriptor: int, first: int, end: int) -> None:
        self._descriptor, self._place, self._end = descriptor, first, end
        # A client that goes away closes it while a thread may be reading: the descriptor's number is soon another file's.
        self._lock = threading.Lock()

    def chunk(self) -> bytes:
        """The next bytes; none at the end, or once it is closed."""
        with self._lock:
            if self._descriptor < 0:
                return b""
            found = os.pread(self._descriptor, min(CHUNK_BYTES, self._end - self._place), self._place)
            self._place += len(found)
            return found

    def close(self) -> None:
        """Let go of the film; more than once is as good as once."""
        with self._lock:
            if self._descriptor >= 0:
                os.close(self._descriptor)
                self._descriptor = -1
