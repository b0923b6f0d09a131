"""A machine without OpenGL: terrain alone under the sun is drawn as usual, and all else is refused in one sentence."""

import json
import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
import rasterio
from PIL import Image

from skugga.api.cli.snapshot import snapshot
from skugga.api.request import ProductRequest
from skugga.terrain.gl.egl_devices import NO_OPENGL_RENDERER
from tests.api.conftest import CORNER, SUN, ZOOM, Client, write_level
from tests.api.http.test_problems import check_problem
from tests.api.http.test_serve import ROOT, serving_process

TIMEOUT_S = 300

WITHOUT_DRIVERS = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"}
"""The loader of EGL finds no driver."""

COMMANDS = """
import contextlib, io, json, sys
from skugga.api.cli.main import main

for arguments in json.loads(sys.argv[1]):
    sys.argv, said, wrong = ["skugga", *arguments], io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
        try:
            main()
        except SystemExit as end:
            status = end.code
    print(json.dumps([status, said.getvalue(), wrong.getvalue()]))
"""

PERSPECTIVE_VIEWS = {"eye": {"kind": "perspective", "eye": [8.4, 47.5, 500], "target": [8.41, 47.51, 0]}}
TILE = f"tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    """Return this process's environment without drivers and without an expected renderer."""
    return {key: value for key, value in os.environ.items() if key != "SKUGGA_EXPECT_RENDERER"} | WITHOUT_DRIVERS


@pytest.fixture(scope="module")
def level(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of a level of hills with a map and perspective views."""
    return write_level(tmp_path_factory.mktemp("bare"), "hills", views={"map": {"kind": "map"}, **PERSPECTIVE_VIEWS})


@pytest.mark.usefixtures("gl")
def test_the_command_line_draws_terrain_without_opengl(level: Path, environment: dict[str, str]):
    folder = level.parent
    picture_path, raster_path, refused_path = folder / "drawn.png", folder / "shaded.tif", folder / "refused.png"
    stats_path, size = folder / "stats.json", ["--size", "200x200"]
    commands = [
        ["render", str(level), "-o", str(picture_path), *size],
        ["shade", str(level), "-o", str(raster_path)],
        [
            "render",
            str(level),
            "-o",
            str(folder / "truth.png"),
            "--algorithm",
            "truth",
            "--size",
            "60x60",
            "--stats",
            str(stats_path),
        ],
        ["render", str(level), "-o", str(refused_path), "--view", "eye", *size],
        ["render", str(level), "-o", str(refused_path), "--algorithm", "shadow_map", *size],
        ["calibrate"],
        ["doctor"],
    ]
    command = [sys.executable, "-c", COMMANDS, json.dumps(commands)]
    process = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    map_result, mask, truth, *opengl_results, doctor = map(json.loads, process.stdout.splitlines())
    assert map_result == mask == truth == [0, "", ""]
    report = json.loads(stats_path.read_text())
    assert report["device"] is None and report["plan"]["algorithm"] == {"sun": {"relief": "truth"}}
    color = snapshot(level, "map", ProductRequest(), {}, size=(200, 200)).computed.array
    with Image.open(picture_path) as picture:
        assert picture.convert("RGB").tobytes() == color[..., :3].tobytes(), "the picture equals that with OpenGL"
    with rasterio.open(raster_path) as dataset:
        assert 0.02 < float((dataset.read(1) < 128).mean()) < 0.98
    for status, output, error_text in opengl_results:
        assert (status, output) == (1, "") and error_text.count("\n") == 1, error_text
        assert (
            "no OpenGL 4.3 context through EGL" in error_text
            and "only terrain without objects can be drawn, under the sun" in error_text
        )
    assert not refused_path.exists()
    status, output, _ = doctor
    assert status == 1 and "MISSING  OpenGL" in output and "apt-get install" in output and "ok       a shadowed map" in output


def test_the_service_draws_terrain_without_opengl(level: Path, environment: dict[str, str], client: Client):
    with serving_process([level], r"on (http://\S+)", environment) as (process, address):
        with httpx.Client(base_url=address, timeout=TIMEOUT_S) as software_client:
            tile = software_client.get(f"/levels/hills/{TILE}")
            assert tile.status_code == 200
            assert tile.content == client.get(f"/levels/hills/{TILE}", timeout=TIMEOUT_S).content, (
                "the picture equals that with OpenGL"
            )
            ready = software_client.get("/readyz").json()
            assert ready["renderer"] == NO_OPENGL_RENDERER and ready["workers"] == 1
            for resource in ("snapshot.png?view=eye&size=64x64", f"{TILE}?algorithm=shadow_map"):
                problem = check_problem(software_client.get(f"/levels/hills/{resource}"), 503, "no_opengl", None)
                assert "needs OpenGL" in problem["detail"] and "EGL" not in problem["detail"]
            assert software_client.get(f"/levels/hills/{TILE}", params=SUN | {"altitude": 9}).status_code == 200
        process.terminate()
        _, log_text = process.communicate(timeout=TIMEOUT_S)
    assert "only terrain without objects can be drawn, under the sun" in log_text
    assert "is replaced" not in log_text, "a refusal does not end the render process"


def test_a_service_without_its_expected_renderer_refuses(level: Path, environment: dict[str, str]):
    with serving_process([level], r"on (http://\S+)", environment | {"SKUGGA_EXPECT_RENDERER": "a GPU"}) as (_, address):
        with httpx.Client(base_url=address, timeout=TIMEOUT_S) as refusing_client:
            check_problem(refusing_client.get(f"/levels/hills/{TILE}"), 503, "graphics", None)
            check_problem(refusing_client.get("/readyz"), 503, "not_ready", None)
