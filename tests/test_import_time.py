"""Slow libraries that each entry point may import: none for help and completion, only the needed ones for a command.

A command that answers at once imports nothing that computes. ``INSTANT_ARGUMENTS``, ``HELP_MODULES``, ``COMPLETION_CASES`` and
``COMMAND_ARGUMENTS`` have a line for each entry point. If one fails, ``python -X importtime`` shows the importing module; move the
import into the function that needs it.
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
from skugga.selector.cost.device_estimate import typical_profile
from skugga.selector.cost.device_profile import save_profile
from skugga.terrain.gl.device import renderer_and_version
from tests.params import mark_long_except
from tests.rasters import write_geotiff

ROOT = Path(__file__).parents[1]

SLOW_MODULES = frozenset(
    "OpenGL PIL boto3 dask embreex fastapi llvmlite mapbox_earcut matplotlib moderngl morecantile numba numpy pandas pmtiles pvlib "
    "py_straight_skeleton pydantic pyogrio pyproj rasterio rich scipy.interpolate scipy.ndimage scipy.optimize scipy.sparse "
    "scipy.spatial shapely starlette trimesh uvicorn xarray".split()
)
"""Modules that take from a hundredth of a second (moderngl) to almost a second (pvlib) to import. SciPy counts by its parts: the
package alone is light, and numba imports it.
"""

TYPER_MODULES = frozenset(["pydantic"])
"""Typer reads the values of options with it, where it is installed."""

RASTER_MODULES = frozenset(["boto3", "numpy", "pydantic", "pyproj", "rasterio"])
"""Modules that open a raster. rasterio imports boto3 where that is installed."""

LOOP_MODULES = frozenset(["llvmlite", "numba"])
"""The decorator of compiled loops imports these, so every module with a loop does."""

SPLINE_MODULES = frozenset(["scipy.interpolate", "scipy.optimize", "scipy.sparse", "scipy.spatial"])
"""SciPy's splines and their imports: the line sweep fits them to the position of the ground in a map."""

SUN_MODULES = SPLINE_MODULES | {"pandas", "pvlib"}
"""Position of the sun at a time. pvlib imports splines, too."""

PLAN_MODULES = frozenset(["moderngl", "scipy.ndimage"])
"""Selection of algorithms: it imports all of them, and filters heights."""

DRAWING_MODULES = PLAN_MODULES | SPLINE_MODULES
TABLE_MODULES = frozenset(["rich"])

INSTANT_ARGUMENTS: dict[str, tuple[list[str], int, frozenset[str]]] = {
    "help": (["--help"], 0, frozenset()),
    "no arguments": ([], 0, frozenset()),
    "version": (["--version"], 0, frozenset()),
    "unknown command": (["frobnicate"], 2, TYPER_MODULES),
    "unknown option": (["--sparkle"], 2, frozenset()),
    "unknown option of a command": (["validate", "x.tif", "--sparkle"], 2, TYPER_MODULES),
    "missing argument": (["validate"], 2, TYPER_MODULES),
    "missing option": (["sunhours", "x.tif"], 2, TYPER_MODULES | {"numpy"}),
    "value that is no number": (["overviews", "x.tif", "--nodata", "none"], 2, TYPER_MODULES),
    "script of completion": (["--show-completion", "bash"], 0, TYPER_MODULES),
}
"""Entry point -> arguments of ``skugga``, exit status, and allowed imports."""

HELP_MODULES: dict[str, frozenset[str]] = {
    **dict.fromkeys(COMMANDS, TYPER_MODULES),
    **dict.fromkeys(["compute", "irradiation", "point", "render", "seed", "shade", "sunhours"], TYPER_MODULES | {"numpy"}),
}
"""Command -> allowed imports of its help. The lists of formats and products are in modules that use arrays."""

COMPLETION_CASES: dict[str, tuple[str, str, frozenset[str]]] = {
    "commands": ("skugga se", "select", TYPER_MODULES),
    "options": ("skugga validate x.tif --no", "--nodata", TYPER_MODULES),
    "levels": ("skugga validate jack", "jacksboro_wooded", TYPER_MODULES),
    "styles": ("skugga render x.tif --style n", "natural", TYPER_MODULES | {"numpy"}),
    "policies": ("skugga select x.tif --policy p", "probe", TYPER_MODULES),
}
"""Completed item -> a line, a word that is shown, and allowed imports."""

SUN_ANGLE_OPTIONS = ["--azimuth", "250", "--altitude", "20"]
TIME_OPTION = ["--time", "2024-03-21T12:00:00+01:00"]
POINT_OPTION = ["--at", "15.008,46.95"]

