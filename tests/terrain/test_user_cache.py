from pathlib import Path

import pytest

from skugga.terrain.user_cache import user_cache_folder


def test_user_cache_without_a_home_is_not_writable(monkeypatch: pytest.MonkeyPatch):
    """A container may run as a user that it does not know."""

    def unknown() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", unknown)
    assert user_cache_folder("devices") == Path("/nonexistent/.cache/skugga/devices")
