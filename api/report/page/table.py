"""The table of all rows (measured plans): figures, settings, stages and counters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Any

from skugga.api.report.page.bars import stages_of
from skugga.api.report.page.markup import breakable_text, definition_list, tag
from skugga.api.report.page.scatter import mark_swatch
from skugga.api.report.summary import RowFigures, algorithm_family
from skugga.selector.formatting import format_duration
from skugga.selector.measure.compare import Comparison


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes
    ----------
    key
        Key of the figure.
    heading
        Heading.
    unit
        Unit of the written values.
    format_value
        Formatter of a value.
    meaning
        Explanation for the glossary.
    """

    key: str
    heading: str
    unit: str
    format_value: Callable[[float], str]
    meaning: str = ""


def decimals_formatter(decimals: int, scale: float = 1.0) -> Callable[[float], str]:
    """Return a formatter with a number of decimals. It writes "0" only for zero, and "<" before small values.

    ``scale`` is a factor that values are multiplied by, such as 100 for per cent.
    """
    smallest = 10.0**-decimals

    def format_value(value: float) -> str:
        scaled = value * scale
        if scaled == 0.0:
            return "0"
        return f"{scaled:.{decimals}f}" if scaled >= smallest / 2.0 else f"<{smallest:.{decimals}f}"

    return format_value


def format_ms(value: float) -> str:
    """Return a time with one decimal below 10 ms and without decimals from there on."""
    return "0" if value == 0.0 else f"{value:.{0 if value >= 9.95 else 1 if value >= 0.05 else 3}f}"


COLUMNS = [
    Column("ms_median", "time", "ms", format_ms, "Wall clock of a frame's shadow work, median of its runs."),
    Column("ms_p95", "p95", "ms", format_ms, "95th percentile of the times of the runs."),
    Column("wrong_cast", "wrong cast", "%", decimals_formatter(3, 100), ("Wrong pixels as a share of the cast shadow "
        "of truth or the row.")),
    Column(
        "soft_error", "soft error", "%", decimals_formatter(3, 100),
        "Mean difference of visibility from ray-traced truth with an area light (the sun's disc): the error of soft edges.",
    ),
    Column("coverage", "coverage", "%", decimals_formatter(2, 100), ("Mean difference in shadow share over "
        "blocks of 16 × 16 pixels.")),
    Column("wrong", "wrong", "%", decimals_formatter(3, 100), "Wrong pixels as a share of the surface where truth is certain."),
    Column("false_shadow", "false", "%", decimals_formatter(3, 100), "Wrong among the pixels that are lit in truth."),
    Column("missed_shadow", "missed", "%", decimals_formatter(3, 100), "Wrong among the pixels that are in shadow in truth."),
    Column("edge_mean", "edge", "px", decimals_formatter(2), "Mean distance between the row's shadow edges and those of truth."),
    Column("edge_p95", "edge p95", "px", decimals_formatter(2), "95th percentile of the distances of edges."),
    Column("edge_p95_m", "edge p95", "m", decimals_formatter(2), "The same, in metres on the ground."),
    Column(
        "interior", "interior", "%", decimals_formatter(3, 100),
        "Wrong pixels farther from all edges of truth than aliasing reaches: failures. A row above 0.1 % is rejected.",
    ),
    Column(
        "interior_sees", "interior sees", "%", decimals_formatter(0, 100),
        "Share of truth's cast shadow that is far enough from edges for interior to detect errors. Large texels reduce it.",
    ),
    Column("interior_parts", "parts", "", decimals_formatter(0), "Connected failures of at least 8 pixels."),
    Column("bytes", "memory", "MB", decimals_formatter(1, 1e-6), "Peak memory of textures and buffers."),
]  # fmt: skip

GLOSSARY = {f"{c.heading} ({c.unit})" if c.unit else c.heading: c.meaning for c in COLUMNS}


def rows_table(comparison: Comparison) -> str:
    """Return the table, smallest error first. A script turns its headings into buttons that sort."""
    figures = [row.figures for row in comparison.rows]
    order = sorted(range(len(figures)), key=lambda k: (figures[k][comparison.error_metric], figures[k]["ms_median"]))
    head = [
        tag("th", "front", scope="col"),
        tag("th", "algorithm and settings", scope="col"),
        *(_heading(column, column.key == comparison.error_metric) for column in COLUMNS),
    ]
    lines = (_table_row(k, figures[k], comparison.light) for k in order)
    return tag("table", tag("thead", tag("tr", *head)), tag("tbody", *lines))