COMMAND_ARGUMENTS: dict[str, tuple[list[str], frozenset[str]]] = {
    "levels": (["levels"], RASTER_MODULES | TABLE_MODULES),
    "levels as JSON": (["levels", "--json"], RASTER_MODULES),
    "validate": (["validate", "hills.tif"], RASTER_MODULES | LOOP_MODULES | PLAN_MODULES),
    "init": (["init", "hills.tif", "-o", "hills.yaml"], RASTER_MODULES | LOOP_MODULES),
    "overviews": (["overviews", "hills.tif"], RASTER_MODULES | LOOP_MODULES),
    "shade": (["shade", "hills.tif", *SUN_ANGLE_OPTIONS, "-o", "mask.tif"], RASTER_MODULES | LOOP_MODULES | DRAWING_MODULES),
    "shade at a time": (
        ["shade", "hills.tif", *TIME_OPTION, "-o", "mask.tif"],
        RASTER_MODULES | LOOP_MODULES | DRAWING_MODULES | SUN_MODULES,
    ),
    "sunhours": (
        ["sunhours", "hills.tif", "--date", "2024-03-21", "-o", "hours.tif"],
        RASTER_MODULES | LOOP_MODULES | SUN_MODULES | {"moderngl"},
    ),
    "irradiation": (
        ["irradiation", "hills.tif", "--date", "2024-03-21", "-o", "kwh.tif"],
        RASTER_MODULES | LOOP_MODULES | SUN_MODULES | {"moderngl"},
    ),
    "compute": (
        ["compute", "hills.tif", "--product", "height", "-o", "height.tif"],
        RASTER_MODULES | LOOP_MODULES | DRAWING_MODULES,
    ),
    "point": (
        ["point", "hills.tif", *POINT_OPTION, "--date", "2024-03-21"],
        RASTER_MODULES | LOOP_MODULES | SUN_MODULES | TABLE_MODULES,
    ),
    "horizon of a point": (["point", "hills.tif", *POINT_OPTION, "--horizon", "pvlib"], RASTER_MODULES | LOOP_MODULES),
    "render": (
        ["render", "hills.tif", *SUN_ANGLE_OPTIONS, "--size", "64x64", "-o", "color.png"],
        RASTER_MODULES | LOOP_MODULES | DRAWING_MODULES | {"PIL"},
    ),
    "select": (["select", "hills.tif", *SUN_ANGLE_OPTIONS, "--policy", "rules"], RASTER_MODULES | LOOP_MODULES | PLAN_MODULES),
    "seed": (
        ["seed", "hills.tif", *SUN_ANGLE_OPTIONS, "--zooms", "11-11", "--dry-run", "-o", "hills.pmtiles"],
        RASTER_MODULES | LOOP_MODULES | PLAN_MODULES | TABLE_MODULES | {"PIL", "morecantile", "pmtiles"},
    ),
    "compare": (
        ["compare", "hills.tif", *SUN_ANGLE_OPTIONS, "--size", "32x32", "--time-limit", "0"],
        RASTER_MODULES | LOOP_MODULES | DRAWING_MODULES | TABLE_MODULES | {"OpenGL", "PIL", "embreex"},
    ),
    "doctor": (["doctor"], RASTER_MODULES | LOOP_MODULES | DRAWING_MODULES | SUN_MODULES),
}
"""Command and its input -> its arguments, and allowed imports."""

COMMANDS_NOT_RUN = {"calibrate": "takes a minute", "compile": "has its own tests", "serve": "is below"}
"""Commands that are not run here, and the reason."""

COMMAND_SCRIPT = "import sys; sys.argv[:] = {argv!r}\nfrom skugga.api.cli.main import main; main()"

