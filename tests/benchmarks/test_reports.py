"""The published comparisons: the page links its reports, and ``skugga`` accepts every command on it."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
import typer

from benchmarks.reports import __main__ as reports
from benchmarks.reports.measure import MAX_REPORT_BYTES, stored_figures, write_report
from benchmarks.reports.page import format_comparisons, omitted_row_commands
from benchmarks.reports.scenes import SCENES
from benchmarks.selection.page import END, START
from skugga.api.cli.main import app
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from tests.api.report.test_summary import NONE_FIGURES, comparison, figures

DOCS = reports.ROOT / "docs"
PAGE = reports.PAGE.read_text(encoding="utf-8")

REPORT_FACTS = dict.fromkeys(("level", "view", "size", "light", "device", "driver", "processors", "Skugga", "made"), "said")
RUN_FIGURES = {"time_limit_s": 70.0, "took_s": 70, "load": 0.0}


def parse_command(command: str) -> dict[str, Any]:
    """Return the parameters of a command line of ``skugga compare``. Raise the command's own errors."""
    program, name, *words = shlex.split(command)
    assert (program, name) == ("skugga", "compare")
    group: Any = typer.main.get_command(app)
    return group.commands[name].make_context(name, words).params


def make_record(*rows: dict[str, Any], **other_figures: Any) -> dict[str, Any]:
    """Return the stored figures of a scene whose comparison has these rows."""
    return stored_figures(SCENES["city"], comparison(*rows, **other_figures), REPORT_FACTS) | RUN_FIGURES


def measured_part(text: str) -> str:
    """Return the text between the marks of a page."""
    return text.partition(START)[2].partition(END)[0]


def test_the_comparison_page_is_up_to_date() -> None:
    assert measured_part(PAGE) == format_comparisons(reports.stored_records())


def test_the_page_links_exactly_the_existing_reports() -> None:
    report_names = {path.name for path in reports.REPORTS.iterdir()}
    assert report_names == {f"{name}.html" for name in SCENES} and set(reports.stored_records()) == set(SCENES)
    assert set(re.findall(r"\]\(\.\./compare/([^)]*)\)", PAGE)) == report_names
    assert set(re.findall(r"\]\(\.\./images/([^)]*)\)", PAGE)) == {f"compare-{name}.svg" for name in SCENES}


@pytest.mark.parametrize("name", SCENES)
def test_a_published_report_is_one_small_file(name: str) -> None:
    report = reports.REPORTS / f"{name}.html"
    text, stored_record = report.read_text(encoding="utf-8"), reports.stored_records()[name]
    assert report.stat().st_size < MAX_REPORT_BYTES
    assert not re.search(r"""(?:src|href)=["'](?!#|data:image/)""", text), "the page loads no other file"
    assert f"<dd>{stored_record['made']}</dd>" in text, "the page names the run of the report"
    assert all(row in text for row in stored_record["rows"])


@pytest.mark.parametrize("scene", SCENES.values(), ids=lambda scene: scene.name)
def test_the_command_of_a_scene_matches_its_measurement(scene: Any) -> None:
    parameters = parse_command(scene.command)
    assert (parameters["level"], parameters["view"], parameters["size"]) == (scene.level, scene.view, "{}x{}".format(*scene.size))
    assert scene.sun == (None if parameters["azimuth"] is None else (parameters["azimuth"], parameters["altitude"]))
    bounds = parameters["bounds"] and tuple(map(float, parameters["bounds"].split(",")))
    assert bounds == scene.bounds
    assert reports.stored_records()[scene.name]["command"] == scene.command


def test_skugga_accepts_every_command_on_the_page() -> None:
    blocks = "".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL))
    lines = [line for line in blocks.splitlines() if line] + re.findall(r"`(skugga compare [^`]*-o DIR)`", PAGE)
    assert len(lines) == sum(len(stored_record["left_out"]) + 1 for stored_record in reports.stored_records().values())
    for line in lines:
        parse_command(line)


def test_every_omitted_variant_has_its_command() -> None:
    left_out = ("relief=sweep,meshes=hybrid-768", "shadow_map-512-3-32")
    scene_record = make_record(figures("sweep", 12.0, 0.03), left_out=left_out)
    assert [parse_command(line)["only"] for line in omitted_row_commands(scene_record)] == [[name] for name in left_out]
    text = format_comparisons({"city": scene_record})
    assert all(f"\n{line}\n" in text for line in omitted_row_commands(scene_record)) and "1 of 3" in text
    assert "No variant was left out." in format_comparisons({"city": make_record(figures("sweep", 12.0, 0.03))})


def test_an_invalid_command_is_detected() -> None:
    with pytest.raises(Exception, match="--row"):
        parse_command("skugga compare jacksboro --row sweep")


def test_the_page_lists_the_cheapest_row_of_each_target() -> None:
    leaky = figures("planar", 1.0, 0.001, interior=2 * MAX_INTERIOR_SHARE)
    scene_record = make_record(
        NONE_FIGURES, leaky, figures("shadow_map-1", 5.0, 0.08), figures("sweep", 20.0, 0.008), figures("hybrid", 30.0, 0.009)
    )
    assert "| city | `wrong_cast` | `shadow_map-1`, 5.0 ms | `sweep`, 20 ms | `sweep`, 20 ms | none |" in format_comparisons(
        {"city": scene_record}
    )


@pytest.mark.parametrize(
    ("rival", "place"),
    [
        ({"ms": 5.0, "error": 0.01, "soft_error": 0.01}, "dominated by `sweep` (time and `wrong_cast` and `soft_error`)"),
        ({"ms": 5.0, "error": 0.01, "soft_error": 0.9}, "on the front by `soft_error`: no row dominates it"),
        ({"ms": 50.0, "error": 0.01, "soft_error": 0.01}, "on the front by `wrong_cast` and `soft_error`: no row dominates it"),
    ],
)
def test_the_page_ranks_the_default(rival: dict[str, float], place: str) -> None:
    default = figures("hybrid", 10.0, 0.02, pareto_soft=not (rival["ms"] < 10.0 and rival["soft_error"] < 0.02))
    scene_record = make_record(default, figures("sweep", **rival), default_row_name="hybrid")
    assert f"| city | `hybrid` | 2.0 % | 2.0 % | 10 ms | {place} |" in format_comparisons({"city": scene_record})


def test_names_of_rows_in_sentences_are_code() -> None:
    """Underscores would be emphasis in Markdown, and one name may begin with another."""
    scene_record = make_record(figures("shadow_map", 1.0, 0.1), figures("shadow_map-1024-1-32", 2.0, 0.01))
    text = format_comparisons({"city": scene_record})
    assert "The fastest is `shadow_map`: " in text and "The most accurate is `shadow_map-1024-1-32`: " in text


def test_a_report_that_is_too_large_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report("å" * (MAX_REPORT_BYTES // 2 - 1), path)
    with pytest.raises(RuntimeError, match="less than 1000000"):
        write_report("å" * (MAX_REPORT_BYTES // 2), path)
    assert path.stat().st_size == MAX_REPORT_BYTES - 2


def test_a_failed_scene_is_reported_and_the_others_are_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene_names = []

    def run(words: list[str], check: bool) -> subprocess.CompletedProcess[str]:
        scene_names.append(words[-1])
        return subprocess.CompletedProcess(words, int(words[-1] == "city"))

    monkeypatch.setattr("subprocess.run", run)
    assert reports.make_reports(list(SCENES), ["DATA"]) == ["city"] and scene_names == list(SCENES)
    assert "city: failed, exit status 1" in capsys.readouterr().err
