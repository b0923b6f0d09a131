"""Stacked bar chart of the rows' times as SVG. Each row (measured plan) has a bar with a segment per stage, shortest bar first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from math import floor, log10

from skugga.api.report.page.marks import COLOURS, stage_colours
from skugga.api.report.page.markup import tag
from skugga.api.report.page.scales import time_label
from skugga.api.report.summary import RowFigures
from skugga.selector.formatting import format_duration

BARS_WIDTH_PX, BAR_STEP_PX, BARS_TOP_PX, BAR_HEIGHT_PX = 1180.0, 21.0, 26.0, 14.0
"""Layout of the chart in pixels: its width, the distance of two bars, the top of the first bar, and the height of a bar."""

NAME_WIDTH_PX, BAR_CHARACTER_PX, BOLD_CHARACTER_PX, TIME_WIDTH_PX = 130.0, 7.4, 8.3, 78.0
"""Widths in pixels: of the names at least, of a character of a name, of one in bold, and of a time."""

REST_STAGE = "not in a stage"
"""Name of the segment for the time outside all stages."""
MIN_REST_SHARE = 0.02
"""Minimum share of a row's time outside all stages that is shown."""


@dataclass(frozen=True)
class Axis:
    """The time axis of the bars. Bars that are longer than the axis are scaled down to its length.

    Attributes
    ----------
    left_px
        Position of 0 ms, pixels.
    end_ms
        Time at the right end.
    """

    left_px: float
    end_ms: float

    def width_px(self, ms: float, total_ms: float) -> float:
        """Return the width in pixels of a segment of ``ms`` in a bar whose segments add up to ``total_ms``."""
        return ms * (BARS_WIDTH_PX - self.left_px - TIME_WIDTH_PX) / max(self.end_ms, total_ms)


def bar_chart(figures: list[RowFigures]) -> str:
    """Return an SVG element, 1180 px wide: stacked bars with median times and names, which link to the table."""
    order = sorted(range(len(figures)), key=lambda k: (figures[k]["ms_median"], figures[k]["name"]))
    names_px = [len(f["name"]) * (BOLD_CHARACTER_PX if f["pareto"] else BAR_CHARACTER_PX) + 12.0 for f in figures]
    axis = Axis(max([NAME_WIDTH_PX, *names_px]), _end_ms(figures))
    colours = _stage_colours(figures)
    bottom = BARS_TOP_PX + BAR_STEP_PX * len(figures)
    return tag(
        "svg",
        *_grid_lines(axis, bottom),
        *(_bar_elements(k, figures[k], BARS_TOP_PX + BAR_STEP_PX * place, axis, colours) for place, k in enumerate(order)),
        viewBox=f"0 0 {BARS_WIDTH_PX:g} {bottom + 6:g}",
        role="group",
        aria_label="Time of every row by its stages",
        class_="bars",
    )


def exceeds_axis(figures: list[RowFigures]) -> bool:
    """Return whether any bar is longer than the axis."""
    return max(map(_total_ms, figures), default=0.0) > _end_ms(figures)


def bars_legend(figures: list[RowFigures]) -> str:
    """Return the legend: a list of stages and their colours."""
    return tag(
        "ul",
        *(tag("li", _colour_swatch(colour), escape(name)) for name, colour in _stage_colours(figures).items()),
        class_="legend",
    )


def _colour_swatch(colour: str) -> str:
    """Return a small square of a colour as an SVG element."""
    return tag("svg", tag("path", d="M2 2H14V14H2Z", fill=colour), viewBox="0 0 16 16", class_="swatch", aria_hidden="true")


def stages_of(figures: RowFigures) -> dict[str, float]:
    """Return the milliseconds of a row's stages. The rest of its median time is added if it exceeds ``MIN_REST_SHARE``."""
    stages = {name: ms for name, ms in figures["stages"].items() if ms > 0.0}
    rest = figures["ms_median"] - sum(stages.values())
    return stages | ({REST_STAGE: rest} if rest > MIN_REST_SHARE * figures["ms_median"] else {})


def _stage_colours(figures: list[RowFigures]) -> dict[str, str]:
    """Return the colour of each stage that occurs in the rows, by the stage's name."""
    stages = list(dict.fromkeys(name for f in figures for name in stages_of(f)))
    colours = stage_colours([name for name in stages if name != REST_STAGE])
    return colours | ({REST_STAGE: COLOURS["gray"]} if REST_STAGE in stages else {})


def _total_ms(figures: RowFigures) -> float:
    """Return the length of a row's bar in milliseconds."""
    return sum(stages_of(figures).values())


def _end_ms(figures: list[RowFigures]) -> float:
    """Return the time at the end of the axis.

    It is the longest time, but at most twice the 80th percentile. A few long bars thus do not shrink all others.
    """
    times = sorted(map(_total_ms, figures)) or [0.0]
    common = 2.0 * times[(4 * (len(times) - 1)) // 5]
    return max(1e-3, times[-1] if times[-1] <= common or common == 0.0 else common)


def _grid_lines(axis: Axis, bottom: float) -> Iterator[str]:
    """Yield the vertical lines of the time axis and their labels. ``bottom`` is the lower end of the lines in pixels."""
    power = 10.0 ** floor(log10(axis.end_ms / 4.0))
    step = next(f * power for f in (1, 2, 5, 10) if f * power >= axis.end_ms / 8.0)
    for k in range(floor(axis.end_ms / step) + 1):
        x = f"{axis.left_px + axis.width_px(k * step, 0.0):.1f}"
        yield tag("line", x1=x, x2=x, y1=BARS_TOP_PX - 6, y2=bottom, class_="grid" if k else "axis")
        yield tag("text", escape(time_label(k * step)), x=x, y=BARS_TOP_PX - 11, text_anchor="middle")


def _bar_elements(row_index: int, figures: RowFigures, y: float, axis: Axis, colours: dict[str, str]) -> str:
    """Return the bar of a row as an SVG element: its segments, its name and its time, with a link to the table.

    ``y`` is the top of the bar in pixels. ``colours`` has the colours of stages by name.
    """
    stages, total_ms, line = stages_of(figures), _total_ms(figures), y + BAR_HEIGHT_PX - 3.0
    x, parts = axis.left_px, []
    for name, ms in stages.items():
        width = axis.width_px(ms, total_ms)
        title = tag("title", escape(f"{figures['name']}, {name}: {format_duration(ms)}"))
        parts.append(tag("rect", title, x=f"{x:.2f}", y=f"{y:g}", width=f"{width:.2f}", height=BAR_HEIGHT_PX, fill=colours[name]))
        x += width
    if total_ms > axis.end_ms:
        parts.append(
            tag(
                "path",
                d=f"M{x - 17:.1f} {y + BAR_HEIGHT_PX + 2:g}l6 {-BAR_HEIGHT_PX - 4:g}m5 0l-6 {BAR_HEIGHT_PX + 4:g}",
                class_="cut",
            )
        )
    time = format_duration(figures["ms_median"])
    return tag(
        "a",
        tag("text", escape(figures["name"]), x=f"{axis.left_px - 10:.1f}", y=line, text_anchor="end", class_="name"),
        *parts,
        tag("text", escape(time), x=f"{x + 7:.1f}", y=line),
        href=f"#row-{row_index}",
        data_row=row_index,
        aria_label=f"{figures['name']}: {time}; " + ", ".join(f"{name} {format_duration(ms)}" for name, ms in stages.items()),
        class_="bar front" if figures["pareto"] else "bar",
    )
