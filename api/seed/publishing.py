"""Write the outputs of a run from its shards: an archive or a folder of tiles for each sun.

They are written only after all tasks are done.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, cast

from pmtiles.tile import tileid_to_zxy

from skugga.api.catalogue import ARCHIVE_SUFFIX
from skugga.api.errors import BrokenShardError
from skugga.api.file_stamps import file_stamps
from skugga.api.seed.archive import ArchiveMetadata, ShardIndex, write_archive
from skugga.api.seed.planning import PlannedRun
from skugga.api.seed.run_spec import MATRIX_SET
from skugga.api.seed.running import shard_name
from skugga.api.seed.storage import ShardStore
from skugga.api.seed.task_table import SHARD_LOST_REASON, TaskTable
from skugga.terrain.atomic_files import remove_partial_files, write_atomically
from skugga.terrain.errors import InputError, Problem

MANIFEST_NAME = "tiles.json"
"""TileJSON of a folder of tiles. It is written last: its presence means that the folder is complete."""


def is_archive(output: Path) -> bool:
    """Return whether an output is an archive; otherwise it is a folder of tiles."""
    return output.suffix.lower() == ARCHIVE_SUFFIX


def check_output(output: Path) -> None:
    """Raise ``InputError`` or ``OSError`` for an output that cannot be written, before any work is done."""
    if not output.parent.is_dir():
        raise FileNotFoundError(2, "folder not found", str(output.parent))
    if is_archive(output):
        if output.is_dir():
            raise InputError("--output", Problem(f"'{output}' is a folder"), "Choose another file name")
    elif output.exists() and not output.is_dir():
        raise InputError("--output", str(output), f"a folder of tiles, or a file name that ends in {ARCHIVE_SUFFIX}")
    elif output.is_dir() and any(output.iterdir()) and not (output / MANIFEST_NAME).exists():
        raise InputError("--output", str(output), f"a new folder, an empty folder, or a folder of tiles with a {MANIFEST_NAME}")


def publish(table: TaskTable, run: PlannedRun, store: ShardStore, outputs: Mapping[str, Path]) -> list[Path]:
    """Write the outputs that are out of date, and return their paths. ``outputs`` holds the paths by names of suns.

    If a shard is missing or broken, its task is queued again and ``BrokenShardError`` is raised. Raises ``OSError``.
    """
    written_outputs = []
    for sun, output in outputs.items():
        finished_tasks = table.finished_tasks(sun)
        state = _content_digest(run, sun, finished_tasks)
        if table.get(f"written {output}") == f"{state} {_output_stamp(output)}".encode():
            continue
        numbers, keys = [row[0] for row in finished_tasks], [row[1] for row in finished_tasks]
        indexes = [ShardIndex.from_bytes(row[2]) for row in finished_tasks]

        def read(number: int, keys: list[str] = keys, indexes: list[ShardIndex] = indexes) -> bytes:
            if not len(indexes[number].ids):
                return b""
            try:
                return store.read(shard_name(keys[number]))
            except FileNotFoundError:
                raise BrokenShardError(f"shard {number} is missing", number) from None

        try:
            if is_archive(output):
                remove_partial_files(output)
                write_archive(output, indexes, read, _archive_metadata(run, sun))
            else:
                _write_folder(table, output, numbers, keys, indexes, read, run, sun)
        except BrokenShardError as error:
            if error.shard_number is not None:
                table.retry([numbers[error.shard_number]], SHARD_LOST_REASON)
            raise
        table.put(**{f"written {output}": f"{state} {_output_stamp(output)}".encode()})
        written_outputs.append(output)
    return written_outputs


def _content_digest(run: PlannedRun, sun: str, finished_tasks: list[tuple[int, str, bytes]]) -> str:
    """Return a digest of all that determines the content of an output: its metadata and its tiles.

    ``finished_tasks`` has number, key and shard index of each task of the sun.
    """
    digest = hashlib.blake2b(repr(_archive_metadata(run, sun)).encode(), digest_size=16)
    for _, key, tiles in finished_tasks:
        digest.update(key.encode() + tiles)
    return digest.hexdigest()


def _output_stamp(output: Path) -> str:
    """Return the stamp (times, size and inode) of an archive, or of a folder's manifest, as text."""
    return repr(file_stamps([output if is_archive(output) else output / MANIFEST_NAME]))


