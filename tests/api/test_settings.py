import json

import pytest
from pydantic import ValidationError

from skugga.api import settings as module
from skugga.api.settings import Settings, load_settings
from skugga.terrain.errors import InputError


def test_defaults_are_safe():
    settings = load_settings()
    assert settings.host == "127.0.0.1"
    assert not settings.remote_sources
    assert settings.empty_tile == "transparent"
    assert settings.block_cache_bytes == 64 * 2**20


@pytest.mark.parametrize(("cores", "workers"), [(1, 1), (2, 2), (64, 4)])
def test_the_default_is_one_worker_per_core_within_bounds(monkeypatch: pytest.MonkeyPatch, cores: int, workers: int):
    monkeypatch.setattr(module, "usable_cores", lambda: cores)
    assert load_settings().workers == workers


def test_calibration_when_idle_is_the_default(monkeypatch: pytest.MonkeyPatch):
    assert not load_settings().calibrate_when_idle, "conftest.py disables calibration for services of tests"
    monkeypatch.delenv("SKUGGA_CALIBRATE_WHEN_IDLE")
    assert load_settings().calibrate_when_idle


def test_arguments_override_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKUGGA_WORKERS", "3")
    monkeypatch.setenv("SKUGGA_PORT", "9000")
    monkeypatch.setenv("SKUGGA_CORS_ORIGINS", "https://a.example, https://b.example")
    settings = load_settings(port=9001)
    assert (settings.workers, settings.port) == (3, 9001)
    assert settings.cors_origins == ("https://a.example", "https://b.example")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("SKUGGA_WORKERS", "none"),
        ("SKUGGA_EMPTY_TILE", "grey"),
        ("SKUGGA_PUBLIC_URL", "a.example"),
        ("SKUGGA_PORT", "-1"),
        ("SKUGGA_EGL_DEVICE", "1;2"),
        ("SKUGGA_BASE_MAPS", "streets"),
        ("SKUGGA_BASE_MAPS", '{"title": "Streets"}'),
    ],
)
def test_wrong_environment_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str):
    monkeypatch.setenv(name, value)
    with pytest.raises(InputError) as caught:
        load_settings()
    assert caught.value.name == name
    assert value in str(caught.value)


@pytest.mark.parametrize(
    "tiles",
    [
        "ftp://a.example/{z}/{x}/{y}.png", "https://a.example/{z}/{x}.png", "/etc/{z}/{x}/{y}", "https://{s}.a.example/{z}/{x}/{y}.png",
        "https://a.example; script-src */{z}/{x}/{y}.png", "https://a.example/{z}/{x}/{y}.png'", "//a.example/{z}/{x}/{y}.png",
    ],
)  # fmt: skip
def test_wrong_base_map_is_refused(monkeypatch: pytest.MonkeyPatch, tiles: str):
    """What it contains may not change the page's Content-Security-Policy."""
    monkeypatch.setenv("SKUGGA_BASE_MAPS", json.dumps([{"title": "Streets", "tiles": tiles}]))
    with pytest.raises(InputError) as caught:
        load_settings()
    assert caught.value.name == "SKUGGA_BASE_MAPS"


def test_base_maps_are_json(monkeypatch: pytest.MonkeyPatch):
    assert load_settings().base_maps == () and not load_settings().base_maps_only
    tiles = "https://a.example:8080/{z}/{x}/{y}.png"
    monkeypatch.setenv("SKUGGA_BASE_MAPS", json.dumps([{"title": "Streets", "tiles": tiles, "maxzoom": 16}]))
    (base_map,) = load_settings().base_maps
    assert (base_map.title, base_map.maxzoom, base_map.attribution) == ("Streets", 16, "")
    assert base_map.origin == "https://a.example:8080"


def test_wrong_argument_is_named():
    with pytest.raises(InputError) as caught:
        load_settings(workers=0)
    assert caught.value.name == "workers"


def test_settings_are_immutable():
    with pytest.raises(ValidationError):
        Settings().workers = 2


def test_messages_do_not_show_a_wrong_secret(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKUGGA_API_TOKEN", "hunter2")
    with pytest.raises(InputError) as caught:
        load_settings()
    assert caught.value.name == "SKUGGA_API_TOKEN" and "hunter2" not in str(caught.value)
    monkeypatch.setenv("SKUGGA_API_TOKEN", "hunter2hunter2")
    assert "hunter2" not in repr(load_settings())
