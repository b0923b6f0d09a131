"""The command line. Exit status 0: done, 1: the work failed, 2: the input is wrong; errors are one line."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from api.catalogue import bundled_levels
from api.cli import doctor as doctor_checks
from api.cli.level_argument import takes_level
from api.cli.options import overrides_of, with_shadow_options
from api.cli.outputs import check_targets
from api.cli.same_command import same_command
from api.cli.seed_command import seed
from api.cli.times import suns_of
from api.errors import exit_status
from api.layers import LAYERS, PASS_LAYERS, check_suffix, write_layer
from api.point.horizon_formats import HORIZON_FORMATS
from api.raster_file import RasterCells
from api.shade import SHADE_LAYERS
from terrain.compiling.hooks import compiled_by
from terrain.errors import InputError, SkuggaError, printable
from terrain.level.gdal_guard import cap_caches, forbid_code, forbid_remote_reads
from terrain.level.level import parse_sun
from terrain.level.level_source import LevelSource
from terrain.level.parts import StyleName, SunSpec
from terrain.whole_files import write_whole

if TYPE_CHECKING:
    from rich.table import Table

app = typer.Typer(
    help="Terrain with the sun's true cast shadows.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

_UsageError: Any = typer.BadParameter.__mro__[1]
"""Typer's error of usage, which it exports under no name of its own."""

_FRAME_LAYERS = [name for name in LAYERS if name not in PASS_LAYERS]
LayerName = Annotated[
    str,
    typer.Option(
        help=f"{', '.join(_FRAME_LAYERS[:-1])} or {_FRAME_LAYERS[-1]}; or an algorithm's intermediate picture: "
        f"{', '.join(name for name in LAYERS if name in PASS_LAYERS)}."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]

ViewOption = Annotated[str, typer.Option(help="A view of the level.")]
TimeOption = Annotated[str | None, typer.Option(help="Date and time, ISO 8601 with an offset, as 2024-10-21T16:30:00-04:00.")]
AzimuthOption = Annotated[float | None, typer.Option(help="Degrees clockwise from north.")]
AltitudeOption = Annotated[float | None, typer.Option(help="Degrees above the horizon as seen, refraction included.")]
SizeOption = Annotated[str | None, typer.Option(metavar="WxH", help="Pixels.")]
BoundsOption = Annotated[str | None, typer.Option(metavar="W,S,E,N", help="In units of the output CRS.")]
CrsOption = Annotated[str | None, typer.Option(metavar="EPSG", help="Output CRS.")]
StyleOption = Annotated[str | None, typer.Option(help=f"How relief is shaded: auto, {', '.join(get_args(StyleName))}.")]
SlopeExaggerationOption = Annotated[
    float | None, typer.Option(help="Factor of slopes in shading, 0.1 to 20; cast shadows stay true.")
]
SecondsOption = Annotated[float | None, typer.Option(help="The level's clock, seconds: what moves is where it is then.")]


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"skugga {version('skugga')}")
        raise typer.Exit


