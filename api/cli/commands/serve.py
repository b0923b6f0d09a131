"""``skugga serve``."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from api.cli.level_argument import takes_level
from terrain.errors import InputError
from terrain.level.gdal_guard import forbid_remote_reads

if TYPE_CHECKING:
    from terrain.level.level_source import LevelSource


@takes_level
def serve(
    levels: list[LevelSource],
    folder: Annotated[
        Path | None,
        typer.Option("--levels", metavar="DIR", help="Serve the level files of a folder, too; SIGHUP looks which there are."),
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.", min=0, max=65535)] = None,
    workers: Annotated[int | None, typer.Option(help="Render processes.", min=1)] = None,
) -> None:
    """Serve levels as map tiles over HTTP, with a viewer on /; and archives of tiles (.pmtiles) as they are."""
    from api.catalogue import bundled_levels
    from api.http.archive_file import ARCHIVE_SUFFIX
    from api.http.server import serve as run
    from api.settings import load_settings
    from terrain.level.level_source import LevelSource

    options = {"host": host, "port": port, "workers": workers, "levels": folder}
    settings = load_settings(**{key: value for key, value in options.items() if value is not None})
    if not settings.remote_sources:
        forbid_remote_reads()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the service ends in an order of its own
    archives = [each for each in levels if each.path.suffix.lower() == ARCHIVE_SUFFIX]
    for option in (option for each in archives for option in each.options):
        raise InputError(f"--{option}", str(levels[0].path), "a raster beside it: an archive is served as it is")
    if not levels and settings.levels is None:
        levels = [LevelSource(path=path) for path in bundled_levels()]
    run(settings, [each for each in levels if each not in archives], [each.path for each in archives])
