"""The operators' page is up to date: its tables are generated from the settings, the metrics and the kinds of problems."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from prometheus_client.metrics_core import Metric

from scripts.reference_pages import problems_table, settings_table
from skugga.api.animations.animations import Animations
from skugga.api.animations.drawing import frame_renderer, write_animation
from skugga.api.http.levels.sent_descriptor import MAX_BANDS, MAX_LAMPS
from skugga.api.http.state.encoded_tiles import EncodedTiles
from skugga.api.http.state.metrics import ServiceMetrics
from skugga.api.settings import Settings
from skugga.api.workers.pool import Pool

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "operating.md"


def metrics_table(families: list[Metric]) -> str:
    """Return the table of all metrics."""
    rows = ["| metric | kind | what |", "| --- | --- | --- |"]
    for family in sorted(families, key=lambda item: item.name):
        name = family.name + ("_total" if family.type == "counter" else "")
        rows.append(f"| `{name}` | {family.type} | {family.documentation} |")
    return "\n".join(rows)


def families() -> list[Metric]:
    """Return all metrics of a service that has not served a request."""
    settings = Settings(workers=1)
    pool = Pool(settings)
    animations = Animations(settings, frame_renderer(pool, None), write_animation)  # type: ignore[arg-type]
    return list(ServiceMetrics(pool, EncodedTiles(1), animations).registry.collect())


@pytest.mark.parametrize(
    ("name", "table"),
    [("settings", settings_table), ("metrics", lambda: metrics_table(families())), ("problems", problems_table)],
)
def test_tables_of_the_page_are_up_to_date(name: str, table, request: pytest.FixtureRequest):
    text = PAGE.read_text(encoding="utf-8")
    match = re.search(rf"<!-- {name} -->\n(.*?)<!-- /{name} -->", text, re.DOTALL)
    assert match is not None
    if request.config.getoption("--regenerate-goldens"):
        PAGE.write_text(text[: match.start(1)] + table() + "\n" + text[match.end(1) :], encoding="utf-8")
        return
    assert match[1].strip() == table(), "pytest --regenerate-goldens writes it anew"


def test_every_setting_is_described():
    assert all(field.description for field in Settings.model_fields.values())


def test_page_names_exactly_the_settings():
    named = set(re.findall(r"SKUGGA_([A-Z_]+)", PAGE.read_text(encoding="utf-8")))
    assert named == {name.upper() for name in Settings.model_fields}


def test_page_states_the_descriptor_limits():
    assert f"up to {MAX_LAMPS} lamps and {MAX_BANDS} bands" in PAGE.read_text(encoding="utf-8")


def attacks() -> list[tuple[str, str]]:
    """Return file and name of every test that ``SECURITY.md`` names."""
    return re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", (ROOT / "SECURITY.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("file", "name"), attacks())
def test_tests_named_by_the_security_page_exist(file: str, name: str):
    assert re.search(rf"^def {name}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), f"{file} has no {name}"


def test_every_attack_names_a_test():
    page = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    lines = [line for line in page.splitlines() if line.startswith("* **")]
    assert len(lines) == len(attacks()) == int(re.search(r"(\d+) kinds of attacks", page)[1])  # type: ignore[index]
    assert all(re.search(r"`tests/[\w/]+\.py::\w+`$", line) for line in lines)
