"""Snapshots of views that a request defines by eye and target."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skugga.api.cli.snapshot import snapshot
from skugga.api.request import ProductRequest
from tests.api.conftest import Client, write_level
from tests.api.http.test_problems import check_problem

SNAPSHOT = "/levels/hills/snapshot"
EYE, TARGET = "8.4300,47.5000,300", "8.4500,47.5100,0"
SMALL = {"size": "96x64"}


def pixels(client: Client, address: str = f"{SNAPSHOT}.png", **parameters: str) -> np.ndarray:
    """Return a snapshot as integers (rows, cols, 3). ``parameters`` are query parameters besides ``SMALL``."""
    answer = client.get(address, params={**SMALL, **parameters})
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB")).astype(int)


def test_requested_view_equals_a_view_of_the_level(client: Client, folder: Path):
    """The same numbers in a level file draw the same picture."""
    camera = {"kind": "perspective", "eye": [8.43, 47.5, 300], "target": [8.45, 47.51, 0], "fov": 40}
    color = snapshot(
        write_level(folder, "viewed", views={"request": camera}), "request", ProductRequest(), {}, (96, 64)
    ).computed.array
    requested_pixels = pixels(client, eye=EYE, target=TARGET, fov="40")
    assert np.array_equal(requested_pixels, color[..., :3]) and len(np.unique(requested_pixels.reshape(-1, 3), axis=0)) > 100, (
        "the picture is blank"
    )


def test_eye_target_and_fov_change_the_picture(client: Client):
    first = pixels(client, eye=EYE, target=TARGET)
    for other in (
        {"eye": "8.4300,47.5000,900", "target": TARGET}, {"eye": EYE, "target": "8.4100,47.5100,0"},
        {"eye": EYE, "target": TARGET, "fov": "20"}, {"eye": EYE, "target": TARGET, "azimuth": "100", "altitude": "40"},
    ):  # fmt: skip
        assert np.abs(pixels(client, **other) - first).max() > 32, other


def test_default_size_is_that_of_views_in_level_files(client: Client):
    answer = client.get(f"{SNAPSHOT}.jpg", params={"eye": EYE, "target": TARGET})
    assert Image.open(io.BytesIO(answer.content)).size == (1280, 1024)


@pytest.mark.parametrize(
    ("query", "parameter", "expected_text"),
    [
        ({"eye": EYE}, "target", "eye and target together"),
        ({"target": TARGET}, "eye", "eye and target together"),
        ({"fov": "40"}, "fov", "without eye and target"),
        ({"eye": "8.43,47.5", "target": TARGET}, "eye", "three numbers"),
        ({"eye": "8.43,47.5,high", "target": TARGET}, "eye", "three numbers"),
        ({"eye": "8.43,47.5,1e6", "target": TARGET}, "eye", "at most 100000"),
        ({"eye": "8.43,47.5,nan", "target": TARGET}, "eye", "three numbers"),
        ({"eye": EYE, "target": "8.45,47.51,0,1"}, "target", "three numbers"),
        ({"eye": EYE, "target": EYE}, "target", "other than the eye"),
        ({"eye": "0,0,2", "target": TARGET}, "eye", "a position on the terrain's data"),
        ({"eye": EYE, "target": "0,0,2"}, "target", "a position on the terrain's data"),
        ({"eye": EYE, "target": TARGET, "fov": "180"}, "fov", "179"),
        ({"eye": EYE, "target": TARGET, "fov": "wide"}, "fov", "a number"),
        ({"eye": EYE, "target": TARGET, "view": "map"}, "view", "cannot be combined with eye and target"),
        ({"eye": EYE, "target": TARGET, "size": "9000x9000"}, "size", "WIDTHxHEIGHT"),
    ],
)
def test_wrong_camera_parameters_are_named(client: Client, query: dict[str, str], parameter: str, expected_text: str):
    answer = client.get(f"{SNAPSHOT}.png", params=query)
    check_problem(answer, 422, "invalid_parameter", parameter)
    assert expected_text in answer.json()["detail"]


@pytest.mark.parametrize(
    ("algorithm", "layer", "max_value"),
    [("shadow_map", "shadow-map", 65535), ("shadow_volume", "stencil", 255), ("shadow_volume", "volumes", 255),
     ("hybrid", "silhouettes", 255), ("hybrid", "light-view", 255), ("shadow_map", "light-frustum", 255),
     ("perspective_shadow_map", "post-perspective", 255)],
)  # fmt: skip
def test_intermediate_layers_can_be_requested(client: Client, algorithm: str, layer: str, max_value: int):
    query = {**SMALL, "eye": EYE, "target": TARGET, "algorithm": algorithm, "layer": layer}
    answer = client.get(f"{SNAPSHOT}.png", params=query)
    assert answer.status_code == 200, answer.text
    values = np.asarray(Image.open(io.BytesIO(answer.content)))
    assert values.max() <= max_value and len(np.unique(values)) > 1
    if layer == "volumes":
        color = pixels(client, **{key: value for key, value in query.items() if key != "layer"})
        assert values.shape == color.shape and not np.array_equal(values, color)


def test_missing_intermediate_layers_are_refused(client: Client):
    camera_query = {"eye": EYE, "target": TARGET, "algorithm": "shadow_map"}
    assert "volumes" in client.get("/levels/hills").json()["layers_between"]
    answer = client.get(f"{SNAPSHOT}.png", params={**SMALL, **camera_query, "layer": "volumes"})
    check_problem(answer, 422, "unsupported", "layer")
    assert "algorithms that have it" in answer.json()["detail"]
    check_problem(
        client.get(f"{SNAPSHOT}.webp", params={**camera_query, "layer": "shadow-map"}), 422, "invalid_parameter", "format"
    )
    check_problem(client.get(f"{SNAPSHOT}.png", params={**camera_query, "layer": "depth"}), 422, "invalid_parameter", "layer")
