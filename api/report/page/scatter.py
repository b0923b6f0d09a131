"""Scatter plot of error against time as SVG. Marks link to rows of the table; the Pareto front is drawn and labelled."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from itertools import pairwise

from skugga.api.report.page.marks import mark_of, mark_svg
from skugga.api.report.page.markup import tag
from skugga.api.report.page.scales import Scale, log_scale_of, time_label
from skugga.api.report.summary import MAX_EXACT_NOISE_FLOORS, RowFigures, algorithm_family, casts_shadow, is_on_front
from skugga.selector.formatting import format_duration, format_percent
from skugga.selector.measure.compare import Comparison
from skugga.shadows.registry import ALGORITHMS, NO_SHADOWS

SCATTER_WIDTH_PX, SCATTER_HEIGHT_PX = 860.0, 540.0
"""Size of the plot in pixels, with its margins."""
MARGIN_LEFT_PX, MARGIN_RIGHT_PX, MARGIN_TOP_PX, MARGIN_BOTTOM_PX = 84.0, 16.0, 14.0, 56.0
"""Margins around the area of the plot, for labels and titles."""
TITLE_HEIGHT_PX, LEGEND_LEFT_PX, LEGEND_COLUMNS = 54.0, 14.0, 2
"""Layout of the separate picture: height of the title, left end of the legend, and columns of the legend."""
LABEL_CHARACTER_PX, LINE_HEIGHT_PX = 8.3, 16.0
"""Size of label text, slightly more than any font needs."""

TextBox = tuple[float, float, float, float]
"""Left, top, right and bottom of a text in pixels."""


@dataclass(frozen=True)
class ScatterPoint:
    """A row (measured plan) in the plot.

    Attributes
    ----------
    row_index
        Index of the row.
    figures
        Its measured figures.
    x, y
        Position, pixels.
    """

    row_index: int
    figures: RowFigures
    x: float
    y: float


def scatter_plot(comparison: Comparison) -> str:
    """Return an SVG element of 860 x 540 px: time to the right, error upwards, both logarithmic with a position for zero.

    Rows without shadows are omitted if other rows exist. They take no time and are all wrong, so they would only stretch the axes.
    """
    label = "Error against time of every row"
    return tag(
        "svg",
        _plot(comparison),
        viewBox=f"0 0 {SCATTER_WIDTH_PX:g} {SCATTER_HEIGHT_PX:g}",
        role="group",
        aria_label=label,
        class_="scatter",
    )


def _plot(comparison: Comparison) -> str:
    """Return the content of the plot as SVG: axes, noise band, marks, the Pareto front and labels."""
    figures_by_row = {k: row.figures for k, row in enumerate(comparison.rows) if casts_shadow(row.figures, comparison.light)}
    figures_by_row = figures_by_row or {k: row.figures for k, row in enumerate(comparison.rows)}
    x = log_scale_of([f["ms_median"] for f in figures_by_row.values()], MARGIN_LEFT_PX, SCATTER_WIDTH_PX - MARGIN_RIGHT_PX)
    y = log_scale_of(
        [f[comparison.error_metric] for f in figures_by_row.values()], SCATTER_HEIGHT_PX - MARGIN_BOTTOM_PX, MARGIN_TOP_PX
    )
    points = [ScatterPoint(k, f, x(f["ms_median"]), y(f[comparison.error_metric])) for k, f in figures_by_row.items()]
    points.sort(key=lambda point: (point.figures["pareto"], -point.figures["ms_median"]))  # the front on top
    stairs = _staircase([point for point in points if is_on_front(point.figures, comparison.light)])
    return "".join([
        *_axes(x, y, "wrong pixels of the cast shadow" if comparison.error_metric == "wrong_cast" else "error of the shadow share"),
        *_noise_band(y, MAX_EXACT_NOISE_FLOORS * comparison.noise_floor),
        tag("polyline", points=" ".join(f"{x:.1f},{y:.1f}" for x, y in stairs), class_="stairs") if stairs else "",
        *(_mark(point, comparison) for point in points),
        *_labels(points, stairs, comparison.light),
    ])  # fmt: skip


def scatter_file(comparison: Comparison, title: list[str], style: str) -> str:
    """Return the scatter plot as a separate SVG file with title lines, a legend and a style (CSS)."""
    names = _families(comparison)
    legend_top = TITLE_HEIGHT_PX + SCATTER_HEIGHT_PX + 8.0
    legend_items = []
    for k, name in enumerate(names):
        legend_row, legend_col = divmod(k, LEGEND_COLUMNS)
        x, y = (
            LEGEND_LEFT_PX + legend_col * (SCATTER_WIDTH_PX - LEGEND_LEFT_PX) / LEGEND_COLUMNS,
            legend_top + 1.4 * LINE_HEIGHT_PX * legend_row,
        )
        legend_items.append(
            tag("g", mark_svg(mark_of(name), 8, 0, 5.2), _text(20, 4.5, name), transform=f"translate({x:.1f} {y:.1f})")
        )
    height = legend_top + 1.4 * LINE_HEIGHT_PX * -(-len(names) // LEGEND_COLUMNS)
    return tag(
        "svg",
        tag("style", escape(style, quote=False)),
        tag("rect", width="100%", height="100%", fill="#fff"),
        *(
            _text(LEGEND_LEFT_PX, 22.0 + LINE_HEIGHT_PX * 1.2 * k, line, class_="title" if k else "name")
            for k, line in enumerate(title)
        ),
        tag("g", _plot(comparison), transform=f"translate(0 {TITLE_HEIGHT_PX:g})", class_="scatter"),
        *legend_items,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {SCATTER_WIDTH_PX:g} {height:g}",
        width=f"{SCATTER_WIDTH_PX:g}",
        height=f"{height:g}",
    )


def scatter_legend(comparison: Comparison) -> str:
    """Return the legend: a list of marks and their algorithms."""
    items = (tag("li", mark_swatch(name), escape(name)) for name in _families(comparison))
    return tag("ul", *items, class_="legend")


def _families(comparison: Comparison) -> list[str]:
    """Return the combinations of algorithms of the rows, in the order of the legend: single algorithms first."""
    families = {algorithm_family(row.figures, comparison.light) for row in comparison.rows}
    ranks = {name: k for k, name in enumerate(ALGORITHMS)}
    return sorted(families - {NO_SHADOWS} or families, key=lambda name: (" + " in name, ranks.get(name, len(ranks)), name))


def mark_swatch(name: str) -> str:
    """Return the mark of an algorithm as a small SVG element."""
    return tag("svg", mark_svg(mark_of(name), 8, 8, 5.2), viewBox="0 0 16 16", class_="swatch", aria_hidden="true")


def _axes(x: Scale, y: Scale, error: str) -> Iterator[str]:
    """Yield the axes with their ticks and titles.

    ``x`` and ``y`` are the scales, and ``error`` is the title of the error's axis.
    """
    bottom, right = SCATTER_HEIGHT_PX - MARGIN_BOTTOM_PX, SCATTER_WIDTH_PX - MARGIN_RIGHT_PX
    for value in y.ticks():
        tick_px = y(value)
        yield tag("line", x1=MARGIN_LEFT_PX, x2=right, y1=f"{tick_px:.1f}", y2=f"{tick_px:.1f}", class_="grid")
        yield _text(MARGIN_LEFT_PX - 9, tick_px + 4.5, f"{100.0 * value:g} %", "end")
    for value in x.ticks():
        tick_px = x(value)
        yield tag("line", x1=f"{tick_px:.1f}", x2=f"{tick_px:.1f}", y1=MARGIN_TOP_PX, y2=bottom, class_="grid")
        yield _text(tick_px, bottom + 20, time_label(value), "middle")
    if y.zero_px is not None:
        yield tag("line", x1=MARGIN_LEFT_PX, x2=right, y1=y.start_px, y2=y.start_px, class_="break")
        yield _text(MARGIN_LEFT_PX - 9, y.zero_px + 4.5, "0 %", "end")
    if x.zero_px is not None:
        yield tag("line", x1=x.start_px, x2=x.start_px, y1=MARGIN_TOP_PX, y2=bottom, class_="break")
        yield _text(x.zero_px, bottom + 20, "0 ms", "middle")
    yield tag("path", d=f"M{MARGIN_LEFT_PX:g} {MARGIN_TOP_PX:g}V{bottom:g}H{right:g}", class_="axis")
    yield _text((MARGIN_LEFT_PX + right) / 2, SCATTER_HEIGHT_PX - 10, "time of the shadows in a frame, median", "middle", "title")
    middle = (MARGIN_TOP_PX + bottom) / 2
    yield tag("text", escape(error), transform=f"translate(13 {middle:g}) rotate(-90)", text_anchor="middle", class_="title")


def _noise_band(y: Scale, max_exact_error: float) -> Iterator[str]:
    """Yield the band of errors below the noise of the ray-traced truth, if any of it lies on the axis.

    ``max_exact_error`` is the upper end of the band, as a fraction like the errors on the scale ``y``.
    """
    top, bottom = y(max_exact_error), SCATTER_HEIGHT_PX - MARGIN_BOTTOM_PX
    if max_exact_error > y.low:
        yield tag(
            "rect",
            x=MARGIN_LEFT_PX,
            y=f"{top:.1f}",
            width=SCATTER_WIDTH_PX - MARGIN_RIGHT_PX - MARGIN_LEFT_PX,
            height=f"{bottom - top:.1f}",
            class_="floor",
        )
        yield _text(
            SCATTER_WIDTH_PX - MARGIN_RIGHT_PX - 6, min(top + 15, bottom - 5), "within the noise of the reference", "end", "remark"
        )


def _staircase(front: list[ScatterPoint]) -> list[tuple[float, float]]:
    """Return the vertices (x, y), in pixels, of the staircase through the Pareto front.

    Every point above and right of the staircase is dominated.
    """
    front_points = sorted((point.x, point.y) for point in front)
    corners = [(x, y) for (x, _), (_, y) in zip(front_points, [(0.0, MARGIN_TOP_PX), *front_points], strict=False)]
    line = [vertex for pair in zip(corners, front_points, strict=True) for vertex in pair]
    return [*line, (SCATTER_WIDTH_PX - MARGIN_RIGHT_PX, line[-1][1])] if line else []


def _mark(point: ScatterPoint, comparison: Comparison) -> str:
    """Return the mark of a row as an SVG element with a tooltip and a link to the table."""
    figures = point.figures
    tooltip = f"{figures['name']}: {format_percent(figures[comparison.error_metric])} in {format_duration(figures['ms_median'])}"
    tooltip += ", on the front" if figures["pareto"] else ""
    return tag(
        "a",
        tag("title", escape(tooltip)),
        tag("circle", cx=f"{point.x:.1f}", cy=f"{point.y:.1f}", r=11, class_="halo"),
        mark_svg(mark_of(algorithm_family(figures, comparison.light)), point.x, point.y, 7.0 if figures["pareto"] else 5.2),
        href=f"#row-{point.row_index}",
        data_row=point.row_index,
        aria_label=tooltip,
        class_="point front" if figures["pareto"] else "point",
    )


def _labels(points: list[ScatterPoint], stairs: list[tuple[float, float]], light: str) -> Iterator[str]:
    """Yield labels of the rows on the Pareto front, at positions that overlap no mark, line, label or border of the plot.

    ``stairs`` are the vertices of the staircase through the front, in pixels. A row without a free position gets no label.
    """
    occupied: list[TextBox] = [(point.x - 6.0, point.y - 6.0, point.x + 6.0, point.y + 6.0) for point in points]
    occupied += [(min(a, c) - 1.0, min(b, d) - 1.0, max(a, c) + 1.0, max(b, d) + 1.0) for (a, b), (c, d) in pairwise(stairs)]
    for point in sorted((point for point in points if is_on_front(point.figures, light)), key=lambda point: -point.y):
        lines = point.figures["name"].replace(",", ",\n").split("\n")
        width, extra_height = LABEL_CHARACTER_PX * max(map(len, lines)), LINE_HEIGHT_PX * (len(lines) - 1)
        for anchor, right, down in LABEL_POSITIONS:
            left = point.x + right - (width if anchor == "end" else 0.0)
            line = point.y + down - (extra_height if down < 0.0 else 0.0)
            boxes = [(left, line - 12.0, left + width, line - 12.0 + LINE_HEIGHT_PX + extra_height)]
            if abs(down) > 25.0:  # its leader
                start, end = sorted((point.y + (9.0 if down > 0.0 else -9.0), point.y + down + (-12.0 if down > 0.0 else 4.0)))
                boxes.append((point.x - 1.0, start, point.x + 1.0, end))
            if all(_is_inside(box) and not any(_overlaps(box, other) for other in occupied) for box in boxes):
                occupied += boxes
                yield from (
                    tag("path", d=f"M{point.x:.1f} {top:.1f}V{bottom:.1f}", class_="leader") for _, top, _, bottom in boxes[1:]
                )
                yield from (_text(point.x + right, line + LINE_HEIGHT_PX * k, text, anchor, "name") for k, text in enumerate(lines))
                break


LABEL_POSITIONS = (
    ("end", -13.0, 5.0), ("end", -9.0, 19.0), ("end", 3.0, 34.0), ("end", 3.0, 50.0), ("end", 3.0, 66.0), ("end", 3.0, 82.0),
    ("start", 11.0, -8.0), ("start", 13.0, 5.0), ("start", -3.0, 34.0), ("start", -3.0, 50.0), ("start", -3.0, 66.0),
    ("start", -3.0, -30.0), ("start", -3.0, -48.0), ("end", -9.0, -9.0),
)  # fmt: skip
"""Candidate positions of a label, best first: text anchor, pixels right and down of the mark. Positions below and left come
first, since the area below and left of the front is empty.
"""


def _is_inside(box: TextBox) -> bool:
    """Return whether a text lies inside the area of the plot."""
    return (
        box[0] > MARGIN_LEFT_PX
        and box[2] < SCATTER_WIDTH_PX - MARGIN_RIGHT_PX
        and box[1] > MARGIN_TOP_PX
        and box[3] < SCATTER_HEIGHT_PX - MARGIN_BOTTOM_PX
    )


def _overlaps(first: TextBox, second: TextBox) -> bool:
    """Return whether two texts overlap."""
    return first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3]


def _text(x: float, y: float, text: str, anchor: str = "start", class_: str | None = None) -> str:
    """Return a text as an SVG element.

    ``x`` and ``y`` are the position in pixels of the point of the text that ``anchor`` names: ``start``, ``middle`` or ``end``.
    """
    return tag("text", escape(text), x=f"{x:.1f}", y=f"{y:.1f}", text_anchor=anchor, class_=class_)
