"""``skugga serve``."""

from __future__ import annotations

import signal
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skugga.api.cli.level_argument import with_level_argument
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.gdal_guard import forbid_remote_reads

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def serve(
    levels: list[LevelSource],
    folder: Annotated[
        Path | None,
        typer.Option("--levels", metavar="DIR", help="Serve the level files of this folder too; SIGHUP reads the folder again."),
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.", min=0, max=65535)] = None,
    workers: Annotated[int | None, typer.Option(help="Number of render processes.", min=1)] = None,
) -> None:
    """Serve levels as map tiles over HTTP, with a viewer on /. Archives of tiles (.pmtiles) are served unchanged."""
    from skugga.api.catalogue import ARCHIVE_SUFFIX, bundled_levels
    from skugga.api.settings import load_settings
    from skugga.api.workers.piped_process import SpawnedWorker
    from skugga.api.workers.worker_config import first_config
    from skugga.api.workers.worker_main import worker_main
    from skugga.terrain.level.level_source import LevelSource

    options = {"host": host, "port": port, "workers": workers, "levels": folder}
    settings = load_settings(**{key: value for key, value in options.items() if value is not None})
    if not settings.remote_sources:
        forbid_remote_reads()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the service handles SIGTERM itself
    archives = [source for source in levels if source.path.suffix.lower() == ARCHIVE_SUFFIX]
    for option in (option for source in archives for option in source.options):
        raise InputError(f"--{option}", Problem(f"does not apply to {levels[0].path}, an archive of tiles"), "Leave it out")
    for named in (source for source in archives if source.name is not None):
        raise InputError(
            "LEVEL", f"{named.name}={named.path}", "NAME=FILE for levels only; an archive is served under the name of its file"
        )
    if not levels and settings.levels is None:
        levels = [LevelSource(path=path) for path in bundled_levels()]
    rendered_levels = [source for source in levels if source not in archives]
    spawned_worker = None
    if rendered_levels or settings.levels is not None:
        with suppress(OSError):  # the service starts one later, as after any failed start
            spawned_worker = SpawnedWorker(worker_main, first_config(settings))
            spawned_worker.start()  # in parallel with the imports of this process, which take as long
    from skugga.api.http.server.server import serve as run

    try:
        run(settings, rendered_levels, [source.path for source in archives], spawned_worker)
    finally:
        if spawned_worker is not None:
            spawned_worker.end()
