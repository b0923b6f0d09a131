"""Outputs of commands: no input file is overwritten, and a full disk damages no file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio

from skugga.api.cli.outputs import check_output_files
from skugga.terrain.errors import InputError
from skugga.terrain.level.level_source import LevelSource
from tests.params import mark_long_except
from tests.rasters import write_geotiff

UTM = "EPSG:32633"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """Return the current folder, which holds a level made of many files."""
    monkeypatch.chdir(tmp_path)
    row, col = np.mgrid[:90, :120].astype(np.float32)
    ground = write_geotiff(tmp_path / "dem.tif", 300 * np.sin(col / 9) * np.cos(row / 13), UTM, 500e3, 5200e3, 30.0)
    write_geotiff(tmp_path / "ortho.tif", np.zeros((3, 30, 40), np.uint8), UTM, 500e3, 5200e3, 90.0)
    write_geotiff(tmp_path / "canopy.tif", np.zeros((90, 120), np.float32), UTM, 500e3, 5200e3, 30.0)
    (tmp_path / "parts.vrt").write_text(
        '<VRTDataset rasterXSize="1" rasterYSize="1"><VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="1">canopy.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>'
    )
    (tmp_path / "mill.obj").write_text("mtllib mill.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "mill.mtl").write_text("newmtl wall\nmap_Kd -clamp on wall.png\n")
    (tmp_path / "coarse.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "images": [{"uri": "roof.png"}]}))
    for name in ("wall.png", "roof.png"):
        (tmp_path / name).write_bytes(b"a picture")
    level = {
        "version": 1, "terrain": {"source": ground.name, "imagery": "ortho.tif"}, "forest": [{"source": "parts.vrt"}],
        "meshes": [{"source": "mill.obj", "at": [500e3, 5200e3], "caster": "coarse.gltf"}],
    }  # fmt: skip
    (tmp_path / "level.yaml").write_text(json.dumps(level))
    return tmp_path


@pytest.mark.parametrize(
    "name",
    [
        "level.yaml",
        "dem.tif",
        "ortho.tif",
        "canopy.tif",
        "parts.vrt",
        "mill.obj",
        "mill.mtl",
        "wall.png",
        "coarse.gltf",
        "roof.png",
    ],
)
def test_no_file_of_a_level_is_an_output(folder, name):
    level = LevelSource(path=Path("level.yaml"))
    (folder / "link").symlink_to(name)
    os.link(folder / name, folder / "twin")
    (folder / "sub").mkdir()
    for path_text in (name, f"./sub/../{name}", str(folder / name), "link", "twin"):
        with pytest.raises(InputError, match=rf"--output: .*{name}"):
            check_output_files(level, [("--output", Path(path_text))])


def test_other_files_may_be_outputs(folder):
    (folder / "old.tif").write_bytes(b"old")
    check_output_files(
        LevelSource(path=Path("level.yaml")), [("--output", Path("old.tif")), ("--stats", Path("new.json")), ("-x", None)]
    )


def test_a_command_s_other_inputs_are_no_outputs(folder):
    source = LevelSource(path=Path("dem.tif"), canopy=Path("canopy.tif"))
    for name in ("dem.tif", "canopy.tif", "ortho.tif"):
        with pytest.raises(InputError, match=name):
            check_output_files(source, [("--output", Path(name))], Path("ortho.tif"))


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (("shade", "dem.tif", "-o", "dem.tif"), "dem.tif"),
        (("shade", "dem.tif", "-o", "ortho.tif", "--like", "ortho.tif"), "ortho.tif"),
        (("render", "dem.tif", "-o", "./dem.tif", "--layer", "mask"), "dem.tif"),
        (("render", "level.yaml", "-o", "wall.png"), "wall.png"),
        (("render", "level.yaml", "-o", "new.png", "--stats", "level.yaml"), "level.yaml"),
        (("sunhours", "dem.tif", "-o", "dem.tif", "--date", "2024-03-21"), "dem.tif"),
        (("point", "level.yaml", "--at", "15,46.9", "--picture", "roof.png"), "roof.png"),
        (("select", "level.yaml", "--descriptor", "level.yaml"), "level.yaml"),
        (("compare", "level.yaml", "--json", "level.yaml"), "level.yaml"),
        (("compare", "level.yaml", "-o", "."), "png"),
    ],
)  # fmt: skip
def test_commands_refuse_input_files_as_outputs(run, folder, options, name):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    status, out, err = run(*options)
    assert (status, out, err.count("\n")) == (2, "", 1) and name in err and "another file" in err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("output", ["mask.tif", "color.tif", "depth.npy", "color.png"])
def test_a_full_disk_is_reported_and_keeps_the_old_file(run, folder, full_disk, output):
    layer = output.partition(".")[0]
    (folder / output).write_bytes(b"old")
    with full_disk(500):
        sun = ("--azimuth", "225", "--altitude", "30")
        status, _, err = run("render", "dem.tif", "--layer", layer, *sun, "--size", "200x200", "-o", output)
    assert status == 1 and err.count("\n") == 1 and output in err
    assert (folder / output).read_bytes() == b"old" and not list(folder.glob(".*"))


@pytest.mark.parametrize("free_bytes", [0, 700, 8000])
def test_a_raster_on_a_full_disk_is_an_error(run, folder, full_disk, free_bytes):
    arguments = ("shade", "dem.tif", "--layer", "cosi", "--azimuth", "225", "--altitude", "30", "-o")
    assert run(*arguments, "first.tif")[0] == 0  # compiles and caches the loops before the disk is full
    with full_disk(free_bytes):
        status, _, err = run(*arguments, "cosi.tif")
    assert status == 1 and err.count("\n") == 1 and "cosi.tif" in err
    assert not (folder / "cosi.tif").exists() and not list(folder.glob(".*"))


def test_contours_on_a_full_disk_keep_the_old_file(run, folder, full_disk):
    arguments = ("sunhours", "dem.tif", "-o", "hours.tif", "--date", "2024-03-21", "--step", "1h", "--contours", "hours.gpkg")
    assert run(*arguments)[0] == 0  # compiles the loops and caches them in files
    (folder / "hours.gpkg").write_bytes(b"old")
    with full_disk(90_000):  # enough for the raster
        status, _, err = run(*arguments)
    assert status == 1 and err.count("\n") == 1 and "hours.gpkg" in err
    assert (folder / "hours.gpkg").read_bytes() == b"old" and not list(folder.glob(".*"))
    with rasterio.open("hours.tif") as dataset:
        assert np.isfinite(dataset.read(1)).any()


@pytest.mark.parametrize("signal_number", mark_long_except([signal.SIGTERM, signal.SIGINT], signal.SIGTERM))
def test_an_interrupted_run_leaves_no_partial_file(folder, signal_number):
    code = "import sys; sys.argv = ['skugga', *sys.argv[1:]]; from skugga.api.cli.main import main; main()"
    times = ("--from", "2024-03-21T06:00Z", "--to", "2024-03-28T06:00Z", "--step", "1h")
    process = subprocess.Popen(
        [sys.executable, "-c", code, "shade", "dem.tif", "-o", "m_{time}.tif", *times],
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal_number, signal.SIG_DFL),  # a background process may inherit an ignored signal
    )
    deadline = time.monotonic() + 120
    while not list(folder.glob(".m_*")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal_number)
    process.communicate(timeout=120)
    assert process.returncode not in (0, -signal_number)
    assert not list(folder.glob(".m_*")) and not list(folder.glob("m_*"))
