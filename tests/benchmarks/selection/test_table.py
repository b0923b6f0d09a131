"""The measured table: writing and reading round-trip, and the stored lines are consistent."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

import pytest

from benchmarks.selection.table import DIGITS, ROW_COLUMNS, TABLE, read_table, write_table
from skugga.selector.choices import StandaloneRequest
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.planner.planner import planner_of
from skugga.selector.portfolio import portfolio
from skugga.selector.predict import MAX_OPTIONS
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand, Casting, LightFacts
from skugga.terrain.level.level import SUN, Shadows

DEVICE = DeviceProfile(
    renderer="a device", version="1", cpus=2, engine="0", measured=datetime(2025, 1, 1, tzinfo=UTC), took_s=1.25,
    rates_ns={"planar": {"blocks": 0.1 + 0.2}},
)  # fmt: skip

DIFFERING_SHARES = tuple(k / 31.0 for k in range(8))


def descriptor_with_digits() -> Descriptor:
    """Return a map view under the sun with numbers of more digits than the table stores."""
    band = CastBand(near_m=0.0, share=1.0, cast=1.0 / 3.0, pixel_m=4.0 / 7.0, differs=DIFFERING_SHARES)
    lights = {SUN: LightFacts(cast_share=1.0 / 3.0, casts={"relief": Casting(share=1.0 / 3.0, bands=(band,))})}
    return Descriptor(
        view="map", view_kind="map", flat_world=False, pixel_m=4.0 / 7.0, node_m=30.0 / 7.0, casters=("relief",),
        relief_m=200.0 / 3.0, block_relief_m=20.0, sun_azimuth_deg=140.0 / 3.0, sun_altitude_deg=30.0, highest_sun_deg=30.0,
        receivers_light_m=(200.0 / 3.0, 100.0, 1e5 / 7.0), lights=lights, facts={"snow": {"lies": False, "on": True, "why": None}},
    )  # fmt: skip


def view_record(name: str = "a map", count: int = 3) -> dict[str, Any]:
    """Return the record of a view with ``count`` measured plans."""
    rows = {
        f"shadow_map-{number}": dict(zip(ROW_COLUMNS, (["shadow_map"], 1.5 + number, 0.01, 0.1, 0.0, 0.2, 2**number), strict=True))
        for number in range(count)
    }
    choices = {f"shadow_map {number}": row for number, row in enumerate(rows)} | {"rules 0.03": "shadow_map-0"}
    return {
        "name": name, "terrain": "made", "light": SUN, "error": "wrong_cast", "noise_floor": 1e-4, "plan_ms": 20.25, "rows": rows,
        "picks": choices, "measured": {"3 %": "shadow_map-1"}, "descriptor": descriptor_with_digits().model_dump(mode="json"),
        "probe": {"start_s": 0.5, "points_s": [0.25], "rows": {"shadow_map-1": {"ms": 2.5, "draw_s": 0.0, "proofs": [[0.125, 3]]}}},
    }  # fmt: skip


def test_the_table_survives_a_round_trip(tmp_path):
    path, view = tmp_path / "table.jsonl", view_record()
    write_table([view], DEVICE, path)
    (read,), device = read_table(path)
    assert device == DEVICE
    assert {key: read[key] for key in read if key != "descriptor"} == {key: view[key] for key in view if key != "descriptor"}
    original, restored = view["descriptor"], Descriptor.model_validate(read["descriptor"]).model_dump(mode="json")
    assert list(iterate_numbers(restored)) == pytest.approx(
        list(iterate_numbers(original)), rel=0.5 * 10.0 ** (1 - DIGITS), abs=0.0
    )
    assert list(iterate_numbers(restored)) != list(iterate_numbers(original))  # thirds are rounded
    assert dict(iterate_other_values(restored)) == dict(iterate_other_values(original))


def test_unmeasured_picks_and_single_rows_are_left_out(tmp_path):
    path, view = tmp_path / "table.jsonl", view_record()
    unmeasured = view | {"picks": view["picks"] | {"planar": "planar"}}
    write_table([unmeasured, view_record("another", 1), view_record("third", 2)], DEVICE, path)
    first, third = read_table(path)[0]
    assert first["picks"] == view["picks"] and third["name"] == "third"
    assert len(path.read_text(encoding="utf-8").splitlines()) == 4  # lines that are not read stay in the file


def test_rewriting_the_stored_table_changes_no_line(tmp_path, stored_table):
    views, device = stored_table
    write_table(views, device, tmp_path / "table.jsonl")
    assert read_table(tmp_path / "table.jsonl") == (views, device)
    assert set((tmp_path / "table.jsonl").read_text(encoding="utf-8").splitlines()) <= set(
        TABLE.read_text(encoding="utf-8").splitlines()
    )


def test_every_stored_line_has_a_valid_descriptor_and_rows(stored_table):
    device, *lines = map(json.loads, TABLE.read_text(encoding="utf-8").splitlines())
    assert DeviceProfile.model_validate(device) == stored_table[1]
    assert len({line["name"] for line in lines}) == len(lines)
    for line in lines:
        descriptor = Descriptor.model_validate(line["descriptor"])
        assert line["light"] in descriptor.lights and line["renderer"] == device["renderer"], line["name"]
        assert line["error"] in ("wrong_cast", "wrong", "coverage") and line["noise_floor"] >= 0.0 and line["plan_ms"] > 0.0
        for row in line["rows"].values():
            figures = dict(zip(ROW_COLUMNS, row, strict=True))
            assert figures["bytes"] >= 0 and (figures["ms"] > 0.0) == bool(figures["algorithms"]), line["name"]
            assert 0.0 <= figures["interior"] <= figures["wrong"] <= figures["wrong_cast"] <= 1.0, line["name"]
            assert 0.0 <= figures["coverage"] <= 1.0, line["name"]
        assert all(0 <= number < len(line["rows"]) for number in line["picks"].values()), line["name"]


def test_the_stored_table_has_enough_views_and_picks(stored_table):
    views, _ = stored_table
    assert len(views) >= 60 and all(len(view["rows"]) > 1 for view in views)
    assert all(len(view["rows"]) <= MAX_OPTIONS for view in views), "policies search all measured choices"
    choices = {view["name"]: {choice for choice in view["picks"] if not choice.startswith("rules ")} for view in views}
    for view in views:
        descriptor, light = Descriptor.model_validate(view["descriptor"]), view["light"]
        casting = planner_of(descriptor, StandaloneRequest(Shadows(), tuple(descriptor.lights))).casting_kinds(light)
        assert choices[view["name"]] <= {choice.name for choice in portfolio(descriptor, light, casting)}, view["name"]
    assert all(any(choice.startswith("rules ") for choice in view["picks"]) for view in views)


def iterate_numbers(value: Any):
    """Yield the numbers of nested lists and dictionaries, in order."""
    if isinstance(value, dict | list | tuple):
        for entry in value.values() if isinstance(value, dict) else value:
            yield from iterate_numbers(entry)
    elif isinstance(value, float):
        yield value


def iterate_other_values(value: Any, path: str = ""):
    """Yield all values that are no numbers, with their paths."""
    if isinstance(value, dict | list | tuple):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from iterate_other_values(entry, f"{path}.{key}")
    elif not isinstance(value, float):
        yield path, value
