"""The choice of the EGL device that a process draws with."""

from __future__ import annotations

import json
import logging
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from skugga.terrain.errors import GraphicsError, InputError, NoOpenGLError
from skugga.terrain.gl import egl_devices
from skugga.terrain.gl.egl_devices import (
    EGL_DEVICE_VARIABLE,
    EglDevice,
    ProbedDevice,
    candidate_devices,
    open_context,
    parse_device_setting,
    probe_device,
    set_process_number,
)
from tests.terrain.gl.egl_machines import duplicate_mesa_environment

ROOT = Path(__file__).parents[3]

CARD, EQUAL, OTHER, BROKEN = (
    ProbedDevice("Card 9", "4.6"),
    ProbedDevice("Card 9", "4.6"),
    ProbedDevice("Card 7", "4.6"),
    ProbedDevice(fault="eglInitialize failed (0x3001)"),
)
SOFTWARE_DEVICE = ProbedDevice("llvmpipe", "4.5")


def tried_device_numbers(setting: str, kinds: list[ProbedDevice], process_number: int = 0) -> list[int]:
    """Return the numbers of the devices that are tried on a machine with devices of some kinds."""
    devices = [EglDevice(index, kind is SOFTWARE_DEVICE) for index, kind in enumerate(kinds)]
    return [device.index for device in candidate_devices(setting, devices, process_number, lambda index: kinds[index])]


def fail_on_probe(index: int) -> ProbedDevice:
    """Fail, because the device with this index must not be probed."""
    raise AssertionError("only the selected device may be probed: a probe is slow")


@pytest.mark.parametrize(
    ("text", "meaning"),
    [("auto", "auto"), ("", "auto"), ("Software ", "software"), ("2", (2,)), ("0, 1,1", (0, 1, 1))],
)
def test_device_setting_is_parsed(text, meaning):
    assert parse_device_setting(text) == meaning


@pytest.mark.parametrize("text", ["gpu", "-1", "0;1", "0,", "1.0", "٣", "auto,0"])
def test_read_setting_refuses_other_text(text):
    with pytest.raises(InputError) as error:
        parse_device_setting(text)
    assert str(error.value) == f"{EGL_DEVICE_VARIABLE}: '{text}' is not allowed. Allowed: {egl_devices.EGL_DEVICE_VALUES}."


@pytest.mark.parametrize(
    ("setting", "kinds", "expected"),
    [
        ("auto", [SOFTWARE_DEVICE], [0]),
        ("auto", [SOFTWARE_DEVICE, CARD], [1, 0]),
        ("auto", [CARD, OTHER, SOFTWARE_DEVICE], [0, 1, 2]),
        ("software", [CARD, SOFTWARE_DEVICE], [1]),
        ("1", [CARD, OTHER, SOFTWARE_DEVICE], [1]),
        ("1,0", [CARD, EQUAL, SOFTWARE_DEVICE], [1]),
    ],
)
def test_a_single_process_prefers_cards_and_probes_no_device(setting, kinds, expected):
    devices = [EglDevice(index, kind is SOFTWARE_DEVICE) for index, kind in enumerate(kinds)]
    assert [device.index for device in candidate_devices(setting, devices, 0, fail_on_probe)] == expected


@pytest.mark.parametrize(
    ("setting", "kinds", "firsts"),
    [
        ("auto", [CARD, EQUAL, SOFTWARE_DEVICE], [0, 1, 0, 1]),
        ("auto", [CARD, OTHER, EQUAL, SOFTWARE_DEVICE], [0, 2, 0, 2]),
        ("auto", [OTHER, CARD, EQUAL, SOFTWARE_DEVICE], [0, 0, 0, 0]),
        (
            "auto",
            [BROKEN, CARD, EQUAL, SOFTWARE_DEVICE],
            [0, 2, 1, 2],
        ),  # the first process finds the fault itself, and takes device 1
        ("auto", [SOFTWARE_DEVICE], [0, 0, 0, 0]),
        ("0,1", [CARD, EQUAL, SOFTWARE_DEVICE], [0, 1, 0, 1]),
        ("1,0,1", [CARD, EQUAL, SOFTWARE_DEVICE], [1, 0, 1, 1]),
        ("0,1", [SOFTWARE_DEVICE, SOFTWARE_DEVICE], [0, 1, 0, 1]),
        ("software", [CARD, EQUAL, SOFTWARE_DEVICE], [2, 2, 2, 2]),
    ],
)
def test_processes_take_turns_with_devices_of_one_kind(setting, kinds, firsts):
    assert [tried_device_numbers(setting, kinds, process_number)[0] for process_number in range(4)] == firsts


def test_a_setting_with_devices_of_two_kinds_is_refused():
    assert tried_device_numbers("0,1", [CARD, OTHER]) == [0]
    with pytest.raises(
        GraphicsError, match=f"{EGL_DEVICE_VARIABLE}: '0,1' names devices of two kinds.*0 is Card 9, 4.6; 1 is Card 7, 4.6"
    ):
        tried_device_numbers("0,1", [CARD, OTHER], process_number=1)


@pytest.mark.parametrize(
    ("setting", "kinds"), [("2", [CARD, SOFTWARE_DEVICE]), ("0,5", [CARD, SOFTWARE_DEVICE]), ("software", [CARD])]
)
def test_a_device_that_does_not_exist_is_refused(setting, kinds):
    with pytest.raises(InputError) as error:
        tried_device_numbers(setting, kinds)
    message = str(error.value)
    assert message.startswith(
        f"{EGL_DEVICE_VARIABLE}: '{setting}' names a device that does not exist. Allowed: auto, software, or numbers"
    )
    assert message.endswith(
        ". Devices: 0 (without a name), 1 (software rasteriser)." if SOFTWARE_DEVICE in kinds else ". Devices: 0 (without a name)."
    )


