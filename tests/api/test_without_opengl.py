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
from skugga.terrain.gl.egl_devices import NO_OPENGL
from tests.api.conftest import CORNER, SUN, ZOOM, Client, write_level
from tests.api.http.test_problems import check_problem
from tests.api.http.test_serve import ROOT, serving

PATIENCE_S = 300

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

NEEDS_OPENGL = {"eye": {"kind": "perspective", "eye": [8.4, 47.5, 500], "target": [8.41, 47.51, 0]}}
TILE = f"tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    """Return this process's environment without drivers and without an expected renderer."""
    return {key: value for key, value in os.environ.items() if key != "SKUGGA_EXPECT_RENDERER"} | WITHOUT_DRIVERS


@pytest.fixture(scope="module")
def level(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_level(tmp_path_factory.mktemp("bare"), "hills", views={"map": {"kind": "map"}, **NEEDS_OPENGL})


@pytest.mark.usefixtures("gl")
def test_the_command_line_draws_terrain_without_opengl(level: Path, environment: dict[str, str]):
    folder = level.parent
    drawn, shaded, refused = folder / "drawn.png", folder / "shaded.tif", folder / "refused.png"
    size = ["--size", "200x200"]
    commands = [
        ["render", str(level), "-o", str(drawn), *size],
        ["shade", str(level), "-o", str(shaded)],
        ["render", str(level), "-o", str(refused), "--view", "eye", *size],
        ["render", str(level), "-o", str(refused), "--algorithm", "shadow_map", *size],
        ["calibrate"],
        ["doctor"],
    ]
    command = [sys.executable, "-c", COMMANDS, json.dumps(commands)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    by_map, mask, *need_it, doctor = map(json.loads, done.stdout.splitlines())
    assert by_map == mask == [0, "", ""]
    color = snapshot(level, "map", ProductRequest(), {}, size=(200, 200)).computed.array
    with Image.open(drawn) as picture:
        assert picture.convert("RGB").tobytes() == color[..., :3].tobytes(), "as with OpenGL"
    with rasterio.open(shaded) as dataset:
        assert 0.02 < float((dataset.read(1) < 128).mean()) < 0.98
    for status, said, wrong in need_it:
        assert (status, said) == (1, "") and wrong.count("\n") == 1, wrong
        assert "no OpenGL 4.3 context through EGL" in wrong and "only terrain without objects can be drawn, under the sun" in wrong
    assert not refused.exists()
    status, said, _ = doctor
    assert status == 1 and "MISSING  OpenGL" in said and "apt-get install" in said and "ok       a shadowed map" in said


def test_the_service_draws_terrain_without_opengl(level: Path, environment: dict[str, str], client: Client):
    with serving([level], r"on (http://\S+)", environment) as (process, address):
        with httpx.Client(base_url=address, timeout=PATIENCE_S) as without:
            tile = without.get(f"/levels/hills/{TILE}")
            assert tile.status_code == 200
            assert tile.content == client.get(f"/levels/hills/{TILE}", timeout=PATIENCE_S).content, "as with OpenGL"
            ready = without.get("/readyz").json()
            assert ready["renderer"] == NO_OPENGL and ready["workers"] == 1
            for asked in ("snapshot.png?view=eye&size=64x64", f"{TILE}?algorithm=shadow_map"):
                problem = check_problem(without.get(f"/levels/hills/{asked}"), 503, "no_opengl", None)
                assert "needs OpenGL" in problem["detail"] and "EGL" not in problem["detail"]
            assert without.get(f"/levels/hills/{TILE}", params=SUN | {"altitude": 9}).status_code == 200
        process.terminate()
        _, said = process.communicate(timeout=PATIENCE_S)
    assert "only terrain without objects can be drawn, under the sun" in said
    assert "is replaced" not in said, "a refusal ends no render process"


def test_a_service_without_its_expected_renderer_refuses(level: Path, environment: dict[str, str]):
    with serving([level], r"on (http://\S+)", environment | {"SKUGGA_EXPECT_RENDERER": "a GPU"}) as (_, address):
        with httpx.Client(base_url=address, timeout=PATIENCE_S) as without:
            check_problem(without.get(f"/levels/hills/{TILE}"), 503, "graphics", None)
            check_problem(without.get("/readyz"), 503, "not_ready", None)
