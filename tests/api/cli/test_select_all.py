"""``skugga select --all-views``: one table of choices, and one list of pins in the level's file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from skugga.terrain.level.level import load_level

LEVEL = """\
version: 1   # the first
terrain: {flat: {size: [120, 120], cells: [40, 40]}}
meshes: [{generate: tetrahedra}]
sun: {azimuth: 200, altitude: 35}
views:
  eye: {kind: perspective, eye: [-30, -48, 15], target: [3, 2, 2], size: [64, 48]}
  away: {kind: perspective, eye: [30, 48, 15], target: [50, 55, 9], size: [64, 48]}   # looks past it
shadows:
  max_error: 0.02   # ours
"""
RULES_OPTIONS = ("--all-views", "--policy", "rules")


@pytest.fixture
def level(tmp_path: Path) -> Path:
    """File of the level ``LEVEL``."""
    path = tmp_path / "mine.yaml"
    path.write_text(LEVEL)
    return path


def test_each_view_and_the_map_have_a_row(run, level):
    status, out, err = run("select", str(level), *RULES_OPTIONS)
    assert (status, err) == (0, "")
    rows = [line.split()[0] for line in out.splitlines() if line.strip() and line.split()[0] in ("map", "eye", "away")]
    assert rows == ["map", "eye", "away"] and "35 degrees high in the south-south-west" in out and "not predicted" in out


def test_json_has_one_object_for_each_view(run, level):
    _, out, _ = run("select", str(level), *RULES_OPTIONS, "--json", "--azimuth", "90", "--altitude", "20")
    rows = json.loads(out)
    assert [row["view"] for row in rows] == ["map", "eye", "away"]
    assert all(row["sun"] == {"azimuth": 90.0, "altitude": 20.0} and row["plan"]["view"] == row["view"] for row in rows)
    view_plan = json.loads(
        run("select", str(level), "--view", "eye", "--policy", "rules", "--json", "--azimuth", "90", "--altitude", "20")[1]
    )
    assert rows[1]["plan"] == view_plan


def test_written_pins_are_used_by_later_plans(run, level):
    before = {row["view"]: row["plan"] for row in json.loads(run("select", str(level), *RULES_OPTIONS, "--json")[1])}
    status, _, err = run("select", str(level), *RULES_OPTIONS, "--write")
    assert status == 0 and str(level) in err
    text, shadows = level.read_text(), load_level(level).level.shadows
    assert [line for line in text.splitlines() if line in LEVEL.splitlines()] == LEVEL.splitlines()
    assert text.count("#: Pinned by skugga select") == 1 and "#: Pinned keys: pins." in text
    assert {pin.view for pin in shadows.pins} <= set(before) and shadows.algorithm == "auto"
    for pin in shadows.pins:
        plan = json.loads(run("select", str(level), "--view", pin.view, "--policy", "rules", "--json")[1])
        assert plan["algorithm"] == before[pin.view]["algorithm"] and plan["settings"] == before[pin.view]["settings"]
        assert f"pinned by the level for view {pin.view}" in {reason["reason"] for reason in plan["reasons"]}
    run("select", str(level), *RULES_OPTIONS, "--write")
    assert level.read_text() == text


def test_one_pin_for_all_views_replaces_the_list_and_back(run, level):
    run("select", str(level), *RULES_OPTIONS, "--algorithm", "hybrid", "--write")
    assert all("hybrid" in json.dumps(pin.algorithm) for pin in load_level(level).level.shadows.pins)
    run("select", str(level), "--view", "eye", "--policy", "rules", "--write")
    shadows = load_level(level).level.shadows
    assert shadows.pins == () and shadows.algorithm != "auto" and "hybrid" not in level.read_text()
    run("select", str(level), *RULES_OPTIONS, "--write")
    assert load_level(level).level.shadows.algorithm == "auto" and load_level(level).level.shadows.pins


@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        (("--view", "eye"), ("--view: cannot be combined with --all-views",)),
        (("--size", "9x9"), ("--size: cannot be combined with --all-views",)),
        (("--descriptor", "x.json"), ("--descriptor: cannot be combined with --all-views",)),
        (("--policy", "guess"), ("--policy", "guess", "rules, predict")),
        (("--azimuth", "0", "--altitude", "-30", "--write"), ("--write", "no view", "cast shadow")),
    ],
)
def test_wrong_input_is_one_line(run, level, arguments, expected_texts):
    status, out, err = run("select", str(level), *RULES_OPTIONS, *arguments)
    assert status in (1, 2) and out == "" and err.count("\n") == 1
    for text in expected_texts:
        assert text in err
    assert level.read_text() == LEVEL


def test_validate_checks_pins_under_their_suns(run, level):
    pins = "  pins: [{view: eye, algorithm: hybrid}, {view: map, sun_altitude_deg: [40, 60], algorithm: perspective_shadow_map}]\n"
    level.write_text(LEVEL + pins)
    status, _, err = run("validate", str(level))
    assert status != 0 and "shadows.pins.1.algorithm" in err and "in view map" in err
