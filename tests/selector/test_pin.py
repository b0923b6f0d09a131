"""Pins: choices written into level files. All other bytes stay, and a later render uses the pinned choices."""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from skugga.selector.choices import Choice, StandaloneRequest
from skugga.selector.pin import PIN_COMMENT, pin, pinned_keys, pinned_text, pins
from skugga.selector.planner.planner import make_plan
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError, LevelError
from skugga.terrain.level.level import load_level, override_settings
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene

PIN_REASONS = ["Pinned by skugga select on 2026-11-22: view map.", "sun/relief: sweep, for it is exact."]
PIN_SETTINGS = {"algorithm": {"relief": "sweep", "forest": "shadow_map"}, "map_size": 2048}

HEAD = "version: 1\ntitle: 'Hänge  am  Öst'   # ö\nterrain: {source: jacksboro}\n"
LEVEL_TEXTS = {
    "no shadows": HEAD,
    "no final newline": HEAD.removesuffix("\n"),
    "flow style": f"{HEAD}shadows: {{map_size: auto}}   # said\n# tail\n",
    "flow style over lines": f"{HEAD}shadows:\n  {{map_size: 64,   # small\n   filter: 1}}\nwater: {{level: 3}}\n",
    "empty": f"{HEAD}shadows: {{}}\nseconds: 2",
    "block style": f"{HEAD}shadows:\n  # coarse\n  map_size: auto    # keep\n  # after\n\nweather: {{snow: false}}\n",
    "deeper": f"{HEAD}shadows:\n      algorithm:\n        relief: sweep  # was\n      # in\n      filter: 3\nsun: none\n",
    "anchors": f"{HEAD}shadows: {{max_error: &e 0.02}}\nweather: {{cloud_cover: *e}}\n",
    "an alias within": f"{HEAD}shadows: {{algorithm: {{relief: &a sweep, meshes: *a}}, map_size: 512}}\n",
    "an alias for a setting": f"{HEAD}water: {{level: &n 512}}\nshadows:\n  map_size: *n   # as the water\n",
    "line ends of another system": f"{HEAD}shadows:\n  map_size: 512  # x\nsun: none\n".replace("\n", "\r\n"),
    "byte order mark": f"\ufeff{HEAD}",
    "a document's marks": f"%YAML 1.2\n---\n{HEAD}...\n",
    "JSON": '{"version": 1, "title": "ö", "terrain": {"source": "jacksboro"}}',
    "JSON with shadows": '{\n  "version": 1,\n  "shadows": {"map_size": "auto"},\n  "terrain": {"source": "jacksboro"}\n}\n',
    "a lamp": f"{HEAD}lights: {{lamp: {{kind: omni, position: [0, 0, 9]}}}}\nshadows: {{algorithm: {{lamp: hybrid}}}}\n",
}


def load(text: str) -> dict:
    """Return the content of a YAML text."""
    return YAML(typ="safe", pure=True).load(text)


def removed_lines(before: str, after: str) -> list[str]:
    """Return the lines of a text that an edited text lacks."""
    return [line[2:] for line in difflib.ndiff(before.splitlines(), after.splitlines()) if line.startswith("- ")]


@pytest.mark.parametrize("name", LEVEL_TEXTS)
def test_pinned_text_sets_choices_and_keeps_the_rest(name):
    before = LEVEL_TEXTS[name]
    after = pinned_text(before, PIN_SETTINGS, PIN_REASONS)
    assert after is not None
    old, new = load(before), load(after)
    assert new["shadows"] == {**old.get("shadows", {}), **PIN_SETTINGS}
    assert {**new, "shadows": None} == {**old, "shadows": None}
    touched = ("shadows", "algorithm", "map_size", "relief", "filter")
    assert all(any(word in line for word in touched) for line in removed_lines(before, after) if "JSON" not in name)
    assert after.count(PIN_COMMENT) == 1 and "sweep, for it is exact" in after
    assert ("\r\n" in before) == ("\r\n" in after) and "\n" not in after.replace("\r\n", "") if "\r\n" in before else True
    for comment in ("# ö", "# said", "# tail", "# small", "# coarse", "# keep", "# after", "# in\n", "# as the water"):
        assert (comment in before) == (comment in after)