@app.callback()
def _everywhere(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Terrain with the sun's true cast shadows."""


@app.command()
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
    from api.http.archive_file import ARCHIVE_SUFFIX
    from api.http.server import serve as run
    from api.settings import load_settings

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


@app.command()
@takes_level
@with_shadow_options("render")
def render(
    level: LevelSource,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help="File to write; the suffix sets the format. Of a film: .webp, .mp4 or frames/%04d.png."
        ),
    ],
    view: ViewOption = "map",
    layer: LayerName = "color",
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    size: SizeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    light: Annotated[str | None, typer.Option(help="The light to show, for layers of one light.")] = None,
    style: StyleOption = None,
    slope_exaggeration: SlopeExaggerationOption = None,
    seconds: SecondsOption = None,
    start: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="Of a film: the first time, or a reading of the clock as 0s, ...")
    ] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="TIME", help="... the last one, ...")] = None,
    step: Annotated[str | None, typer.Option(metavar="10m", help="... and what lies between two frames: as 30s, 10m, 1h.")] = None,
    path: Annotated[
        Path | None, typer.Option(metavar="CAMERA.yaml", help="Key positions with times of a camera that moves: a film.")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second of a film that plays; default: 25.")] = None,
    stats: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write plan, passes, times and caster reach as JSON.")
    ] = None,
    **asked: Any,
) -> None:
    """Render one snapshot of a level's view into a file; or a film, under a sun or along a path that moves."""
    from api.cli.film import FilmOptions, render_film
    from api.cli.snapshot import Appearance, snapshot, statistics

    film = FilmOptions(start, end, step, path, fps)
    if film.given:
        if light is not None:
            raise InputError("--light", light, f"nothing beside {film.given[0]}: films are of all lights")
        sun, look = parse_sun(time, azimuth, altitude), Appearance(style, slope_exaggeration)
        view_options = _size(size), _bounds(bounds), crs, seconds
        render_film(level, output, film, view, layer, sun, overrides_of("render", asked), *view_options, look, stats)
        return
    check_suffix(layer, output)
    check_targets(level, [("--output", output), ("--stats", stats)])
    overrides = overrides_of("render", asked)
    with _progress("Rendering") as advance:
        sun, shape = parse_sun(time, azimuth, altitude), _size(size)
        kept = frozenset(pass_layer for pass_layer in PASS_LAYERS if pass_layer == layer)
        look = Appearance(style, slope_exaggeration)
        scene, frame = snapshot(level, view, sun, overrides, shape, _bounds(bounds), crs, advance, seconds, kept, look)
    write_layer(scene, frame.under(light), layer, output)
    if stats is not None:
        write_whole(stats, json.dumps(statistics(scene, frame), indent=2) + "\n")


@app.command("shade")
@takes_level
@with_shadow_options("render")
def shade_raster(
    level: LevelSource,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="GeoTIFF to write (COG); of several times {time} in its name stands for each.")
    ],
    layer: Annotated[str, typer.Option(help=f"{', '.join(SHADE_LAYERS)}.")] = "mask",
    time: TimeOption = None,
    times: Annotated[str | None, typer.Option(metavar="T,T,...", help="Several times, in one run.")] = None,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help="The first of many times, ...")] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="TIME", help="... the last, ...")] = None,
    step: Annotated[str | None, typer.Option(metavar="15m", help="... and what lies between two: as 15m, 1h or 1d.")] = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    resolution: Annotated[float | None, typer.Option(help="Side of a cell, in units of the output CRS.")] = None,
    like: Annotated[Path | None, typer.Option(metavar="RASTER", help="Write the cells of this raster.")] = None,
    stac: Annotated[
        Path | None,
        typer.Option(metavar="ITEM.json", help="The sun, or the time, of a STAC item, and its finest cells if it has any."),
    ] = None,
    **asked: Any,
) -> None:
    """Write the shade of a raster of any size, by default on its own grid."""
    from api.cli.shading import scene_of_item, shade_level

    overrides = overrides_of("render", asked)
    cells: Path | RasterCells | None = like
    suns = suns_of(parse_sun(time, azimuth, altitude), times, start, end, step)
    if stac is not None:
        check_targets(level, [("--output", output)], stac)
        suns, cells = scene_of_item(stac, suns, like, free=bounds is None and crs is None and resolution is None)
    with _progress("Shading") as advance:
        shade_level(level, output, layer, suns, _bounds(bounds), crs, resolution, cells, overrides, advance)


app.command("seed")(seed)


