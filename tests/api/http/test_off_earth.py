"""Levels off the earth: pictures work with a sun given by angles; requests that need the earth fail with one reason."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from httpx import Client

from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from tests.api.conftest import running
from tests.api.crs_towers import plain_with_tower
from tests.rasters import write_geotiff

NOT_A_CRS_OF_THE_EARTH = "is not a CRS of the earth"


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Yield a client of a service of two levels: ``moon`` on the Moon, and ``paris`` in grads from the meridian of Paris."""
    folder: Path = tmp_path_factory.mktemp("moon")
    moon = write_geotiff(folder / "moon.tif", plain_with_tower(), "IAU_2015:30110", 3e5, 6e5, 10.0)
    paris = write_geotiff(folder / "paris.tif", plain_with_tower(), "EPSG:4807", 0.0, 51.0, (1.4e-4, 1e-4))
    with running(create_app(Settings(workers=1), [moon, paris])) as client:
        yield client


@pytest.mark.parametrize(
    "address",
    [
        "tiles/WebMercatorQuad/12/2048/2000.png", "WebMercatorQuad/tilejson.json", "map.png?crs=EPSG:3857", "map.png?bbox=0,0,1,1",
        "WMTSCapabilities.xml", "wms?SERVICE=WMS&REQUEST=GetCapabilities", "lines.json",
        "snapshot.png?view=map&time=2024-06-21T12:00:00Z", "point?lon=9.91&lat=19.77&date=2024-06-21",
    ],
)  # fmt: skip
def test_requests_that_need_the_earth_are_refused(client: Client, address: str):
    answer = client.get(f"levels/moon/{address}")
    assert answer.status_code == 422
    assert NOT_A_CRS_OF_THE_EARTH in answer.text


@pytest.mark.parametrize("address", ["levels/moon/snapshot.png?view=map&azimuth=110&altitude=15&size=64x64", "levels/moon/map.png"])
def test_sun_by_angles_is_drawn_off_the_earth(client: Client, address: str):
    answer = client.get(address)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "image/png"


def test_maps_in_grads_are_refused(client: Client):
    answer = client.get("levels/paris/map.png?crs=EPSG:4807")
    assert answer.status_code == 422
    assert "in the unit grad" in answer.json()["detail"]


def test_level_in_grads_has_bounds_in_degrees(client: Client):
    """Paris lies 2.34 degrees east of Greenwich."""
    west, south, _, _ = client.get("levels/paris/WebMercatorQuad/tilejson.json").json()["bounds"]
    assert west == pytest.approx(2.337, abs=0.01)
    assert south == pytest.approx(45.9, abs=0.01)