REPORT_SCRIPT = """
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


def run_and_list_imports(code: str, folder: Path, **environment: str) -> tuple[int, set[str], str]:
    """Run code in a new Python process. Return its exit status, the imported modules of ``SLOW_MODULES``, and its output."""
    report = folder / "report"
    script = REPORT_SCRIPT.format(code=code, report=str(report))
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=folder, env=env, check=False)
    assert report.exists(), process.stderr
    status, modules = eval(report.read_text())
    return status, SLOW_MODULES & set(modules), process.stdout + process.stderr


def run_skugga(arguments: list[str], folder: Path) -> tuple[int, set[str], str]:
    """Run a command of ``skugga`` in a new process. Return its exit status, the imported modules, and its output."""
    return run_and_list_imports(COMMAND_SCRIPT.format(argv=["skugga", *arguments]), folder)


@pytest.mark.parametrize("name", INSTANT_ARGUMENTS)
def test_answers_without_work_import_nothing_heavy(name, tmp_path, monkeypatch):
    # A build server's shell is sh, which has no completion. This makes the named shell count.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    arguments, status, allowed = INSTANT_ARGUMENTS[name]
    (tmp_path / "x.tif").touch()
    exit_status, imported_modules, output = run_skugga(arguments, tmp_path)
    assert exit_status == status, output
    assert imported_modules <= allowed, output


HELP_SCRIPT = """
import sys
from skugga.api.cli.main import main
commands, imports = sys.argv[1:], {}
for command in commands:
    sys.argv[:] = ["skugga", command, "--help"]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, command
    imports[command] = sorted(sys.modules)
print(imports, file=sys.stderr)
"""


def test_help_of_commands_imports_nothing_heavy(tmp_path):
    """One process shows the help of all commands, those with the fewest imports first."""
    commands = sorted(HELP_MODULES, key=lambda command: len(HELP_MODULES[command]))
    process = subprocess.run(
        [sys.executable, "-c", HELP_SCRIPT, *commands], capture_output=True, text=True, cwd=tmp_path, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    for command, modules in eval(process.stderr).items():
        assert f"Usage: skugga {command}" in process.stdout
        assert SLOW_MODULES & set(modules) <= HELP_MODULES[command], command


@pytest.mark.parametrize(("shell", "name"), [*(("bash", name) for name in COMPLETION_CASES), ("zsh", "options")])
def test_completion_imports_nothing_heavy(shell, name, tmp_path):
    line, word, allowed = COMPLETION_CASES[name]
    words = line.split(" ")
    completion_environment = (
        {"COMP_WORDS": "\n".join(words), "COMP_CWORD": str(len(words) - 1)} if shell == "bash" else {"_TYPER_COMPLETE_ARGS": line}
    )
    code = COMMAND_SCRIPT.format(argv=["skugga"])
    status, imported_modules, output = run_and_list_imports(
        code, tmp_path, _SKUGGA_COMPLETE=f"complete_{shell}", **completion_environment
    )
    assert status == 0 and word in output
    assert imported_modules <= allowed | (
        TABLE_MODULES if shell == "zsh" else frozenset()
    )  # Rich removes markup from the help that zsh shows


@pytest.fixture(scope="module")
def _known_device() -> None:
    """Store an estimate of the device. Without it the first command that shows times runs a benchmark, with many libraries."""
    save_profile(typical_profile(*renderer_and_version()))


@pytest.mark.parametrize("name", mark_long_except(COMMAND_ARGUMENTS, "levels", "shade", "sunhours", "point"))
@pytest.mark.usefixtures("_known_device")
def test_commands_import_only_the_libraries_they_need(name, folder):
    arguments, allowed = COMMAND_ARGUMENTS[name]
    status, imported_modules, output = run_skugga(arguments, folder)
    assert status == 0 or name == "doctor", output
    assert imported_modules <= allowed


def test_every_command_has_a_line():
    assert {arguments[0] for arguments, _ in COMMAND_ARGUMENTS.values()} | set(COMMANDS_NOT_RUN) == set(COMMANDS)


@pytest.mark.parametrize(
    ("code", "allowed"),
    [
        ("import skugga", frozenset()),
        ("import skugga; dir(skugga); skugga.SkuggaError", frozenset()),
        ("import numpy, skugga; skugga.shadow(numpy.eye(9), 30.0, 250.0, 20.0)", RASTER_MODULES | LOOP_MODULES | SPLINE_MODULES),
        ("import skugga; skugga.open_level('hills.tif').close()", RASTER_MODULES | LOOP_MODULES | {"moderngl"}),
    ],
)
def test_the_library_imports_only_what_is_used(code, allowed, folder):
    status, imported_modules, output = run_and_list_imports(code, folder)
    assert status == 0, output
    assert imported_modules <= allowed


SERVICE_SCRIPT = """
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

HTTP_MODULES = RASTER_MODULES | {"PIL", "fastapi", "morecantile", "pmtiles", "starlette", "uvicorn"}


def test_the_http_process_of_a_service_imports_no_renderer(folder):
    """This holds up to its first responses. Drawing is for its render processes."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    status, imported_modules, output = run_and_list_imports(SERVICE_SCRIPT.replace("{port}", str(port)), folder)
    assert status == 0 and "Skugga serves hills" in output, output
    assert imported_modules <= HTTP_MODULES
