"""Films of ``skugga render``: written files, messages and errors."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skugga.api.film_span import DEFAULT_FPS
from skugga.selector.film import film_frames, frame_moments
from skugga.selector.film_request import FilmRequest, FilmSpan
from skugga.selector.replanning import Replanner
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

LEVEL = {
    "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}},
    "meshes": [{"generate": "tetrahedra", "motion": {"spin": 30}}], "sun": {"azimuth": 200, "altitude": 35},
    "views": {"eye": {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [64, 48]}},
}  # fmt: skip
CAMERA_KEYS = [
    {"at": "0s", "eye": [-30, -48, 15], "target": [3, 2, 2]},
    {"at": "1s", "eye": [30, -40, 12], "target": [3, 2, 2]},
]
CLOCK_SPAN = "--from", "0s", "--to", "0.5s", "--step", "0.1s"
DAY_SPAN = "--from", "2024-10-21T15:00:00-04:00", "--to", "2024-10-21T17:00:00-04:00", "--step", "30m"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """Return the current folder, which holds a level and a camera."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "floor.yaml").write_text(json.dumps(LEVEL))
    (tmp_path / "camera.yaml").write_text(json.dumps({"size": [64, 48], "keys": CAMERA_KEYS}))
    return tmp_path


def read_pngs(folder: Path) -> list[np.ndarray]:
    """Return the pictures of a folder's PNG files (rows, cols, channels), in the order of their names."""
    return [np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))]


def test_a_moving_camera_is_written_and_reported(gl, run, folder):
    """Compare the frames of the three kinds of files with a still by the same camera and plan."""
    exact = "--algorithm", "meshes=shadow_volume"  # a film keeps settings of earlier frames, and volumes have none
    arguments = "render", "floor.yaml", "--path", "camera.yaml", "--fps", "5", *exact
    for output in ("film.webp", "film.mp4", "frames/%02d.png"):
        lossless = ["--lossless"] if output == "film.webp" else []
        status, out, err = run(*arguments, *lossless, "-o", output, "--stats", "film.json")
        assert (status, out) == (0, "")
        lines = [line for line in err.splitlines() if line.startswith("[")]
        assert lines[0].startswith("[1/6] frame 1 (0 s): relief=none,meshes=") and len(lines) == 6
    report = json.loads((folder / "film.json").read_text())
    assert (report["level"], report["fps"], report["switches"]) == ("floor", 5.0, [])
    assert [frame["seconds"] for frame in report["frames"]] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert {frame["share"] for frame in report["frames"]} == {1.0} and all(frame["ms"] > 0 for frame in report["frames"])
    frames = read_pngs(folder / "frames")
    with Image.open(folder / "film.webp") as film:
        assert film.n_frames == len(frames) == 6
        for number, picture in enumerate(frames):
            film.seek(number)
            assert (np.asarray(film.convert("RGB")) == picture).all()
    end = {"kind": "perspective", "eye": CAMERA_KEYS[1]["eye"], "target": CAMERA_KEYS[1]["target"], "size": [64, 48]}
    (folder / "still.yaml").write_text(json.dumps(LEVEL | {"seconds": 1.0, "views": {"end": end}}))
    assert run("render", "still.yaml", "--view", "end", *exact, "-o", "still.png")[0] == 0
    assert (np.asarray(Image.open("still.png").convert("RGB")) == frames[-1]).all()


def test_a_film_of_a_costly_frame_is_refused(gl, run, folder):
    """The message is that of a still. The middle of a day counts, for its first and last frames are dark."""
    clock_film = "render", "floor.yaml", "--view", "eye", *CLOCK_SPAN, "-o", "film.webp"
    status, out, err = run(*clock_film, "--max-ms", "0.0001")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "frame 1 (0 s) by " in err and "is expected to take" in err and "(--max-ms)" in err
    night_to_night = "--from", "2024-10-21T00:00:00-04:00", "--to", "2024-10-22T00:00:00-04:00", "--step", "12h"
    status, _, err = run("render", "jacksboro", *night_to_night, "--size", "64x48", "--max-ms", "0.0001", "-o", "day.webp")
    assert status == 2 and "a block of frame 2 (2024-10-21T12:00:00-04:00) by " in err
    assert not list(folder.glob("*.webp"))
    assert run(*clock_film, "--max-ms", "60000")[0] == 0 and Path("film.webp").exists()


