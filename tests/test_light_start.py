"""Slow libraries that each entry point may import: none for help and completion, only the needed ones for a command.

A command that answers at once imports nothing that computes. ``LIGHT``, ``HELP``, ``SHOWN`` and ``WORK`` have a line for
each entry point. If one fails, ``python -X importtime`` shows the importing module; move the import into the function that
needs it.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skugga.api.cli.lazy_commands import COMMANDS
from tests.rasters import write_geotiff

ROOT = Path(__file__).parents[1]

HEAVY = frozenset(
    "OpenGL PIL boto3 dask embreex fastapi llvmlite mapbox_earcut matplotlib moderngl morecantile numba numpy pandas pmtiles pvlib "
    "pydantic pyogrio pyproj rasterio rich scipy.interpolate scipy.ndimage scipy.optimize scipy.sparse scipy.spatial shapely "
    "starlette trimesh uvicorn xarray".split()
)
"""Modules that take from a hundredth of a second (moderngl) to almost a second (pvlib) to import. SciPy counts by its parts: the
package alone is light, and numba imports it.
"""

TYPER = frozenset(["pydantic"])
"""Typer reads the values of options with it, where it is installed."""

RASTERS = frozenset(["boto3", "numpy", "pydantic", "pyproj", "rasterio"])
"""Modules that open a raster. rasterio imports boto3 where that is installed."""

LOOPS = frozenset(["llvmlite", "numba"])
"""The decorator of compiled loops imports these, so every module with a loop does."""

SPLINES = frozenset(["scipy.interpolate", "scipy.optimize", "scipy.sparse", "scipy.spatial"])
"""SciPy's splines and their imports: the line sweep fits them to the position of the ground in a map."""

SUN = SPLINES | {"pandas", "pvlib"}
"""Position of the sun at a time. pvlib imports splines, too."""

PLAN = frozenset(["moderngl", "scipy.ndimage"])
"""Selection of algorithms: it imports all of them, and filters heights."""

DRAWING = PLAN | SPLINES
TABLES = frozenset(["rich"])

LIGHT: dict[str, tuple[list[str], int, frozenset[str]]] = {
    "help": (["--help"], 0, frozenset()),
    "no arguments": ([], 0, frozenset()),
    "version": (["--version"], 0, frozenset()),
    "unknown command": (["frobnicate"], 2, TYPER),
    "unknown option": (["--sparkle"], 2, frozenset()),
    "unknown option of a command": (["validate", "x.tif", "--sparkle"], 2, TYPER),
    "missing argument": (["validate"], 2, TYPER),
    "missing option": (["sunhours", "x.tif"], 2, TYPER | {"numpy"}),
    "value that is no number": (["overviews", "x.tif", "--nodata", "none"], 2, TYPER),
    "script of completion": (["--show-completion", "bash"], 0, TYPER),
}
"""Entry point -> arguments of ``skugga``, exit status, and allowed imports."""

HELP: dict[str, frozenset[str]] = {
    **dict.fromkeys(COMMANDS, TYPER),
    **dict.fromkeys(["compute", "point", "render", "seed", "shade", "sunhours"], TYPER | {"numpy"}),
}
"""Command -> allowed imports of its help. The lists of formats and products are in modules that use arrays."""

SHOWN: dict[str, tuple[str, str, frozenset[str]]] = {
    "commands": ("skugga se", "select", TYPER),
    "options": ("skugga validate x.tif --no", "--nodata", TYPER),
    "levels": ("skugga validate jack", "jacksboro_wooded", TYPER),
    "styles": ("skugga render x.tif --style n", "natural", TYPER | {"numpy"}),
    "policies": ("skugga select x.tif --policy p", "probe", TYPER),
}
"""Completed item -> a line, a word that is shown, and allowed imports."""

SWEEP = ["--azimuth", "250", "--altitude", "20"]
NOON = ["--time", "2024-03-21T12:00:00+01:00"]
PLACE = ["--at", "15.008,46.95"]

WORK: dict[str, tuple[list[str], frozenset[str]]] = {
    "levels": (["levels"], RASTERS | TABLES),
    "levels as JSON": (["levels", "--json"], RASTERS),
    "validate": (["validate", "hills.tif"], RASTERS | LOOPS | PLAN),
    "init": (["init", "hills.tif", "-o", "hills.yaml"], RASTERS | LOOPS),
    "overviews": (["overviews", "hills.tif"], RASTERS | LOOPS),
    "shade": (["shade", "hills.tif", *SWEEP, "-o", "mask.tif"], RASTERS | LOOPS | DRAWING),
    "shade at a time": (["shade", "hills.tif", *NOON, "-o", "mask.tif"], RASTERS | LOOPS | DRAWING | SUN),
    "sunhours": (["sunhours", "hills.tif", "--date", "2024-03-21", "-o", "hours.tif"], RASTERS | LOOPS | SUN | {"moderngl"}),
    "compute": (["compute", "hills.tif", "--product", "height", "-o", "height.tif"], RASTERS | LOOPS | DRAWING),
    "point": (["point", "hills.tif", *PLACE, "--date", "2024-03-21"], RASTERS | LOOPS | SUN | TABLES),
    "horizon of a point": (["point", "hills.tif", *PLACE, "--horizon", "pvlib"], RASTERS | LOOPS),
    "render": (["render", "hills.tif", *SWEEP, "--size", "64x64", "-o", "color.png"], RASTERS | LOOPS | DRAWING | {"PIL"}),
    "select": (["select", "hills.tif", *SWEEP, "--policy", "rules"], RASTERS | LOOPS | PLAN),
    "seed": (
        ["seed", "hills.tif", *SWEEP, "--zooms", "11-11", "--dry-run", "-o", "hills.pmtiles"],
        RASTERS | LOOPS | PLAN | TABLES | {"PIL", "morecantile", "pmtiles"},
    ),
    "compare": (
        ["compare", "hills.tif", *SWEEP, "--size", "32x32", "--time-limit", "0"],
        RASTERS | LOOPS | DRAWING | TABLES | {"OpenGL", "PIL", "embreex"},
    ),
    "doctor": (["doctor"], RASTERS | LOOPS | DRAWING | SUN),
}
"""Command and its input -> its arguments, and allowed imports."""

