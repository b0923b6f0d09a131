"""The page of seed experiments: figures of a second device stand beside those of the first."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.seeds import __main__ as seeds
from benchmarks.seeds.claims import Claim, Experiment, Section
from benchmarks.seeds.devices import add_figures, format_devices, format_experiment

FIGURES = Path(seeds.__file__).parent / "seeds.json"


def device(renderer: str, software: bool) -> Any:
    """Return a device with an OpenGL name, which may be a software renderer."""
    return SimpleNamespace(renderer=renderer, egl_device=SimpleNamespace(is_software=software))


CPU, CARD = device("a rasteriser", True), device("a card", False)


def section(figures: dict[str, Any]) -> Section:
    """Return a section with a table of times by scene, and a claim about the largest time."""
    rows = [{"scene": scene, "map": "1024", "time": f"{time:.2f}"} for scene, time in figures["times"].items()]
    claim = Claim("a text", "it is fast", f"{max(figures['times'].values()):.2f}", max(figures["times"].values()) < 1.0, "so it is")
    return Section("Times", "Measured.", [("The times", rows)], [claim])


EXPERIMENT = Experiment(dict, section)


def measured_on(*devices: Any, times: tuple[dict[str, float], ...]) -> dict[str, Any]:
    """Return the stored figures of devices. ``times`` has each device's times by scene."""
    measured: dict[str, Any] = {}
    for device_info, device_times in zip(devices, times, strict=True):
        add_figures(measured, device_info, "times", {"times": device_times})
    return measured


def test_figures_without_a_commit_forget_that_of_older_ones():
    measured: dict[str, Any] = {}
    add_figures(measured, CPU, "times", {"times": {"one": 2}}, "abc1234")
    assert "at commit abc1234" in str(format_experiment("times", EXPERIMENT, measured))
    add_figures(measured, CPU, "times", {"times": {"one": 2}})
    assert "commit" not in str(format_experiment("times", EXPERIMENT, measured))


def test_differing_cells_hold_the_figures_of_both_devices():
    text = format_experiment("times", EXPERIMENT, measured_on(CPU, CARD, times=({"one": 2, "two": 0.5}, {"one": 0.25, "two": 0.5})))
    assert text is not None
    assert "| one | 1024 | 2.00 / 0.25 |\n| two | 1024 | 0.50 |" in text
    first, second = text.split("**The same claims on a card**")
    assert "| it is fast (a text) | 2.00 | **not held** | so it is |" in first
    assert "| it is fast (a text) | 0.50 | held | so it is |" in second


def test_a_table_with_other_rows_is_separate():
    text = format_experiment("times", EXPERIMENT, measured_on(CPU, CARD, times=({"one": 2, "two": 0.5}, {"one": 0.25, "six": 0.5})))
    assert text is not None
    assert "| two | 1024 | 0.50 |\n" in text and "**The times: a card**" in text and "| six | 1024 | 0.50 |" in text


def test_experiments_of_a_single_device_name_it():
    measured = measured_on(CPU, CARD, times=({"one": 2}, {"one": 0.25}))
    assert format_experiment("other", EXPERIMENT, measured) is None
    del measured[CPU.renderer]["experiments"]["times"]
    assert "Measured. (measured on a card alone)" in format_experiment("times", EXPERIMENT, measured)


def test_a_new_run_replaces_only_the_device_s_own_figures():
    measured = measured_on(CPU, CARD, CPU, times=({"one": 2}, {"one": 0.25}, {"one": 3}))
    assert [device_figures["experiments"]["times"]["times"]["one"] for device_figures in measured.values()] == [3, 0.25]
    assert list(measured) == [CPU.renderer, CARD.renderer], "the first device remains the main device of the page"


def test_the_page_says_whether_a_gpu_was_measured():
    software_device, two_devices = measured_on(CPU, times=({"one": 2},)), measured_on(CPU, CARD, times=({"one": 2}, {"one": 1}))
    assert "Nothing on this page was measured on a GPU" in format_devices(software_device)
    assert "Nothing on this page was measured on a GPU" in format_devices(measured_on(CPU, device("b", True), times=({}, {})))
    assert "Nothing" not in format_devices(two_devices) and "(1) a rasteriser; (2) a card" in format_devices(two_devices)


def test_all_experiments_can_be_merged_with_another_device():
    """The test adds two made-up devices to the page: one that needs half the time for everything, and one with equal
    figures.
    """
    measured = json.loads(FIGURES.read_text("utf-8"))
    (first,) = measured.values()
    plain = seeds.format_page(measured)

    def halved(figures: Any) -> Any:
        if isinstance(figures, dict):
            return {key: halved(value) / 2 if key == "ms" else halved(value) for key, value in figures.items()}
        return figures

    merged_page = seeds.format_page(measured | {"twin": copy.deepcopy(first)})
    assert not re.search(r"\d / \d", "".join(set(merged_page.splitlines()) - set(plain.splitlines())).replace("1.00 / 0.52", ""))
    assert merged_page.count("**The same claims on twin**") == sum(
        "| claim | found here |" in part for part in plain.split("\n## ")
    )
    other = {"software": False, "experiments": {"stages": halved(first["experiments"]["stages"])}}
    assert "**The same claims on card**" in seeds.format_page(measured | {"card": other})


def test_a_second_device_keeps_the_figures_of_the_first(tmp_path, monkeypatch, capsys):
    json_file, page_file = tmp_path / "figures.json", tmp_path / "page.md"
    monkeypatch.setattr(seeds, "EXPERIMENTS", {"times": Experiment(lambda: {"times": {"one": state.speed}}, section)})
    monkeypatch.setattr(seeds, "current_commit", lambda: "abc1234")
    state = SimpleNamespace(speed=2.0)
    for device_info, speed in ((CPU, 2.0), (CARD, 0.123456789)):
        state.speed = speed
        monkeypatch.setattr(seeds, "device", lambda device_info=device_info: device_info)
        monkeypatch.setattr("sys.argv", ["seeds", "--json", str(json_file), "--markdown", str(page_file)])
        seeds.main()
    assert json.loads(json_file.read_text())[CARD.renderer] == {
        "software": False, "experiments": {"times": {"times": {"one": 0.123457}}}, "commits": {"times": "abc1234"},
    }  # fmt: skip
    assert "\nMeasured. Measured at commit abc1234.\n" in page_file.read_text()
    assert "| one | 1024 | 2.00 / 0.12 |" in page_file.read_text()
    monkeypatch.setattr("sys.argv", [*("seeds --write-only --without".split()), CARD.renderer, "--json", str(json_file),
                                     "--markdown", str(page_file)])  # fmt: skip
    seeds.main()
    assert list(json.loads(json_file.read_text())) == [CPU.renderer] and "2.00 |" in page_file.read_text()
    with pytest.raises(SystemExit):
        seeds.main()
    assert "the file has no figures of a card. It has figures of: a rasteriser" in capsys.readouterr().err