def test_the_limit_of_a_service_is_that_of_films(gl, run, folder, monkeypatch):
    clock_film = "render", "floor.yaml", "--view", "eye", *CLOCK_SPAN, "-o", "film.webp"
    monkeypatch.setenv("SKUGGA_RENDER_TIMEOUT_S", "1e-7")
    status, _, err = run(*clock_film)
    assert status == 2 and "is expected to take" in err and not Path("film.webp").exists()


def test_size_and_time_are_estimated_after_a_few_frames(gl, run, folder):
    status, _, err = run(
        "render", "floor.yaml", "--view", "eye", "--from", "0s", "--to", "2s", "--step", "0.05s", "-o", "film.webp"
    )
    lines = err.splitlines()
    (first, *_) = (n for n, line in enumerate(lines) if line.startswith("41 frames: about "))
    assert status == 0 and 4 < first < 20
    size, unit = re.fullmatch(r"41 frames: about ([0-9.]+) (kB|MB) in total, [0-9]+ (s|minutes) left", lines[first]).groups()[:2]
    estimated_bytes = float(size) * {"kB": 1e3, "MB": 1e6}[unit]
    assert estimated_bytes == pytest.approx((folder / "film.webp").stat().st_size, rel=0.5)


def test_frames_drawn_by_threads_equal_serial_frames(gl):
    """Threads draw frames of terrain alone. They return frames in order and by the same plans. Closing the generator early
    ends the threads.
    """
    scene = build_scene(load_level("configs/jacksboro.yaml"))
    request = FilmRequest(FilmSpan(9, 5400.0, datetime.fromisoformat("2024-10-21T07:00:00-04:00")), "map", size=(96, 64))
    moments = frame_moments(scene, request)
    serial_frames, threaded_frames = (list(film_frames(scene, request, moments, Replanner(), threads)) for threads in (0, 3))
    assert [frame.moment.number for frame in threaded_frames] == list(range(9))
    assert all(
        (a.color == b.color).all() and a.plan == b.plan and a.switch == b.switch
        for a, b in zip(serial_frames, threaded_frames, strict=True)
    )
    assert len({frame.color.tobytes() for frame in threaded_frames}) == 9
    frames = film_frames(scene, request, moments, Replanner(), 3)
    next(frames), next(frames)
    frames.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("skugga-frames")]


def test_a_film_of_a_moving_sun_equals_stills(gl, run, folder):
    assert run("render", "jacksboro", *DAY_SPAN, "--size", "64x48", "-o", "day%d.png")[0] == 0
    frames = read_pngs(folder)
    assert len(frames) == 5 and len({frame.tobytes() for frame in frames}) == 5
    assert run("render", "jacksboro", "--time", "2024-10-21T16:30:00-04:00", "--size", "64x48", "-o", "still.png")[0] == 0
    assert (np.asarray(Image.open("still.png").convert("RGB")) == frames[3]).all()


def test_sun_and_camera_can_move_together(gl, run, folder):
    level = Path("jacksboro_wooded")
    keys = [
        {"at": DAY_SPAN[1], "eye": [-84.1660, 36.22813, 62], "target": [-84.1582, 36.22573, 0], "fov": 40},
        {"at": DAY_SPAN[3], "eye": [-84.1640, 36.22713, 50], "target": [-84.1582, 36.22573, 0], "fov": 40},
    ]
    (folder / "fly.yaml").write_text(json.dumps({"size": [48, 36], "keys": keys}))
    status, _, err = run("render", str(level), "--path", "fly.yaml", "--step", "1h", "-o", "fly.webp")
    assert status == 0 and "[3/3] frame 3 (2024-10-21T17:00:00-04:00)" in err


