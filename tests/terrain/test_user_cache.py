from pathlib import Path

import pytest

from skugga.terrain.user_cache import user_cache


def test_a_user_without_a_home_has_a_cache_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch):
    """As in a container that runs as a user that it does not know."""

    def unknown() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", unknown)
    assert user_cache("devices") == Path("/nonexistent/.cache/skugga/devices")
