"""The report's page: self-contained, safe with any name, reproducible, and consistent with its rows."""

from __future__ import annotations

import json
import re
from base64 import b64decode, b64encode
from hashlib import sha256
from html.parser import HTMLParser
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from skugga.api.report.page.bars import REST_STAGE, bar_chart, stages_of
from skugga.api.report.page.marks import mark_of
from skugga.api.report.page.pictures import (
    CORRECT,
    FALSE_SHADOW,
    FEW_GRAY_LEVELS,
    GRAY_LEVELS,
    MISSED_SHADOW,
    ErrorPicture,
    palette,
    palette_indexes,
    report_pictures,
)
from skugga.api.report.page.scales import log_scale_of
from skugga.api.report.page.scatter import SCATTER_HEIGHT_PX, SCATTER_WIDTH_PX, scatter_plot
from skugga.api.report.report import MAX_PAGE_BYTES, report_html, write_report, write_scatter
from skugga.api.report.summary import algorithm_family, casts_shadow
from skugga.selector.measure.compare import Comparison, ComparisonRow, false_colours
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.geo.camera import PerspectiveView
from tests.api.report.test_summary import COLS, NONE_FIGURES, ROWS, comparison, figures

BASE_PICTURE = np.linspace(0, 255, ROWS * COLS * 3).astype(np.uint8).reshape(ROWS, COLS, 3)
MARKUP_TEXT = "</script><b>&\"'$title"
REPORT_CONTEXT = {"level": f"Hills {MARKUP_TEXT}", "view": "map", "device": "llvmpipe"}
VOID_ELEMENTS = {"meta", "img", "input", "br", "wbr", "link"}


class Page(HTMLParser):
    """Elements of a page as (name, attributes), checked for correct nesting, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text_parts: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {key: value or "" for key, value in attrs}))
        if tag not in VOID_ELEMENTS:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self._open or self._open[-1] not in ("style", "script"):
            self.text_parts.append(data)

    def elements_named(self, name: str, **attributes: str) -> list[dict[str, str]]:
        expected = attributes.items()
        return [
            element_attributes
            for tag, element_attributes in self.elements
            if tag == name and all(element_attributes.get(key.rstrip("_")) == value for key, value in expected)
        ]

    @property
    def text(self) -> str:
        return " ".join(self.text_parts)


@pytest.fixture(scope="module")
def rows() -> Comparison:
    """Return five rows, one for each kind of error, with a name that contains markup."""
    result = comparison(
        NONE_FIGURES,
        figures("sweep", 12.0, 0.03),
        figures("shadow_map-64", 20.0, 0.004, notes=[MARKUP_TEXT], cold=True, runs=1),
        figures(f"planar-{MARKUP_TEXT}", 35.0, 0.006),
        figures("shadow_volume", 4100.0, 0.0),
        remarks=["nothing is lit: only missed shadow can be measured"],
    )
    sweep = result.rows[1]
    sweep.false_shadow[0, COLS - 1] = sweep.missed_shadow[ROWS - 1, 0] = True
    return result


@pytest.fixture(scope="module")
def text(rows: Comparison) -> str:
    """The report of the comparison as HTML."""
    return report_html(rows, BASE_PICTURE, REPORT_CONTEXT)


def data_of(text: str) -> dict[str, Any]:
    """Return the data that a report's page contains as JSON."""
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert match is not None
    return json.loads(match.group(1))


def decoded(uri: str) -> np.ndarray:
    """Return the WebP picture of a data URI as RGB (rows, cols, 3)."""
    return np.asarray(Image.open(BytesIO(b64decode(uri.removeprefix("data:image/webp;base64,")))).convert("RGB"))


def indexes_of(uri: str) -> np.ndarray:
    """Return the indexes that the page's script finds in a picture."""
    matches = (decoded(uri)[:, :, None, :] == palette()[None, None]).all(axis=-1)
    assert (matches.sum(axis=-1) == 1).all(), "each colour is one of the palette's"
    return matches.argmax(axis=-1)


