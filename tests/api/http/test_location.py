"""Places by coordinates of the level's own maps."""

from __future__ import annotations

import pytest
from pyproj import CRS, Transformer

from tests.api.conftest import Client
from tests.api.http.test_problems import check_problem


def test_location_agrees_with_proj(client: Client):
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    lon, lat = (west + east) / 2, (south + north) / 2
    crs = client.get("/levels/hills/location?x=1&y=1").json()["crs"]
    x, y = Transformer.from_crs("OGC:CRS84", CRS.from_user_input(crs), always_xy=True).transform(lon, lat)
    place = client.get("/levels/hills/location", params={"x": f"{x:.9f}", "y": f"{y:.9f}"}).json()
    assert (place["lon"], place["lat"]) == pytest.approx((lon, lat), abs=1e-8)
    assert place["crs_name"] == CRS.from_user_input(crs).name


@pytest.mark.parametrize(
    ("query", "name"), [("x=1", "y"), ("x=here&y=1", "x"), ("x=1e9&y=1e9", "x"), ("x=1&y=1&crs=EPSG:3857", "crs")]
)
def test_wrong_coordinates_are_named(client: Client, query: str, name: str):
    check_problem(client.get(f"/levels/hills/location?{query}"), 422, "invalid_parameter", name)
