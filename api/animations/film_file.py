"""Keep a finished film in an unlinked file, which the system deletes after its last reader, even if this process crashes."""

from __future__ import annotations

import os
import threading
from pathlib import Path

READ_CHUNK_BYTES = 2**18
"""Size of one read. Other work runs between two reads, and a slow client's connection buffers no more."""


class FilmFile:
    """A film in an open file. The caller may unlink the file from now on.

    The file stays open until the film and every ``FilmReader`` of it are closed. The class is thread-safe.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._reference_count = 1
        self._lock = threading.Lock()
        self.nbytes = os.fstat(self._file.fileno()).st_size
        self.is_closed = False

    @property
    def is_file_closed(self) -> bool:
        """Whether the file is closed, because the film and all its readers are closed."""
        return self._file.closed

    def open_reader(self, first_byte: int, end_byte: int) -> FilmReader:
        """Return a reader of the bytes from ``first_byte`` to before ``end_byte``, for one client. The film must not be closed."""
        with self._lock:
            self._reference_count += 1
        return FilmReader(self, first_byte, end_byte)

    def read_range(self, first_byte: int, end_byte: int) -> bytes:
        """Return the bytes from ``first_byte`` to before ``end_byte``, for a ``FilmReader`` that is not closed.

        All clients share one file descriptor.
        """
        return os.pread(self._file.fileno(), end_byte - first_byte, first_byte)

    def close(self) -> None:
        """Release the film. Further calls do nothing."""
        if not self.is_closed:
            self.is_closed = True
            self.release()

    def release(self) -> None:
        """Drop one reference to the open file. The last one closes the file."""
        with self._lock:
            self._reference_count -= 1
            if not self._reference_count:
                self._file.close()


class FilmReader:
    """Reader of a range of a film's bytes for one client, with its own position. The film's file stays open until ``close``."""

    def __init__(self, film: FilmFile, first_byte: int, end_byte: int) -> None:
        self._film: FilmFile | None = film
        self._position, self._end = first_byte, end_byte
        # A disconnecting client closes it while a thread may be reading: the descriptor's number may soon be another file's.
        self._lock = threading.Lock()

    def read_chunk(self) -> bytes:
        """Return the next bytes of the range; empty at its end, or after ``close``."""
        with self._lock:
            if self._film is None:
                return b""
            content = self._film.read_range(self._position, min(self._position + READ_CHUNK_BYTES, self._end))
            self._position += len(content)
            return content

    def close(self) -> None:
        """Release the film's file. Further calls do nothing."""
        with self._lock:
            film, self._film = self._film, None
        if film is not None:
            film.release()