@pytest.mark.parametrize("name", LEVEL_TEXTS)
def test_pinned_text_replaces_the_previous_pin(name):
    pinned = pinned_text(LEVEL_TEXTS[name], PIN_SETTINGS, PIN_REASONS)
    assert pinned is not None and pinned_text(pinned, PIN_SETTINGS, PIN_REASONS) == pinned
    repinned = pinned_text(pinned, {"algorithm": {"relief": "hybrid"}}, [PIN_REASONS[0], "For another reason."])
    assert repinned is not None and repinned.count(PIN_COMMENT) == 1 and "sweep, for it is exact" not in repinned
    assert load(repinned)["shadows"] == {**load(pinned)["shadows"], "algorithm": {"relief": "hybrid"}, "map_size": "auto"}
    restored = pinned_text(repinned, PIN_SETTINGS, PIN_REASONS)
    assert restored == pinned


PIN_LIST = {
    "pins": [
        {"view": "map", "sun_altitude_deg": [5, 20.5], "algorithm": {"relief": "sweep", "meshes": "shadow_map"}, "map_size": 2048},
        {"view": "grüne Au", "algorithm": {"sun": {"relief": "hybrid"}, "lamp": {"meshes": "planar"}}},
    ]
}
LEVEL_TEXTS_WITH_PINS = {
    "a list of hand": f"{HEAD}shadows:\n  pins:   # mine\n  - {{view: a, filter: 1}}\n  map_size: 64  # kept\n",
    "a list over lines": f"{HEAD}shadows:\n    pins:\n      - view: a\n        filter: 1\n      - filter: 2\n\n# tail\nsun: none\n",
    "a list in brackets": f"{HEAD}shadows:\n  pins: [{{view: a, filter: 1}}]  # mine\n  map_size: 64  # kept\n",
    "an empty list": f"{HEAD}shadows:\n  pins: []   # mine\n# tail\n",
    "a list in braces": f"{HEAD}shadows: {{pins: [{{filter: 1}}], map_size: 64}}   # said\n",
    "a list of JSON": '{"version": 1, "shadows": {"pins": [{"filter": 1}]}, "terrain": {"source": "jacksboro"}}',
    "a list of another system": f"{HEAD}shadows:\n  pins:\n  - {{filter: 1}}\nsun: none # x\n".replace("\n", "\r\n"),
}


@pytest.mark.parametrize("name", [*LEVEL_TEXTS, *LEVEL_TEXTS_WITH_PINS])
def test_pinned_text_replaces_the_previous_list(name):
    before = {**LEVEL_TEXTS, **LEVEL_TEXTS_WITH_PINS}[name]
    pinned = pinned_text(before, PIN_LIST, PIN_REASONS)
    assert pinned is not None and pinned_text(pinned, PIN_LIST, PIN_REASONS) == pinned
    old = load(before)
    assert load(pinned) == {**old, "shadows": {**old.get("shadows", {}), **PIN_LIST}}
    assert "\n" not in pinned.replace("\r\n", "") if "\r\n" in before else "\r" not in pinned
    for comment in ("# ö", "# said", "# tail", "# small", "# coarse", "# keep", "# after", "# in\n", "# mine", "# kept", "# x"):
        assert (comment in before) == (comment in pinned)
    assert "grüne Au" in pinned
    without_pins = pinned_text(pinned, PIN_SETTINGS, PIN_REASONS)
    assert without_pins is not None and load(without_pins)["shadows"] == {**load(pinned)["shadows"], **PIN_SETTINGS, "pins": []}
    restored = pinned_text(without_pins, PIN_LIST, PIN_REASONS)
    assert restored is not None
    assert load(restored)["shadows"] == {**load(pinned)["shadows"], **dict.fromkeys(PIN_SETTINGS, "auto")}
    assert pinned_text(restored, PIN_LIST, PIN_REASONS) == restored
    for comment in ("# ö", "# said", "# tail", "# mine", "# kept"):
        assert (comment in before) == (comment in restored)


