"""The HTML report of a comparison: one self-contained page with plots, pictures, style and script."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from skugga.api.report.page.bars import bar_chart, bars_legend, exceeds_axis
from skugga.api.report.page.markup import breakable_text, definition_list, script_json, tag
from skugga.api.report.page.pictures import ErrorPicture, ReportPictures, palette, report_pictures
from skugga.api.report.page.scatter import scatter_file, scatter_legend, scatter_plot
from skugga.api.report.page.table import GLOSSARY, rows_table
from skugga.api.report.summary import MAX_EXACT_NOISE_FLOORS, RowFigures, casts_shadow, format_summary, is_on_front
from skugga.selector.formatting import format_duration, format_percent
from skugga.selector.measure.compare import Comparison
from skugga.terrain.atomic_files import write_atomically

MAX_PAGE_BYTES = 5_000_000
"""Limit of a page in bytes. Pictures get the bytes that remain after text and plots."""

MAX_REMARK_CHARACTERS = 240
"""Length in characters above which a remark is collapsed."""

LEFT_OUT_REMARK = "some rows were left out by the time limit"
"""Remark on rows for which the time limit left no time."""

_COLOUR_MEANINGS = {
    "false": "false shadow: lit in truth",
    "missed": "missed shadow: dark in truth",
    "dark": "shadow",
    "lit": "light",
}


def write_report(
    path: Path,
    comparison: Comparison,
    shadowless_view: np.ndarray,
    facts: dict[str, str],
    commands: Sequence[str] = (),
    max_bytes: int = MAX_PAGE_BYTES,
) -> None:
    """Write the page of a comparison.

    The page has a row for each measured plan. The same input gives the same page, byte for byte.

    Parameters
    ----------
    path
        File to write.
    comparison
        The comparison.
    shadowless_view
        The view without cast shadows, uint8 (rows, cols, 3).
    facts
        Facts of the run, in order. The first two values make the title.
    commands
        Command lines that measure the rows for which no time was left.
    max_bytes
        Limit of the page; pictures are shrunk to fit.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_atomically(path, report_html(comparison, shadowless_view, facts, commands, max_bytes))


def write_scatter(path: Path, comparison: Comparison, title: list[str]) -> None:
    """Write the scatter plot of error against time, with the lines of a title, as an SVG file. Raises ``OSError``."""
    write_atomically(path, scatter_file(comparison, title, _template_text("report.css")))


def report_html(
    comparison: Comparison,
    shadowless_view: np.ndarray,
    facts: dict[str, str],
    commands: Sequence[str] = (),
    max_bytes: int = MAX_PAGE_BYTES,
) -> str:
    """Return the page as text; see ``write_report``."""
    style, script = _template_text("report.css"), _template_text("report.js")
    parts = {
        "title": escape(" · ".join(list(facts.values())[:2])),
        "about": definition_list(facts, class_="about"),
        "summary": tag(
            "ul",
            *(
                tag("li", text)
                for text in [
                    *map(escape, format_summary(comparison)),
                    *map(_remark, comparison.remarks),
                    *_left_out_note(commands),
                ]  # fmt: skip
            ),
        ),
        "shares": definition_list(_share_texts(comparison), class_="shares"),
        "glossary": definition_list(GLOSSARY),
        "style": style,
        "script": script,
        "style_hash": _csp_hash(style),
        "script_hash": _csp_hash(script),
    }
    if not comparison.rows:
        return Template(_template_text("report.html")).substitute(parts, results="", data="")
    results = _results(comparison)
    picture_budget = max_bytes - sum(len(text.encode()) for text in (*parts.values(), *results.values())) - 20_000
    encoded_pictures = report_pictures(shadowless_view, _error_pictures(comparison), picture_budget)
    results |= {"thumbs": _thumbs(comparison, encoded_pictures), "shrunk": _pictures_note(encoded_pictures)}
    return Template(_template_text("report.html")).substitute(
        parts, results=Template(_template_text("results.html")).substitute(results), data=_data_script(comparison, encoded_pictures)
    )


def _template_text(name: str) -> str:
    """Return the text of a file of the page's template, style or script."""
    return (files("skugga.api.report.page") / name).read_text(encoding="utf-8")


def _csp_hash(text: str) -> str:
    """Return the source expression of a Content-Security-Policy for an inline element (CSP level 3, 2.3.1)."""
    return f"sha256-{b64encode(sha256(text.encode()).digest()).decode()}"


def _remark(remark_text: str) -> str:
    """Return a remark as a sentence; the list after the colon of a long remark is collapsed."""
    sentence = escape(f"{remark_text[:1].upper()}{remark_text[1:]}{'' if remark_text.endswith('.') else '.'}")
    head, colon, tail = sentence.partition(": ")
    return tag("details", tag("summary", head, colon), tail) if colon and len(sentence) > MAX_REMARK_CHARACTERS else sentence


def _left_out_note(commands: Sequence[str]) -> list[str]:
    """Return the note on rows that were left out, with the commands that measure them."""
    if not commands:
        return []
    lines = "".join(tag("div", tag("code", escape(command))) for command in commands)
    return [tag("details", tag("summary", f"{LEFT_OUT_REMARK[:1].upper()}{LEFT_OUT_REMARK[1:]}. To measure them, run"), lines)]


