"""Stores of shards: a folder, or any address that ``fsspec`` supports, such as an object store. Writes are atomic."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from skugga.terrain.errors import InputError, Problem, RenderError


class ShardStore(Protocol):
    """Protocol of a store of bytes by name. Names may contain folders."""

    def write(self, name: str, content: bytes) -> None:
        """Write bytes under a name, replacing earlier ones. Raises ``OSError``."""

    def read(self, name: str) -> bytes:
        """Return the bytes under a name. Raises ``FileNotFoundError`` and other ``OSError``."""

    def names(self) -> set[str]:
        """Return the names of all stored entries."""

    def delete(self, names: Iterable[str]) -> None:
        """Delete the entries with these names, if they exist."""


class FolderStore:
    """A folder of this machine, or one shared by all workers."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def write(self, name: str, content: bytes) -> None:
        """Write a temporary file and rename it, so that a worker's death leaves the old file intact.

        The write is not synced to disk, since readers check digests.
        """
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
        try:
            part.write_bytes(content)
            os.replace(part, path)
        except BaseException as error:
            with suppress(OSError):
                part.unlink()
            if isinstance(error, OSError):
                raise OSError(error.errno, error.strerror, str(self._folder)) from None
            raise

    def read(self, name: str) -> bytes:
        """Implement ``ShardStore.read``."""
        return (self._folder / name).read_bytes()

    def names(self) -> set[str]:
        """Implement ``ShardStore.names``, and delete temporary files of dead writers."""
        names = set()
        for folder, _, files in os.walk(self._folder):
            for file in files:
                path = Path(folder) / file
                if file.startswith("."):
                    with suppress(OSError):
                        path.unlink()
                else:
                    names.add(path.relative_to(self._folder).as_posix())
        return names

    def delete(self, names: Iterable[str]) -> None:
        """Implement ``ShardStore.delete``."""
        for name in names:
            with suppress(FileNotFoundError):
                (self._folder / name).unlink()


class RemoteStore:
    """A folder at an address of ``fsspec``, such as ``s3://bucket/shards``. Object stores write objects atomically."""

    def __init__(self, address: str) -> None:
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise InputError(
                "--shards",
                Problem(f"the address {address} needs the package fsspec"),
                "Run pip install 'skugga[cluster]', or use a folder",
            ) from None
        try:
            system, root = url_to_fs(address)
        except (ImportError, ValueError) as error:
            raise InputError("--shards", address, f"a folder, or an address that fsspec supports ({error})") from None
        self._system: Any = system
        self._root = str(root).rstrip("/")

    def write(self, name: str, content: bytes) -> None:
        """Implement ``ShardStore.write``."""
        self._system.pipe_file(f"{self._root}/{name}", content)

    def read(self, name: str) -> bytes:
        """Implement ``ShardStore.read``."""
        return bytes(self._system.cat_file(f"{self._root}/{name}"))

    def names(self) -> set[str]:
        """Implement ``ShardStore.names``."""
        self._system.invalidate_cache()
        try:
            paths = self._system.find(self._root)
        except FileNotFoundError:
            return set()
        return {path.removeprefix(f"{self._root}/") for path in paths}

    def delete(self, names: Iterable[str]) -> None:
        """Implement ``ShardStore.delete``."""
        paths = [f"{self._root}/{name}" for name in names]
        if paths:
            with suppress(FileNotFoundError):
                self._system.rm(paths)


def open_store(location: str) -> ShardStore:
    """Return the store at a folder or an address. Raises ``InputError`` for an unsupported address."""
    return RemoteStore(location) if "://" in location else FolderStore(Path(location))


def check_writable(store: ShardStore, location: str) -> None:
    """Write a test file and read it again. Raises ``RenderError``, and ``OSError`` that names the place ``location``."""
    name, content = f"check-{secrets.token_hex(4)}", b"skugga"
    try:
        store.write(name, content)
        if store.read(name) != content:
            raise RenderError(f"{location}: a test file read back differs from what was written. Use another store.")
        store.delete([name])
    except OSError as error:
        raise OSError(error.errno or 5, error.strerror or str(error), location) from None
    except RenderError:
        raise
    except Exception as error:  # an error of an object store
        raise RenderError(f"{location}: shards cannot be written there ({type(error).__name__}: {error})") from None
