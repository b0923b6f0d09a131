"""Polar chart of the sky over a point: the horizon of ground, roofs and trees, and the paths of the sun.

* North is up and east is right, as on a map.
* The rim is the level horizon and the centre is the zenith; the radius is linear in altitude.
* Hours are those of the clock of the place.
"""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta, tzinfo
from typing import Any

import numpy as np

from skugga.api.point.charts import (
    FOREST_COLOR,
    GRID_COLOR,
    INK_COLOR,
    LABEL_COLOR,
    PAPER_COLOR,
    RELIEF_COLOR,
    SOLIDS_COLOR,
    SUN_COLOR,
    ChartFormat,
    chart_file,
    place_text,
)
from skugga.shadows.point.horizon import PointHorizon, Surroundings, sees_sun
from skugga.shadows.point.sun_angles import sun_angles_at, sun_samples
from skugga.terrain.geo.clock import day_bounds

PATH_STEP_S = 120.0
"""Time between two points of a sun path."""

MIN_LABEL_DIFFERENCE_DEG = 6.0
"""A path is labelled if its highest altitude differs from that of the day by more than this, degrees."""

MIN_OUTWARD_LABEL_ALTITUDE_DEG = 6.0
"""Altitude above which an hour's number lies on the outer side of its mark, degrees."""

CHART_SIDE_INCHES = 8.0
"""Side of the square chart."""

_SKY_COLOR, _SUN_EDGE_COLOR, _HIDDEN_PATH_COLOR, _OTHER_PATH_COLOR = "#f4f8fb", "#b97f00", "#3f3a34", "#7f9fbf"


def sky_picture(
    surroundings: Surroundings, horizon: PointHorizon, day: date, clock: tzinfo, format: ChartFormat, title: str
) -> bytes:
    """Return the chart as an SVG or PNG file: the horizon and the sun's paths of a day, the solstices and the equinox.

    ``day`` is a day of ``clock``, whose hours are marked. ``title`` stands above the chart. The chart of a flat world has only the
    horizon.
    """

    def draw(figure: Any) -> None:
        axes = figure.add_axes((0.07, 0.085, 0.86, 0.80), projection="polar")
        _draw_axes(axes)
        _draw_horizon(axes, horizon)
        has_sun = surroundings.scene.world.off_earth_reason is None
        if has_sun:
            _draw_paths(axes, surroundings, day, clock)
        figure.text(0.06, 0.98, title, fontsize=12.5, fontweight="bold", color=INK_COLOR, va="top")
        figure.text(0.06, 0.951, _subtitle(surroundings, day, clock), fontsize=9.5, color=INK_COLOR, va="top")
        _draw_legend(figure, horizon, not has_sun)

    return chart_file((CHART_SIDE_INCHES, CHART_SIDE_INCHES + 0.95), format, draw)


def _draw_axes(axes: Any) -> None:
    """Draw the empty chart: axes, grid and labels."""
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_facecolor(_SKY_COLOR)
    axes.set_ylim(0.0, 90.0)
    axes.set_yticks([30.0, 60.0], labels=["", ""])
    for altitude in (30, 60):
        axes.text(
            np.radians(2.5), 90.0 - altitude, f"{altitude}°", fontsize=7.5, color=LABEL_COLOR, ha="left", va="bottom", zorder=9
        )
    axes.set_xticks(np.radians(np.arange(0, 360, 30)))
    words = {0: "N", 90: "E", 180: "S", 270: "W"}
    axes.set_xticklabels([words.get(azimuth, f"{azimuth}°") for azimuth in range(0, 360, 30)])
    for label, azimuth in zip(axes.get_xticklabels(), range(0, 360, 30), strict=True):
        cardinal = azimuth in words
        label.set(
            fontsize=13 if cardinal else 8.5,
            fontweight="bold" if cardinal else "normal",
            color=INK_COLOR if cardinal else LABEL_COLOR,
        )
    axes.tick_params(axis="x", pad=3)
    axes.grid(color=GRID_COLOR, linewidth=0.6)
    axes.spines["polar"].set(color=INK_COLOR, linewidth=1.0)
    axes.set_axisbelow(True)


