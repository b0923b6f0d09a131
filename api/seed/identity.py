"""Identity of a level, as digests of its settings and of file contents. It does not depend on the files' places and times."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from skugga.api.file_stamps import file_stamps
from skugga.api.seed.ground_chunks import GroundChunks, ground_chunks
from skugga.api.seed.task_table import TaskTable
from skugga.shadows.plan import Plan
from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.linked_files import is_remote, linked_files, sidecar_files
from skugga.terrain.scene import Scene

KEYS_WITHOUT_EFFECT = {"title", "attribution", "views", "shadows", "sun", "archive"}
"""Keys of a level that do not affect tiles directly. The plans include ``shadows``, and the sun has its own digest."""

READ_BLOCK_BYTES = 2**20
"""Number of bytes of a file that are read at once."""


def level_digest(loaded: LoadedLevel, scene: Scene, table: TaskTable) -> str:
    """Return the digest of everything in a level that affects its tiles, except the ground's heights. Raises ``OSError``.

    Contents of files affect it; their paths and their modification times do not. ``table`` caches digests of files.
    """
    settings = loaded.level.model_dump(mode="json", exclude=KEYS_WITHOUT_EFFECT)
    terrain = loaded.level.terrain.source
    contents = {name: contents_digest(loaded.resolve(name), table) for name in _source_names(loaded) if name != terrain}
    if terrain is not None:
        contents[terrain] = ""
    ground = scene.elevation
    facts = {
        "shape": ground.shape, "cells": [float(v) for v in (*ground.xy(0, 0), *ground.xy(1, 1))], "crs": ground.crs.to_wkt(),
    }  # fmt: skip
    return digest_of_json([_without_paths(settings, contents), facts])


def cached_ground_chunks(loaded: LoadedLevel, scene: Scene, table: TaskTable) -> GroundChunks:
    """Return the digests of a level's ground by chunk. They are recomputed only if one of the ground's files has changed.

    Raises ``SourceError``.
    """
    source = loaded.source
    stamp = _stamp_of_source(source) if source and Path(source).exists() else None
    cache_key = (
        f"{stamp} {loaded.level.terrain.model_dump_json()} {None if loaded.level.water is None else loaded.level.water.level}"
    )
    cached = table.get("ground")
    if stamp is not None and cached is not None and table.get("ground_stamp") == cache_key.encode():
        return GroundChunks.from_bytes(cached)
    chunks = ground_chunks(scene.elevation)
    table.put(ground=chunks.to_bytes(), ground_stamp=cache_key.encode())
    return chunks


def contents_digest(source: str, table: TaskTable) -> str:
    """Return the digest of a file's bytes, including linked files and sidecar files. For a remote file it is that of its address.

    Modification times do not affect the digest. They only save work: ``table`` stores digests of files by their stamps (times, size
    and inode), and files with unchanged stamps are not read again. Raises ``OSError``.
    """
    digest = hashlib.blake2b(digest_size=16)
    for path in _files_of(source):
        if is_remote(str(path)):
            digest.update(str(path).encode())
            continue
        stamp = repr(file_stamps([path]))
        file_digest = table.file_digest(str(path), stamp)
        if file_digest is None:
            file_digest = _digest_of_bytes(path)
            table.put_file(str(path), stamp, file_digest)
        digest.update(file_digest.encode())
    return digest.hexdigest()


def plan_digest(plan: Plan | None) -> str:
    """Return the digest of what a plan does: its algorithms, settings and effects. Its reasons and expected costs do not count.

    ``None`` stands for a product that needs no plan.
    """
    return digest_of_json(None if plan is None else plan.model_dump(mode="json", include={"algorithm", "settings"}) | {
        "effects": sorted(plan.effect_names)
    })  # fmt: skip


def digest_of_json(value: Any) -> str:
    """Return a digest of a JSON value as 32 hexadecimal digits."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()


def _source_names(loaded: LoadedLevel) -> list[str]:
    """Return the names of the files that a level refers to, as written in the level file."""
    level = loaded.level
    sources = [level.terrain.source, level.terrain.imagery]
    sources += [spec.source for spec in (*level.roads, *level.rivers)]
    sources += [spec.source for spec in level.land_cover]
    sources += [stand.source for stand in level.forest]
    for mesh in level.meshes:
        sources += [mesh.source, mesh.caster, mesh.surface, mesh.ground]
    return [name for name in dict.fromkeys(sources) if name is not None]


def _without_paths(value: Any, contents: dict[str, str]) -> Any:
    """Return a JSON value with names of files replaced by the digests of their contents.

    ``contents`` has the digests by the names of files, as written in the level file.
    """
    if isinstance(value, dict):
        return {key: _without_paths(item, contents) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_paths(item, contents) for item in value]
    return contents.get(value, value) if isinstance(value, str) else value


def _files_of(source: str) -> list[Path]:
    """Return the files that belong to a source: itself, the files that it links to, and their sidecar files, if they exist.

    ``source`` is a path or an address. Remote files are included without a check.
    """
    files = [Path(source), *map(Path, linked_files(source))]
    sidecars = [file for path in files if not is_remote(str(path)) for file in sidecar_files(path)]
    return [path for path in dict.fromkeys([*files, *sidecars]) if is_remote(str(path)) or path.is_file()]


def _stamp_of_source(source: str) -> str:
    """Return the stamps (times, size and inode) of the files that belong to a source, as text."""
    return repr(file_stamps(_files_of(source)))


def _digest_of_bytes(path: Path) -> str:
    """Return the digest of a file's bytes as 32 hexadecimal digits. Raises ``OSError``."""
    digest = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        for part in _file_blocks(file):
            digest.update(part)
    return digest.hexdigest()


def _file_blocks(file: Any) -> Iterable[bytes]:
    """Yield the bytes of an open file in pieces of ``READ_BLOCK_BYTES``."""
    while part := file.read(READ_BLOCK_BYTES):
        yield part
