"""``skugga sunhours``: from its options to files."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

from skugga.api.cli.outputs import check_targets
from skugga.api.cli.shading import SUFFIXES
from skugga.api.cli.times import duration_of
from skugga.api.cli.warnings import say_reach_beside, say_warnings, say_written
from skugga.api.shade import Bounds, raster_view
from skugga.api.sun_hours import write_sun_hours
from skugga.api.sun_quantities import QUANTITIES, QUANTITY_NOTES
from skugga.shadows.sun_hours.sun_hours import SunRules
from skugga.terrain.compiling.ahead import SUN_HOURS
from skugga.terrain.compiling.hooks import need
from skugga.terrain.errors import InputError
from skugga.terrain.geo.clock import clock_named, date_of
from skugga.terrain.geo.daily_windows import readings_of, windows_asked
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import build_scene


def write_sun_level(
    level: LevelSource,
    output: Path,
    quantity: str,
    dates: tuple[str, str | None, str],
    window: str,
    clock: str,
    rules: SunRules,
    where: tuple[Bounds | None, str | None, float | None, Path | None],
    contours: tuple[Path, str] | None,
    on_block: Callable[[int, int], None] | None = None,
) -> None:
    """Write a quantity of a level's sun, and its contours. Raises ``SkuggaError`` and ``OSError``."""
    if output.suffix.lower() not in SUFFIXES:
        raise InputError("--output", str(output), f"a GeoTIFF: {' or '.join(SUFFIXES)}")
    if quantity not in QUANTITIES:
        raise InputError("--quantity", quantity, ", ".join(QUANTITIES))
    lines = None if contours is None else (contours[0], _values(contours))
    check_targets(level, [("--output", output), ("--contours", None if contours is None else contours[0])], where[-1])
    known_clock, readings = clock_named("clock", clock), readings_of(window)
    first = date_of("date", dates[0])
    last = first if dates[1] is None else date_of("to", dates[1])
    every = duration_of("every", dates[2])
    if every % timedelta(days=1):
        raise InputError("every", dates[2], "whole days, as 7d")
    need(SUN_HOURS)
    scene = build_scene(load_level(level))
    say_warnings(scene)
    try:
        windows = windows_asked(scene.world, first, last, every.days, readings, known_clock)
        raster = raster_view(scene, *where)
        if where[-1] is not None:
            say_reach_beside(scene, raster)
        write_sun_hours(scene, raster, windows, rules, {quantity: output}, on_block, lines, clock)
        about, unit = QUANTITY_NOTES[quantity]
        say_written([output], f"{about} ({unit})", raster)
    finally:
        scene.close()


def rules_of(step: str, threshold: str, least_altitude: float, height: float) -> SunRules:
    """What counts as sun, of the options. Raises ``InputError``."""
    minutes = None if step == "auto" else duration_of("--step", step) / timedelta(minutes=1)
    if minutes is not None and not 0.5 <= minutes <= 60.0:
        raise InputError("--step", step, "30s to 1h, or auto")
    if not -1.0 <= least_altitude < 90.0:
        raise InputError("--least-altitude", least_altitude, "degrees above the horizon, -1 to 90")
    if not 0.0 <= height <= 1000.0:
        raise InputError("--height", height, "metres above the ground, 0 to 1000")
    return SunRules(minutes, duration_of("--threshold", threshold) / timedelta(hours=1), least_altitude, height)


def _values(contours: tuple[Path, str]) -> list[float]:
    path, text = contours
    if path.suffix.lower() != ".gpkg":
        raise InputError("--contours", str(path), "a GeoPackage: .gpkg")
    try:
        values = sorted({float(part) for part in text.split(",")})
    except ValueError:
        values = []
    if not values or not all(abs(value) < 1e6 for value in values):
        raise InputError("--levels", text, "numbers, as 1,2,3: of hours, or of minutes from midnight for first and last")
    return values
