"""Bar chart of the irradiation at a point: what each month receives, and what terrain, buildings and trees take from it."""

from __future__ import annotations

from datetime import date
from typing import Any

import numpy as np

from skugga.api.point.charts import (
    FOREST_COLOR,
    GRID_COLOR,
    INK_COLOR,
    LABEL_COLOR,
    PAPER_COLOR,
    REFLECTED_COLOR,
    RELIEF_COLOR,
    SKY_LIGHT_COLOR,
    SOLIDS_COLOR,
    SUN_COLOR,
    ChartFormat,
    chart_file,
    place_text,
)
from skugga.api.point.irradiation_values import IrradiationSums, PointIrradiationReport
from skugga.terrain.errors import InputError

SIZE_INCHES = 9.0, 5.6
"""Width and height of the chart."""

BAR_WIDTH = 0.72
"""Width of a bar; 1 is the distance between two months."""

MAX_LABELS = 12
"""Maximum number of months with a label."""

LOSS_HATCH = "/////"
"""Hatch of light that is lost."""

TINT_SHARE = 0.25
"""Share of a colour in the tint below its hatch; the rest is paper."""

_LAYER_COLORS = {
    "direct sun": SUN_COLOR, "sky": SKY_LIGHT_COLOR, "reflected": REFLECTED_COLOR,
    "lost to surface": RELIEF_COLOR, "lost to buildings": SOLIDS_COLOR, "lost to trees": FOREST_COLOR,
}  # fmt: skip
"""Colours of the layers of a bar, from below to above."""

LOSSES = ("lost to surface", "lost to buildings", "lost to trees")

MIN_LOSS_SHARE = 5e-4
"""Share of the light under an open sky below which a loss of all months has no entry in the legend."""


def irradiation_chart(report: PointIrradiationReport, format: ChartFormat, title: str) -> bytes:
    """Return the chart of a report as an SVG or PNG file. ``title`` stands above it.

    Raises ``InputError`` for a report off the level's data, which has no values.
    """
    if report.months is None or report.all_months is None:
        raise InputError("point", f"{report.lon},{report.lat}", "a place on the level's data")

    def draw(figure: Any) -> None:
        axes = figure.add_axes((0.085, 0.16, 0.885, 0.68))
        handles, labels = _draw_bars(axes, report)
        _draw_axes(axes, [month.month for month in report.months or ()])
        figure.text(0.03, 0.972, title, fontsize=12.5, fontweight="bold", color=INK_COLOR, va="top")
        place = place_text(report.lon, report.lat, report.elevation_m or 0.0, report.height_m)
        figure.text(0.03, 0.927, f"{place}    {_plane_text(report)}", fontsize=9.5, color=INK_COLOR, va="top")
        figure.text(0.03, 0.888, _sum_text(report), fontsize=9.5, color=INK_COLOR, va="top")
        figure.legend(
            handles=handles, labels=labels, loc="lower center", bbox_to_anchor=(0.5, 0.015), ncols=len(handles), frameon=False,
            fontsize=9, labelcolor=INK_COLOR, handlelength=1.3, columnspacing=1.3,
        )  # fmt: skip

    return chart_file(SIZE_INCHES, format, draw)


def _draw_bars(axes: Any, report: PointIrradiationReport) -> tuple[list[Any], list[str]]:
    """Draw the bars of all months, and return the entries of the legend and their names, from below to above."""
    months, everything = report.months or (), report.all_months
    assert everything is not None
    position, base = np.arange(len(months)), np.zeros(len(months))
    handles: list[Any] = []
    labels: list[str] = []
    for name, color in _LAYER_COLORS.items():
        value = np.array([_layers(month)[name] for month in months])
        is_loss = name in LOSSES
        if is_loss and _layers(everything)[name] <= MIN_LOSS_SHARE * everything.open_sky:
            continue
        bars = axes.bar(position, value, BAR_WIDTH, base, zorder=3, color=_tint(color) if is_loss else color, linewidth=0.0)
        handle: Any = bars
        if is_loss:  # programs that draw no patterns of an SVG, such as QGIS, show the tint alone
            hatch = {"facecolor": "none", "edgecolor": color, "linewidth": 0.0, "hatch": LOSS_HATCH}
            handle = (bars, axes.bar(position, value, BAR_WIDTH, base, zorder=3, **hatch))
        handles.append(handle)
        labels.append(name)
        base += value
    outline = {"color": "none", "edgecolor": INK_COLOR, "linewidth": 0.6, "zorder": 4}
    outlines = axes.bar(position, [month.open_sky for month in months], BAR_WIDTH, **outline)
    return [*handles, outlines], [*labels, "under an open sky"]


def _tint(color: str) -> tuple[float, ...]:
    """Return the tint below the hatch of a colour, RGB of 0 to 1."""
    from matplotlib.colors import to_rgb

    return tuple(
        TINT_SHARE * ink + (1.0 - TINT_SHARE) * paper for ink, paper in zip(to_rgb(color), to_rgb(PAPER_COLOR), strict=True)
    )


def _layers(sums: IrradiationSums) -> dict[str, float]:
    """Return the layers of a bar by name, kWh/m2."""
    return {
        "direct sun": sums.beam + sums.circumsolar,
        "sky": sums.sky + sums.horizon_band,
        "reflected": sums.reflected,
        "lost to surface": sums.lost("relief"),
        "lost to buildings": sums.lost("solids"),
        "lost to trees": sums.lost("forest"),
    }


def _draw_axes(axes: Any, months: list[str]) -> None:
    """Draw the axes of months such as 2023-06: names within a year, and otherwise years and months."""
    step = -(-len(months) // MAX_LABELS)
    of_one_year = len({month[:4] for month in months}) == 1
    labels = [f"{date.fromisoformat(f'{month}-01'):%b}" if of_one_year else month for month in months]
    axes.set_xticks(np.arange(0, len(months), step), labels=labels[::step])
    axes.set_xlim(-0.6, len(months) - 0.4)
    axes.set_ylim(bottom=0.0)
    if axes.get_ylim()[1] <= 0.06:  # a period without light
        axes.set_ylim(top=1.0)
    axes.set_xlabel(months[0][:4] if of_one_year else "", fontsize=9, color=LABEL_COLOR, labelpad=3)
    axes.set_ylabel("kWh/m²", fontsize=9, color=LABEL_COLOR)
    axes.set_facecolor(PAPER_COLOR)
    axes.grid(axis="y", color=GRID_COLOR, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=LABEL_COLOR, labelsize=9, length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set(color=INK_COLOR, linewidth=1.0)


def _plane_text(report: PointIrradiationReport) -> str:
    """Return the plane as text."""
    if not report.tilt:
        return "level plane"
    return f"plane tilted {report.tilt:.0f}°, facing {report.azimuth:.0f}°"


def _sum_text(report: PointIrradiationReport) -> str:
    """Return the dates, the sum, and that under an open sky, as text."""
    sums = report.all_months
    assert sums is not None
    period = f"{report.first:%-d %B %Y}" + (f" to {report.last:%-d %B %Y}" if report.last != report.first else "")
    remark = f"; {report.remark}" if report.remark else ""
    return f"{period}: {sums.total:,.0f} kWh/m², of {sums.open_sky:,.0f} kWh/m² under an open sky{remark}"
