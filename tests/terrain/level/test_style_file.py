"""Style files: the keys of a level's style, in YAML or JSON."""

import json

import pytest

from skugga.terrain.errors import LevelError
from skugga.terrain.level.style_file import load_style_keys

KEYS = {"name": "swiss", "slope_exaggeration": 2.0, "ramp": [[0, "#a9be98"], [900, "#ffffff"]]}


def test_a_style_file_has_only_the_keys_that_it_sets(tmp_path):
    file = tmp_path / "style.yaml"
    file.write_text("# mine\nsky: clear\nslope_exaggeration: 2\n", encoding="utf-8")
    assert load_style_keys(file) == {"sky": "clear", "slope_exaggeration": 2.0}


def test_a_style_file_may_be_json(tmp_path):
    file = tmp_path / "style.json"
    file.write_text(json.dumps(KEYS), encoding="utf-8")
    assert load_style_keys(file) == {**KEYS, "ramp": ((0.0, "#a9be98"), (900.0, "#ffffff"))}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("swiss", "a mapping with keys of a style: name"),
        ("name: pretty", "name: .pretty. is not allowed"),
        ("colour: red", "colour: unknown key"),
        ("ramp: [[1, '#ffffff'], [0, '#000000']]", "ramp: .*with increasing heights"),
        ("slope_exaggeration: 0", "slope_exaggeration"),
        ("name: [", "line 1"),
        ("#" * 2**17, "more than 65536 characters"),
    ],
)
def test_a_wrong_style_file_names_file_and_key(tmp_path, text, message):
    file = tmp_path / "style.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(LevelError, match=f"style.yaml: .*{message}"):
        load_style_keys(file)


def test_a_missing_style_file_is_named(tmp_path):
    with pytest.raises(LevelError, match="none.yaml: No such file or directory"):
        load_style_keys(tmp_path / "none.yaml")