def _archive_metadata(run: PlannedRun, sun: str) -> ArchiveMetadata:
    """Return the metadata of the archive for the sun with this name."""
    spec, level = run.spec, run.loaded.level
    title = level.title or run.loaded.name
    query = spec.request(run.sun_names.index(sun)).product_query()
    metadata: dict[str, Any] = {
        "name": title, "description": f"{title}: {spec.layer}, shaded by Skugga", "attribution": level.attribution,
        "type": "overlay" if spec.layer == "shadow" else "baselayer", "version": "1",
        "skugga": {"level": run.loaded.name, "layer": spec.layer, "format": spec.format, "tms": MATRIX_SET, "query": query},
    }  # fmt: skip
    format = cast(Literal["png", "webp", "jpg"], spec.format)
    return ArchiveMetadata(format, run.bounds, run.zooms.first, run.zooms.last, metadata)


def _write_folder(
    table: TaskTable,
    output: Path,
    task_numbers: list[int],
    task_keys: list[str],
    indexes: list[ShardIndex],
    read_shard: Any,
    run: PlannedRun,
    sun: str,
) -> None:
    """Write the tiles that a folder lacks, delete those that are no longer requested, and write the manifest last.

    ``task_numbers``, ``task_keys`` and ``indexes`` belong to the same finished tasks. ``read_shard(i)`` returns the bytes of
    the i-th shard.
    """
    with suppress(FileNotFoundError):
        (output / MANIFEST_NAME).unlink()
    published_tasks = table.published_tasks(str(output))
    for position, (number, key, index) in enumerate(zip(task_numbers, task_keys, indexes, strict=True)):
        previous = published_tasks.pop(number, None)
        if previous is not None and previous[0] == key:
            continue
        if previous is not None:
            _delete_tiles(output, ShardIndex.from_bytes(previous[1]), run.spec.format)
        content, begin = read_shard(position), 0
        for tile_id, length in zip(index.ids.tolist(), index.lengths.tolist(), strict=True):
            path = _tile_path(output, tile_id, run.spec.format)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content[begin : begin + length])
            begin += length
        table.record_published(str(output), number, key, index.to_bytes())
    for number, (_, tiles) in published_tasks.items():  # tasks of zooms that are no longer requested
        _delete_tiles(output, ShardIndex.from_bytes(tiles), run.spec.format)
        table.remove_published(str(output), number)
    write_atomically(output / MANIFEST_NAME, _tile_json(run, sun))


def _tile_path(output: Path, tile_id: int, format: str) -> Path:
    """Return the path of a tile in an output folder: zoom, column and row, with the suffix ``format``."""
    z, x, y = tileid_to_zxy(tile_id)
    return output / str(z) / str(x) / f"{y}.{format}"


def _delete_tiles(output: Path, index: ShardIndex, format: str) -> None:
    """Delete the tiles of a shard from an output folder, if they exist."""
    for tile_id in index.ids.tolist():
        with suppress(FileNotFoundError):
            _tile_path(output, tile_id, format).unlink()


def _tile_json(run: PlannedRun, sun: str) -> str:
    """Return the TileJSON 3.0.0: https://github.com/mapbox/tilejson-spec/tree/master/3.0.0."""
    facts = _archive_metadata(run, sun)
    west, south, east, north = facts.bounds
    fields = {
        "tilejson": "3.0.0", "tiles": [f"{{z}}/{{x}}/{{y}}.{facts.format}"],
        "minzoom": facts.first_zoom, "maxzoom": facts.last_zoom,
        "bounds": [-180.0 if east > 180.0 else west, south, min(east, 180.0), north], **facts.metadata,
    }  # fmt: skip
    return json.dumps({**fields, "version": "1.0.0"}, indent=1) + "\n"