def test_a_page_loads_no_other_files(text: str) -> None:
    page = Page(text)
    for name, attributes in page.elements:
        for key in ("src", "href", "xlink:href", "action", "data"):
            assert attributes.get(key, "#").startswith(("#", "data:image/")), (name, key)
        assert not [key for key in attributes if key == "style" or key.startswith("on")], (
            "a policy without unsafe-inline forbids them"
        )
    assert "url(" not in text and "@import" not in text and "@font-face" not in text and not page.elements_named("link")
    assert not re.search(r"https?://", text)


def test_the_policy_allows_only_the_page_s_style_and_script(text: str) -> None:
    (policy,) = (
        attributes["content"]
        for attributes in Page(text).elements_named("meta")
        if attributes.get("http-equiv") == "Content-Security-Policy"
    )
    assert "default-src 'none'" in policy and "img-src data:" in policy and "unsafe" not in policy
    for name in ("style", "script"):
        (content,) = re.findall(rf"<{name}>(.*?)</{name}>", text, re.S)
        assert f"{name}-src 'sha256-{b64encode(sha256(content.encode()).digest()).decode()}'" in policy


def test_the_page_states_shares_that_hold_for_all_rows(text: str) -> None:
    page_text = Page(text).text
    assert "25 % of the surface, by truth" in page_text and "2.0 % of the surface: errors are not counted there" in page_text


def test_names_cannot_become_markup(text: str) -> None:
    page = Page(text)
    assert page.text.count(MARKUP_TEXT) >= 4, "the markup is shown as text in title, level, name and note"
    assert not [attributes for attributes in page.elements_named("b") if attributes], "a name creates no element"
    assert len(page.elements_named("script")) == 2
    assert text.count("</script>") == 2