@app.command("point")
@takes_level
def sun_at_point(
    level: LevelSource,
    at: Annotated[str | None, typer.Option(metavar="LON,LAT", help="The point: degrees; or x,y of --crs.")] = None,
    crs: Annotated[str | None, typer.Option(metavar="EPSG", help="CRS of the point.")] = None,
    time: TimeOption = None,
    date: Annotated[str | None, typer.Option(help="Day, as 2024-10-21; default: that of --time, else today.")] = None,
    clock: Annotated[str | None, typer.Option(help="solar, utc, +02:00 or Europe/Oslo; default: the offset of --time.")] = None,
    height: Annotated[float, typer.Option(help="Metres above the ground.")] = 0.0,
    year: Annotated[int | None, typer.Option(help="Hours of sun of each day of a year.")] = None,
    horizon: Annotated[
        str | None,
        typer.Option(metavar="FORMAT", help=f"Print the horizon instead, or write it to --output: {', '.join(HORIZON_FORMATS)}."),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE", help="File for --horizon.")] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the horizon and the sun's paths: .svg or .png.")
    ] = None,
    points: Annotated[Path | None, typer.Option(metavar="FILE", help="Many points: .csv (lon, lat), .gpkg, .geojson ...")] = None,
    line: Annotated[Path | None, typer.Option(metavar="FILE", help="A track: a line of any vector file.")] = None,
    start: Annotated[str | None, typer.Option(help="When the track begins: ISO 8601 with an offset.")] = None,
    speed: Annotated[float, typer.Option(help="Along the track, km/h.")] = 4.5,
    every: Annotated[float, typer.Option(help="Metres between places of the track, at most.", min=0.1)] = 100.0,
    as_json: JsonOption = False,
) -> None:
    """The sun at a point: lit or not and by what, a day's sun, the horizon."""
    from api.cli.point import PointOptions, check_point_options, report_line, report_point, report_points

    sun = parse_sun(time, None, None)
    asked = PointOptions(at, crs, sun, date, clock, height, year, horizon, output, picture, as_json)
    check_point_options(asked, points, line, start)
    if points is not None:
        report_points(level, points, asked)
    elif line is not None:
        report_line(level, line, asked, start, speed, every)
    else:
        report_point(level, asked)


@app.command("sunhours")
@takes_level
def sun_hours_raster(
    level: LevelSource,
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write (COG).")],
    date: Annotated[str, typer.Option(metavar="DATE", help="The date, or the first of many, as 2024-03-21.")],
    last: Annotated[str | None, typer.Option("--to", metavar="DATE", help="The last of many dates, ...")] = None,
    every: Annotated[str, typer.Option(metavar="1d", help="... and what lies between two.")] = "1d",
    window: Annotated[str, typer.Option(metavar="HH:MM-HH:MM", help="The part of each day that counts.")] = "00:00-24:00",
    clock: Annotated[
        str, typer.Option(help="What dates and windows go by: solar (true solar time), utc, an offset, or a zone as Europe/Oslo.")
    ] = "solar",
    step: Annotated[
        str,
        typer.Option(
            metavar="5m",
            help="Time between two suns (crossings in between are found), or auto: as long as hours stay right on that ground.",
        ),
    ] = "auto",
    quantity: Annotated[str, typer.Option(help="hours (mean of the dates), first, last, longest or days.")] = "hours",
    threshold: Annotated[str, typer.Option(metavar="2h", help="Sun that a day needs to count, for days.")] = "2h",
    least_altitude: Annotated[float, typer.Option(help="Least altitude of a sun that counts, degrees.")] = 0.0,
    height: Annotated[float, typer.Option(help="Height above the ground from which the sun is seen, metres.")] = 0.0,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    resolution: Annotated[float | None, typer.Option(help="Side of a cell, in units of the output CRS.")] = None,
    like: Annotated[Path | None, typer.Option(metavar="RASTER", help="Write the cells of this raster.")] = None,
    contours: Annotated[Path | None, typer.Option(metavar="FILE.gpkg", help="Write contours, too.")] = None,
    levels: Annotated[str, typer.Option(metavar="V,V,...", help="Values of the contours.")] = "1,2,3,4,6,8,10,12",
) -> None:
    """Write hours of sun, first or last sun of a raster of any size, over dates and daily windows."""
    from api.cli.sunning import rules_of, write_sun_level

    rules = rules_of(step, threshold, least_altitude, height)
    lines = None if contours is None else (contours, levels)
    with _progress("Following the sun") as advance:
        write_sun_level(
            level, output, quantity, (date, last, every), window, clock, rules,
            (_bounds(bounds), crs, resolution, like), lines, advance,
        )  # fmt: skip