@pytest.mark.parametrize(
    ("options", "expected_text"),
    [
        ((*CLOCK_SPAN, "-o", "film.gif"), "output: 'film.gif' is not allowed. Allowed: a film such as day.webp"),
        ((*CLOCK_SPAN, "--lossless", "-o", "film.mp4"), "--lossless: film.mp4 is no .webp film. Use .webp"),
        (("--lossless", "-o", "film.webp"), "from: missing"),
        ((*CLOCK_SPAN, "-o", "film.png"), "a name with one number for 6 frames, such as frames/%04d.png"),
        ((*CLOCK_SPAN, "-o", "no/film.webp"), "no/film.webp: folder not found"),
        ((*CLOCK_SPAN, "--layer", "mask", "-o", "film.webp"), "--layer: 'mask'"),
        ((*CLOCK_SPAN, "--light", "sun", "-o", "film.webp"), "--light: cannot be combined with --from"),
        ((*CLOCK_SPAN, "--seconds", "3", "-o", "film.webp"), "seconds: cannot be combined with from"),
        ((*CLOCK_SPAN, "--view", "hill", "-o", "film.webp"), "view: 'hill'"),
        ((*CLOCK_SPAN, "-o", "floor.yaml"), "output: 'floor.yaml'"),
        ((*DAY_SPAN, "--view", "eye", "-o", "film.webp"), "time: '2024-10-21T15:00:00-04:00'"),
        ((*DAY_SPAN, "--time", "2024-10-21T15:00:00-04:00", "-o", "film.webp"), "--time: cannot be combined with --from"),
        (("--from", "2024-10-21T15:00:00", *DAY_SPAN[2:], "-o", "film.webp"), "from: '2024-10-21T15:00:00'"),
        ((*DAY_SPAN[:2], "--to", "2024-10-20T15:00:00-04:00", *DAY_SPAN[4:], "-o", "film.webp"), "to: '2024-10-20T15:00:00-04:00'"),
        ((*DAY_SPAN[:4], "--step", "0s", "-o", "film.webp"), "step: '0s'"),
        (
            (*DAY_SPAN[:4], "--step", "0.1s", "-o", "film.webp"),
            "step: 72001 frames, one every 0.1 s, more than the limit of 10000 frames",
        ),
        (("--fps", "25", "-o", "film.webp"), "from: missing"),
        (("--step", "10m", "-o", "film.webp"), "from: missing"),
        (("--path", "none.yaml", "-o", "film.webp"), "none.yaml: No such file"),
        (("--path", "camera.yaml", "--view", "eye", "-o", "film.webp"), "--view: cannot be combined with --path"),
        (
            ("--path", "camera.yaml", "--stats", "camera.yaml", "-o", "film.webp"),
            "--stats: camera.yaml is the same file as the input camera.yaml",
        ),
        (
            ("--path", "low.yaml", "-o", "film.webp"),
            "path, frame 10 (0.36 s): eye: the camera is 0.319 m below the ground",
        ),
        (("--path", "off.yaml", "-o", "film.webp"), "keys.1.eye: '(900.0, 0.0, 5.0)' is not allowed"),
        (("--path", "camera.yaml", "--size", "9000x9", "-o", "film.webp"), "size: '9000x9'"),
    ],
)  # fmt: skip
def test_wrong_options_are_one_line_before_a_frame_is_drawn(run, folder, monkeypatch, options, expected_text):
    monkeypatch.setattr("skugga.selector.film.render_frame", lambda *_: pytest.fail("a frame was drawn"))
    for name, eye in (("low.yaml", [0, 0, -13]), ("off.yaml", [900, 0, 5])):
        (folder / name).write_text(json.dumps({"keys": [CAMERA_KEYS[0] | {"eye": [0, 9, 5]}, CAMERA_KEYS[1] | {"eye": eye}]}))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    status, out, err = run("render", "floor.yaml", *options)
    assert status == (1 if "folder" in expected_text else 2)
    assert (out, err.count("\n")) == ("", 1) and expected_text in err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_default_light_is_reported(gl, run, folder):
    """A warning names the default light of a level without a sun, for pictures and for films without times, also when
    standard error is no terminal.
    """
    (folder / "bare.yaml").write_text(json.dumps({key: value for key, value in LEVEL.items() if key != "sun"}))
    for options in (("-o", "bare.png"), (*CLOCK_SPAN, "--view", "eye", "-o", "bare.webp")):
        for level, is_reported in (("bare", True), ("floor", False)):
            status, _, err = run("render", f"{level}.yaml", "--size", "64x48", *options)
            assert status == 0 and ("skugga: bare is drawn with its default light, the sun " in err) == is_reported, err