ELSEWHERE = {"calibrate": "takes a minute", "compile": "has its own tests", "serve": "is below"}
"""Commands that are not run here, and the reason."""

PROGRAM = "import sys; sys.argv[:] = {argv!r}\nfrom skugga.api.cli.main import main; main()"

REPORT = """
import sys
status = 0
try:
    exec({code!r}, {{"__name__": "__main__"}})
except SystemExit as ended:
    status = ended.code or 0
with open({report!r}, "w") as file:
    file.write(repr((status, sorted(sys.modules))))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a small raster of hills."""
    row, col = np.mgrid[:48, :48].astype(np.float32)
    heights = 500 + 200 * np.sin(col / 5 + 1) * np.cos(row / 7 + 1)
    write_geotiff(tmp_path / "hills.tif", heights, "EPSG:32633", 500e3, 5200e3, 30.0)
    return tmp_path


def imported(code: str, folder: Path, **environment: str) -> tuple[int, set[str], str]:
    """Run code in a new Python process. Return its exit status, the imported modules of ``HEAVY``, and its output."""
    report = folder / "report"
    script = REPORT.format(code=code, report=str(report))
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=folder, env=env, check=False)
    assert report.exists(), done.stderr
    status, modules = eval(report.read_text())
    return status, HEAVY & set(modules), done.stdout + done.stderr


def run(arguments: list[str], folder: Path) -> tuple[int, set[str], str]:
    return imported(PROGRAM.format(argv=["skugga", *arguments]), folder)


@pytest.mark.parametrize("name", LIGHT)
def test_answers_without_work_import_nothing_heavy(name, tmp_path, monkeypatch):
    # A build server's shell is sh, which has no completion. This makes the named shell count.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    arguments, status, allowed = LIGHT[name]
    (tmp_path / "x.tif").touch()
    ended, found, said = run(arguments, tmp_path)
    assert ended == status, said
    assert found <= allowed, said


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_imports_nothing_heavy(command, tmp_path):
    status, found, said = run([command, "--help"], tmp_path)
    assert status == 0 and f"Usage: skugga {command}" in said
    assert found <= HELP[command]


@pytest.mark.parametrize("name", SHOWN)
@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_imports_nothing_heavy(shell, name, tmp_path):
    line, word, allowed = SHOWN[name]
    words = line.split(" ")
    asked = (
        {"COMP_WORDS": "\n".join(words), "COMP_CWORD": str(len(words) - 1)} if shell == "bash" else {"_TYPER_COMPLETE_ARGS": line}
    )
    code = PROGRAM.format(argv=["skugga"])
    status, found, said = imported(code, tmp_path, _SKUGGA_COMPLETE=f"complete_{shell}", **asked)
    assert status == 0 and word in said
    assert found <= allowed | (TABLES if shell == "zsh" else frozenset())  # Rich removes markup from the help that zsh shows


@pytest.mark.parametrize("name", WORK)
def test_commands_import_only_the_libraries_they_need(name, folder):
    arguments, allowed = WORK[name]
    status, found, said = run(arguments, folder)
    assert status == 0 or name == "doctor", said
    assert found <= allowed


def test_every_command_has_a_line():
    assert {arguments[0] for arguments, _ in WORK.values()} | set(ELSEWHERE) == set(COMMANDS)


@pytest.mark.parametrize(
    ("code", "allowed"),
    [
        ("import skugga", frozenset()),
        ("import skugga; dir(skugga); skugga.SkuggaError", frozenset()),
        ("import numpy, skugga; skugga.shadow(numpy.eye(9), 30.0, 250.0, 20.0)", RASTERS | LOOPS | SPLINES),
        ("import skugga; skugga.open_level('hills.tif').close()", RASTERS | LOOPS | {"moderngl"}),
    ],
)
def test_the_library_imports_only_what_is_used(code, allowed, folder):
    status, found, said = imported(code, folder)
    assert status == 0, said
    assert found <= allowed


SERVICE = """
import json, os, signal, sys, threading, time, urllib.request

def ask():
    address = "http://127.0.0.1:{port}"
    for path in ("/livez", "/levels", "/levels/hills", "/levels/hills/WebMercatorQuad/tilejson.json", "/metrics", "/readyz"):
        while True:
            try:
                urllib.request.urlopen(address + path).read()
            except urllib.error.HTTPError:  # it is not ready: an answer, too
                pass
            except OSError:
                time.sleep(0.1)
                continue
            break
    os.kill(os.getpid(), signal.SIGINT)

if __name__ == "__main__":
    threading.Thread(target=ask, daemon=True).start()
    sys.argv[:] = ["skugga", "serve", "hills.tif", "--port", "{port}", "--workers", "1"]
    from skugga.api.cli.main import main
    main()
"""

FRONT = RASTERS | {"PIL", "fastapi", "morecantile", "pmtiles", "starlette", "uvicorn"}


def test_the_http_process_of_a_service_imports_no_renderer(folder):
    """This holds up to its first responses. Drawing is for its render processes."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    status, found, said = imported(SERVICE.replace("{port}", str(port)), folder)
    assert status == 0 and "Skugga serves hills" in said, said
    assert found <= FRONT