def _share_texts(comparison: Comparison) -> dict[str, str]:
    """Return sentences on parts of the surface, by heading: cast shadow, uncertain pixels, and the errors of truth itself."""
    return {
        "cast shadow": f"{format_percent(comparison.cast_share)} of the surface, by truth",
        "boundary": f"{format_percent(comparison.undecided_share)} of the surface: errors are not counted there, because "
        "truth itself is uncertain",
        "rendered grid": f"{format_percent(comparison.simplification_share)} of the surface differs from that of the full raster",
        "noise floor": f"{format_percent(comparison.noise_floor)} is the error of truth itself with other sub-samples; "
        f"errors up to {format_percent(MAX_EXACT_NOISE_FLOORS * comparison.noise_floor)} are called exact",
    }


def _results(comparison: Comparison) -> dict[str, str]:
    """Return the parts of the page that show the rows, by the names of the template's placeholders."""
    figures = [row.figures for row in comparison.rows]
    cold = [f["name"] for f in figures if f["cold"]]
    return {
        "scatter": scatter_plot(comparison),
        "scatter_legend": scatter_legend(comparison),
        "bars": bar_chart(figures),
        "bars_legend": bars_legend(figures),
        "cut": "A bar with a cut is longer than the axis; its stages keep their proportions." if exceeds_axis(figures) else "",
        "options": "".join(tag("option", escape(f["name"]), value=k) for k, f in enumerate(figures)),
        "table": rows_table(comparison),
        "cold": "A time with a question mark is that of a first run, which includes compilation and allocation." if cold else "",
        "colours": tag(
            "ul",
            *(tag("li", tag("span", class_=f"colour {class_}"), text) for class_, text in _COLOUR_MEANINGS.items()),
            class_="legend",
        ),
    }


def _error_pictures(comparison: Comparison) -> list[ErrorPicture]:
    """Return the error picture of each row.

    Pixels that face away from the light are dark in the shaded view already. They do not count as cast shadow.
    """
    unshadowed = next((row.visibility == 0 for row in comparison.rows if not casts_shadow(row.figures, comparison.light)), None)
    return [
        ErrorPicture(
            row.visibility if unshadowed is None else np.where(unshadowed, 255, row.visibility), row.false_shadow, row.missed_shadow
        )
        for row in comparison.rows
    ]


def _pictures_note(encoded_pictures: ReportPictures) -> str:
    """Return a note on the size and the gray steps of the pictures."""
    steps = f"Visibility is shown in {encoded_pictures.gray_levels} steps."
    if encoded_pictures.shrink_factor == 1:
        return f"Pictures have the pixels of the view. {steps}"
    return (
        f"To keep this page small, each pixel of a picture covers {encoded_pictures.shrink_factor} × "
        f"{encoded_pictures.shrink_factor} pixels of the view; "
        f"it is wrong if any of these is wrong. {steps}"
    )


def _data_script(comparison: Comparison, encoded_pictures: ReportPictures) -> str:
    """Return the script element with the pictures and the palette, and with the two rows that are compared first.

    These are the fastest and the slowest row on the Pareto front.
    """
    figures = [row.figures for row in comparison.rows]
    row_numbers = [k for k, f in enumerate(figures) if is_on_front(f, comparison.light)] or list(range(len(figures)))
    row_numbers.sort(key=lambda k: (figures[k]["ms_median"], figures[k][comparison.error_metric]))
    value = {
        "rows": encoded_pictures.rows,
        "cols": encoded_pictures.cols,
        "levels": encoded_pictures.gray_levels,
        "palette": palette(encoded_pictures.gray_levels).tolist(),
        "ground": encoded_pictures.ground,
        "left": row_numbers[0],
        "right": row_numbers[-1],
    }
    return tag("script", script_json(value), type="application/json", id="data")


def _thumbs(comparison: Comparison, encoded_pictures: ReportPictures) -> str:
    """Return the small error pictures of all rows, smallest error first."""
    figures = [row.figures for row in comparison.rows]
    order = sorted(range(len(figures)), key=lambda k: (figures[k][comparison.error_metric], figures[k]["ms_median"]))
    return "".join(_thumb(k, figures[k], comparison.error_metric, encoded_pictures) for k in order)


def _thumb(row_index: int, figures: RowFigures, error: str, encoded_pictures: ReportPictures) -> str:
    """Return the small error picture of a row with its caption. ``error`` is the key of the error among the figures."""
    caption = f"{format_percent(figures[error])}, {format_duration(figures['ms_median'])}"
    shares = f"{format_percent(figures['false_shadow'])} false and {format_percent(figures['missed_shadow'])} missed shadow"
    alt = f"Errors of {figures['name']}: {shares}"
    picture = tag(
        "img", src=encoded_pictures.row_uris[row_index], alt=alt, width=encoded_pictures.cols, height=encoded_pictures.rows
    )
    name = tag("figcaption", tag("b", breakable_text(figures["name"])), tag("span", escape(caption)))
    return tag(
        "figure",
        tag("a", picture, href=f"#row-{row_index}", data_row=row_index),
        name,
        class_="front" if figures["pareto"] else None,
    )