def _draw_horizon(axes: Any, horizon: PointHorizon) -> None:
    """Draw the horizon from the rim inwards. Trees and roofs are visible where they rise above the ground's horizon."""
    angle = np.radians(np.append(horizon.azimuth_deg, 360.0))
    for height, color, order in (
        (horizon.forest_deg, FOREST_COLOR, 2.0), (horizon.solids_deg, SOLIDS_COLOR, 2.1),
        (horizon.relief_deg, RELIEF_COLOR, 2.2),
    ):  # fmt: skip
        top = 90.0 - np.maximum(np.append(height, height[0]), 0.0)
        axes.fill_between(angle, top, 90.0, color=color, linewidth=0.0, zorder=order)
    top = 90.0 - np.maximum(np.append(horizon.elevation_deg, horizon.elevation_deg[0]), 0.0)
    axes.plot(angle, top, color="#4a443b", linewidth=0.7, zorder=2.3)


def _draw_paths(axes: Any, surroundings: Surroundings, day: date, clock: tzinfo) -> None:
    """Draw the sun's paths: the solstices and the equinox thin, and the requested day bold where the sun reaches the point."""
    day_azimuth, day_altitude = _sun_path(surroundings, day, clock)
    max_altitude = np.nanmax(day_altitude) if np.isfinite(day_altitude).any() else -90.0
    for number, (month, day_of_month) in enumerate(((6, 21), (3, 20), (12, 21))):
        azimuth, altitude = _sun_path(surroundings, date(day.year, month, day_of_month), clock)
        axes.plot(np.radians(_unwrap_azimuth(azimuth)), 90.0 - altitude, color=_OTHER_PATH_COLOR, linewidth=1.1, zorder=3)
        if np.isfinite(altitude).any() and abs(np.nanmax(altitude) - max_altitude) > MIN_LABEL_DIFFERENCE_DEG:
            _label_path(axes, azimuth, altitude, ("21 June", "20 March", "21 December")[number])
    azimuth, altitude = day_azimuth, day_altitude
    lit = sees_sun(surroundings, azimuth, np.nan_to_num(altitude, nan=-90.0))
    angle = np.radians(_unwrap_azimuth(azimuth))
    axes.plot(angle, 90.0 - altitude, color=_HIDDEN_PATH_COLOR, linewidth=1.6, linestyle=(0, (3, 2)), zorder=4)
    shining = np.where(lit, 90.0 - altitude, np.nan)
    axes.plot(angle, shining, color=_SUN_EDGE_COLOR, linewidth=4.6, solid_capstyle="round", zorder=4.1)
    axes.plot(angle, shining, color=SUN_COLOR, linewidth=3.2, solid_capstyle="round", zorder=4.2)
    _draw_hours(axes, surroundings, day, clock, bool(np.isfinite(altitude).any()))


def _sun_path(surroundings: Surroundings, day: date, clock: tzinfo) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and altitudes of the sun through a day, degrees. Altitudes below the level horizon are NaN."""
    begin, end = (moment.astimezone(UTC).timestamp() for moment in day_bounds(day, clock))
    azimuth, altitude = sun_angles_at(surroundings.place, sun_samples(surroundings.scene.world, begin, end, PATH_STEP_S)[1])
    return azimuth, np.where(altitude > 0.0, altitude, np.nan)


def _unwrap_azimuth(azimuth_deg: np.ndarray) -> np.ndarray:
    """Return azimuths in degrees without jumps of 360 degrees."""
    return np.unwrap(azimuth_deg, period=360.0)


def _label_path(axes: Any, azimuth: np.ndarray, altitude: np.ndarray, name: str) -> None:
    """Write ``name`` at the highest point of a path. ``azimuth`` and ``altitude`` are the path's points (n,) in degrees."""
    top = int(np.nanargmax(altitude))
    axes.annotate(
        name, (np.radians(azimuth[top]), 90.0 - altitude[top]), xytext=(0, 5), textcoords="offset points", fontsize=7.5,
        color="#4c6f93", ha="center", va="bottom", zorder=6,
        bbox={"facecolor": _SKY_COLOR, "edgecolor": "none", "pad": 0.4, "alpha": 0.75},
    )  # fmt: skip


