"""The list of everything in the seeds' texts: files, tests, sections and states are real, and the page shows the list."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.seeds.items import LIST_ANCHOR, PAGE, STATES, TEXT_TITLES, Item, find_problems, format_items, read_items

ROOT = Path(__file__).parents[2]


def test_items_name_existing_files_tests_and_sections():
    assert list(find_problems(read_items(), ROOT)) == []


def test_the_page_links_to_the_list_and_ends_with_it():
    page = (ROOT / "docs" / PAGE).read_text("utf-8")
    assert page.endswith("\n" + format_items(read_items())) and f"](#{LIST_ANCHOR})" in page


def test_the_list_counts_every_row():
    items = read_items()
    text = format_items(items)
    rows = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith(("| item |", "| ---"))]
    assert len(rows) == sum(map(len, items.values()))
    assert all(row.count(" | ") == 5 for row in rows), "no text breaks its table"
    for state in STATES:
        count = sum(item.state == state for texts in items.values() for item in texts)
        assert f"{count} {state.removesuffix('s')}" in text


@pytest.mark.parametrize(("changes", "problem"), [
    ({"state": "done", "note": "almost"}, "no such state: done. Allowed: works, partly, left out."),
    ({"files": ()}, "names no file or no test."),
    ({"tests": ()}, "names no file or no test."),
    ({"state": "partly", "note": ""}, "gives no reason."),
    ({"state": "left out", "note": ""}, "gives no reason."),
    ({"files": ("shadows/planes.py",)}, "no such file: shadows/planes.py"),
    ({"files": ("shadows",)}, "no such file: shadows"),
    ({"tests": ("tests/shadows/test_planar.py::test_pl",)}, "no such test: tests/shadows/test_planar.py::test_pl"),
    ({"tests": ("tests/test_no.py::test_no",)}, "no such test: tests/test_no.py::test_no"),
    ({"figure": "algorithms.md#no"}, "no such section: algorithms.md#no"),
    ({"figure": "#no"}, "no such section: #no"),
    ({"figure": "#one--and-two-sided-stencil-figure-22"}, "no such section: #one--and-two-sided-stencil-figure-22"),
    ({"figure": "no.md"}, "no such section: no.md"),
])  # fmt: skip
def test_a_wrong_item_is_found(changes: dict[str, Any], problem: str):
    item = next(item for item in read_items()["thesis"] if item.item == "BoxGrid")
    items: dict[str, list[Item]] = {text: [] for text in TEXT_TITLES}
    assert list(find_problems({**items, "thesis": [item]}, ROOT)) == []
    assert list(find_problems({**items, "thesis": [replace(item, **changes)]}, ROOT)) == [f"thesis: BoxGrid: {problem}"]


def test_missing_texts_and_repeated_items_are_found():
    item = read_items()["lecture"][0]
    assert list(find_problems({"lecture": [item]}, ROOT)) == [f"texts: lecture. Allowed: {', '.join(TEXT_TITLES)}."]
    items = {text: [item, item] if text == "lecture" else [] for text in TEXT_TITLES}
    assert list(find_problems(items, ROOT)) == [f"lecture: {item.item}: occurs 2 times."]


def test_an_unknown_key_is_an_error(tmp_path):
    path = tmp_path / "items.yaml"
    path.write_text("thesis:\n  - {item: a, section: '1', state: left out, figure: '#a', note: why}\n")
    assert read_items(path) == {"thesis": [Item("a", "1", "left out", "#a", note="why")]}
    path.write_text("thesis:\n  - {item: a, section: '1', state: left out, figure: '#a', reason: why}\n")
    with pytest.raises(TypeError, match="reason"):
        read_items(path)