COMMENTED_SHADOWS = {
    "lines and ends of lines": """  pins:   # mine
    # <1> all of them
    - {view: away, filter: 1}   # <2>
    # <3> the map
    #<4>  of tiles
    - {view: map, sun_altitude_deg: [5, 20.5], filter: 3}   # <5> # it is
    # <6>
    - {view: map, filter: 1}  # <7>
  # tail
  map_size: 64
""",
    "blocks": """  pins:
  -   # <1>
    view: grüne Au   # <2>
    # <3>
    filter: 1   # <4>

  - # <5>
    algorithm:   # <6>
      relief: sweep   # <7>
""",
    "brackets over lines": """  pins: [{view: "no # comment, 'at all'", filter: 1},   # <1>
    # <2>
    {view: 'map # 2', filter: 3} # <3>
    ,#<4>
  ]  # tail
  map_size: 64
""",
    "nothing in brackets": "  pins: [   # <1>\n    # <2>\n  ]  # tail\n",
    "other keys": "  filter: 1\n  algorithm:\n    # <1>\n    relief: sweep  # <2>\n    meshes: hybrid  # tail\n  pins: []\n",
}
COMMENTED_SHADOWS_IN_BRACES = {
    "braces": """shadows:
  {map_size: 64,   # tail
   algorithm: {relief: sweep,   # <1>
     meshes: hybrid}, pins: [   # <2>
     {view: map, filter: 1}]}
""",
    "braces on the key's line": "shadows: {pins: [   #~ <1>\n    {view: map,   # <2>\n    filter: 1}]}   # tail\n",
}


@pytest.mark.parametrize("first_keys", [PIN_LIST, {**PIN_SETTINGS, **PIN_LIST}])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("name", [*COMMENTED_SHADOWS, *COMMENTED_SHADOWS_IN_BRACES])
def test_pinned_text_keeps_user_comments_in_replaced_values(name, line_end, first_keys):
    text = (
        f"{HEAD}shadows:\n{COMMENTED_SHADOWS[name]}" if name in COMMENTED_SHADOWS else HEAD + COMMENTED_SHADOWS_IN_BRACES[name]
    ).replace("\n", line_end)
    comments = re.findall(r"#[^\r\n]*", re.sub(r"""(["'])[^"'].*?\1""", "", text))
    assert len(comments) >= 3
    for chosen in (first_keys, {"pins": []}, PIN_SETTINGS, PIN_LIST, {"pins": PIN_LIST["pins"][::-1]}):
        text = pinned_text(text, chosen, PIN_REASONS)
        assert text is not None and pinned_text(text, chosen, PIN_REASONS) == text
        assert [text.count(comment) for comment in comments] == [1] * len(comments)
        lines = text.split(line_end)
        assert all(any(line.endswith(comment) for line in lines) for comment in comments), "none is a part of another one"
        assert {"\r", "\n"} & set("".join(lines)) == set() and load(text)["shadows"].items() >= chosen.items()


