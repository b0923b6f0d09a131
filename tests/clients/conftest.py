"""A real service of one bundled level for third-party programs: QGIS and GDAL as Debian packages them."""

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
"""A render worker compiles at its first start."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test of this folder as a client test."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.clients)


@pytest.fixture(scope="session")
def service() -> Iterator[Client]:
    """Yield a service whose render worker is ready, so that only the client can be slow."""
    with running(create_app(Settings(workers=1), [find_level(LEVEL)])) as client:
        end = time.monotonic() + READY_S
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < end, "no render process is ready"
            time.sleep(0.2)
        yield client
