"""A real service of one bundled level, which programs of their own read: QGIS and GDAL as Debian has them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from morecantile import tms

from skugga.api.catalogue import find_level
from skugga.api.http.server.app import create_app
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET
from skugga.api.settings import Settings
from tests.api.conftest import Client, running

HERE = Path(__file__).parent

LEVEL = "jacksboro"

MATRIX_SET = tms.get(DEFAULT_MATRIX_SET)

READY_S = 600
"""A render process compiles at its first start."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder need a client, also one that does not say so."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.clients)


@pytest.fixture(scope="session")
def service() -> Iterator[Client]:
    """A service with one render process that is ready: what is slow then is the client."""
    with running(create_app(Settings(workers=1), [find_level(LEVEL)])) as client:
        end = time.monotonic() + READY_S
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < end, "no render process is ready"
            time.sleep(0.2)
        yield client
