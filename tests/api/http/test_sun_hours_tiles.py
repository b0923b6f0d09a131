"""Tiles of hours of sun, and their legend."""

from __future__ import annotations

import io
from datetime import date

import numpy as np
import pytest
from morecantile import tms
from PIL import Image

from skugga.api.color_scale import ColorScale
from skugga.api.products.sun_hours import PRODUCT, SunHoursOptions
from tests.api.conftest import Client
from tests.api.http.test_problems import check_problem

MERCATOR = tms.get("WebMercatorQuad")
SUN_HOURS_QUERY = "layer=sunhours&date=2024-12-21"
ZOOM = 13


def tile_of(client: Client, query: str = SUN_HOURS_QUERY, suffix: str = "png"):
    """Return the tile in the middle of the level ``hills``, and the response to its request. ``suffix`` may be empty."""
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    tile = MERCATOR.tile((west + east) / 2, (south + north) / 2, ZOOM)
    return tile, client.get(f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{tile.x}/{tile.y}{suffix and '.' + suffix}?{query}")


def picture(answer) -> np.ndarray:
    """Return the picture of a successful response (rows, cols, channels)."""
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def test_sun_hours_tile_agrees_with_points(client: Client):
    """Points compute the same hours in another way, from their horizons."""
    tile, answer = tile_of(client)
    tile_pixels = picture(answer)
    assert tile_pixels.shape == (256, 256, 4) and (tile_pixels[..., 3] == 255).all()
    tilejson = client.get(f"/levels/hills/WebMercatorQuad/tilejson.json?{SUN_HOURS_QUERY}").json()
    legend = tilejson["skugga"]["legend"]
    legend_hours = np.linspace(legend["low"], legend["high"], 256)
    colors = ColorScale("", "inferno", legend["low"], legend["high"], ()).to_rgba(legend_hours[None])[0].astype(int)
    rows, cols = (item.ravel() for item in np.mgrid[10:256:35, 5:256:35])
    bounds = MERCATOR.xy_bounds(tile)
    side = (bounds.right - bounds.left) / 256
    lon_lat = [MERCATOR.lnglat(bounds.left + col * side, bounds.top - row * side) for row, col in zip(rows, cols, strict=True)]
    body = {"points": [{"lon": place.x, "lat": place.y} for place in lon_lat], "time": "2024-12-21T12:00:00+01:00"}
    direct = np.array([item["direct_h"] for item in client.post("/levels/hills/point", json=body).json()["points"]])
    hours_by_color = legend_hours[np.abs(colors - tile_pixels[rows, cols][:, None].astype(int)).sum(axis=2).argmin(axis=1)]
    assert direct.std() > 1.0
    assert np.corrcoef(hours_by_color, direct)[0, 1] > 0.95  # the tile samples the ground between the cells
    assert np.abs(hours_by_color - direct).mean() < 0.5


def test_sun_hours_tiles_are_cached_per_date(client: Client):
    noon = "window=11:30-12:30"
    _, answer = tile_of(client, f"{SUN_HOURS_QUERY}&{noon}")
    _, cached_response = tile_of(client, f"{SUN_HOURS_QUERY}&{noon}")
    assert cached_response.content == answer.content and "kept" in cached_response.headers["server-timing"]
    assert "x-skugga-caster-reach" not in answer.headers
    summer = tile_of(client, f"layer=sunhours&date=2024-06-21&{noon}")[1]
    assert summer.headers["etag"] != answer.headers["etag"] and summer.content != answer.content
    path = answer.request.url.raw_path.decode()
    assert client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    first = picture(tile_of(client, f"{SUN_HOURS_QUERY}&{noon}&quantity=first&clock=Europe/Zurich")[1])
    assert (first != picture(answer)).any()


def test_legend_is_a_picture_and_numbers(client: Client):
    tilejson = client.get(f"/levels/hills/WebMercatorQuad/tilejson.json?{SUN_HOURS_QUERY}&quantity=first&clock=%2B01:00").json()
    assert tilejson["tiles"][0].endswith("?layer=sunhours&date=2024-12-21&quantity=first&clock=%2B01%3A00")
    legend = tilejson["skugga"]["legend"]
    assert legend["title"] == "First sun, 21 December 2024 (+01:00)"
    assert legend["entries"][0]["label"] == "08:00" and legend["entries"][-1]["label"] in ("16:00", "17:00")
    assert legend["picture"] in tilejson["legend"].replace("&amp;", "&")
    png = client.get(legend["picture"])
    assert png.headers["content-type"] == "image/png" and picture(png).shape[:2] == (85, 340)
    svg = client.get(legend["picture"].replace("legend.png", "legend.svg"))
    assert svg.headers["content-type"].startswith("image/svg+xml") and b"</svg>" in svg.content
    assert client.get(legend["picture"], headers={"If-None-Match": png.headers["etag"]}).status_code == 304


@pytest.mark.parametrize(
    ("query", "name"),
    [
        ("layer=sunhours", "date"), ("layer=sunhours&date=2023-02-29", "date"),
        (f"{SUN_HOURS_QUERY}&time=2024-12-21T09:00Z", "time"),
        (f"{SUN_HOURS_QUERY}&algorithm=sweep", "algorithm"), ("date=2024-12-21", "date"),
        (f"{SUN_HOURS_QUERY}&window=16:00-08:00", "window"),
        (f"{SUN_HOURS_QUERY}&quantity=weeks", "quantity"), (f"{SUN_HOURS_QUERY}&height=-1", "height"),
        ("layer=hours", "layer"), (f"{SUN_HOURS_QUERY}&color_range=12,8", "color_range"),
        (f"{SUN_HOURS_QUERY}&color_range=0,25", "color_range"), (f"{SUN_HOURS_QUERY}&color_range=week", "color_range"),
    ],
)  # fmt: skip
def test_wrong_sun_hours_parameters_are_named(client: Client, query: str, name: str):
    check_problem(tile_of(client, query)[1], 422, "invalid_parameter", name)


def test_color_range_sets_colors_and_legend(client: Client):
    """A number has the colour that the legend gives it; numbers themselves stay the same."""
    noon = f"{SUN_HOURS_QUERY}&window=11:30-12:30"
    hours = np.load(io.BytesIO(tile_of(client, noon, "npy")[1].content))
    seen = {}
    for color_range, (low, high) in {"day": (0.0, 2.0), "fixed": (0.0, 24.0), "0.5,1": (0.5, 1.0)}.items():
        query = f"{noon}&color_range={color_range}"
        legend = client.get(f"/levels/hills/WebMercatorQuad/tilejson.json?{query}").json()["skugga"]["legend"]
        assert (legend["low"], legend["high"]) == (low, high)
        labels = [entry["label"] for entry in legend["entries"]]
        assert len(set(labels)) == len(labels) >= 2
        seen[color_range] = picture(tile_of(client, query)[1])
        np.testing.assert_array_equal(seen[color_range], ColorScale("", "inferno", low, high, ()).to_rgba(hours))
    plain = picture(tile_of(client, noon)[1])
    np.testing.assert_array_equal(seen["day"], plain)
    assert (seen["fixed"] != plain).any() and (seen["0.5,1"] != plain).any()


def test_color_range_of_first_sun_is_by_the_clock(globe_at):
    assert PRODUCT.color_scale is not None
    options = SunHoursOptions(date=date(2024, 3, 21), quantity="first", color_range="6.5,10")
    scale = PRODUCT.color_scale(options, globe_at(10.0, 45.0))
    assert (scale.low, scale.high) == (390.0, 600.0)
    assert scale.ticks[0] == (390.0, "06:30")


def test_picture_layers_have_no_legend(client: Client):
    check_problem(client.get("/levels/hills/legend.png?layer=mask"), 422, "invalid_parameter", "layer")
    check_problem(tile_of(client, SUN_HOURS_QUERY, "jpg")[1], 422, "invalid_parameter", "format")


def test_color_scale_is_valid_in_polar_night(globe_at):
    for lat, day in ((80.0, date(2024, 12, 21)), (80.0, date(2024, 6, 21)), (45.0, date(2024, 3, 21))):
        for quantity in ("hours", "first", "last", "longest", "days"):
            assert PRODUCT.color_scale is not None
            scale = PRODUCT.color_scale(SunHoursOptions(date=day, quantity=quantity), globe_at(10.0, lat))
            assert scale.low < scale.high and 2 <= len(scale.ticks) <= 8
            assert scale.ticks[0][0] == scale.low


@pytest.fixture
def globe_at():
    """A function of longitude and latitude that returns a world in degrees with this anchor."""
    from pyproj import CRS

    from skugga.terrain.geo.world import World

    return lambda lon, lat: World(CRS.from_epsg(4326), False, lon, lat, lon, lat)
