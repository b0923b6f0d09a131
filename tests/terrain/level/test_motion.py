"""Motion paths in level files: valid content, and one-line errors with the key, its value and the allowed values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from skugga.terrain.errors import LevelError
from skugga.terrain.level.level import Level, load_level

FLOOR_LEVEL = {"version": 1, "terrain": {"flat": {"size": [200, 200], "cells": [20, 20]}}}
START_KEY, END_KEY = {"seconds": 0, "position": [0, 0, 5]}, {"seconds": 9, "position": [40, 0, 5]}
TARGET_KEYS = [{"seconds": 0, "target": [0, 0, 0]}, {"seconds": 3, "target": [4, 0, 0]}]
PATH_MOTION = {"path": [START_KEY, END_KEY]}


def load_floor_level(folder: Path, **parts: Any) -> Level:
    """Return the level ``FLOOR_LEVEL`` with further keys."""
    path = folder / "level.yaml"
    path.write_text(json.dumps(FLOOR_LEVEL | parts), encoding="utf-8")
    return load_level(path).level


def moving_mesh(*path: dict, **keys: Any) -> dict:
    """Return the keys of a moving mesh with a path of keys."""
    mesh_keys = {name: keys.pop(name) for name in ("at",) if name in keys}
    return {"meshes": [{"generate": "rocks", **mesh_keys, "motion": {"path": list(path), **keys}}]}


def moving_lamp(*path: dict, kind: str = "omni", lamp_keys: dict | None = None, **keys: Any) -> dict:
    """Return the keys of a moving lamp with a path of keys."""
    return {"lights": {"lamp": {"kind": kind, **(lamp_keys or {}), "motion": {"path": list(path), **keys}}}}


def test_moving_keys_lists_everything_in_motion(tmp_path):
    meshes = [
        {"generate": "rocks"}, {"generate": "rocks", "motion": {"spin": 3}}, {"generate": "rocks", "motion": {"spin": 0}},
        {"generate": "rocks", "motion": PATH_MOTION},
    ]  # fmt: skip
    lights = {
        "still": {"kind": "omni", "position": [0, 0, 3]}, "goes": {"kind": "omni", "motion": PATH_MOTION},
        "looks": {"kind": "spot", "position": [0, 0, 9], "motion": {"path": TARGET_KEYS}},
    }  # fmt: skip
    level = load_floor_level(tmp_path, meshes=meshes, lights=lights, weather={"cloud_cover": 0.4})
    assert level.moving_keys == ("meshes.1", "meshes.3", "lights.goes", "lights.looks", "weather.cloud_cover")
    assert load_floor_level(tmp_path, meshes=meshes[:1], weather={"cloud_cover": 1.0}).moving_keys == ()
    assert load_floor_level(tmp_path, weather={"precipitation": "rain"}).moving_keys == ("weather.precipitation",)


def test_omitted_height_of_a_path_key_is_on_the_ground(tmp_path):
    loop = moving_mesh(
        {"seconds": 0, "position": [3, 4]}, END_KEY, {"seconds": 20, "position": [3, 4, 0]}, loop=True, face="along", spin=2
    )
    motion = load_floor_level(tmp_path, **loop).meshes[0].motion
    assert motion is not None and motion.path is not None
    assert motion.path[0].position_3d == (3.0, 4.0, 0.0) and motion.above == "ground" and motion.loop and motion.face == "along"


@pytest.mark.parametrize(
    "parts, key, expected_text",
    [
        (moving_mesh(END_KEY, START_KEY), "meshes.0.motion.path.1.seconds", ("'0.0' is not allowed. Allowed: "
            "seconds that increase by")),
        (moving_mesh(START_KEY, END_KEY, END_KEY), "meshes.0.motion.path.2.seconds", ("'9.0' is not allowed. Allowed: "
            "seconds that increase by")),
        (moving_mesh(START_KEY, {**END_KEY, "seconds": 1e-5}), "meshes.0.motion.path.1.seconds", "by at least 0.001"),
        (moving_mesh(START_KEY), "meshes.0.motion.path", "Allowed: at least two keys"),
        (moving_mesh(), "meshes.0.motion.path", "'[]' is not allowed. Allowed: at least two keys"),
        (moving_mesh(START_KEY, END_KEY, at=[1, 2]), "meshes.0.at", ("'(1.0, 2.0)' is not allowed. Allowed: no "
            "value together with a path")),
        (
            moving_mesh(START_KEY, END_KEY, loop=True), "meshes.0.motion.path.1.position",
            "Allowed: the position of the first key, [0.0, 0.0, 5.0]: a loop",
        ),
        (moving_mesh(START_KEY, {**END_KEY, "seconds": 1e300}), "meshes.0.motion.path.1.seconds", "'1e+300' is not allowed"),
        (moving_mesh(START_KEY, {**END_KEY, "position": [1, 2, 1e8]}), "meshes.0.motion.path.1.position.2",
         "less than or equal to 1000000"),
        (moving_mesh(START_KEY, {**END_KEY, "position": [1]}), "meshes.0.motion.path.1.position", ("'[1]' is not allowed. "
            "Allowed: two")),
        (moving_mesh(START_KEY, {**END_KEY, "position": [1, 2, 3, 4]}), "meshes.0.motion.path.1.position", "Allowed: two numbers"),
        (
            moving_mesh(START_KEY, {"seconds": 9, "position": [1, 2]}, above="sea"), "meshes.0.motion.path.1.position",
            "with the height above the sea",
        ),
        (moving_mesh(START_KEY, END_KEY, above="moon"), "meshes.0.motion.above", ("'moon' is not allowed. Allowed: "
            "'ground' or 'sea'")),
        (moving_mesh(START_KEY, END_KEY, face="back"), "meshes.0.motion.face", ("'back' is not allowed. Allowed: "
            "'fixed' or 'along'")),
        (
            {"meshes": [{"generate": "rocks", "motion": {"spin": 3, "loop": True}}]}, "meshes.0.motion.loop",
            "no value without a path",
        ),
        (moving_lamp(START_KEY, END_KEY, lamp_keys={"position": [0, 0, 3]}), "lights.lamp.position", ("Allowed: no value "
            "together with a path")),
        (moving_lamp(START_KEY, {"seconds": 9, "position": [1, 2]}), "lights.lamp.motion.path.1.position",
         "'[1, 2]' is not allowed"),
        (moving_lamp(END_KEY, START_KEY), "lights.lamp.motion.path.1.seconds", ("'0.0' is not allowed. Allowed: "
            "seconds that increase by")),
        (moving_lamp(*TARGET_KEYS, kind="spot"), "lights.lamp.position", "missing. This key is required"),
        (moving_lamp(START_KEY, END_KEY, kind="spot"), "lights.lamp", "Allowed: a target for a spot, none for an omni light"),
        (moving_lamp(*TARGET_KEYS, lamp_keys={"position": [0, 0, 3]}), "lights.lamp", ("Allowed: a target for a spot, none "
            "for an omni light")),
        (
            moving_lamp(START_KEY, TARGET_KEYS[1], kind="spot"), "lights.lamp.motion.path.1",
            "Allowed: the keys of the first one: seconds, position",
        ),
        (moving_lamp(START_KEY, {"seconds": 9}), "lights.lamp.motion.path.1", "Allowed: a position, a target or both"),
        ({"lights": {"lamp": {"kind": "omni"}}}, "lights.lamp.position", "missing. This key is required"),
        ({"lights": {"lamp": {"kind": "omni", "motion": {}}}}, "lights.lamp.motion.path", "missing. This key is required"),
    ],
)  # fmt: skip
def test_motion_error_names_the_key_in_one_line(tmp_path, parts, key, expected_text):
    with pytest.raises(LevelError) as caught:
        load_floor_level(tmp_path, **parts)
    text = str(caught.value)
    assert text.startswith(f"{tmp_path}/level.yaml: {key}: ") and expected_text in text and "\n" not in text, text


def test_every_wrong_key_of_a_path_is_reported(tmp_path):
    with pytest.raises(LevelError) as caught:
        load_floor_level(tmp_path, **moving_mesh(END_KEY, START_KEY, {"seconds": -4, "position": [0, 0]}))
    assert [line.split(": ")[1] for line in str(caught.value).split("\n")] == [f"meshes.0.motion.path.{n}.seconds" for n in (1, 2)]
