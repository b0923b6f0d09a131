"""Options of shadow maps and shadow volumes, on the command line and over HTTP, reach the plan or are refused by name."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from skugga.api.cli import main as cli
from skugga.api.http.parameters import picture_query
from skugga.api.request import RequestedSettings
from skugga.api.settings import Settings

SMALL_MAP_OPTIONS = ("--size", "64x64", "--azimuth", "246", "--altitude", "12")


@pytest.fixture
def settings_of(monkeypatch, capsys, tmp_path: Path):
    """Return ``settings_of("--bias", "...")``, which renders and returns exit status, standard error and the settings used."""

    def call(*arguments: str) -> tuple[int, str, dict]:
        stats = tmp_path / "stats.json"
        picture = str(tmp_path / "picture.png")
        monkeypatch.setattr(
            sys, "argv", ["skugga", "render", "jacksboro", *SMALL_MAP_OPTIONS, "-o", picture, "--stats", str(stats), *arguments]
        )
        with pytest.raises(SystemExit) as exit_info:
            cli.main()
        plan = json.loads(stats.read_text(encoding="utf-8"))["plan"] if exit_info.value.code == 0 else {}
        return exit_info.value.code, capsys.readouterr().err, plan.get("settings", {}).get("sun", {}).get("relief", {})

    return call


@pytest.mark.parametrize(
    ("key", "value", "planned_value"),
    [("filter", "sun", "sun"), ("filter", "2", 2), ("bias", "normal_offset", "normal_offset"),
     ("bias", "polygon_offset", "polygon_offset"), ("culling", "front", "front")],
)  # fmt: skip
def test_shadow_map_options_reach_the_plan(gl, settings_of, key: str, value: str, planned_value: str | int):
    status, _, settings = settings_of(f"--{key}", value)
    assert status == 0 and settings[key] == planned_value


@pytest.mark.parametrize(
    ("algorithm", "key", "value"),
    [
        ("shadow_volume", "stencil", "one_pass"), ("shadow_volume", "stencil", "two_pass"), ("shadow_volume", "counting", "auto"),
        ("shadow_volume", "counting", "z_fail"), ("hybrid", "mask", "conservative"), ("hybrid", "mask", "original"),
        ("hybrid", "stencil", "two_pass"),
    ],
)  # fmt: skip
def test_shadow_volume_options_reach_the_plan(gl, settings_of, algorithm: str, key: str, value: str):
    status, _, settings = settings_of("--algorithm", algorithm, f"--{key}", value)
    assert status == 0 and settings[key] == value


@pytest.mark.parametrize(
    ("key", "value", "expected_text"),
    [
        ("filter", "4", "'sun'"), ("filter", "moon", "'sun'"), ("bias", "slope", "normal_offset"), ("culling", "back", "'front'"),
        ("stencil", "three_pass", "'one_pass' or 'two_pass'"), ("counting", "z_both", "'z_fail'"), ("mask", "paper", "'original'"),
    ],
)  # fmt: skip
def test_invalid_options_list_the_allowed_values(settings_of, key: str, value: str, expected_text: str):
    status, error_text, _ = settings_of(f"--{key}", value)
    assert status == 2 and error_text.count("\n") == 1 and key in error_text and value in error_text and expected_text in error_text


def test_picture_query_carries_the_options():
    options = {"filter": "sun", "bias": "normal_offset", "culling": "front"}
    options |= {"stencil": "two_pass", "counting": "z_fail", "mask": "original"}
    service = SimpleNamespace(settings=Settings())
    request = SimpleNamespace(app=SimpleNamespace(state=SimpleNamespace(service=service)))
    parsed = asyncio.run(picture_query(request, **options))
    assert parsed.overrides == RequestedSettings.of(options)
    assert options == parsed.overrides.for_selector()
    assert parsed.query() == "&".join(f"{key}={value}" for key, value in options.items())