def test_pinned_text_moves_comments_with_their_pin():
    after = pinned_text(
        f"version: 1\nshadows:\n{COMMENTED_SHADOWS['lines and ends of lines']}", PIN_LIST, ["Pinned by skugga select."]
    )
    assert after == (
        "version: 1\n#: Pinned by skugga select.\n#: Pinned keys: pins.\nshadows:\n"
        "  # <1> all of them\n  # <2>\n  # <6>\n  # <7>\n  pins:   # mine\n    # <3> the map\n    #<4>  of tiles\n"
        "    - {view: map, sun_altitude_deg: [5, 20.5], algorithm: {relief: sweep, meshes: shadow_map}, map_size: 2048}"
        "  # <5> # it is\n"
        '    - {view: "grüne Au", algorithm: {sun: {relief: hybrid}, lamp: {meshes: planar}}}\n  # tail\n  map_size: 64\n'
    )
    in_blocks = pinned_text(f"version: 1\nshadows:\n{COMMENTED_SHADOWS['blocks']}", PIN_LIST, PIN_REASONS)
    assert in_blocks is not None
    assert '    # <1>\n    # <2>\n    # <3>\n    # <4>\n    - {view: "grüne Au"' in in_blocks
    assert "shadows:\n  # <5>\n  # <6>\n  # <7>\n  pins:\n" in in_blocks


def test_pinned_text_drops_its_old_comment_in_a_list():
    before = f"version: 1\nshadows:\n  pins:\n    {PIN_COMMENT} of old.\n    #: And why.\n    # mine\n    - {{filter: 1}}\n"
    after = pinned_text(before, PIN_LIST, PIN_REASONS)
    assert after is not None and "# mine" in after and "of old" not in after and "And why" not in after


def test_pinned_text_writes_one_line_per_pin():
    before = "version: 1\nshadows:\n  max_error: 0.01  # fine\n"
    after = pinned_text(before, PIN_LIST, ["Pinned by skugga select."])
    assert after == (
        "version: 1\n#: Pinned by skugga select.\n#: Pinned keys: pins.\nshadows:\n  max_error: 0.01  # fine\n  pins:\n"
        "    - {view: map, sun_altitude_deg: [5, 20.5], algorithm: {relief: sweep, meshes: shadow_map}, map_size: 2048}\n"
        '    - {view: "grüne Au", algorithm: {sun: {relief: hybrid}, lamp: {meshes: planar}}}\n'
    )


def test_pinned_text_of_block_style():
    before = LEVEL_TEXTS["block style"]
    after = pinned_text(before, {"algorithm": {"relief": "sweep"}, "map_size": 1024}, ["Pinned by skugga select."])
    assert after == (
        f"{HEAD}#: Pinned by skugga select.\n#: Pinned keys: algorithm, map_size.\nshadows:\n  # coarse\n"
        "  map_size: 1024    # keep\n  algorithm: {relief: sweep}\n  # after\n\nweather: {snow: false}\n"
    )


@given(
    keys=st.dictionaries(
        st.sampled_from(["map_size", "depth_bits", "filter", "max_error", "fit"]),
        st.sampled_from(["auto", "auto   # as it comes", "'auto'", '"auto" # ö']),
    ),
    indent=st.integers(1, 6),
    head=st.sampled_from(["", "# über allem\n\n", "---\n"]),
    tail=st.sampled_from(["", "\n", "\n\n# the end", "\nviews:\n- not one\n", "\nseconds: 1 # s\n"]),
    line_end=st.sampled_from(["\n", "\r\n"]),
    chosen=st.fixed_dictionaries(
        {"algorithm": st.sampled_from([{"relief": "sweep"}, {"sun": {"meshes": "hybrid"}, "no": {"meshes": "planar"}}])},
        optional={"map_size": st.integers(64, 8192), "filter": st.sampled_from([1, "sun"]), "cascades": st.integers(1, 4)},
    ),
)
def test_pinned_text_handles_any_block_of_settings(keys, indent, head, tail, line_end, chosen):
    shadows = "".join(f"\n{' ' * indent}{key}: {value}" for key, value in keys.items()) or " {}"
    before = f"{head}version: 1 # v\nshadows:{shadows}{tail}".replace("\n", line_end)
    after = pinned_text(before, chosen, PIN_REASONS)
    assert after is not None
    assert load(after) == {**load(before), "shadows": {**(load(before)["shadows"] or {}), **chosen}}
    removed = [line for line in removed_lines(before, after) if not line.startswith("shadows:")]
    assert all(line.split(":")[0].strip() in chosen for line in removed)
    assert pinned_text(after, chosen, PIN_REASONS) == after


