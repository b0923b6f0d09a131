"""Camera files: their content, and an error message for each kind of mistake."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from skugga.terrain.errors import LevelError
from skugga.terrain.level.camera_file import MAX_FILE_CHARACTERS, MAX_KEYS, load_camera_path
from skugga.terrain.level.durations import parse_duration

CAMERA_KEY_YAML = "{at: 0s, eye: [0, 0, 5], target: [9, 9, 0]}"


def load_camera_text(tmp_path, text: str):
    """Return the camera path of a file with a text."""
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding="utf-8")
    return load_camera_path(path)


def test_camera_file_has_keys_and_a_size(tmp_path):
    camera_path = load_camera_text(
        tmp_path, f"size: [64, 48]\nkeys:\n- {CAMERA_KEY_YAML}\n- {{at: 1.5m, eye: [1, 2, 3], target: [4, 5, 6], fov: 30}}\n"
    )
    assert camera_path.size == (64, 48) and camera_path.times_s(None) == (0.0, 90.0)
    assert (camera_path.keys[0].fov, camera_path.keys[1].fov, camera_path.keys[1].eye) == (50.0, 30.0, (1.0, 2.0, 3.0))


def test_quoted_and_unquoted_dates_are_equal(tmp_path):
    key_template = "- {{at: {}, eye: [0, 0, 5], target: [9, 9, 0]}}\n"
    times = "2024-10-21T16:30:00-04:00", '"2024-10-21T17:30:00-04:00"'
    camera_path = load_camera_text(tmp_path, "keys:\n" + "".join(map(key_template.format, times)))
    assert [key.moment for key in camera_path.keys] == [datetime(2024, 10, 21, hour, 30, tzinfo=UTC) for hour in (20, 21)]
    assert camera_path.times_s(datetime(2024, 10, 21, 20, tzinfo=UTC)) == (1800.0, 5400.0)
    with pytest.raises(ValueError, match="first frame"):
        camera_path.times_s(None)


INVALID_CAMERA_FILES = {
    "keys: []": ("keys", "2 items"),
    f"keys: [{CAMERA_KEY_YAML}]": ("keys", "at least 2 items"),
    "size: [9, 9]": ("keys", "missing. This key is required"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 5, eye: [0, 0, 5], target: [9, 9, 0]}}]": (
        "keys.1.at",
        "such as 0s, 90s or 10m, or an ISO 8601 time",
    ),
    f"keys: [{CAMERA_KEY_YAML}, {{at: soon, eye: [0, 0, 5], target: [9, 9, 0]}}]": ("keys.1.at", "'soon' is not allowed"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: -5s, eye: [0, 0, 5], target: [9, 9, 0]}}]": ("keys.1.at", "'-5s' is not allowed"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 2024-10-21T16:30:00, eye: [0, 0, 5], target: [9, 9, 0]}}]": ("keys.1.at", "with an offset"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 2024-10-21T16:30:00Z, eye: [0, 0, 5], target: [9, 9, 0]}}]": (
        "keys.1.at",
        "as in the first key",
    ),
    f"keys: [{CAMERA_KEY_YAML}, {CAMERA_KEY_YAML}]": ("keys.1.at", "a time later than 0s, the time of the previous key"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0, 5], target: [0, 0, 5]}}]": ("keys.1", "a target other than the eye"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0], target: [9, 9, 0]}}]": ("keys.1.eye", "3 items"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0, .nan], target: [9, 9, 0]}}]": ("keys.1.eye.2", "nan"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0, 1], target: [9, 9, 0], fov: 180}}]": ("keys.1.fov", "179"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0, 1], target: [9, 9, 0], fow: 50}}]": ("keys.1.fow", "Did you mean 'fov'?"),
    f"keys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0, 1]}}]": ("keys.1.target", "missing. This key is required"),
    f"size: [0, 9]\nkeys: [{CAMERA_KEY_YAML}, {{at: 1s, eye: [0, 0, 1], target: [9, 9, 0]}}]": (
        "size.0",
        "greater than or equal to 1",
    ),
    "just text": ("", "a mapping with the key 'keys'"),
    "keys: [": ("line", "well-formed YAML"),
    "a: &a [x, x]\nkeys: " + "[" * 40 + "]" * 40: ("line", "nested lists and mappings"),
    "keys: [2024-13-40]": ("", "well-formed YAML"),
}


@pytest.mark.parametrize("text", INVALID_CAMERA_FILES)
def test_camera_file_error_names_the_key_in_one_line(tmp_path, text):
    key, words = INVALID_CAMERA_FILES[text]
    with pytest.raises(LevelError) as caught:
        load_camera_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'camera.yaml'}: {key}") and words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_several_wrong_keys_are_reported_together(tmp_path):
    with pytest.raises(LevelError) as caught:
        load_camera_text(tmp_path, f"keys: [{CAMERA_KEY_YAML}, {{at: soon, eye: [0, 0, 5], target: [9, 9]}}]")
    assert [error.name.rpartition(": ")[2] for error in (caught.value, *caught.value.further_errors)] == [
        "keys.1.at",
        "keys.1.target",
    ]


def test_missing_long_and_binary_camera_files_are_rejected(tmp_path):
    with pytest.raises(LevelError, match="No such file"):
        load_camera_path(tmp_path / "none.yaml")
    with pytest.raises(LevelError, match="folder"):
        load_camera_path(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(LevelError, match="not UTF-8 text"):
        load_camera_path(tmp_path / "binary.yaml")
    with pytest.raises(LevelError, match=f"more than {MAX_FILE_CHARACTERS} characters"):
        load_camera_text(tmp_path, "#" * (MAX_FILE_CHARACTERS + 1))
    with pytest.raises(LevelError, match=f"at most {MAX_KEYS} items"):
        load_camera_text(
            tmp_path, "keys:\n" + "".join(f"- {{at: {n}s, eye: [0, 0, 5], target: [9, 9, 0]}}\n" for n in range(MAX_KEYS + 1))
        )


@pytest.mark.parametrize(("text", "seconds"), [("0s", 0.0), ("0.04s", 0.04), (" 10m ", 600.0), ("1.5h", 5400.0), ("2d", 172800.0)])
def test_parse_duration_reads_numbers_with_units(text, seconds):
    assert parse_duration(text) == timedelta(seconds=seconds)


@pytest.mark.parametrize("text", ["", "5", "-5s", "5 s", "1e3s", "5min", "١s", "1234567s", "infs"])
def test_parse_duration_rejects_other_texts(text):
    with pytest.raises(ValueError, match="a number and a unit, s, m, h or d, such as 15m"):
        parse_duration(text)
