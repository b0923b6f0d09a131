"""``skugga compare``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skugga.api.cli.common_options import (
    AltitudeOption,
    AzimuthOption,
    BoundsOption,
    CrsOption,
    SizeOption,
    TimeOption,
    ViewOption,
    read_bounds,
    read_size,
)
from skugga.api.cli.level_argument import with_level_argument
from skugga.api.cli.progress import ProgressBar
from skugga.api.cli.repeated_command import command_line_without
from skugga.terrain.atomic_files import write_atomically

if TYPE_CHECKING:
    from skugga.terrain.level.level_source import LevelSource


@with_level_argument
def compare(
    level: LevelSource,
    context: typer.Context,
    view: ViewOption = "map",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Folder for report.html and error pictures.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the rows as JSON.")] = None,
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    size: SizeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    light: Annotated[str | None, typer.Option(help="Light to compare; default: the sun, else the first light.")] = None,
    fine: Annotated[bool, typer.Option("--fine", help="16 sub-pixel samples per pixel instead of 4.")] = False,
    time_limit: Annotated[
        float | None, typer.Option(min=0.0, metavar="S", help="Time limit for all rows and repeats, seconds; default: 70.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="ROW", help="Measure only the row of this name. May be repeated.")
    ] = None,
) -> None:
    """Compare algorithms and settings with ray-traced truth: error against time."""
    from skugga.api.cli.outputs import check_output_files
    from skugga.api.cli.snapshot import scene_and_view
    from skugga.api.cli.times import sun_from_options
    from skugga.api.report.comparison import check_outputs, print_comparison, write_comparison
    from skugga.selector.measure.compare import TIME_LIMIT_S
    from skugga.selector.measure.compare import compare as measure

    sun, shape = sun_from_options(time, azimuth, altitude), read_size(size)
    check_outputs(output, json_file)
    pictures = [] if output is None else sorted(output.glob("*.png"))
    check_output_files(level, [("--json", json_file), *(("--output", picture) for picture in pictures)])
    scene, view_value = scene_and_view(level, view, sun, shape, read_bounds(bounds), crs)
    with ProgressBar("Comparing") as advance:
        limit_s = TIME_LIMIT_S if time_limit is None else time_limit
        comparison = measure(scene, view_value, view, fine, advance, light, limit_s, only=only or ())
    base_command = command_line_without(context, "output", "json_file", "time_limit", "only")
    print_comparison(comparison, base_command)
    if output is not None:
        write_comparison(scene, comparison, output, view, base_command)
    if json_file is not None:
        rows = [row.figures for row in comparison.rows]
        write_atomically(json_file, json.dumps(rows, indent=2) + "\n")
