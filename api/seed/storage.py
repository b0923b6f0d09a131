"""Where shards lie: a folder, or any address that ``fsspec`` knows, as an object store's. Written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from skugga.terrain.errors import InputError, RenderError


class ShardStore(Protocol):
    """Bytes by name; names may have folders in them."""

    def write(self, name: str, content: bytes) -> None:
        """Put bytes under a name, in the place of others. Raises ``OSError``."""

    def read(self, name: str) -> bytes:
        """The bytes under a name. Raises ``FileNotFoundError`` and other ``OSError``."""

    def names(self) -> set[str]:
        """All names."""

    def delete(self, names: Iterable[str]) -> None:
        """Delete what is there of some names."""


class FolderStore:
    """A folder of this machine, or of one that all workers see."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def write(self, name: str, content: bytes) -> None:
        """A file beside its place, moved there: a worker that dies in between leaves what was there. It is not waited until it is
        on the disk: whoever reads a shard knows its digests.
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
        """As the protocol says."""
        return (self._folder / name).read_bytes()

    def names(self) -> set[str]:
        """As the protocol says; what writers left that died is deleted."""
        found = set()
        for folder, _, files in os.walk(self._folder):
            for file in files:
                path = Path(folder) / file
                if file.startswith("."):
                    with suppress(OSError):
                        path.unlink()
                else:
                    found.add(path.relative_to(self._folder).as_posix())
        return found

    def delete(self, names: Iterable[str]) -> None:
        """As the protocol says."""
        for name in names:
            with suppress(FileNotFoundError):
                (self._folder / name).unlink()


class RemoteStore:
    """A folder at an address of ``fsspec``, as ``s3://bucket/shards``. An object appears whole, or does not."""

    def __init__(self, address: str) -> None:
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise InputError("--shards", address, "a folder; or pip install 'skugga[cluster]', for addresses") from None
        try:
            system, root = url_to_fs(address)
        except (ImportError, ValueError) as error:
            raise InputError("--shards", address, f"a folder, or an address that fsspec knows ({error})") from None
        self._system: Any = system
        self._root = str(root).rstrip("/")

    def write(self, name: str, content: bytes) -> None:
        """As the protocol says."""
        self._system.pipe_file(f"{self._root}/{name}", content)

    def read(self, name: str) -> bytes:
        """As the protocol says."""
        return bytes(self._system.cat_file(f"{self._root}/{name}"))

    def names(self) -> set[str]:
        """As the protocol says."""
        self._system.invalidate_cache()
        try:
            found = self._system.find(self._root)
        except FileNotFoundError:
            return set()
        return {path.removeprefix(f"{self._root}/") for path in found}

    def delete(self, names: Iterable[str]) -> None:
        """As the protocol says."""
        paths = [f"{self._root}/{name}" for name in names]
        if paths:
            with suppress(FileNotFoundError):
                self._system.rm(paths)


def store_at(place: str) -> ShardStore:
    """The store at a folder or an address. Raises ``InputError`` for an address that nothing here can reach."""
    return RemoteStore(place) if "://" in place else FolderStore(Path(place))


def check_writable(store: ShardStore, place: str) -> None:
    """Write something and read it again. Raises ``OSError`` that names the place, and ``RenderError``."""
    name, content = f"check-{secrets.token_hex(4)}", b"skugga"
    try:
        store.write(name, content)
        if store.read(name) != content:
            raise RenderError(f"{place}: what was written there is not what is read")
        store.delete([name])
    except OSError as error:
        raise OSError(error.errno or 5, error.strerror or str(error), place) from None
    except RenderError:
        raise
    except Exception as error:  # an object store's own
        raise RenderError(f"{place}: shards cannot be written there: {type(error).__name__}: {error}") from None