@app.command()
@takes_level
@with_shadow_options("select")
def select(
    level: LevelSource,
    view: ViewOption = "map",
    policy: Annotated[
        str,
        typer.Option(
            help="rules: fixed rules; predict: cost and error models of this device; probe: the same, corrected by candidates that "
            "are drawn and compared with ray-traced truth; measure: a probe without a limit of time (minutes)."
        ),
    ] = "probe",
    budget: Annotated[str | None, typer.Option(metavar="TIME", help="Time of a probe, as 3s (the default) or 1m.")] = None,
    as_json: JsonOption = False,
    write: Annotated[bool, typer.Option("--write", help="Pin the choice into the level file.")] = False,
    all_views: Annotated[
        bool, typer.Option("--all-views", help="Choose for each view of the level, and for its tiles (map); prints a table.")
    ] = False,
    all_scales: Annotated[
        bool,
        typer.Option(
            "--all-scales",
            help="Probe the level's maps and tiles at all their scales; prints a table. --write keeps what was seen in the user's "
            "cache: services make plans of tiles by it.",
        ),
    ] = False,
    descriptor: Annotated[
        Path | None, typer.Option(metavar="FILE.json", help="Write the facts of the view to a file; POST /plan accepts it.")
    ] = None,
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    size: SizeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    seconds: SecondsOption = None,
    **asked: Any,
) -> None:
    """Choose algorithms and settings for a view, and say why; or for all views of a level."""
    from api.cli.planning import pin_plan, plan_level_view, write_descriptor
    from api.report.plan_text import format_plan

    check_targets(level, [("--descriptor", descriptor)])
    overrides = overrides_of("select", asked)
    if all_views or all_scales:
        from api.cli.all_views import refuse_beside

        option = "--all-views" if all_views else "--all-scales"
        refuse_beside(option, view, {"size": size, "bounds": bounds, "crs": crs, "descriptor": descriptor})
    if all_scales:
        refuse_beside("--all-scales", view, {"all-views": all_views or None, "seconds": seconds})
        _probe_all_scales(level, policy, overrides, parse_sun(time, azimuth, altitude), budget, as_json, write)
        return
    if all_views:
        _select_all(level, policy, budget, overrides, parse_sun(time, azimuth, altitude), seconds, as_json, write)
        return
    view_options = parse_sun(time, azimuth, altitude), _size(size), _bounds(bounds), crs, seconds
    with _waiting({"measure": "Measuring", "probe": "Probing"}.get(policy, "Choosing")):
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
    from api.cli.all_views import pin_all, plan_all_views, rows_of, table_of

    with _waiting("Choosing for all views"):
        choices = plan_all_views(level, policy, overrides, sun, seconds, ignore_pins=write, budget=budget)
        message = pin_all(choices) if write else None
    _print_choices(rows_of(choices), table_of(choices), as_json, message)


def _print_choices(rows: list[dict[str, Any]], table: Table, as_json: bool, message: str | None) -> None:
    """Print choices as JSON or as a table, and what was written."""
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
    from api.cli.all_scales import probe_all_scales, rows_of_scales, table_of_scales

    with _waiting("Probing at all scales"):
        plans, message = probe_all_scales(level, policy, overrides, sun, budget, write)
    _print_choices(rows_of_scales(plans), table_of_scales(plans), as_json, message)


