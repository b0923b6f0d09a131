"""``skugga select``: plans as text and JSON, and choices pinned in level files."""

from __future__ import annotations

import json
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from scripts.write_schemas import DOCS_FOLDER, MODEL_BY_SCHEMA_FILE, schema_text
from skugga.api import device_calibration
from skugga.api.catalogue import bundled_levels
from skugga.api.report.plan_text import format_expectation, format_overshoot, format_plan
from skugga.selector.cost import device_estimate
from skugga.selector.cost.device_profile import DeviceProfile, Residual, load_profile, profile_path
from skugga.shadows.plan import Plan, Predicted, Target
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import load_level


@pytest.fixture
def level(tmp_path: Path) -> Path:
    """Return a writable copy of a level file."""
    return Path(shutil.copy("configs/jacksboro.yaml", tmp_path / "mine.yaml"))


@pytest.mark.parametrize("model", MODEL_BY_SCHEMA_FILE)
def test_the_published_schemas_match_the_models(model):
    text = (DOCS_FOLDER / model).read_text(encoding="utf-8")
    assert text == schema_text(MODEL_BY_SCHEMA_FILE[model]), "python scripts/write_schemas.py writes them anew"


def test_json_is_a_plan_of_the_published_schema(gl, run):
    status, out, err = run("select", "jacksboro", "--policy", "rules", "--json")
    plan = Plan.model_validate_json(out)
    assert (status, err) == (0, "") and plan.policy == "rules" and plan.predicted is None
    assert set(json.loads(out)) == set(json.loads((DOCS_FOLDER / "plan.schema.json").read_text())["properties"])


def test_an_uncalibrated_software_rasteriser_is_estimated(gl, run):
    status, out, _ = run("select", "jacksboro", "--policy", "predict")
    output = " ".join(out.split())
    assert status == 0 and "chosen by prediction" in output and "not calibrated, so times are estimates" in output


def test_an_uncalibrated_graphics_card_falls_back_to_the_rules(gl, run, monkeypatch):
    monkeypatch.setattr(device_calibration, "load_profile", lambda renderer, version: None)
    monkeypatch.setattr(device_estimate, "is_software_rasteriser", lambda renderer: False)
    status, out, _ = run("select", "jacksboro", "--policy", "predict")
    assert status == 0 and "not calibrated" in out and "chosen by the rules" in " ".join(out.split())


def test_a_probe_is_the_default_and_reports_its_candidates(gl, run):
    status, out, _ = run("select", "jacksboro", "--size", "128x128")
    output = " ".join(out.split())
    assert status == 0 and "chosen by a probe" in output and "This device is not calibrated" in output
    assert "candidates drawn and compared with truth" in output and "wrong of" in output and "(expected: " in output


@pytest.mark.parametrize("path", bundled_levels(), ids=lambda path: path.stem)
def test_each_bundled_level_has_a_plan_as_text(gl, run, path):
    name = next(iter(load_level(path).level.views), "map")
    status, out, err = run("select", path.stem, "--view", name, "--policy", "rules")
    assert (status, err) == (0, "")
    assert all(len(line) <= 100 for line in out.splitlines())
    body = " ".join(out.split())
    assert f"View {name}, " in body and "Effects left out" in body and "Rejected algorithms" in body
    assert "_" not in re.sub(r"\S+/\S+", "", body), "names are written as words"
    paragraphs = [part for part in out.split("\n\n") if part]
    assert all(part.rstrip().endswith(".") for part in paragraphs)


def test_the_text_of_a_plan_has_every_reason(gl, run):
    _, out, _ = run("select", "thesis_room", "--view", "main", "--policy", "rules", "--json")
    plan = Plan.model_validate_json(out)
    plan_text = " ".join(format_plan(plan, "A plan.").split())
    for item in (*plan.reasons, *plan.effects, *plan.left_out):
        assert item.reason.lower() in plan_text.lower(), item


def test_options_change_the_plan_and_are_named_in_it(gl, run):
    arguments = ("--policy", "rules", "--algorithm", "shadow_map", "--map-size", "777", "--depth-bits", "32", "--max-error", "0.01")
    _, out, _ = run("select", "jacksboro", *arguments, "--max-ms", "40", "--azimuth", "90", "--altitude", "20", "--json")
    plan = json.loads(out)
    assert plan["algorithm"] == {"sun": {"relief": "shadow_map"}} and plan["target"] == {
        "max_error": 0.01, "max_ms": 40.0, "met": None,
    }  # fmt: skip
    assert plan["settings"]["sun"]["relief"]["map_size"] == 777
    reasons = {entry["name"]: entry["reason"] for entry in plan["reasons"]}
    assert reasons["sun/relief: shadow_map"] == reasons["map_size 777"] == "set by the request"
    _, out, _ = run("select", "jacksboro", "--policy", "rules", "--azimuth", "90", "--altitude", "-20")
    assert "20 degrees below the horizon in the east" in " ".join(out.split()) and "Relief casts nothing" in out


