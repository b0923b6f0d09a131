"""Graphics cards of a machine, and what keeps OpenGL from drawing with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from skugga.api.cli import doctor
from skugga.api.cli.graphics_card import (
    NVIDIA_LIBRARY,
    NVIDIA_VENDOR,
    Card,
    CardPlaces,
    find_cards,
    find_nvidia_vendor_file,
    unused_card_reason,
)
from skugga.terrain.errors import NoOpenGLError
from skugga.terrain.gl.egl_devices import EGL_DEVICE_VARIABLE, EglDevice, ProbedDevice

LIBEGL = "libEGL.so.1"
INFORMATION = "Model: \t\t NVIDIA H200\nIRQ:   \t\t 41\nGPU UUID: \t GPU-1\n"


@pytest.fixture
def places(tmp_path: Path) -> CardPlaces:
    """Return the places of a machine without cards, in a folder of its own."""
    for name in ("dev/dri", "library", "vendor", "extra"):
        (tmp_path / name).mkdir(parents=True)
    return CardPlaces(
        tmp_path / "proc", tmp_path / "dev", str(tmp_path / "nvidia-smi"),
        (tmp_path / "library",), (tmp_path / "vendor",), (tmp_path / "extra",),
    )  # fmt: skip


def add_kernel_driver(places: CardPlaces) -> None:
    """Add the folder of NVIDIA's kernel driver with one card."""
    folder = places.proc / "gpus" / "0000:41:00.0"
    folder.mkdir(parents=True)
    (folder / "information").write_text(INFORMATION)


def add_smi(places: CardPlaces, script: str) -> None:
    """Add ``nvidia-smi``, a shell script."""
    path = Path(places.nvidia_smi)
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


def add_complete_driver(places: CardPlaces) -> Card:
    """Add a card with all that EGL needs to draw with it, and return the card."""
    (places.dev / "nvidia0").touch()
    (places.vendor_folders[0] / "10_nvidia.json").write_text(json.dumps(NVIDIA_VENDOR))
    return find_cards(places)[0]


def load_all(name: str) -> bool:
    """Return that any library can be loaded."""
    return True


def load_loader_only(name: str) -> bool:
    """Return whether a library is the loader of EGL drivers, the only one that can be loaded."""
    return name == LIBEGL


def test_a_machine_without_cards_has_none(places):
    (places.dev / "nvidiactl").touch()
    assert find_cards(places) == []


def test_models_come_from_the_kernel_driver(places):
    add_kernel_driver(places)
    (places.dev / "nvidia0").touch()
    add_smi(places, "echo never asked")
    assert find_cards(places) == [Card("NVIDIA H200", True, places.dev / "nvidia0")]


def test_models_come_from_nvidia_smi_without_the_kernel_s_list(places):
    for name in ("nvidia0", "nvidia1", "nvidiactl"):
        (places.dev / name).touch()
    add_smi(places, "echo NVIDIA H200")
    assert find_cards(places) == [
        Card("NVIDIA H200", True, places.dev / "nvidia0"),
        Card("NVIDIA card nvidia1", True, places.dev / "nvidia1"),
    ]


def test_a_failing_nvidia_smi_does_not_hide_a_card(places):
    (places.dev / "nvidia0").touch()
    add_smi(places, "echo NVIDIA-SMI has failed; exit 9")
    assert find_cards(places) == [Card("NVIDIA card nvidia0", True, places.dev / "nvidia0")]


def test_render_nodes_are_cards_of_others(places):
    (places.dev / "dri" / "renderD128").touch()
    assert find_cards(places) == [Card("graphics card renderD128", False, places.dev / "dri" / "renderD128")]
    (places.dev / "nvidia0").touch()
    assert [card.is_nvidia for card in find_cards(places)] == [True], "NVIDIA's cards have render nodes, too"


def test_a_hidden_device_file_is_the_first_reason(places):
    add_kernel_driver(places)
    reason = unused_card_reason(find_cards(places)[0], places, {}, load_loader_only)
    assert "no device file" in reason and "--gpus all" in reason


def test_a_device_file_that_cannot_be_opened_is_named(places, monkeypatch):
    card = add_complete_driver(places)
    monkeypatch.setattr("skugga.api.cli.graphics_card.os.access", lambda path, mode: False)
    reason = unused_card_reason(card, places, {}, load_all)
    assert f"cannot open {places.dev / 'nvidia0'}" in reason and "group" in reason


def test_a_missing_loader_is_named(places):
    reason = unused_card_reason(add_complete_driver(places), places, {}, lambda name: name != LIBEGL)
    assert "apt-get install libegl1 libgl1" in reason


def test_a_driver_without_its_opengl_part_is_named(places):
    card = add_complete_driver(places)
    reason = unused_card_reason(card, places, {}, load_loader_only)
    assert f"{NVIDIA_LIBRARY}, the OpenGL part" in reason and "NVIDIA_DRIVER_CAPABILITIES=graphics" in reason
    (places.library_folders[0] / NVIDIA_LIBRARY).touch()
    reason = unused_card_reason(card, places, {}, load_loader_only)
    assert reason.endswith(f"Set LD_LIBRARY_PATH={places.library_folders[0]}.")


