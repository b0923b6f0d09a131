"""``skugga seed``: its options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from skugga.api.cli.common_options import SkyOption, SlopeExaggerationOption, StyleOption
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.options import with_shadow_options
from skugga.api.cli.product_parameters import with_product_options
from skugga.api.products import SEED_PRODUCTS
from skugga.api.seed.messages import MIN_TASK_TIMEOUT_S
from skugga.terrain.level.level_source import LevelSource


@with_level_argument
@with_product_options(SEED_PRODUCTS, after_parameter="format")
@with_shadow_options("pictures", after_parameter="altitude")
def seed(
    level: LevelSource,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="Archive (.pmtiles) or folder to write. {time} in its name is replaced by each of several times.",
        ),
    ],
    zooms: Annotated[
        str | None,
        typer.Option(
            metavar="A-B",
            help="First and last zoom; default: from the zoom at which one tile shows the level to the cells' resolution.",
        ),
    ] = None,
    layer: Annotated[
        str,
        typer.Option(
            help=f"Layer of the tiles: {', '.join(SEED_PRODUCTS)}.",
            autocompletion=complete_words(SEED_PRODUCTS),
        ),
    ] = "color",
    format: Annotated[str, typer.Option(help="png, webp or jpg.", autocompletion=complete_words(["png", "webp", "jpg"]))] = "png",
    time: Annotated[str | None, typer.Option(help="Date and time, ISO 8601 with an offset: 2024-10-21T16:30:00-04:00.")] = None,
    times: Annotated[str | None, typer.Option(metavar="T,T,...", help="Several times, with one output each.")] = None,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help="First of many times.")] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="TIME", help="Last of many times.")] = None,
    step: Annotated[str | None, typer.Option(metavar="1h", help="Interval between two times.")] = None,
    azimuth: Annotated[float | None, typer.Option(help="Azimuth of the sun, degrees clockwise from north.")] = None,
    altitude: Annotated[float | None, typer.Option(help="Altitude of the sun in degrees, with refraction.")] = None,
    style: StyleOption = None,
    slope_exaggeration: SlopeExaggerationOption = None,
    sky: SkyOption = None,
    workers: Annotated[int | None, typer.Option(help="Number of render processes; default: one per core.", min=1, max=1024)] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Render on the Dask cluster of this scheduler: tcp://host:8786."),
    ] = None,
    work: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the task table; default: the output's name and .seed.")
    ] = None,
    shards: Annotated[
        str | None,
        typer.Option(metavar="PLACE", help="Folder or address (s3://...) of rendered shards; default: in the work folder."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the tasks that would run, why, their time and size; render nothing.")
    ] = False,
    max_tasks: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Render nothing if more than N tasks would run.")
    ] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Run failed tasks again.")] = False,
    task_timeout: Annotated[
        float,
        typer.Option(
            metavar="S",
            min=1.0,
            help="Seconds after which a render process is ended if it has not finished its task; another process then retries. The "
            "limit is at least a hundred times the expected time of the task.",
        ),
    ] = MIN_TASK_TIMEOUT_S,
    max_ms: Annotated[
        float | None,
        typer.Option(help="Longest expected time of a block, ms; default: the limit of a service (60 s).", min=0.0),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: the forecast of --dry-run, or a summary.")] = False,
    **declared_options: Any,
) -> None:
    """Render a level's tiles in advance, into an archive (PMTiles) or a folder. The same command resumes an interrupted run,
    and redraws what has changed.
    """
    from skugga.api.cli.seeding import SeedOptions, seed_level

    options = SeedOptions(
        output, zooms, layer, format, time, times, start, end, step, azimuth, altitude, style, slope_exaggeration, sky, workers,
        scheduler, work, shards, dry_run, max_tasks, retry_failed, task_timeout, max_ms, as_json,
    )  # fmt: skip
    seed_level(level, options, declared_options)