def _draw_hours(axes: Any, surroundings: Surroundings, day: date, clock: tzinfo, has_path: bool) -> None:
    """Mark full hours on all paths, and number them on the day's path.

    ``has_path`` is false if the sun does not rise on the day; no hours are numbered then.
    """
    days = [date(day.year, 6, 21), date(day.year, 3, 20), date(day.year, 12, 21), day]
    for path_day in days:
        first = day_bounds(path_day, clock)[0]
        moments = [datetime(path_day.year, path_day.month, path_day.day, hour, tzinfo=clock) for hour in range(24)]
        begin = first.astimezone(UTC).timestamp()
        times_s, to_sun = sun_samples(surroundings.scene.world, begin, begin + 86400.0, PATH_STEP_S)
        seconds = np.array([moment.astimezone(UTC).timestamp() for moment in moments])
        nearest = np.clip(np.searchsorted(times_s, seconds), 0, len(times_s) - 1)
        azimuth, altitude = sun_angles_at(surroundings.place, to_sun[nearest])
        is_day = path_day == day
        for hour in np.flatnonzero(altitude > 0.0):
            angle, radius = np.radians(azimuth[hour]), 90.0 - altitude[hour]
            size = 5.0 if is_day else 2.6
            axes.plot(
                [angle], [radius], "o", markersize=size, color=PAPER_COLOR if is_day else _OTHER_PATH_COLOR,
                markeredgecolor=INK_COLOR if is_day else _OTHER_PATH_COLOR, markeredgewidth=0.9 if is_day else 0.0, zorder=5,
            )  # fmt: skip
            if is_day and has_path:
                axes.annotate(
                    f"{hour}", (angle, radius), xytext=_number_offset(azimuth[hour], altitude[hour]), textcoords="offset points",
                    fontsize=8.5, fontweight="bold", color=INK_COLOR, ha="center", va="center", zorder=7,
                    bbox={"facecolor": PAPER_COLOR, "edgecolor": "none", "pad": 0.6, "alpha": 0.7, "boxstyle": "round,pad=0.15"},
                )  # fmt: skip


def _number_offset(azimuth_deg: float, altitude_deg: float) -> tuple[float, float]:
    """Return the offset of an hour's number from its mark, in points.

    The offset is towards the rim. Near the rim it is towards the centre, so that the number does not overlap azimuth labels.
    """
    angle, radius = np.radians(azimuth_deg), 11.0 if altitude_deg > MIN_OUTWARD_LABEL_ALTITUDE_DEG else -11.0
    return float(radius * np.sin(angle)), float(radius * np.cos(angle))


def _subtitle(surroundings: Surroundings, day: date, clock: tzinfo) -> str:
    """Return the line below the title: the position, the height, the day and its clock."""
    place = surroundings.place
    text = place_text(place.lon_deg, place.lat_deg, place.ground_m, place.height_m)
    return text if place.lon_deg is None else f"{text}    {day:%-d %B %Y}, {_clock_label(day, clock)}"


def _clock_label(day: date, clock: tzinfo) -> str:
    """Return the name of a clock and its offset from UTC on a day, as text."""
    noon = datetime(day.year, day.month, day.day, 12, tzinfo=clock)
    name = noon.tzname() or ""
    if name == "solar":
        return "true solar time"
    offset = noon.utcoffset() or timedelta()
    minutes = round(offset.total_seconds() / 60.0)
    offset_text = f"UTC{'+' if minutes >= 0 else '−'}{abs(minutes) // 60}" + (f":{abs(minutes) % 60:02d}" if minutes % 60 else "")
    return offset_text if name.startswith("UTC") else f"{name} ({offset_text})"


def _draw_legend(figure: Any, horizon: PointHorizon, is_flat_world: bool) -> None:
    """Draw the legend of the chart. Roofs and trees are listed only if they rise above the ground's horizon somewhere."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(color=RELIEF_COLOR, label="ground")]
    if (horizon.solids_deg > np.maximum(horizon.relief_deg, 0.0)).any():
        handles.append(Patch(color=SOLIDS_COLOR, label="roofs and models"))
    if (horizon.forest_deg > np.maximum(horizon.relief_deg, 0.0)).any():
        handles.append(Patch(color=FOREST_COLOR, label="trees"))
    if not is_flat_world:
        handles += [
            Line2D([], [], color=SUN_COLOR, linewidth=3.2, label="direct sun"),
            Line2D([], [], color=_HIDDEN_PATH_COLOR, linewidth=1.6, linestyle=(0, (3, 2)), label="sun hidden"),
            Line2D([], [], color=_OTHER_PATH_COLOR, linewidth=1.1, label="solstices, equinox"),
        ]
    figure.legend(
        handles=handles, loc="lower center", bbox_to_anchor=(0.5, 0.012), ncols=len(handles), frameon=False, fontsize=9,
        labelcolor=INK_COLOR, handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip
