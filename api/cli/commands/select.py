"""``skugga select``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from skugga.api.cli.common_options import (
    AltitudeOption,
    AzimuthOption,
    BoundsOption,
    CrsOption,
    JsonOption,
    SecondsOption,
    SizeOption,
    TimeOption,
    ViewOption,
    read_bounds,
    read_size,
)
from skugga.api.cli.completion import complete_words
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.options import overrides_of, with_shadow_options
from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.progress import spinner
from skugga.api.cli.times import sun_from_options
from skugga.selector.choices import PolicyName
from skugga.terrain.level.level_source import LevelSource

if TYPE_CHECKING:
    from rich.table import Table

    from skugga.terrain.level.parts import SunSpec


@with_level_argument
@with_shadow_options("select")
def select(
    level: LevelSource,
    view: ViewOption = "map",
    policy: Annotated[
        str,
        typer.Option(
            help="rules: fixed rules; predict: cost and error models of this device; probe: predict, corrected by candidates that "
            "are rendered and compared with ray-traced truth; measure: probe without a time limit (minutes).",
            autocompletion=complete_words(get_args(PolicyName)),
        ),
    ] = "probe",
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="Time limit of a probe, such as 30s or 1m. Default: 10s, and 3s a scale with --all-scales."
        ),
    ] = None,
    as_json: JsonOption = False,
    write: Annotated[
        bool,
        typer.Option("--write", help="Pin the choice into the level file, for all of its views; with --all-views each view's own."),
    ] = False,
    all_views: Annotated[
        bool, typer.Option("--all-views", help="Choose for each view and for the tiles (map); print a table.")
    ] = False,
    all_scales: Annotated[
        bool,
        typer.Option(
            "--all-scales",
            help="Probe the level's maps and tiles at all their scales; print a table. --write saves the probes to the user's "
            "cache, and services plan tiles with them.",
        ),
    ] = False,
    descriptor: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write the descriptor of the view to a file; POST /plan accepts it.")
    ] = None,
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    size: SizeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    seconds: SecondsOption = None,
    **declared_options: Any,
) -> None:
    """Choose algorithms and settings for one view or all views of a level, and give the reasons."""
    from skugga.api.cli.planning import pin_plan, plan_level_view, write_descriptor
    from skugga.api.report.plan_text import format_plan

    check_output_files(level, [("--descriptor", descriptor)])
    overrides = overrides_of("select", declared_options)
    if all_views or all_scales:
        from skugga.api.cli.all_views import check_conflicts

        option = "--all-views" if all_views else "--all-scales"
        check_conflicts(option, view, {"size": size, "bounds": bounds, "crs": crs, "descriptor": descriptor})
    if all_scales:
        check_conflicts("--all-scales", view, {"all-views": all_views or None, "seconds": seconds})
        _probe_all_scales(level, policy, overrides, sun_from_options(time, azimuth, altitude), budget, as_json, write)
        return
    if all_views:
        _select_all(level, policy, budget, overrides, sun_from_options(time, azimuth, altitude), seconds, as_json, write)
        return
    view_options = sun_from_options(time, azimuth, altitude), read_size(size), read_bounds(bounds), crs, seconds
    with spinner({"measure": "Measuring", "probe": "Probing"}.get(policy, "Choosing")):
        choice = plan_level_view(level, view, policy, overrides, *view_options, ignore_pin=write, budget=budget)
        message = pin_plan(choice) if write else None
    if descriptor is not None:
        write_descriptor(choice, descriptor)
    typer.echo(choice.plan.model_dump_json(indent=2) if as_json else format_plan(choice.plan, choice.heading))
    if message is not None:
        typer.echo(message, err=True)


def _select_all(
    level: LevelSource,
    policy: str,
    budget: str | None,
    overrides: dict[str, Any],
    sun: SunSpec | None,
    seconds: float | None,
    as_json: bool,
    write: bool,
) -> None:
    """Choose for all views of a level and print the choices. ``write`` pins them into the level file.

    ``budget`` is the time of each probe as text, ``seconds`` a reading of the level's clock in seconds.
    """
    from skugga.api.cli.all_views import choices_table, json_rows, pin_all_views, plan_all_views

    with spinner("Choosing for all views"):
        choices = plan_all_views(level, policy, overrides, sun, seconds, ignore_pins=write, budget=budget)
        message = pin_all_views(choices) if write else None
    _print_choices(json_rows(choices), choices_table(choices), as_json, message)


def _print_choices(rows: list[dict[str, Any]], table: Table, as_json: bool, message: str | None) -> None:
    """Print choices as JSON (``rows``) or as a table; print the message on standard error."""
    from rich.console import Console

    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        Console(width=None if sys.stdout.isatty() else 200).print(table)
    if message is not None:
        typer.echo(message, err=True)


def _probe_all_scales(
    level: LevelSource, policy: str, overrides: dict[str, Any], sun: SunSpec | None, budget: str | None, as_json: bool, write: bool
) -> None:
    """Probe a level's maps at all scales and print the plans. ``write`` saves the probes to the user's cache.

    ``budget`` is the time of each probe as text, such as 3s.
    """
    from skugga.api.cli.all_scales import probe_all_scales, rows_of_scales, table_of_scales

    with spinner("Probing at all scales"):
        plans, message = probe_all_scales(level, policy, overrides, sun, budget, write)
    _print_choices(rows_of_scales(plans), table_of_scales(plans), as_json, message)