def test_a_missing_vendor_file_is_named(places):
    card = add_complete_driver(places)
    (places.vendor_folders[0] / "10_nvidia.json").rename(places.vendor_folders[0] / "50_mesa.json")
    assert unused_card_reason(card, places, {}, load_all).startswith("EGL does not list it"), "the content counts, not the name"
    (places.vendor_folders[0] / "50_mesa.json").write_text('{"ICD": {"library_path": "libEGL_mesa.so.0"}}')
    reason = unused_card_reason(card, places, {}, load_all)
    assert f"Write {places.vendor_folders[0] / '10_nvidia.json'}: {json.dumps(NVIDIA_VENDOR)}" in reason
    extra = places.extra_vendor_folders[0] / "10_nvidia.json"
    extra.write_text(json.dumps(NVIDIA_VENDOR))
    assert unused_card_reason(card, places, {}, load_all).endswith(f"Set __EGL_VENDOR_LIBRARY_FILENAMES={extra}.")
    variables = {"__EGL_VENDOR_LIBRARY_FILENAMES": f"/none.json:{extra}"}
    assert unused_card_reason(card, places, variables, load_all).startswith("EGL does not list it")


def test_a_variable_that_hides_the_driver_is_named(places, tmp_path):
    card, mesa = add_complete_driver(places), tmp_path / "mesa.json"
    mesa.write_text('{"ICD": {"library_path": "libEGL_mesa.so.0"}}')
    reason = unused_card_reason(card, places, {"__EGL_VENDOR_LIBRARY_FILENAMES": str(mesa)}, load_all)
    assert reason.startswith("__EGL_VENDOR_LIBRARY_FILENAMES names no file of NVIDIA's driver")
    reason = unused_card_reason(card, places, {"__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path / "empty")}, load_all)
    assert f"Write {tmp_path / 'empty' / '10_nvidia.json'}" in reason


def test_a_device_s_fault_is_told(places):
    reason = unused_card_reason(add_complete_driver(places), places, {}, load_all, ["eglInitialize failed (0x3001)"])
    assert "eglInitialize failed (0x3001)" in reason


def test_a_card_of_another_vendor_needs_mesa_s_driver(places):
    (places.dev / "dri" / "renderD128").touch()
    reason = unused_card_reason(find_cards(places)[0], places, {}, load_loader_only)
    assert "libgl1-mesa-dri" in reason and "virtual display" in reason


@pytest.mark.parametrize("text", ["", "{", "[]", '{"ICD": 1}', '{"ICD": {}}', '{"ICD": {"library_path": "libEGL_mesa.so.0"}}'])
def test_other_vendor_files_do_not_name_nvidia(places, text):
    (places.vendor_folders[0] / "10_nvidia.json").write_text(text)
    assert find_nvidia_vendor_file(places.vendor_folders) is None


def test_vendor_files_may_name_the_library_by_its_path(places):
    path = places.vendor_folders[0] / "99.json"
    path.write_text(json.dumps({"ICD": {"library_path": f"/opt/lib/{NVIDIA_LIBRARY}"}}))
    assert find_nvidia_vendor_file(places.vendor_folders) == path


def card_findings(monkeypatch, places: CardPlaces, is_software: bool | None, devices=()) -> list[doctor.Finding]:
    """Return doctor's findings of cards where a device of a kind draws; ``None``: where none does."""

    def device() -> SimpleNamespace:
        if is_software is None:
            raise NoOpenGLError("OpenGL: none")
        return SimpleNamespace(renderer="llvmpipe", egl_device=EglDevice(0, is_software))

    monkeypatch.setattr("skugga.terrain.gl.device.device", device)
    return doctor._check_graphics_card(devices, places)


def test_doctor_says_why_a_card_is_not_used(places, monkeypatch):
    add_kernel_driver(places)
    assert card_findings(monkeypatch, places, is_software=False) == []
    (finding,) = card_findings(monkeypatch, places, is_software=True)
    assert not finding.ok and finding.detail.startswith("NVIDIA H200 is present, but llvmpipe draws: ")
    assert "--gpus all" in finding.detail
    (finding,) = card_findings(monkeypatch, places, is_software=None)
    assert not finding.ok and "but nothing draws" in finding.detail


def test_doctor_passes_on_faults_of_cards_alone(places, monkeypatch):
    (places.dev / "dri" / "renderD128").touch()
    devices = [(EglDevice(0, False), ProbedDevice(fault="0x3001")), (EglDevice(1, True), ProbedDevice(fault="0x3002"))]
    (finding,) = card_findings(monkeypatch, places, True, devices)
    assert "(0x3001)" in finding.detail and "0x3002" not in finding.detail


def test_doctor_finds_no_fault_in_a_chosen_software_device_or_a_display(places, monkeypatch):
    (places.dev / "dri" / "renderD128").touch()
    (finding,) = card_findings(monkeypatch, places, is_software=True)
    assert finding.ok and "virtual display" in finding.detail
    monkeypatch.setenv(EGL_DEVICE_VARIABLE, "software")
    (places.dev / "nvidia0").touch()
    (finding,) = card_findings(monkeypatch, places, is_software=True)
    assert finding.ok and finding.detail == f"NVIDIA card nvidia0 is not used: {EGL_DEVICE_VARIABLE} is 'software'"


def test_doctor_finds_no_card_where_there_is_none(places, monkeypatch):
    assert card_findings(monkeypatch, replace(places, proc=places.dev), is_software=True) == []