def row_details(figures: RowFigures, light: str) -> str:
    """Return the settings for a light, the stages, counters and notes of a row."""
    parts = [(f"Settings: {kinds}", definition_list(pairs)) for kinds, pairs in _settings(figures, light).items()]
    parts.append(("Stages", definition_list({name: format_duration(ms) for name, ms in stages_of(figures).items()})))
    parts.append(("Counters", definition_list({name.replace("_", " "): f"{n:,}" for name, n in figures["counters"].items() if n})))
    parts.append(("Notes", "".join(tag("p", escape(note)) for note in figures["notes"])))
    times = "time" if figures["runs"] == 1 else "times"
    runs = f"Timed {figures['runs']} {times}{', in its first run alone' if figures['cold'] else ''}."
    if (ms_at_rest := figures.get("ms_at_rest")) is not None:  # not measured for maps, nor in older reports
        runs = f"{runs} While nothing moves, caches hold maps and volumes: {format_duration(ms_at_rest)}."
    sections = (tag("div", tag("h4", escape(name)), markup) for name, markup in parts if markup not in ("", definition_list({})))
    return tag("div", *sections, tag("p", runs), class_="particulars")


def _settings(figures: RowFigures, light: str) -> dict[str, dict[str, str]]:
    """Return settings by caster kind; kinds with equal settings share an entry."""
    kinds: dict[str, list[str]] = {}
    settings: dict[str, dict[str, str]] = {}
    for kind, name in figures["algorithm"].get(light, {}).items():
        flat_settings = _flat_settings((figures["settings"].get(light, {}).get(kind)) or {})
        key = f"{name} {flat_settings}"
        kinds.setdefault(key, []).append(kind)
        settings[key] = {"algorithm": name} | flat_settings
    return {", ".join(kinds[key]): settings[key] for key in kinds}


def _flat_settings(values: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings as text by flat names, such as ``cascades 2 far m``. All names begin with ``prefix``."""
    flat: dict[str, str] = {}
    for key, value in values.items():
        name = f"{prefix}{key.replace('_', ' ')}"
        if isinstance(value, dict):
            flat |= _flat_settings(value, f"{name} ")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            flat |= _flat_settings({str(k): item for k, item in enumerate(value, start=1)}, f"{name} ")
        elif value is not None:
            flat[name] = " × ".join(map(_short_text, value)) if isinstance(value, list) else _short_text(value)
    return flat


def _short_text(value: Any) -> str:
    """Return a value as text; numbers have four significant digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _heading(column: Column, is_sort_column: bool) -> str:
    """Return the heading of a column as a table cell. ``is_sort_column`` says whether the table is sorted by it."""
    unit = tag("span", escape(column.unit), class_="unit") if column.unit else ""
    return tag(
        "th",
        tag("span", escape(column.heading)),
        unit,
        scope="col",
        title=column.meaning,
        class_="number",
        aria_sort="ascending" if is_sort_column else None,
    )


def _table_row(row_index: int, figures: RowFigures, light: str) -> str:
    """Return the row of the table with the index ``row_index``: the name, with details for the light ``light``, and the figures."""
    front, name = figures["pareto"], figures["name"]
    title = tag("summary", mark_swatch(algorithm_family(figures, light)), tag("span", breakable_text(name)))
    cells = [
        tag(
            "td",
            tag("span", "●" if front else "", class_="dot"),
            data_value=int(not front),
            aria_label="on the front" if front else None,
        ),
        tag("th", tag("details", title, row_details(figures, light)), scope="row", data_value=name),
        *(tag("td", _figure(column, figures), data_value=f"{figures[column.key]:.9g}", class_="number") for column in COLUMNS),
    ]
    return tag("tr", *cells, id=f"row-{row_index}", data_row=row_index, class_="front" if front else None)


def _figure(column: Column, figures: RowFigures) -> str:
    """Return the figure of a column as escaped text. A time of a first run gets a question mark."""
    cold = figures["cold"] and column.unit == "ms" and figures[column.key] > 0.0
    return escape(column.format_value(figures[column.key])) + ("?" if cold else "")
