"""``skugga seed``: its options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import takes_level
from skugga.api.cli.options import with_shadow_options
from skugga.api.cli.product_parameters import with_product_options
from skugga.api.products import SEEDED_PRODUCTS
from skugga.api.seed.messages import LEAST_LIMIT_S
from skugga.terrain.level.level_source import LevelSource


@takes_level
@with_product_options(SEEDED_PRODUCTS, after="format")
@with_shadow_options("pictures", after="altitude")
def seed(
    level: LevelSource,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="An archive to write (.pmtiles), or a folder; of several times {time} in its name stands for each.",
        ),
    ],
    zooms: Annotated[
        str | None,
        typer.Option(metavar="A-B", help="First and last zoom; default: from the one that shows all to the one of the cells."),
    ] = None,
    layer: Annotated[
        str,
        typer.Option(
            help=f"A layer that tiles are served in: {', '.join(SEEDED_PRODUCTS)}.",
            autocompletion=complete_words(SEEDED_PRODUCTS),
        ),
    ] = "color",
    format: Annotated[str, typer.Option(help="png, webp or jpg.", autocompletion=complete_words(["png", "webp", "jpg"]))] = "png",
    time: Annotated[str | None, typer.Option(help="Date and time, ISO 8601 with an offset, as 2024-10-21T16:30:00-04:00.")] = None,
    times: Annotated[str | None, typer.Option(metavar="T,T,...", help="Several times, an output each.")] = None,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help="The first of many times, ...")] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="TIME", help="... the last, ...")] = None,
    step: Annotated[str | None, typer.Option(metavar="1h", help="... and what lies between two.")] = None,
    azimuth: Annotated[float | None, typer.Option(help="Degrees clockwise from north.")] = None,
    altitude: Annotated[float | None, typer.Option(help="Degrees above the horizon as seen, refraction included.")] = None,
    workers: Annotated[int | None, typer.Option(help="Render processes; default: one a core.", min=1, max=1024)] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Draw on a Dask cluster, by its scheduler: tcp://host:8786.")
    ] = None,
    work: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the task table; default: beside the output, its name and .seed.")
    ] = None,
    shards: Annotated[
        str | None, typer.Option(metavar="PLACE", help="Folder or address (s3://...) of drawn tiles; default: in the work folder.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would run, why, how long and how large; draw nothing.")
    ] = False,
    max_tasks: Annotated[
        int | None, typer.Option(metavar="N", min=0, help="Draw nothing if more tasks than these would run.")
    ] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Try tasks that failed again.")] = False,
    task_timeout: Annotated[
        float,
        typer.Option(
            metavar="S",
            min=1.0,
            help="Seconds after which a render process that has not finished a task is ended, and another one tries; of tasks that "
            "are expected to take more than a hundredth of that, a hundred times as long.",
        ),
    ] = LEAST_LIMIT_S,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: with --dry-run the outlook, else what was done.")] = False,
    **asked: Any,
) -> None:
    """Draw a level's tiles ahead, into an archive (PMTiles) or a folder. What was drawn is kept: the same command goes on, and
    draws what has changed.
    """
    from skugga.api.cli.seeding import SeedOptions, seed_level

    options = SeedOptions(
        output, zooms, layer, format, time, times, start, end, step, azimuth, altitude, workers, scheduler, work, shards, dry_run,
        max_tasks, retry_failed, task_timeout, as_json,
    )  # fmt: skip
    seed_level(level, options, asked)