@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        (("--policy", "guess"), ("--policy", "guess", "rules, predict, probe, measure")),
        (("--policy", "rules", "--budget", "3s"), ("--budget", "cannot be combined with --policy rules")),
        (("--policy", "probe", "--budget", "soon"), ("--budget", "soon", "a number and a unit, s, m, h or d")),
        (("--view", "ridge"), ("view", "ridge", "map")),
        (("--max-error", "-0.01"), ("max_error", "0 to 1")),
        (("--max-error", "2"), ("max_error", "2.0", "0 to 1")),
        (("--max-ms", "-3"), ("max_ms", "-3.0", "greater than 0")),
        (("--max-ms", "soon"), ("--max-ms",)),
        (("--cascades", "5"), ("cascades", "5")),
        (("--bias-scale", "-1"), ("bias_scale: '-1.0'", "0 to 100")),
        (("--bias-scale", "101"), ("bias_scale: '101.0'", "0 to 100")),
        (("--algorithm", "magic"), ("--algorithm", "magic", "sweep")),
        (("--algorithm", "planar"), ("algorithm", "planar", "not flat")),
        (("--algorithm", "perspective_shadow_map"), ("algorithm", "no perspective")),
        (("--altitude", "10"), ("azimuth",)),
        (("--size", "0x5"), ("--size", "0x5")),
        (("--azimuth", "0", "--altitude", "-30", "--write"), ("--write", "cast shadow")),
        (("--descriptor", "no/such/folder.json"), ("no/such/folder.json",)),
    ],
)
def test_wrong_input_is_one_line(run, level, arguments, expected_texts):
    before = level.read_bytes()
    status, out, err = run("select", str(level), "--policy", "rules", *arguments)
    assert status in (1, 2) and out == "" and err.count("\n") == 1 and "Traceback" not in err
    for text in expected_texts:
        assert text in err, err
    assert level.read_bytes() == before


def test_a_pinned_choice_is_used_afterwards(gl, run, level):
    before = level.read_text(encoding="utf-8")
    status, _, err = run("select", str(level), "--policy", "rules", "--write")
    text = level.read_text(encoding="utf-8")
    assert status == 0 and str(level) in err and text.startswith(before) and "by the rules" in text and "View map" in text
    _, out, _ = run("select", str(level), "--policy", "rules", "--json")
    plan = Plan.model_validate_json(out)
    assert plan.reasons[0].reason == "set by the level"
    stats = level.parent / "stats.json"
    run("render", str(level), "--size", "60x60", "-o", str(level.parent / "x.png"), "--stats", str(stats))
    rendered_plan = json.loads(stats.read_text())["plan"]
    assert rendered_plan["algorithm"] == plan.model_dump(mode="json")["algorithm"]
    assert rendered_plan["reasons"][0]["reason"] == "set by the level"


def test_a_second_choice_ignores_the_first_pin(gl, run, level):
    run("select", str(level), "--policy", "rules", "--algorithm", "hybrid", "--map-size", "300", "--write")
    assert load_level(level).level.shadows.algorithm == {"relief": "hybrid"} and load_level(level).level.shadows.map_size == 300
    run("select", str(level), "--policy", "rules", "--write")
    text, shadows = level.read_text(encoding="utf-8"), load_level(level).level.shadows
    assert shadows.algorithm != {"relief": "hybrid"} and shadows.map_size == "auto"
    assert text.count("Pinned by") == 1 and "hybrid" not in text


def test_a_choice_that_another_view_cannot_use_is_not_pinned(gl, run, tmp_path):
    path = Path(shutil.copy("configs/thesis_street_sun.yaml", tmp_path / "street.yaml"))
    before = path.read_bytes()
    arguments = ("--view", "main", "--policy", "rules", "--algorithm", "perspective_shadow_map", "--write")
    status, _, err = run("select", str(path), *arguments)
    assert status == 2 and err.count("\n") == 1 and "view map" in err and "no perspective" in err
    assert path.read_bytes() == before


def test_the_descriptor_survives_a_round_trip(gl, run, tmp_path):
    path = tmp_path / "facts.json"
    status, _, _ = run("select", "jacksboro", "--policy", "rules", "--descriptor", str(path))
    restored = Descriptor.model_validate_json(path.read_text(encoding="utf-8"))
    assert status == 0 and restored.view == "map" and restored.casters == ("relief",)