def test_each_wrong_key_of_a_camera_is_one_line(run, folder):
    (folder / "camera.yaml").write_text(json.dumps({"keys": [CAMERA_KEYS[0], CAMERA_KEYS[1] | {"at": "soon", "eye": [1, 2]}]}))
    status, _, err = run("render", "floor.yaml", "--path", "camera.yaml", "-o", "film.webp")
    assert status == 2 and [line.split(": ")[2] for line in err.splitlines()] == ["keys.1.at", "keys.1.eye"]


def test_without_the_encoder_the_extra_is_named(run, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    status, _, err = run("render", "floor.yaml", *CLOCK_SPAN, "--view", "eye", "-o", "film.mp4")
    assert status == 2 and err.count("\n") == 1 and "skugga[film]" in err


@pytest.mark.parametrize("output", ["film.webp", "film.mp4", "frames/%d.png"])
def test_a_full_disk_is_reported_and_leaves_no_file(gl, run, folder, full_disk, output):
    run("render", "floor.yaml", *CLOCK_SPAN, "--view", "eye", "-o", output)  # compiles and caches the loops before the disk is full
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with full_disk(1000):
        status, _, err = run("render", "floor.yaml", *CLOCK_SPAN, "--view", "eye", "-o", output)
    lines = [line for line in err.splitlines() if line.startswith("skugga:")]
    assert status == 1 and len(lines) == 1 and output.partition("/")[0] in lines[0]
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("signal_number", "output"),
    [(signal.SIGTERM, "film.mp4"), (signal.SIGINT, "frames/%d.png")],
)
def test_an_interrupted_film_leaves_no_file(folder, signal_number, output):
    code = "import sys; sys.argv = ['skugga', *sys.argv[1:]]; from skugga.api.cli.main import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "render", "floor.yaml", "--view", "eye", "--from", "0s", "--to", "300s", "-o", output],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal_number, signal.SIG_DFL),  # a background process may inherit an ignored signal
    )
    before = sorted(os.listdir(folder))
    assert process.stderr is not None
    for _ in range(3):  # wait for some frames
        assert process.stderr.readline().startswith("[")
    process.send_signal(signal_number)
    process.communicate(timeout=120)
    assert process.returncode not in (0, -signal_number)
    assert sorted(os.listdir(folder)) == before


def test_a_terminal_shows_a_bar_with_the_time_left(gl, folder):
    """The bar replaces the line for each frame."""
    import pty

    code = "import sys; sys.argv = ['skugga', *sys.argv[1:]]; from skugga.api.cli.main import main; main()"
    controller_fd, terminal_fd = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", code, "render", "floor.yaml", "--view", "eye", *CLOCK_SPAN, "-o", "film.webp"],
        stderr=terminal_fd, env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    )  # fmt: skip
    os.close(terminal_fd)
    output, deadline = b"", time.monotonic() + 120
    while time.monotonic() < deadline:
        try:
            output += (part := os.read(controller_fd, 4096))
        except OSError:  # the other end is closed
            break
        if not part:
            break
    os.close(controller_fd)
    assert process.wait(120) == 0
    assert b"Filming" in output and b"6/6" in output and b"0:00:0" in output and b"[3/6] frame" not in output


def test_help_states_the_default_frame_rate(run):
    status, out, _ = run("render", "--help")
    assert status == 0 and f"default: {DEFAULT_FPS:g}" in " ".join(out.split())
    assert all(option in out for option in ("--from", "--to", "--step", "--path", "--fps"))