def test_pin_refuses_an_edit_that_would_change_other_keys(tmp_path):
    path = tmp_path / "level.yaml"
    text = f"{HEAD}shadows: {{algorithm: &name sweep}}\nsun: none\nattribution: *name\n"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(LevelError, match="by hand") as error:
        pin(path, PIN_SETTINGS, PIN_REASONS)
    assert "\n" not in str(error.value) and path.read_text(encoding="utf-8") == text


def test_pin_refuses_a_read_only_file(tmp_path):
    path = tmp_path / "level.yaml"
    path.write_text(HEAD, encoding="utf-8")
    path.chmod(0o444)
    with pytest.raises(LevelError, match="read-only"):
        pin(path, PIN_SETTINGS, PIN_REASONS)
    assert path.read_text(encoding="utf-8") == HEAD and os.listdir(tmp_path) == ["level.yaml"]


def test_pin_is_atomic(tmp_path, monkeypatch):
    path = tmp_path / "level.yaml"
    path.write_text(HEAD, encoding="utf-8")

    def raise_disk_full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("skugga.selector.pin.os.replace", raise_disk_full)
    with pytest.raises(LevelError, match="No space left"):
        pin(path, PIN_SETTINGS, PIN_REASONS)
    assert path.read_text(encoding="utf-8") == HEAD and os.listdir(tmp_path) == ["level.yaml"]


def test_pin_keeps_permissions_and_symbolic_links(tmp_path):
    path, link = tmp_path / "level.yaml", tmp_path / "link.yaml"
    path.write_bytes(HEAD.replace("\n", "\r\n").encode())
    path.chmod(0o640)
    link.symlink_to(path)
    pin(link, PIN_SETTINGS, PIN_REASONS)
    assert link.is_symlink() and path.stat().st_mode & 0o777 == 0o640
    assert path.read_bytes().startswith(HEAD.replace("\n", "\r\n").encode())
    assert pinned_keys(link) == ("algorithm", "map_size")


def test_pinned_text_escapes_and_wraps_its_comment():
    after = pinned_text(HEAD, PIN_SETTINGS, [f"{PIN_REASONS[0]} view a\nb: \x07\u2028 {{c}}", "word " * 60])
    assert after is not None and load(after)["shadows"] == PIN_SETTINGS
    assert all(len(line) <= 130 for line in after.splitlines())


@pytest.fixture(scope="module")
def scene():
    """Scene of a bundled level of terrain only."""
    return build_scene(load_level(Path("configs/jacksboro.yaml")))


def test_pins_of_a_rules_plan_hold_only_algorithms(scene):
    facts, level = describe(scene, scene.view()), scene.loaded.level
    plan = make_plan(facts, level)
    chosen = pins(plan, facts, level)
    assert chosen == {"algorithm": plan.algorithm["sun"]}


def test_pins_of_a_choice_reproduce_its_plan(scene):
    facts, level = describe(scene, scene.view()), scene.loaded.level
    choice = Choice("a map", {"relief": "shadow_map"}, {"map_size": 1024, "filter": 1})
    plan = make_plan(facts, level, choices={"sun": choice})
    chosen = pins(plan, facts, level)
    assert chosen == {"algorithm": {"relief": "shadow_map"}, "map_size": 1024, "filter": 1}
    replanned = make_plan(facts, StandaloneRequest(override_settings(level.shadows, chosen), level.light_names, level.effects))
    assert (replanned.algorithm, replanned.settings) == (plan.algorithm, plan.settings)
    assert "set by the level" in replanned.reasons[0].reason


def test_pins_refuse_a_plan_without_cast_shadow(scene):
    night = scene.with_sun(SunSpec(azimuth=0, altitude=-20))
    facts, level = describe(night, night.view()), night.loaded.level
    with pytest.raises(InputError, match="cast shadow"):
        pins(make_plan(facts, level), facts, level)
