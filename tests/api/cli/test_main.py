"""The command line: its outputs, and errors in one line with the right exit status."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from skugga.api.products.mask import MASK_LIT, MASK_NO_SURFACE, MASK_SHADOW
from skugga.selector.cost import device_estimate
from tests.rasters import write_geotiff

SMALL_MAP_OPTIONS = ("--size", "96x100", "--azimuth", "246", "--altitude", "12")


def test_render_writes_every_layer(gl, run, tmp_path):
    arrays = {}
    for layer, suffix in (
        ("color", "png"), ("shadow", "webp"), ("mask", "png"), ("visibility", "npy"), ("depth", "npy"), ("position", "npy"),
    ):  # fmt: skip
        path = tmp_path / f"{layer}.{suffix}"
        status, out, err = run("render", "jacksboro", *SMALL_MAP_OPTIONS, "--layer", layer, "-o", str(path))
        assert (status, out, err) == (0, "", "")
        arrays[layer] = np.load(path) if suffix == "npy" else np.asarray(Image.open(path))
    valid = np.isfinite(arrays["visibility"])
    assert 0.5 < valid.mean() < 1.0
    assert arrays["visibility"].dtype == np.float32 and arrays["position"].dtype == np.float64
    assert arrays["position"].shape == (100, 96, 3) and arrays["color"].shape == (100, 96, 4)
    assert set(np.unique(arrays["mask"])) == {MASK_SHADOW, MASK_NO_SURFACE, MASK_LIT}
    np.testing.assert_array_equal(arrays["mask"] == MASK_NO_SURFACE, ~valid)
    np.testing.assert_array_equal(arrays["mask"][valid] == MASK_SHADOW, arrays["visibility"][valid] < 0.5)
    expected = np.rint(255 * (1 - np.where(valid, arrays["visibility"], 1)))
    np.testing.assert_array_equal(arrays["shadow"][..., 3], expected)
    assert (arrays["shadow"][..., :3] == 0).all()
    np.testing.assert_array_equal(arrays["color"][..., 3] == 255, valid)
    np.testing.assert_array_equal(np.isfinite(arrays["position"][..., 2]), valid)
    highest = (arrays["depth"] + arrays["position"][..., 2])[valid]
    assert np.ptp(highest) < 1e-3 and np.nanmin(arrays["depth"]) >= 0


def test_a_geotiff_has_the_requested_bounds_and_crs(gl, run, tmp_path):
    path = tmp_path / "mask.tif"
    bounds = "-84.30,36.26,-84.20,36.36"
    status, _, err = run(
        "render",
        "jacksboro",
        "--crs",
        "EPSG:4326",
        "--bounds",
        bounds,
        "--size",
        "200x200",
        "--layer",
        "mask",
        "-o",
        str(path),
    )
    assert (status, err) == (0, "")
    with rasterio.open(path) as dataset:
        assert dataset.crs.to_epsg() == 4326 and dataset.nodata == MASK_NO_SURFACE
        assert dataset.bounds == pytest.approx((-84.30, 36.26, -84.20, 36.36))
        assert set(np.unique(dataset.read(1))) == {MASK_SHADOW, MASK_LIT}


def test_stats_report_passes_and_device(gl, run, tmp_path):
    stats = tmp_path / "stats.json"
    assert run("render", "jacksboro", *SMALL_MAP_OPTIONS, "-o", str(tmp_path / "c.png"), "--stats", str(stats))[0] == 0
    report = json.loads(stats.read_text())
    assert [record["name"] for record in report["passes"]] == report["plan"]["passes"]
    assert report["caster_reach"]["clipped"] is True and report["caster_reach"]["needed_m"] > 5000
    assert report["sun"]["altitude"] == 12 and report["view"]["size"] == [96, 100]
    assert report["device"]["renderer"] == gl.renderer


def test_each_option_changes_the_picture(gl, run, tmp_path):
    def picture(*options: str) -> np.ndarray:
        path = tmp_path / "p.png"
        assert run("render", "jacksboro", "--size", "120x120", *options, "-o", str(path))[0] == 0
        return np.asarray(Image.open(path))

    default_picture = picture()
    for options in (
        ("--algorithm", "none"), ("--algorithm", "relief=none"), ("--time", "2024-10-21T09:00:00-04:00"), ("--filter", "5"),
        ("--azimuth", "100", "--altitude", "10"), ("--map-size", "64"), ("--bounds", "741000,4008000,751000,4018000"),
        ("--crs", "3857"),
    ):  # fmt: skip
        assert (picture(*options) != default_picture).any(), options


@pytest.mark.parametrize(
    ("arguments", "expected_texts"),
    [
        (("render", "nowhere", "-o", "x.png"), ("nowhere", "jacksboro")),
        (("render", "jacksboro", "-o", "x.gif"), ("--output", "x.gif", ".png")),
        (("render", "jacksboro", "--layer", "sparkle", "-o", "x.png"), ("layer", "sparkle", "visibility")),
        (("render", "jacksboro", "--layer", "position", "-o", "x.png"), ("x.png", ".npy")),
        (("render", "jacksboro", "--size", "0x5", "-o", "x.png"), ("--size", "0x5", "16384")),
        (("render", "jacksboro", "--size", "16384x16384", "-o", "x.png"), ("size", "16384x16384", "pixels")),
        (("render", "jacksboro", "--bounds", "1,2,3", "-o", "x.png"), ("--bounds", "1,2,3", "W,S,E,N")),
        (("render", "jacksboro", "--bounds", "5,5,1,1", "-o", "x.png"), ("bounds", "west < east")),
        (("render", "jacksboro", "--bounds", "nan,0,1,1", "-o", "x.png"), ("bounds", "west < east")),
        (("render", "jacksboro", "--crs", "EPSG:999999", "-o", "x.png"), ("crs", "EPSG:999999")),
        (("render", "jacksboro", "--algorithm", "magic", "-o", "x.png"), ("--algorithm", "magic", "shadow_map")),
        (("render", "jacksboro", "--filter", "4", "-o", "x.png"), ("filter", "4", "1, 2, 3")),
        (("render", "jacksboro", "--depth-bits", "12", "-o", "x.png"), ("depth_bits", "12", "16, 24")),
        (("render", "jacksboro", "--map-size", "9", "-o", "x.png"), ("map_size", "9", "64")),
        (("render", "jacksboro", "--time", "noon", "-o", "x.png"), ("time", "noon", "offset")),
        (("render", "jacksboro", "--altitude", "10", "-o", "x.png"), ("azimuth",)),
        (("render", "jacksboro", "--view", "ridge", "-o", "x.png"), ("view", "ridge", "map")),
        (("render", "jacksboro"), ("-o",)),
        (("render", "jacksboro", "--sparkle", "-o", "x.png"), ("--sparkle",)),
        (("render", "jacksboro", "--size", "²x1", "-o", "x.png"), ("--size",)),
        (("render", "jacksboro", "--size", "16384x1", "-o", "x.png"), ("size", "square pixels")),
        (("render", "jacksboro", "--crs", "²", "-o", "x.png"), ("crs",)),
        (("render", "jacksboro", "--bounds=-1e300,-1e300,1e300,1e300", "-o", "x.png"), ("bounds", "1e9")),
        (("render", "jacksboro", "--bounds", "741000,4008000,741000.0000001,4008000.0000001", "-o", "x.png"), ("bounds",)),
        (("render", "jacksboro", "--crs", "4326", "--bounds", "0,-100,1,0", "-o", "x.png"), ("bounds", "-90 to 90")),
        (("render", "jacksboro", "--time", "0001-01-01T00:00:00+14:00", "-o", "x.png"), ("time", "1678")),
        (("render", "jacksboro", "--bounds", "0,0,1000,1000", "-o", "x.png"), ("bounds", "UTM zone 16N", "which are 73")),
        (("render", "jacksboro", "--crs", "4326", "--bounds", "8,47,9,48", "-o", "x.png"), ("bounds", "WGS 84", "which are -84")),
        (("validate", "nowhere.yaml"), ("nowhere.yaml",)),
        (("frobnicate",), ("frobnicate",)),
    ],
)
def test_wrong_input_is_one_line_and_status_2(run, arguments, expected_texts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, err = run(*arguments)
    assert status == 2, err
    assert out == "" and err.count("\n") == 1 and "Traceback" not in err
    for text in expected_texts:
        assert text in err, err
    assert not list(tmp_path.iterdir())


def test_each_error_of_a_level_file_is_one_line(run, tmp_path):
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\ntitel: x\nterrain: {source: jacksboro, units: yards}\nsun: {azimuth: 1, altitude: 91}\n")
    status, out, err = run("validate", str(level))
    assert (status, out) == (2, "") and err.count("\n") == 3
    assert [line.split(": ")[:3] for line in err.splitlines()] == [
        ["skugga", str(level), key] for key in ("titel", "terrain.units", "sun.altitude")
    ]


def test_validate_reports_every_file_and_position(run, tmp_path):
    level = tmp_path / "level.yaml"
    keys = {
        "version": 1, "terrain": {"source": "jacksboro", "imagery": "no.tif"}, "forest": [{"source": "no.gpkg"}],
        "meshes": [{"source": "no.obj"}], "lights": {"lamp": {"kind": "omni", "position": [0, 0, 1]}},
        "views": {"eye": {"kind": "perspective", "eye": [0, 0, 9], "target": [-84.2, 36.3, 0]}},
    }  # fmt: skip
    level.write_text(json.dumps(keys))
    status, _, err = run("validate", str(level))
    assert status == 2
    for line, word in zip(err.splitlines(), ("views.eye.eye", "no.tif", "no.obj", "no.gpkg", "lights.lamp"), strict=True):
        assert word in line


def test_a_raster_that_cannot_be_used_is_status_2(run, tmp_path):
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\nterrain: {source: absent.tif}\n")
    status, _, err = run("validate", str(level))
    assert status == 2 and "absent.tif" in err and err.count("\n") == 1


def test_an_unwritable_output_is_status_1(run, tmp_path):
    status, _, err = run("render", "jacksboro", *SMALL_MAP_OPTIONS, "-o", str(tmp_path / "no" / "such" / "x.png"))
    assert status == 1 and "x.png" in err and err.count("\n") == 1


def test_an_unexpected_error_is_one_line(run, tmp_path, monkeypatch):
    def fail_unexpectedly(*_: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr("skugga.api.cli.snapshot.compute", fail_unexpectedly)
    status, _, err = run("render", "jacksboro", *SMALL_MAP_OPTIONS, "-o", str(tmp_path / "x.png"))
    assert status == 1 and err.count("\n") == 1 and "ZeroDivisionError" in err and "--debug" in err


@pytest.mark.parametrize(("cause", "expected"), [(SystemExit(143), (143, "")), (KeyboardInterrupt(), (1, "skugga: interrupted\n"))])
def test_a_signal_in_a_compiled_loop_ends_the_command_cleanly(run, tmp_path, monkeypatch, cause, expected):
    """Numba's dispatchers return with the signal's exception set. Python reports this as a ``SystemError``."""

    def fail_on_signal(*_: object) -> None:
        raise SystemError("returned a result with an exception set") from cause

    monkeypatch.setattr("skugga.api.cli.snapshot.compute", fail_on_signal)
    status, _, err = run(
        "render", "jacksboro", *SMALL_MAP_OPTIONS, "--azimuth", "200", "--altitude", "30", "-o", str(tmp_path / "x.png")
    )
    assert (status, err) == expected


def test_levels_and_validate_describe_a_bundled_level(run):
    status, out, _ = run("levels", "--json")
    rows = {row["name"]: row for row in json.loads(out)}
    assert status == 0 and {"jacksboro", "jacksboro_alpine"} <= set(rows)
    assert set(rows["jacksboro"]) == {"name", "title", "bounds", "views"}
    assert rows["jacksboro"]["bounds"] == pytest.approx([-84.41375, 36.15958, -84.07792, 36.44625], abs=1e-4)
    status, out, _ = run("validate", "jacksboro")
    assert status == 0 and "403 x 344 cells" in out
    status, out, _ = run("levels")
    assert status == 0 and "jacksboro" in out


def test_validate_refuses_an_unsupported_algorithm(run, tmp_path):
    level = tmp_path / "hills.yaml"
    level.write_text("version: 1\nterrain: {source: jacksboro}\nshadows: {algorithm: planar}\n", encoding="utf-8")
    status, _, err = run("validate", str(level))
    assert status == 2 and err.count("\n") == 1
    assert f"{level}: shadows.algorithm" in err and "not flat" in err


def test_validate_checks_each_view_that_the_level_lists(gl, run, tmp_path):
    """A map has no perspective. A level without map views may use a perspective shadow map."""
    level = tmp_path / "figure.yaml"
    eye = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "size": [64, 48]}
    keys = {
        "version": 1, "terrain": {"flat": {"size": [90, 90], "cells": [9, 9]}}, "meshes": [{"generate": "tetrahedra"}],
        "shadows": {"algorithm": "perspective_shadow_map"},
    }  # fmt: skip
    for views, is_valid in (({"eye": eye}, True), ({"eye": eye, "plan": {"kind": "map"}}, False), ({}, False)):
        level.write_text(json.dumps({**keys, "views": views}), encoding="utf-8")
        status, _, err = run("validate", str(level))
        assert (status == 0) is is_valid, err
        assert is_valid or (err.count("\n") == 1 and f"in view {'plan' if views else 'map'}" in err and "no perspective" in err)


def test_doctor_finds_that_this_machine_can_draw(gl, run):
    status, out, _ = run("doctor", "--json")
    findings = {finding["subject"]: finding for finding in json.loads(out)}
    assert findings["OpenGL"]["ok"] and gl.renderer in findings["OpenGL"]["detail"]
    assert findings["a shadowed map"]["ok"]
    used_devices = [subject for subject, finding in findings.items() if finding["detail"].endswith("in use")]
    assert used_devices == [f"EGL device {gl.egl_device.index}"] and gl.renderer in findings[used_devices[0]]["detail"]
    assert status == (0 if all(finding["ok"] for finding in findings.values()) else 1)


def test_a_raster_is_a_level(gl, run, tmp_path):
    row, col = np.mgrid[:200, :200].astype(np.float32)
    raster = write_geotiff(tmp_path / "hills.tif", 400 * np.sin(col / 9) * np.cos(row / 13), "EPSG:32633", 500e3, 5200e3, 30.0)
    status, out, err = run("render", str(raster), "--layer", "mask", "-o", str(tmp_path / "mask.png"))
    assert (status, out, err.count("\n")) == (0, "", 1) and "its default light" in err and "--time" in err
    mask = np.asarray(Image.open(tmp_path / "mask.png"))
    assert 0.05 < (mask == MASK_SHADOW).mean() < 0.6
    status, out, _ = run("validate", str(raster))
    assert status == 0 and "hills" in out and "200 x 200 cells" in out
    status, out, _ = run("select", str(raster), "--policy", "rules")
    assert status == 0 and "sweep" in out
    before = raster.read_bytes()
    status, _, err = run("select", str(raster), "--policy", "rules", "--write")
    assert status == 2 and "hills.tif" in err and "level file" in err and raster.read_bytes() == before


def test_a_file_that_is_neither_level_nor_raster_is_refused(run, tmp_path):
    (tmp_path / "noise.bin").write_bytes(bytes(range(128, 256)) * 9)
    status, out, err = run("validate", str(tmp_path / "noise.bin"))
    assert (status, out) == (2, "") and "noise.bin" in err and "YAML file, or a raster that GDAL reads" in err


def test_version_is_printed(run):
    assert run("--version") == (0, f"skugga {version('skugga')}\n", "")


def test_the_installed_command_runs():
    command = Path(sys.executable).with_name("skugga")
    if not command.is_file():
        pytest.skip("skugga is not installed beside this Python")
    process = subprocess.run([command, "render", "nowhere", "-o", "x.png"], capture_output=True, text=True, check=False)
    assert process.returncode == 2 and process.stderr.startswith("skugga: LEVEL") and process.stderr.count("\n") == 1


@pytest.fixture
def small_hills(tmp_path) -> str:
    """File of a raster of hills whose candidates are drawn in moments."""
    row, col = np.mgrid[:48, :48].astype(np.float32)
    heights = 500 + 200 * np.sin(col / 5 + 1) * np.cos(row / 7 + 1)
    return str(write_geotiff(tmp_path / "hills.tif", heights, "EPSG:32633", 500e3, 5200e3, 30.0))


def test_compare_prints_and_writes_rows_and_pictures(gl, run, small_hills, tmp_path, monkeypatch):
    monkeypatch.setattr("skugga.selector.measure.compare.TIMING_REPEATS", 1)
    rows_file, folder = tmp_path / "rows.json", tmp_path / "errors"
    rows = "none", "sweep", "shadow_map-1024-3-16", "shadow_volume", "hybrid-768-conservative"
    options = [word for name in rows for word in ("--only", name)]
    status, out, err = run("compare", small_hills, *SMALL_MAP_OPTIONS, *options, "--json", str(rows_file), "-o", str(folder))
    assert (status, err) == (0, "")
    rows = json.loads(rows_file.read_text())
    assert len(rows) == 5 and {row["algorithm"]["sun"]["relief"] for row in rows} == {
        "shadow_map", "shadow_volume", "hybrid", "sweep", "none",
    }  # fmt: skip
    assert sum(row["pareto"] for row in rows) >= 1
    for row in rows:
        assert 0 <= row["wrong"] <= 1 and row["ms_p95"] >= row["ms_median"] >= 0 and row["bytes"] >= 0 and row["runs"] >= 1
        name, counters = row["algorithm"]["sun"]["relief"], row["counters"]
        assert (counters["edges"] > 0) is (name in ("shadow_volume", "hybrid")) and row["notes"] == []
        assert (counters["marked"] > 0) is (counters["tiles"] > 0) is (name == "hybrid")
    assert "wrong cast" in out and "surface" in out and "noise" in out
    assert "every row" in (folder / "report.html").read_text(encoding="utf-8")
    assert (folder / "scatter.svg").read_text(encoding="utf-8").startswith("<svg")
    pictures = sorted(folder.glob("*.png"))
    assert len(pictures) == len(rows)
    none = np.asarray(Image.open(folder / "none.png")).astype(int)
    assert ((none[..., 2] - none[..., 0]) > 100).mean() > 0.02, "missed shadow is blue"


def test_compare_prints_commands_for_the_rows_it_left_out(gl, run, small_hills):
    status, out, err = run("compare", small_hills, *SMALL_MAP_OPTIONS, "--time-limit", "0")
    assert (status, err) == (0, "") and "soft %" in out
    commands = [line.strip() for line in out.splitlines() if line.startswith("  skugga compare ")]
    assert commands and all("--only" in command and "--time-limit" not in command for command in commands)
    words = shlex.split(commands[0])
    assert words[2] == small_hills and all(word in words for word in SMALL_MAP_OPTIONS)
    status, out, err = run(*words[1:])
    assert (status, err) == (0, "") and words[-1] in out and "left out" not in out


@pytest.mark.parametrize("option", ["-o", "--json"])
def test_compare_refuses_an_unwritable_output_at_once(run, tmp_path, option):
    (tmp_path / "file").write_text("kept")
    status, _, err = run("compare", "jacksboro", *SMALL_MAP_OPTIONS, option, str(tmp_path / "file" / "inside"))
    assert status == 2 and err.count("\n") == 1 and str(tmp_path / "file" / "inside") in err and "folder" in err
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("seconds", ["nan", "inf", "-inf", "1e10"])
@pytest.mark.parametrize("command", ["render", "select"])
def test_a_clock_beyond_its_range_is_refused(run, tmp_path, command, seconds):
    output = ["-o", str(tmp_path / "x.png")] if command == "render" else []
    status, out, err = run(command, "jacksboro", f"--seconds={seconds}", *output)
    assert (status, out, err.count("\n")) == (2, "", 1) and "--seconds" in err and "1e+09" in err


def test_only_a_time_limit_runs_a_benchmark(gl, run, monkeypatch, tmp_path):
    """``--max-ms`` needs times of this machine. Without a limit, no benchmark delays the picture."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    benchmarks: list[str] = []
    monkeypatch.setattr(device_estimate, "_time_ratio", lambda: benchmarks.append("run") or 1.0)
    device_estimate.estimated_profile.cache.clear()
    for options, count in (((), 0), (("--max-ms", "600000"), 1)):
        assert run("render", "jacksboro", "--size", "32x32", *options, "-o", str(tmp_path / "p.png"))[0] == 0
        assert len(benchmarks) == count


def test_missing_memory_is_one_line(run, monkeypatch):
    def allocate(*args: object, **keys: object) -> None:
        raise MemoryError("Unable to allocate 8.00 GiB")

    monkeypatch.setattr("skugga.api.cli.snapshot.snapshot", allocate)
    status, out, err = run("render", "jacksboro", "-o", "p.png")
    assert (status, out) == (1, "") and "internal error" not in err
    assert err.splitlines()[-1].endswith("no memory is left (Unable to allocate 8.00 GiB). Use a smaller picture or fewer products")
