"""Level files: valid content, and one clear message for each mistake."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
from pydantic_core import PydanticCustomError

from skugga.api.catalogue import bundled_levels
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.effects import EFFECTS
from skugga.terrain.errors import InputError, LevelError
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES
from skugga.terrain.level.level import EffectName, expand_override, load_level, override_text, parse_algorithm, parse_sun

VALID_LEVEL = "version: 1\nterrain: {source: jacksboro}\n"


def level(tmp_path: Path, text: str) -> Path:
    """Write a text as a level file, and return its path."""
    path = tmp_path / "my.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_schema_names_equal_the_registries():
    assert list(ALGORITHMS) == ALGORITHM_NAMES
    assert set(get_args(EffectName)) == set(EFFECTS)


def test_bundled_levels_load():
    paths = bundled_levels()
    assert {path.stem for path in paths} >= {"jacksboro", "jacksboro_alpine"}
    for path in paths:
        loaded = load_level(path)
        assert loaded.level.title and loaded.level.attribution


@pytest.mark.parametrize(
    ("text", "key", "value", "allowed"),
    [
        ("terrain: {source: jacksboro}\n", "version", "missing", "required"),
        (VALID_LEVEL + "forrest: []\n", "forrest", "unknown key", "terrain, water, roads, rivers, land_cover, forest, meshes, sun"),
        ("version: 1\nterrain: {sourc: x}\n", "terrain.sourc", "unknown key", "source, flat, generate, bounds"),
        ("version: 2\nterrain: {source: x}\n", "version", "2", "1"),
        ("version: 1\nterrain: {source: x, units: yards}\n", "terrain.units", "yards", "'m', 'ft', 'us-ft', "),
        ("version: 1\nterrain: {source: x, positive: downwards}\n", "terrain.positive", "downwards", "'up' or 'down'"),
        ("version: 1\nterrain: {source: x, exaggeration: -2}\n", "terrain.exaggeration", "-2", "greater than 0"),
        ("version: 1\nterrain: {source: x, bounds: [3, 2, 1, 4]}\n", "terrain.bounds", "[3, 2, 1, 4]", "west < east"),
        (VALID_LEVEL + "sun: {azimuth: 100, altitude: 91}\n", "sun.altitude", "91", "less than or equal to 90"),
        (VALID_LEVEL + "sun: {time: '2024-06-01T12:00:00'}\n", "sun", "2024-06-01", "offset"),
        (VALID_LEVEL + "sun: {azimuth: 100}\n", "sun", "100", "time, or azimuth and altitude"),
        (VALID_LEVEL + "shadows: {algorithm: magic}\n", "shadows.algorithm", "magic", "shadow_map"),
        (VALID_LEVEL + "shadows: {map_size: 10}\n", "shadows.map_size", "10", "64"),
        (VALID_LEVEL + "shadows: {stencil: three_pass}\n", "shadows.stencil", "three_pass", "'one_pass' or 'two_pass'"),
        (VALID_LEVEL + "shadows: {counting: z_both}\n", "shadows.counting", "z_both", "'auto', 'z_fail' or 'z_pass'"),
        (VALID_LEVEL + "shadows: {mask: paper}\n", "shadows.mask", "paper", "'conservative', 'original' or 'off'"),
        (VALID_LEVEL + "effects: {glitter: on}\n", "effects.glitter", "glitter", "cast_shadows"),
        (VALID_LEVEL + "views: {a: {kind: fisheye}}\n", "views.a", "fisheye", "'map', 'perspective'"),
        (VALID_LEVEL + "views: {a: {kind: perspective, target: [0, 0, 0]}}\n", "views.a.eye", "missing", "required"),
        (
            VALID_LEVEL + "views: {a: {kind: perspective, eye: [0, 0, 1], target: [0, 0, 1]}}\n",
            "views.a",
            "0",
            "other than the eye",
        ),
        (VALID_LEVEL + "lights: {sun: {kind: omni, position: [0, 0, 1]}}\n", "lights", "sun", "light names other than sun"),
        (VALID_LEVEL + "lights: {lamp: {kind: spot, position: [0, 0, 1]}}\n", "lights.lamp", "spot", "a target for a spot"),
        (
            VALID_LEVEL + "shadows: {algorithm: {lamp: shadow_map}}\n",
            "shadows.algorithm",
            "lamp",
            "name a light (sun) or a caster kind",
        ),
        (VALID_LEVEL + "meshes: [{source: a.obj, generate: rocks}]\n", "meshes.0", "rocks", "either source or generate"),
        ("version: 1\nterrain: {source: x, flat: {size: [1, 1], cells: [1, 1]}}\n", "terrain", "flat", "one of source, flat"),
        ("version: 1\nterrain: {flat: {size: [1, 1], cells: [1, 1]}, nodata: 0}\n", "terrain", "flat", "nodata with a source only"),
        (
            "version: 1\nterrain: {flat: {size: [1, 1], cells: [1, 1]}, positive: down}\n",
            "terrain",
            "flat",
            "positive: down with a source only",
        ),
        ("[1, 2]\n", "my.yaml", "[1, 2]", "version: 1"),
        ("version: [1\n", "my.yaml: line 2", "expected", "well-formed YAML"),
        (VALID_LEVEL + "sun: {time: 2024-13-45}\n", "my.yaml", "month", "well-formed YAML"),
        ("[" * 3000, "my.yaml", "nested lists and mappings", "well-formed YAML"),
    ],
)
def test_level_error_names_file_key_value_and_allowed_values(tmp_path, text, key, value, allowed):
    with pytest.raises(LevelError) as caught:
        load_level(level(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    assert str(tmp_path / "my.yaml") in message
    for part in (key, value, allowed):
        assert part in message, message


def test_all_errors_of_a_level_are_reported_at_once(tmp_path):
    text = (
        "version: 2\ntitel: x\nterrain: {sourc: jacksboro, units: yards}\n"
        "forest: [{source: a.geojson, densty: 3}, {source: b.geojson, height: [30, 2]}]\nsun: {azimut: 3, altitude: 99}\n"
        "views: {a: {kind: perspective, target: [1, 2, 3], fovv: 3}, b: {kind: fisheye}}\neffects: {haze: maybe, glitter: on}\n"
    )
    with pytest.raises(LevelError) as caught:
        load_level(level(tmp_path, text))
    lines = str(caught.value).split("\n")
    assert all(line.startswith(f"{tmp_path / 'my.yaml'}: ") for line in lines)
    keys = [line.removeprefix(f"{tmp_path / 'my.yaml'}: ").split(":")[0] for line in lines]
    assert sorted(keys) == [
        "effects.glitter", "effects.haze", "forest.0.densty", "forest.1.height", "sun.altitude", "sun.azimut", "terrain.sourc",
        "terrain.units", "titel", "version", "views.a.eye", "views.a.fovv", "views.b.kind",
    ]  # fmt: skip
    assert len(caught.value.further_errors) == len(keys) - 1
    message_of_key = dict(zip(keys, lines, strict=True))
    for misspelt_key, suggested_key in (
        ("titel", "title"),
        ("terrain.sourc", "source"),
        ("forest.0.densty", "density"),
        ("sun.azimut", "azimuth"),
    ):
        assert f"unknown key. Did you mean '{suggested_key}'? Allowed keys: " in message_of_key[misspelt_key]
    assert "3 items" not in message_of_key["views.a.eye"] and ": missing." in message_of_key["views.a.eye"]


def test_unknown_key_without_a_match_lists_allowed_keys(tmp_path):
    with pytest.raises(LevelError, match=r"my\.yaml: zzz: unknown key\. Allowed keys: version, title"):
        load_level(level(tmp_path, VALID_LEVEL + "zzz: 1\n"))


def test_missing_and_binary_levels_are_rejected(tmp_path):
    with pytest.raises(LevelError, match="No such file"):
        load_level(tmp_path / "absent.yaml")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(LevelError, match="UTF-8"):
        load_level(tmp_path / "b.yaml")


def test_overrides_are_expanded():
    assert expand_override("auto") == {}
    all_kinds = {"relief": "shadow_map", "meshes": "shadow_map", "forest": "shadow_map"}
    assert expand_override("shadow_map") == {"sun": all_kinds}
    assert expand_override("shadow_map", ("sun", "lamp")) == {"sun": all_kinds, "lamp": all_kinds}
    assert expand_override({"forest": "none", "lamp": "shadow_map"}, ("sun", "lamp")) == {
        "sun": {"forest": "none"},
        "lamp": all_kinds,
    }
    assert expand_override({"relief": "none"}) == {"sun": {"relief": "none"}}
    assert expand_override({"sun": {"relief": "none"}}) == {"sun": {"relief": "none"}}
    assert parse_algorithm("relief=shadow_map") == {"relief": "shadow_map"}
    for text in ("sweep", "relief=sweep,forest=shadow_map,lamp=none"):
        assert override_text(parse_algorithm(text)) == text
    with pytest.raises(PydanticCustomError, match="relief"):
        expand_override(parse_algorithm("leaves=shadow_map"))  # "leaves" may be the name of a light, which only the level can tell
    with pytest.raises(InputError, match=", ".join([*ALGORITHM_NAMES, "auto"])):
        parse_algorithm("sweeep")


def test_parse_sun_reads_request_parameters():
    assert parse_sun(None, None, None) is None
    sun_spec = parse_sun("2024-06-01T12:00:00 02:00", None, None)  # a query decodes "+" as a space
    assert sun_spec is not None and sun_spec.time is not None and sun_spec.time.utcoffset().total_seconds() == 7200
    for arguments, name in (
        (("yesterday", None, None), "time"),
        (("2024-06-01T12:00:00", None, None), "time"),
        ((None, 10.0, None), "altitude"),
        ((None, None, 10.0), "azimuth"),
        ((None, 10.0, 91.0), "altitude"),
        ((None, 721.0, 10.0), "azimuth"),
        ((None, float("nan"), 10.0), "azimuth"),
        (("2024-06-01T12:00:00Z", 10.0, 20.0), "time"),
        (("2024-06-01T12:00:00Z", None, 20.0), "time"),
    ):
        with pytest.raises(InputError) as caught:
            parse_sun(*arguments)
        assert caught.value.name == name


def test_a_conflict_names_both_parameters_with_their_prefix():
    with pytest.raises(InputError) as caught:
        parse_sun("2024-06-01T12:00:00Z", None, 20.0)
    assert str(caught.value) == "time: cannot be combined with altitude. Use one of them."
    assert str(caught.value.prefixed("--")) == "--time: cannot be combined with --altitude. Use one of them."


def test_relative_sources_are_relative_to_the_level(tmp_path):
    loaded = load_level(level(tmp_path, "version: 1\nterrain: {source: data/dem.tif}\n"))
    assert loaded.source == str((tmp_path / "data/dem.tif").resolve())
    assert load_level(level(tmp_path, VALID_LEVEL)).source == "jacksboro"
