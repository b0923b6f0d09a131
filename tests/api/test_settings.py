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
def test_a_render_process_per_core_within_reason(monkeypatch: pytest.MonkeyPatch, cores: int, workers: int):
    monkeypatch.setattr(module, "usable_cores", lambda: cores)
    assert load_settings().workers == workers


def test_a_device_is_calibrated_unasked(monkeypatch: pytest.MonkeyPatch):
    assert not load_settings().calibrate_when_idle, "services of tests must not"
    monkeypatch.delenv("SKUGGA_CALIBRATE_WHEN_IDLE")
    assert load_settings().calibrate_when_idle


def test_environment_and_arguments(monkeypatch: pytest.MonkeyPatch):
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
    ],
)
def test_wrong_environment_is_named(monkeypatch: pytest.MonkeyPatch, name: str, value: str):
    monkeypatch.setenv(name, value)
    with pytest.raises(InputError) as caught:
        load_settings()
    assert caught.value.name == name
    assert value in str(caught.value)


def test_wrong_argument_is_named():
    with pytest.raises(InputError) as caught:
        load_settings(workers=0)
    assert caught.value.name == "workers"


def test_settings_do_not_change():
    with pytest.raises(ValidationError):
        Settings().workers = 2


def test_a_secret_that_is_wrong_is_not_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKUGGA_API_TOKEN", "hunter2")
    with pytest.raises(InputError) as caught:
        load_settings()
    assert caught.value.name == "SKUGGA_API_TOKEN" and "hunter2" not in str(caught.value)
    monkeypatch.setenv("SKUGGA_API_TOKEN", "hunter2hunter2")
    assert "hunter2" not in repr(load_settings())
