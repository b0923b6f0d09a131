"""Motion paths in level files: valid content, and one-line errors with the key, its value and the allowed values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from skugga.terrain.errors import LevelError
from skugga.terrain.level.level import Level, load_level

FLOOR = {"version": 1, "terrain": {"flat": {"size": [200, 200], "cells": [20, 20]}}}
THERE, BACK = {"seconds": 0, "position": [0, 0, 5]}, {"seconds": 9, "position": [40, 0, 5]}
AIMS = [{"seconds": 0, "target": [0, 0, 0]}, {"seconds": 3, "target": [4, 0, 0]}]
MOVING = {"path": [THERE, BACK]}


def loaded(folder: Path, **parts: Any) -> Level:
    path = folder / "level.yaml"
    path.write_text(json.dumps(FLOOR | parts), encoding="utf-8")
    return load_level(path).level


def of_mesh(*path: dict, **keys: Any) -> dict:
    own = {name: keys.pop(name) for name in ("at",) if name in keys}
    return {"meshes": [{"generate": "rocks", **own, "motion": {"path": list(path), **keys}}]}


def of_lamp(*path: dict, kind: str = "omni", own: dict | None = None, **keys: Any) -> dict:
    return {"lights": {"lamp": {"kind": kind, **(own or {}), "motion": {"path": list(path), **keys}}}}


def test_moving_keys_lists_everything_in_motion(tmp_path):
    meshes = [
        {"generate": "rocks"}, {"generate": "rocks", "motion": {"spin": 3}}, {"generate": "rocks", "motion": {"spin": 0}},
        {"generate": "rocks", "motion": MOVING},
    ]  # fmt: skip
    lights = {
        "still": {"kind": "omni", "position": [0, 0, 3]}, "goes": {"kind": "omni", "motion": MOVING},
        "looks": {"kind": "spot", "position": [0, 0, 9], "motion": {"path": AIMS}},
    }  # fmt: skip
    level = loaded(tmp_path, meshes=meshes, lights=lights, weather={"cloud_cover": 0.4})
    assert level.moving_keys == ("meshes.1", "meshes.3", "lights.goes", "lights.looks", "weather.cloud_cover")
    assert loaded(tmp_path, meshes=meshes[:1], weather={"cloud_cover": 1.0}).moving_keys == ()


def test_omitted_height_of_a_path_key_is_on_the_ground(tmp_path):
    loop = of_mesh(
        {"seconds": 0, "position": [3, 4]}, BACK, {"seconds": 20, "position": [3, 4, 0]}, loop=True, face="along", spin=2
    )
    motion = loaded(tmp_path, **loop).meshes[0].motion
    assert motion is not None and motion.path is not None
    assert motion.path[0].place == (3.0, 4.0, 0.0) and motion.above == "ground" and motion.loop and motion.face == "along"


@pytest.mark.parametrize(
    "parts, key, said",
    [
        (of_mesh(BACK, THERE), "meshes.0.motion.path.1.seconds", "'0.0' is not allowed. Allowed: seconds that increase by"),
        (of_mesh(THERE, BACK, BACK), "meshes.0.motion.path.2.seconds", "'9.0' is not allowed. Allowed: seconds that increase by"),
        (of_mesh(THERE, {**BACK, "seconds": 1e-5}), "meshes.0.motion.path.1.seconds", "by at least 0.001"),
        (of_mesh(THERE), "meshes.0.motion.path", "Allowed: at least two keys"),
        (of_mesh(), "meshes.0.motion.path", "'[]' is not allowed. Allowed: at least two keys"),
        (of_mesh(THERE, BACK, at=[1, 2]), "meshes.0.at", "'(1.0, 2.0)' is not allowed. Allowed: no value together with a path"),
        (
            of_mesh(THERE, BACK, loop=True), "meshes.0.motion.path.1.position",
            "Allowed: the position of the first key, [0.0, 0.0, 5.0]: a loop",
        ),
        (of_mesh(THERE, {**BACK, "seconds": 1e300}), "meshes.0.motion.path.1.seconds", "'1e+300' is not allowed"),
        (of_mesh(THERE, {**BACK, "position": [1, 2, 1e8]}), "meshes.0.motion.path.1.position.2", "less than or equal to 1000000"),
        (of_mesh(THERE, {**BACK, "position": [1]}), "meshes.0.motion.path.1.position", "'[1]' is not allowed. Allowed: two"),
        (of_mesh(THERE, {**BACK, "position": [1, 2, 3, 4]}), "meshes.0.motion.path.1.position", "Allowed: two numbers"),
        (
            of_mesh(THERE, {"seconds": 9, "position": [1, 2]}, above="sea"), "meshes.0.motion.path.1.position",
            "with the height above the sea",
        ),
        (of_mesh(THERE, BACK, above="moon"), "meshes.0.motion.above", "'moon' is not allowed. Allowed: 'ground' or 'sea'"),
        (of_mesh(THERE, BACK, face="back"), "meshes.0.motion.face", "'back' is not allowed. Allowed: 'fixed' or 'along'"),
        (
            {"meshes": [{"generate": "rocks", "motion": {"spin": 3, "loop": True}}]}, "meshes.0.motion.loop",
            "no value without a path",
        ),
        (of_lamp(THERE, BACK, own={"position": [0, 0, 3]}), "lights.lamp.position", "Allowed: no value together with a path"),
        (of_lamp(THERE, {"seconds": 9, "position": [1, 2]}), "lights.lamp.motion.path.1.position", "'[1, 2]' is not allowed"),
        (of_lamp(BACK, THERE), "lights.lamp.motion.path.1.seconds", "'0.0' is not allowed. Allowed: seconds that increase by"),
        (of_lamp(*AIMS, kind="spot"), "lights.lamp.position", "missing. This key is required"),
        (of_lamp(THERE, BACK, kind="spot"), "lights.lamp", "Allowed: a target for a spot, none for an omni light"),
        (of_lamp(*AIMS, own={"position": [0, 0, 3]}), "lights.lamp", "Allowed: a target for a spot, none for an omni light"),
        (
            of_lamp(THERE, AIMS[1], kind="spot"), "lights.lamp.motion.path.1",
            "Allowed: the keys of the first one: seconds, position",
        ),
        (of_lamp(THERE, {"seconds": 9}), "lights.lamp.motion.path.1", "Allowed: a position, a target or both"),
        ({"lights": {"lamp": {"kind": "omni"}}}, "lights.lamp.position", "missing. This key is required"),
        ({"lights": {"lamp": {"kind": "omni", "motion": {}}}}, "lights.lamp.motion.path", "missing. This key is required"),
    ],
)  # fmt: skip
def test_motion_error_names_the_key_in_one_line(tmp_path, parts, key, said):
    with pytest.raises(LevelError) as caught:
        loaded(tmp_path, **parts)
    text = str(caught.value)
    assert text.startswith(f"{tmp_path}/level.yaml: {key}: ") and said in text and "\n" not in text, text


def test_every_wrong_key_of_a_path_is_reported(tmp_path):
    with pytest.raises(LevelError) as caught:
        loaded(tmp_path, **of_mesh(BACK, THERE, {"seconds": -4, "position": [0, 0]}))
    assert [line.split(": ")[1] for line in str(caught.value).split("\n")] == [f"meshes.0.motion.path.{n}.seconds" for n in (1, 2)]
