"""One import name, ``skugga``, beside other packages called ``api`` or ``terrain``; and the rules of imports between
packages.
"""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.bare_names import PACKAGE_FOLDERS
from tests.copies import copy_with
from tests.rasters import write_geotiff

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = Path(sys.executable).parent


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """Return a user's folder whose packages have the names of the repository's folders and raise an error on import."""
    for name in PACKAGE_FOLDERS:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(f"raise RuntimeError('{name} of the user was imported')\n", encoding="utf-8")
    heights = np.zeros((40, 40), np.float32)
    heights[15:20, 10:30] = 30.0
    write_geotiff(tmp_path / "dem.tif", heights, "EPSG:32632", 600_000, 5_100_000, 10)
    return tmp_path


def run_in_project(project: Path, *command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a project's folder, with the project and this checkout on the path of modules."""
    path = os.pathsep.join([str(project), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(list(map(str, command)), cwd=project, env=environment, capture_output=True, text=True, timeout=600)


def test_skugga_imports_beside_packages_of_the_same_names(project: Path):
    code = (
        "import skugga, numpy, sys\n"
        "heights = numpy.zeros((9, 9), numpy.float32); heights[4, 4] = 10.0\n"
        "print(int(skugga.shadow(heights, 1.0, azimuth_deg=180.0, altitude_deg=45.0).sum()))\n"
        "print(sorted(set(sys.modules) & {'api', 'configs', 'selector', 'shadows', 'terrain'}))"
    )
    process = run_in_project(project, sys.executable, "-c", code)
    assert process.returncode == 0, process.stderr
    dark_count, bare_modules = process.stdout.splitlines()
    assert int(dark_count) > 3 and bare_modules == "[]"


def test_commands_work_beside_packages_of_the_same_names(project: Path):
    sun = ["--azimuth", "180", "--altitude", "45"]
    code = "from skugga.api.cli.main import main; main()"
    process = run_in_project(project, sys.executable, "-c", code, "shade", "dem.tif", *sun, "-o", "mask.tif")
    assert process.returncode == 0 and (project / "mask.tif").is_file(), process.stderr


@pytest.mark.parametrize("name", sorted(PACKAGE_FOLDERS))
def test_a_bare_name_is_refused_in_tests(name: str):
    with pytest.raises(ImportError, match=rf"second copy of skugga\.{name}"):
        importlib.import_module(name)


def test_no_second_copy_was_imported():
    assert not {name for name in sys.modules if name.partition(".")[0] in PACKAGE_FOLDERS}


BARE_IMPORTS = [*(f"import {name}" for name in sorted(PACKAGE_FOLDERS)), "from terrain.geo import sun", "import api.cli as c"]


@pytest.mark.parametrize("line", BARE_IMPORTS)
def test_the_linter_reports_a_bare_import(line: str):
    command = [SCRIPTS / "ruff", "check", "--stdin-filename", "planted.py", "-"]
    process = subprocess.run(command, input=line + "\n", capture_output=True, text=True, cwd=ROOT)
    assert process.returncode == 1 and "TID251" in process.stdout, process.stdout + process.stderr


FORBIDDEN_IMPORTS = {
    "a layer above": (
        "terrain/errors.py",
        "from skugga.selector.formatting import *",
        "skugga.terrain is not allowed to import skugga.selector",
    ),
    "a part above": (
        "terrain/geo/grid.py",
        "from skugga.terrain.scene import *",
        "skugga.terrain.geo is not allowed to import skugga.terrain.scene",
    ),
    "a circle": (
        "shadows/maps/taps.py",
        "from skugga.shadows.maps.resolve import *",
        "No cycles are allowed in skugga.shadows.maps",
    ),
    "raw OpenGL": ("shadows/work.py", "import OpenGL.GL", "skugga.shadows.work -> OpenGL"),
}


@pytest.mark.parametrize("violation", FORBIDDEN_IMPORTS)
def test_import_linter_reports_a_forbidden_import(tmp_path: Path, violation: str):
    name, line, expected_message = FORBIDDEN_IMPORTS[violation]
    project_copy = copy_with(tmp_path, {})
    path = project_copy / name
    path.write_text(path.read_text(encoding="utf-8").rstrip() + f"\n{line}\n", encoding="utf-8")
    shutil.copy(ROOT / "pyproject.toml", project_copy)
    process = subprocess.run(
        [SCRIPTS / "lint-imports", "--no-logo", "--no-cache"], cwd=project_copy, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(project_copy), "COLUMNS": "200"},
    )  # fmt: skip
    assert process.returncode == 1 and expected_message in process.stdout, process.stdout + process.stderr