def test_the_same_rows_give_the_same_bytes(rows: Comparison, text: str, tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", rows, BASE_PICTURE, REPORT_CONTEXT)
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == text


def test_the_page_has_a_valid_structure(rows: Comparison, text: str) -> None:
    page = Page(text)
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {attributes["href"] for attributes in page.elements_named("a")}
    assert links == {f"#row-{k}" for k in range(len(rows.rows))} and all(link[1:] in ids for link in links)
    assert all(attributes["aria-labelledby"] in ids for _, attributes in page.elements if "aria-labelledby" in attributes)
    assert all(attributes["alt"] for attributes in page.elements_named("img")) and len(page.elements_named("img")) == len(rows.rows)
    assert [len(page.elements_named(name)) for name in ("h1", "main", "header", "footer", "table")] == [1] * 5
    assert page.elements_named("html", lang="en") and len(page.elements_named("option")) == 2 * len(rows.rows)
    for expected_text in (*REPORT_CONTEXT.values(), "Nothing is lit: only missed shadow can be measured.", "The fastest is sweep"):
        assert expected_text in page.text
    assert "Template" not in text and not re.search(
        r"\$[a-z]", re.sub(r"<script.*?</script>", "", text, flags=re.S).replace("$title", "")
    )


def test_the_table_is_sorted_by_the_error(rows: Comparison, text: str) -> None:
    page = Page(text)
    sorted_columns = [attributes for attributes in page.elements_named("th") if "aria-sort" in attributes]
    assert [attributes["aria-sort"] for attributes in sorted_columns] == ["ascending"]
    order = [int(attributes["data-row"]) for attributes in page.elements_named("tr") if "data-row" in attributes]
    errors = [rows.rows[k].figures["wrong_cast"] for k in order]
    assert errors == sorted(errors) and len(errors) == len(rows.rows)
    front = {int(attributes["data-row"]) for attributes in page.elements_named("tr", class_="front")}
    assert front == {k for k, row in enumerate(rows.rows) if row.figures["pareto"]}
    assert "20?" in page.text and "question mark" in page.text, "a time of a first run is marked"


def test_pictures_hold_every_class_and_level(rows: Comparison, text: str) -> None:
    data = data_of(text)
    assert (data["rows"], data["cols"], data["levels"]) == (ROWS, COLS, GRAY_LEVELS)
    assert np.array_equal(np.array(data["palette"]), palette())
    page = Page(text)
    order = [int(attributes["data-row"]) for attributes in page.elements_named("a") if attributes.get("class") is None]
    assert sorted(order) == list(range(len(rows.rows)))
    for k, picture in zip(order, page.elements_named("img"), strict=True):
        row, indexes = rows.rows[k], indexes_of(picture["src"])
        assert np.array_equal(indexes // GRAY_LEVELS == FALSE_SHADOW, row.false_shadow)
        assert np.array_equal(indexes // GRAY_LEVELS == MISSED_SHADOW, row.missed_shadow)
        assert np.array_equal(indexes % GRAY_LEVELS, np.rint(row.visibility / 255.0 * (GRAY_LEVELS - 1)))
    assert np.abs(decoded(data["ground"]).astype(int) - BASE_PICTURE).mean() < 12
    assert (data["left"], data["right"]) == (1, 4), (
        "the slider starts with the fastest casting row of the front and with its most accurate row"
    )


def test_pixels_that_no_light_reaches_are_no_cast_shadow() -> None:
    rows = comparison(NONE_FIGURES, figures("sweep", 1.0, 0.1))
    rows.rows[0].visibility[:, -1] = 0
    text = report_html(rows, BASE_PICTURE, REPORT_CONTEXT)
    images = {
        attributes["alt"].split()[2].rstrip(":"): indexes_of(attributes["src"]) for attributes in Page(text).elements_named("img")
    }
    assert (images["none"] == GRAY_LEVELS - 1).all()
    assert (images["sweep"][:, -1] == GRAY_LEVELS - 1).all() and (images["sweep"][:, -2] == 0).all()


def test_errors_have_the_colours_of_false_colours() -> None:
    nowhere = np.zeros((1, 1), bool)
    for error_flags, kind in (((True, False), FALSE_SHADOW), ((False, True), MISSED_SHADOW)):
        row = ComparisonRow({}, np.zeros((1, 1), np.uint8), nowhere | error_flags[0], nowhere | error_flags[1])
        colour = false_colours(np.zeros((1, 1)), row)[0, 0].astype(int)
        assert np.abs(palette()[GRAY_LEVELS * kind : GRAY_LEVELS * (kind + 1)].astype(int) - colour).max() < GRAY_LEVELS
    assert len(np.unique(palette(), axis=0)) == 3 * GRAY_LEVELS == len(palette())


@given(arrays(np.uint8, (7, 5)), arrays(np.int8, (7, 5), elements=st.integers(0, 2)), st.integers(1, 8))
def test_a_shrunk_picture_keeps_every_wrong_pixel(visibility: np.ndarray, wrong: np.ndarray, factor: int) -> None:
    small = palette_indexes(ErrorPicture(visibility, wrong == FALSE_SHADOW, wrong == MISSED_SHADOW), factor)
    assert small.shape == (-(-7 // factor), -(-5 // factor))
    for i, j in np.ndindex(small.shape):
        block = np.s_[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor]
        assert (small[i, j] // GRAY_LEVELS != CORRECT) == wrong[block].any()
        assert small[i, j] // GRAY_LEVELS in (wrong[block] if wrong[block].any() else [CORRECT])


def test_forty_noisy_pictures_fit_the_size_limit() -> None:
    rng = np.random.default_rng(3)
    side = 320
    ground = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
    noise = [rng.integers(0, 256, (side, side), dtype=np.uint8) for _ in range(8)]
    rows = [ErrorPicture(visibility, rng.random((side, side)) < 0.1, visibility > 250) for visibility in noise] * 5
    full_pictures = report_pictures(ground, rows, 10**9)
    assert full_pictures.shrink_factor == 1 and len(full_pictures.row_uris) == 40
    small_pictures = report_pictures(ground, rows, 400_000)
    assert small_pictures.character_count <= 400_000 < full_pictures.character_count and 1 < small_pictures.shrink_factor < 8
    fewer_grays = report_pictures(ground, rows, full_pictures.character_count - 1)
    assert (fewer_grays.shrink_factor, full_pictures.gray_levels, fewer_grays.gray_levels) == (1, GRAY_LEVELS, FEW_GRAY_LEVELS), (
        "pictures that are too large lose grays before they lose pixels"
    )
    levels = palette_indexes(rows[0], gray_levels=FEW_GRAY_LEVELS)
    assert np.array_equal(decoded(fewer_grays.row_uris[0]), palette(FEW_GRAY_LEVELS)[levels])
    assert (
        len(small_pictures.row_uris) == 40
        and (small_pictures.rows, small_pictures.cols) == decoded(small_pictures.row_uris[0]).shape[:2]
    )


def test_a_page_shrinks_pictures_to_keep_its_size() -> None:
    rng = np.random.default_rng(4)
    view = PerspectiveView(np.zeros(3), np.eye(3), 10.0, -2.5, -3.5, 1.0, 400, 500)
    noise = rng.integers(0, 256, (400, 500), dtype=np.uint8)
    template = comparison(*(figures(f"sweep-{k}", 1.0 + k, 0.1 / (1 + k)) for k in range(3)))
    noisy_rows = [ComparisonRow(row.figures, noise, noise > 250, noise < 5) for row in template.rows]
    rows = Comparison(view, "sun", noisy_rows, noise < 256, "wrong_cast", 0.0, 0.0, 0.0, 0.0, [])
    ground = rng.integers(0, 256, (400, 500, 3), dtype=np.uint8)
    assert "pixels of the view" in report_html(rows, ground, REPORT_CONTEXT)
    text = report_html(rows, ground, REPORT_CONTEXT, max_bytes=200_000)
    assert len(text.encode()) < 200_000 < MAX_PAGE_BYTES
    assert "each pixel of a picture covers" in text and data_of(text)["cols"] < 500


def test_a_long_remark_is_folded() -> None:
    names = ", ".join(f"shadow_map-{k}" for k in range(40))
    page = Page(
        report_html(comparison(NONE_FIGURES, remarks=["nothing is lit", f"left out: {names}"]), BASE_PICTURE, REPORT_CONTEXT)
    )
    assert names in page.text and "Nothing is lit." in page.text
    assert len(page.elements_named("details")) == 2, "one element for the remark, one for the settings of the row"


def test_each_omitted_row_has_its_command() -> None:
    commands = ["skugga compare x --only 'relief=sweep,meshes=hybrid'", "skugga compare x --only planar"]
    page = Page(report_html(comparison(NONE_FIGURES), BASE_PICTURE, REPORT_CONTEXT, commands))
    assert all(command in page.text for command in commands) and "left out by the time limit" in page.text
    assert "left out" not in Page(report_html(comparison(NONE_FIGURES), BASE_PICTURE, REPORT_CONTEXT)).text


@pytest.mark.parametrize("rows", [(), (NONE_FIGURES,), (figures("sweep", 0.0, 0.0),)], ids=["no rows", "none alone", "all zero"])
def test_a_page_of_one_row_or_none(rows: tuple[dict[str, Any], ...]) -> None:
    page = Page(
        report_html(
            comparison(*rows, remarks=["the view shows no surface: there is nothing to compare"]), BASE_PICTURE, REPORT_CONTEXT
        )
    )
    assert "The view shows no surface: there is nothing to compare." in page.text
    assert len(page.elements_named("table")) == bool(rows)


def test_points_are_ordered_by_time_and_error(rows: Comparison) -> None:
    page = Page(scatter_plot(rows))
    assert "none" not in page.text, "rows that cast no shadow are not plotted"
    points = {int(attributes["data-row"]): attributes for attributes in page.elements_named("a")}
    halos = page.elements_named("circle", class_="halo")
    places = {
        int(attributes["data-row"]): (float(halo["cx"]), float(halo["cy"]))
        for attributes, halo in zip(page.elements_named("a"), halos, strict=True)
    }
    indexes_by_time = sorted(places, key=lambda k: rows.rows[k].figures["ms_median"])
    assert indexes_by_time == sorted(places, key=lambda k: places[k][0]), "slower rows are plotted further right"
    indexes_by_time = sorted(places, key=lambda k: rows.rows[k].figures["wrong_cast"])
    assert indexes_by_time == sorted(places, key=lambda k: -places[k][1]), "more accurate rows are plotted lower"
    assert all(0 < x < SCATTER_WIDTH_PX and 0 < y < SCATTER_HEIGHT_PX for x, y in places.values())
    for k, attributes in points.items():
        assert attributes["aria-label"].startswith(rows.rows[k].figures["name"] + ":")
        assert attributes["aria-label"].endswith("on the front") == rows.rows[k].figures["pareto"]
    (line,) = page.elements_named("polyline", class_="stairs")
    corners = [tuple(map(float, place.split(","))) for place in line["points"].split()]
    for k, (x, y) in places.items():
        is_on_line = any((round(x, 1), round(y, 1)) == corner for corner in corners)
        assert is_on_line == rows.rows[k].figures["pareto"]
    assert all(a[0] == b[0] or a[1] == b[1] for a, b in pairwise(corners)), (
        "the line of the front has only horizontal and vertical parts"
    )


@given(st.lists(st.one_of(st.just(0.0), st.floats(1e-6, 1e6)), min_size=1, max_size=8), st.booleans())
def test_scales_keep_order_and_bounds(values: list[float], downwards: bool) -> None:
    start, end = (500.0, 0.0) if downwards else (0.0, 500.0)
    scale = log_scale_of(values, start, end)
    positions = [scale(value) for value in sorted(values)]
    assert all(0.0 < x < 500.0 for x in positions)
    assert positions == sorted(positions, reverse=downwards)
    assert len(scale.ticks()) >= 2 and all(scale.low * 0.99 <= tick <= scale.high * 1.01 for tick in scale.ticks())
    equal_ratios = [scale(scale.low * (scale.high / scale.low) ** share) for share in (0.0, 0.5, 1.0)]
    assert equal_ratios[1] == pytest.approx((equal_ratios[0] + equal_ratios[2]) / 2)


def test_bars_are_as_long_as_their_stages() -> None:
    quick, slow = figures("sweep", 100.0, 0.0), figures("hybrid", 150.0, 0.0, stages={"map": 60.0, "mask": 0.0, "visibility": 90.0})
    assert stages_of(quick) == {"depth map": 25.0, "visibility": 70.0, REST_STAGE: pytest.approx(5.0)}
    assert stages_of(slow) == {"map": 60.0, "visibility": 90.0}
    page = Page(bar_chart([slow, quick]))
    assert [attributes["data-row"] for attributes in page.elements_named("a")] == ["1", "0"], "rows are sorted by time"
    widths = [float(attributes["width"]) for attributes in page.elements_named("rect")]
    assert np.allclose(np.array(widths) / widths[0], np.array([25.0, 70.0, 5.0, 60.0, 90.0]) / 25.0, atol=1e-3)
    fills = [attributes["fill"] for attributes in page.elements_named("rect")]
    assert fills[1] == fills[4] and len(set(fills)) == 4, "the same stage has the same colour"


def test_one_slow_row_does_not_hide_the_others() -> None:
    rows = [figures(f"sweep-{k}", 10.0, 0.0, stages={"sweep": 10.0}) for k in range(9)]
    slow = figures("hybrid", 1000.0, 0.0, stages={"map": 250.0, "stencil": 750.0})
    page = Page(bar_chart([*rows, slow]))
    widths = [float(attributes["width"]) for attributes in page.elements_named("rect")]
    assert widths[0] > 0.3 * (widths[-2] + widths[-1]) and widths[-1] == pytest.approx(3 * widths[-2], rel=1e-3)
    assert len(page.elements_named("path", class_="cut")) == 1 and not Page(bar_chart(rows)).elements_named("path", class_="cut")


def test_marks_differ_in_shape_and_colour() -> None:
    marks = [algorithm.marker for algorithm in ALGORITHMS.values() if algorithm.is_selectable]
    assert len({mark.shape for mark in marks}) == len({mark.colour for mark in marks}) == len(marks)
    assert mark_of("shadow_map + sweep") == mark_of("sweep + shadow_map") != mark_of("sweep")
    assert mark_of("sweep + hybrid").colour == mark_of("sweep").colour
    assert mark_of("a newcomer") not in marks


def test_the_scatter_plot_is_a_standalone_svg(rows, tmp_path) -> None:
    """The SVG file is well-formed, has the names of the report's scatter plot, and loads nothing from elsewhere."""
    path = tmp_path / "scatter.svg"
    write_scatter(path, rows, ["First", MARKUP_TEXT])
    root = ElementTree.parse(path).getroot()
    texts = {"".join(item.itertext()) for item in root.iter("{http://www.w3.org/2000/svg}text")}
    casting = [row.figures for row in rows.rows if casts_shadow(row.figures, rows.light)]
    assert {"First", MARKUP_TEXT} <= texts and {algorithm_family(item, rows.light) for item in casting} <= texts
    assert len(list(root.iter("{http://www.w3.org/2000/svg}a"))) == len(casting) > 1
    assert "http" not in path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