def make_plan(predicted: Predicted | None, **target) -> Plan:
    """Return a plan without steps, with predicted figures and the fields ``target`` of its target."""
    return Plan(
        view="map", policy="predict", algorithm={}, settings={}, effects=[], left_out=[], rejected=[], passes=[],
        predicted=predicted, target=Target(**{"max_error": 0.03, **target}), reasons=[],
    )  # fmt: skip


def test_the_target_is_reported_as_met_or_missed():
    assert "not predicted" in format_expectation(make_plan(None)) and "at most 3 %" in format_expectation(make_plan(None))
    figures = Predicted(ms=55.0, wrong=0.01, wrong_cast=0.05)
    met = format_expectation(make_plan(figures, max_error=0.06, max_ms=60, met=True))
    assert "55 ms" in met and "5.0 %" in met and "meets the target" in met and "within 60 ms" in met
    missed_plan = make_plan(figures, max_ms=40, met=False)
    assert format_overshoot(missed_plan) == "2.0 % of the cast shadow and 15 ms"
    assert "misses the target" in format_expectation(missed_plan) and format_overshoot(missed_plan) in format_expectation(
        missed_plan
    )
    assert format_overshoot(make_plan(figures, max_error=0.06, max_ms=40, met=False)) == "15 ms"


def test_the_time_at_rest_is_told_where_it_is_shorter():
    figures = Predicted(ms=55.0, wrong=0.01, wrong_cast=0.01, ms_at_rest=12.0)
    assert format_expectation(make_plan(figures, met=True)).endswith(
        "meets the target: at most 3 % of the cast shadow wrong. While nothing moves: 12 ms a frame, since caches hold maps and "
        "volumes."
    )
    for ms_at_rest in (55.0, None):
        same = figures.model_copy(update={"ms_at_rest": ms_at_rest})
        assert "While nothing moves" not in format_expectation(make_plan(same, met=True))


def test_a_plan_over_the_render_timeout_misses_the_target(monkeypatch):
    monkeypatch.setenv("SKUGGA_RENDER_TIMEOUT_S", "0.05")
    message = format_expectation(make_plan(Predicted(ms=55.0, wrong=0.01, wrong_cast=0.01), met=True))
    assert (
        "meets the target" not in message and "refuses" in message and "SKUGGA_RENDER_TIMEOUT_S" in message and "50 ms" in message
    )
    assert "meets the target" in format_expectation(make_plan(Predicted(ms=45.0, wrong=0.01, wrong_cast=0.01), met=True))


def profile(**changes) -> DeviceProfile:
    """Return a calibration. ``changes`` replace fields."""
    fields = {
        "renderer": "a device", "version": "4.6", "cpus": 2, "engine": "0", "measured": datetime(2026, 1, 1, tzinfo=UTC),
        "took_s": 84.0, "rates_ns": {"depth_map": {"texels": 1.5}},
    }  # fmt: skip
    return DeviceProfile(**{**fields, **changes})


def test_calibrate_saves_and_reports_the_profile(run, monkeypatch):
    residuals = {"shadow_map": Residual(rows=9, median=0.05, p90=0.2)}
    measured = profile(rates_ns={"depth_map": {"texels": 1.5, "triangles": 20.0}}, residuals=residuals)
    monkeypatch.setattr("skugga.selector.cost.calibration.calibrate", lambda on_step: on_step(1, 2) or measured)
    status, out, err = run("calibrate")
    path = profile_path("a device", "4.6")
    assert (status, err) == (0, "") and load_profile("a device", "4.6") == measured
    output = " ".join(out.split())
    assert "a device" in output and "84 s" in output and "2 rates" in output and "5.0 %" in output and str(path) in output
    assert run("calibrate", "--json")[1] == measured.model_dump_json(indent=2) + "\n"


def test_calibrate_on_a_full_disk_measures_nothing(gl, run, monkeypatch, tmp_path, full_disk):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("skugga.selector.cost.calibration.calibrate", lambda on_step: pytest.fail("minutes of work for nothing"))
    with full_disk(100):
        status, out, err = run("calibrate")
    assert status == 1 and out == "" and err.count("\n") == 1 and str(tmp_path / "skugga" / "devices") in err


def test_calibrate_without_a_writable_cache_is_one_line(run, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr("skugga.selector.cost.calibration.calibrate", lambda on_step: pytest.fail("minutes of work for nothing"))
    status, out, err = run("calibrate")
    assert status == 1 and out == "" and err.count("\n") == 1 and "file" in err