@app.command()
def calibrate(as_json: JsonOption = False) -> None:
    """Calibrate this device for the policy `predict`."""
    from api.device_calibration import format_calibration
    from selector.cost.calibration import calibrate as measure
    from selector.cost.device_profile import save_profile

    with _progress("Calibrating") as advance:
        profile = measure(advance)
    path = save_profile(profile)
    typer.echo(profile.model_dump_json(indent=2) if as_json else format_calibration(profile, path))


@app.command()
@takes_level
def compare(
    level: LevelSource,
    context: typer.Context,
    view: ViewOption = "map",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write report.html and error pictures.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the rows as JSON.")] = None,
    time: TimeOption = None,
    azimuth: AzimuthOption = None,
    altitude: AltitudeOption = None,
    size: SizeOption = None,
    bounds: BoundsOption = None,
    crs: CrsOption = None,
    light: Annotated[str | None, typer.Option(help="The light to compare; default: the sun, else the first one.")] = None,
    fine: Annotated[bool, typer.Option("--fine", help="16 sub-samples a pixel instead of 4.")] = False,
    time_limit: Annotated[
        float | None, typer.Option(min=0.0, metavar="S", help="Time limit for all rows and repeats, seconds; default: 70.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="ROW", help="Only the row of this name; may be given several times.")
    ] = None,
) -> None:
    """Compare algorithms and settings with ray-traced truth: error against time."""
    from api.cli.snapshot import scene_and_view
    from api.report.comparison import check_outputs, show, write
    from selector.measure.compare import TIME_LIMIT_S
    from selector.measure.compare import compare as measure

    sun, shape = parse_sun(time, azimuth, altitude), _size(size)
    check_outputs(output, json_file)
    pictures = [] if output is None else sorted(output.glob("*.png"))
    check_targets(level, [("--json", json_file), *(("--output", each) for each in pictures)])
    scene, view_value = scene_and_view(level, view, sun, shape, _bounds(bounds), crs)
    with _progress("Comparing") as advance:
        limit_s = TIME_LIMIT_S if time_limit is None else time_limit
        comparison = measure(scene, view_value, view, fine, advance, light, limit_s, only=only or ())
    again = same_command(context, "output", "json_file", "time_limit", "only")
    show(comparison, again)
    if output is not None:
        write(scene, comparison, output, view, again)
    if json_file is not None:
        rows = [row.figures for row in comparison.rows]
        write_whole(json_file, json.dumps(rows, indent=2) + "\n")


@app.command()
@takes_level
def init(
    level: LevelSource,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Level file to write; default: NAME.yaml.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over a file that is there.")] = False,
) -> None:
    """Write the level file of a raster, with views, and with comments on what else it may say."""
    from api.cli.first_level import write_first_level

    path = write_first_level(level, output, force)
    typer.echo(printable(f"Wrote {path}. To see it: skugga serve {path}"))


@app.command()
def levels(as_json: JsonOption = False) -> None:
    """List the bundled levels."""
    from api.catalogue import summary

    rows = [summary(path) for path in bundled_levels()]
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("name", "title", "bounds (west, south, east, north)", "views", box=None)
    for row in rows:
        bounds = "flat world" if row["bounds"] is None else ", ".join(f"{v:.3f}" for v in row["bounds"])
        table.add_row(row["name"], row["title"], bounds, ", ".join(row["views"]))
    Console().print(table)


@app.command()
@takes_level
def validate(level: LevelSource) -> None:
    """Check a level file and the data it names."""
    from api.catalogue import remarks, summary

    row, notes = summary(level), remarks(level)
    typer.echo(printable(f"{level.path}: right. {row['title'] or row['name']}; views: {', '.join(row['views'])}"))
    for remark in notes:
        typer.echo(printable(f"  note: {remark}"))


@app.command("overviews")
def raster_overviews(
    raster: Annotated[Path, typer.Argument(metavar="RASTER", help="A raster of heights, a virtual one too.", exists=True)],
    nodata: Annotated[float | None, typer.Option(metavar="VALUE", help="Its value of cells without a height.")] = None,
) -> None:
    """Make overviews of a big raster beside it, in RASTER.ovr; the raster itself is only read."""
    from api.overviews import make_overviews, missing_overviews

    if (why_none := missing_overviews(raster)) is not None:
        typer.echo(printable(why_none))
        return
    with _progress("Averaging") as advance:
        path = make_overviews(raster, nodata, advance)
    typer.echo(printable(f"Wrote {path}"))


@app.command("compile")
def compile_loops() -> None:
    """Compile all loops ahead, for this user and processor, so that no later command waits for it."""
    from api.cli.compiling import compile_everything

    typer.echo(compile_everything(_progress))


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Check OpenGL and packages of this machine, and name what is missing."""
    findings = doctor_checks.examine()
    if as_json:
        typer.echo(json.dumps([finding.__dict__ for finding in findings], indent=2))
    else:
        for finding in findings:
            typer.echo(f"{'ok     ' if finding.ok else 'MISSING'}  {finding.subject}: {finding.detail}")
    if not all(finding.ok for finding in findings):
        raise typer.Exit(1)


def main() -> None:
    """Entry point of ``skugga``."""
    debug = "--debug" in sys.argv[1:]
    forbid_code()
    cap_caches()
    try:
        with _ended_in_order(), compiled_by(_compile_products):
            status = app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except _UsageError as error:
        status = _fail(error.format_message(), 2)
    except typer.Abort:
        status = _fail("interrupted", 1)
    except SkuggaError as error:
        if debug:
            raise
        status = _fail(str(error), exit_status(error), several=isinstance(error, InputError) and bool(error.others))
    except OSError as error:
        if debug:
            raise
        status = _fail(f"{error.filename or 'output'}: {error.strerror or error}", 1)
    except Exception as error:
        if debug:
            raise
        status = _fail(f"internal error, {type(error).__name__}: {error}; --debug shows where", 1)
    sys.exit(status if isinstance(status, int) else 0)


def _compile_products(products: Sequence[str]) -> None:
    from api.cli.compiling import compile_for_command

    compile_for_command(products, _progress)


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """Signals that end a process end it by an exception, so that it leaves no half-written file beside its output."""

    def end(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)  # once is enough: what follows removes files
        sys.exit(128 + number)

    numbers = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _fail(message: str, status: int, several: bool = False) -> int:
    """Say what went wrong: one line, or one for each of ``several`` errors."""
    for line in message.split("\n") if several else [message]:
        typer.echo(printable(f"skugga: {' '.join(line.split())}"), err=True)
    return status


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, cross, height = text.lower().partition("x")
    if not (
        cross and text.isascii() and width.isdigit() and height.isdigit() and 1 <= int(width) <= 16384 and 1 <= int(height) <= 16384
    ):
        raise InputError("--size", text, "WxH, 1x1 to 16384x16384, as 1280x1024")
    return int(width), int(height)


def _bounds(text: str | None) -> tuple[float, float, float, float] | None:
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--bounds", text, "W,S,E,N: four numbers in units of the output CRS") from None
    return west, south, east, north


@contextmanager
def _waiting(task: str) -> Iterator[None]:
    """A sign of life on a terminal, for work that does not tell how far it is."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(task):
        yield


class _progress:  # noqa: N801  (used as a function)
    """A progress bar on a terminal for work of more than a few blocks; silent elsewhere."""

    def __init__(self, task: str) -> None:
        self._what = task
        self._bar: Any = None

    def __enter__(self) -> Any:
        return self._advance

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _advance(self, done: int, total: int) -> None:
        if total < 4 or not sys.stderr.isatty():
            return
        if self._bar is None:
            from rich.console import Console
            from rich.progress import Progress

            self._bar = Progress(console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task(self._what, total=total)
            self._bar.start()
        self._bar.update(self._task, completed=done)