@pytest.fixture
def fake_machine(monkeypatch: pytest.MonkeyPatch):
    """``fake_machine(*kinds)`` fakes devices of some kinds. The context of a device is its kind."""

    def make(*kinds: ProbedDevice, setting: str = "auto") -> None:
        def create_egl_context(index: int):
            if kinds[index].fault:
                raise ValueError(kinds[index].fault)
            return kinds[index]

        devices = tuple(EglDevice(index, kind is SOFTWARE_DEVICE) for index, kind in enumerate(kinds))
        monkeypatch.setattr(egl_devices, "egl_devices", lambda: devices)
        monkeypatch.setattr(egl_devices, "create_egl_context", create_egl_context)
        monkeypatch.setattr(egl_devices, "probe_device", lambda index: kinds[index])
        monkeypatch.setattr(egl_devices, "_process_number", 0)
        monkeypatch.setenv(EGL_DEVICE_VARIABLE, setting)

    return make


def test_a_card_without_a_context_is_skipped_and_logged(fake_machine, caplog: pytest.LogCaptureFixture):
    fake_machine(BROKEN, CARD, SOFTWARE_DEVICE)
    with caplog.at_level(logging.WARNING):
        context, device = open_context()
    assert (context, device.index) == (CARD, 1)
    assert [record.message for record in caplog.records] == [
        "EGL: device 0 (without a name): eglInitialize failed (0x3001). Device 1 (without a name) is used instead."
    ]


def test_a_named_device_without_a_context_is_not_skipped(fake_machine):
    fake_machine(BROKEN, CARD, setting="0")
    with pytest.raises(GraphicsError) as error:
        open_context()
    assert not isinstance(error.value, NoOpenGLError), "bare ground is not drawn by another way than was asked for"
    assert f"{EGL_DEVICE_VARIABLE}: '0' gives no OpenGL 4.3 context: device 0" in str(error.value)


def test_a_machine_without_any_context_has_no_opengl(fake_machine):
    fake_machine(BROKEN, BROKEN)
    with pytest.raises(NoOpenGLError, match=r"no OpenGL 4.3 context through EGL \(device 0 .*; device 1 .*Run 'skugga doctor'"):
        open_context()


def test_open_context_uses_the_process_number(fake_machine):
    fake_machine(CARD, EQUAL, SOFTWARE_DEVICE)
    set_process_number(3)
    assert open_context()[1].index == 1


def test_an_egl_that_cannot_list_devices_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(egl_devices, "_function", lambda egl, name, *types: None)
    with pytest.raises(NoOpenGLError, match=r"cannot list devices without EGL_EXT_device_enumeration\)\. Without it"):
        egl_devices.egl_devices()
    monkeypatch.setattr(egl_devices, "LIBEGL", "libNone.so.1")
    with pytest.raises(NoOpenGLError, match="libNone.so.1"):
        egl_devices.egl_devices()


def test_probes_of_this_machine_match_its_device(gl):
    devices = egl_devices.egl_devices()
    assert gl.egl_device in devices
    assert probe_device(gl.egl_device.index) == ProbedDevice(gl.renderer, gl.version)
    assert f"{len(devices)}" in probe_device(len(devices)).fault


@pytest.mark.parametrize(
    ("script", "fault"),
    [("exit 9", "ended the probe process"), ("echo no", "ended the probe process"), ("exec sleep 60", "no answer within")],
)
def test_a_driver_that_crashes_or_hangs_is_a_fault(script, fault, tmp_path, monkeypatch):
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(egl_devices.sys, "executable", str(program))
    monkeypatch.setattr(egl_devices, "PROBE_TIMEOUT_S", 0.5 if "sleep" in script else 60.0)
    assert fault in probe_device(0).fault


def test_the_setting_selects_the_second_of_two_devices(gl, tmp_path):
    """The devices are real: EGL lists each twice, and the library's own setting names another one."""
    code = (
        "import json; from skugga.terrain.gl.device import device; from skugga.terrain.gl.egl_devices import egl_devices;"
        "gl = device(); gl.texture([[1.0]]); gl.check('a call');"
        "print(json.dumps([len(egl_devices()), gl.egl_device.index, gl.renderer]))"
    )
    environment = {**os.environ, **duplicate_mesa_environment(tmp_path), EGL_DEVICE_VARIABLE: "1", "GLCONTEXT_DEVICE_INDEX": "0"}
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr
    count, index, renderer = json.loads(process.stdout)
    assert (count, index, renderer) == (2 * len(egl_devices.egl_devices()), 1, gl.renderer)


def test_a_wrong_device_ends_a_command_with_one_line(tmp_path):
    code = "import sys; from skugga.api.cli.main import main; sys.argv[0] = 'skugga'; main()"
    picture = tmp_path / "out.png"
    for setting in ("7", "gpu"):
        process = subprocess.run(
            [sys.executable, "-c", code, "render", "thesis_street", "--size", "20x20", "-o", str(picture)],
            cwd=ROOT, env={**os.environ, EGL_DEVICE_VARIABLE: setting}, capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert (process.returncode, process.stdout) == (2, "") and process.stderr.count("\n") == 1, process.stderr
        assert f"skugga: {EGL_DEVICE_VARIABLE}: '{setting}' " in process.stderr and not picture.exists()
