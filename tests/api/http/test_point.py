"""Reports of the sun at points."""

from __future__ import annotations

import io
from datetime import UTC, date, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pandas
import pytest
from PIL import Image

from tests.api.conftest import Client
from tests.api.http.test_problems import check_problem

POINT = "/levels/hills/point"
LON_LAT_QUERY = "lon=8.4375&lat=47.5"
DAY_QUERY = f"{LON_LAT_QUERY}&time=2024-12-01T09:00:00%2B01:00"


def centre_query(client: Client) -> str:
    """Return the query parameters of the point in the middle of the level ``hills``."""
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    return f"lon={(west + east) / 2:.5f}&lat={(south + north) / 2:.5f}"


def test_point_report_is_consistent(client: Client):
    answer = client.get(f"{POINT}?{centre_query(client)}&time=2024-12-01T09:00:00%2B01:00&height=2")
    assert answer.status_code == 200, answer.text
    report = answer.json()
    assert 500 < report["elevation_m"] < 1300 and report["height_m"] == 2.0
    assert report["now"]["lit"] == (report["now"]["by"] is None)
    day = report["day"]
    assert day["date"] == "2024-12-01" and day["sunrise"] < day["first_sun"] <= day["last_sun"] < day["sunset"]
    assert day["daylight_h"] == pytest.approx(day["direct_h"] + day["masked_h"], abs=1e-3)
    assert day["sunrise"].endswith("+01:00")
    not_modified = client.get(answer.request.url.raw_path.decode(), headers={"If-None-Match": answer.headers["etag"]})
    assert not_modified.status_code == 304


def test_point_day_defaults_to_today(client: Client):
    """The answer expires before the day can be over, and the next day has another ETag."""
    url = f"{POINT}?{centre_query(client)}&clock=utc"
    before = datetime.now(UTC).date()
    answer = client.get(url)
    day = date.fromisoformat(answer.json()["day"]["date"])
    assert before <= day <= datetime.now(UTC).date()
    assert 0 < int(answer.headers["cache-control"].partition("max-age=")[2]) <= 900
    next_day = datetime.now(UTC) + timedelta(days=1)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("skugga.api.http.request_times.datetime", SimpleNamespace(now=lambda zone: next_day))
        tomorrow = client.get(url, headers={"If-None-Match": answer.headers["etag"]})
    assert tomorrow.status_code == 200 and date.fromisoformat(tomorrow.json()["day"]["date"]) == next_day.date()


def test_point_off_the_data_is_null_with_a_remark(client: Client):
    answer = client.get(f"{POINT}?lon=0&lat=0&time=2024-12-01T09:00:00%2B01:00")
    report = answer.json()
    assert answer.status_code == 200 and report["lon"] == report["lat"] == 0.0
    assert report["elevation_m"] is report["now"] is report["day"] is None
    assert report["remark"].startswith("no ground here. Use a place on the level's data: longitudes 8.")
    for file in ("horizon.csv", "sun.svg", "sun.json"):
        check_problem(client.get(f"{POINT}/{file}?lon=0&lat=0"), 422, "invalid_parameter", "point")


def test_horizon_and_chart_formats_agree(client: Client):
    query = centre_query(client)
    series = pandas.read_csv(io.StringIO(client.get(f"{POINT}/horizon.csv?{query}&format=pvlib").text), index_col=0)
    assert series.index.name == "horizon_azimuth" and len(series) == 720
    for suffix, media in (("csv", "text/csv"), ("json", "application/json"), ("txt", "text/plain"), ("hor", "text/plain")):
        answer = client.get(f"{POINT}/horizon.{suffix}?{query}")
        assert answer.status_code == 200 and answer.headers["content-type"].startswith(media)
    profile = client.get(f"{POINT}/horizon.json?{query}").json()["outputs"]["horizon_profile"]
    north = next(sample["H_hor"] for sample in profile if sample["A"] == -180.0)
    assert north == pytest.approx(float(series["horizon_elevation"].iloc[0]), abs=1e-3)
    png = client.get(f"{POINT}/sun.png?{query}&date=2024-06-21")
    assert Image.open(io.BytesIO(png.content)).size[0] > 600
    svg = client.get(f"{POINT}/sun.svg?{query}&date=2024-06-21")
    assert svg.text.lstrip().startswith("<?xml") and svg.headers["content-type"].startswith("image/svg+xml")


def test_sky_agrees_with_horizon_and_day(client: Client):
    query = f"{centre_query(client)}&time=2024-12-01T09:00:00%2B01:00"
    sky = client.get(f"{POINT}/sun.json?{query}").json()
    profile = client.get(f"{POINT}/horizon.json?{query}").json()["outputs"]["horizon_profile"]
    horizon = sky["horizon"]
    highest = np.max([horizon[kind] for kind in ("relief", "solids", "forest")], axis=0)
    by_azimuth = dict(zip(horizon["azimuth"], highest, strict=True))
    assert len(by_azimuth) == 720 and highest.max() > 5 and not any(horizon["forest"])
    for item in profile:
        assert by_azimuth[(item["A"] + 180.0) % 360.0] == pytest.approx(item["H_hor"], abs=0.006)

    day = client.get(f"{POINT}?{query}").json()["day"]
    path = sky["path"]
    assert sky["date"] == day["date"] and path[0]["time"] > day["sunrise"] and path[-1]["time"] < day["sunset"]
    sunlit_spans = [(item["begin"], item["end"]) for item in day["sunlit"]]
    assert {item["lit"] for item in path} == {True, False}
    for item in path:
        assert item["lit"] == any(begin <= item["time"] <= end for begin, end in sunlit_spans), item
    assert len(path) == pytest.approx(day["daylight_h"] * 12, abs=1)


def test_many_points_agree_with_single_points(client: Client):
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    lon, lat = (west + east) / 2, (south + north) / 2
    points = [{"lon": lon + 0.001 * n, "lat": lat} for n in range(5)] + [{"lon": 0.0, "lat": 0.0}]
    body = {"points": points, "time": "2024-12-01T09:00:00+01:00"}
    answer = client.post(POINT, json=body)
    assert answer.status_code == 200, answer.text
    *rows, outside_point = answer.json()["points"]
    single_point = client.get(f"{POINT}?lon={lon}&lat={lat}&time=2024-12-01T09:00:00%2B01:00").json()
    assert rows[0]["elevation_m"] == single_point["elevation_m"] and rows[0]["now"] == single_point["now"]
    assert rows[0]["direct_h"] == pytest.approx(single_point["day"]["direct_h"], abs=0.15)
    assert outside_point["elevation_m"] is outside_point["now"] is None and "a place on the level's data" in outside_point["remark"]
    assert len({row["elevation_m"] for row in rows}) == 5


@pytest.mark.parametrize(
    ("query", "parameter"),
    [
        (f"{LON_LAT_QUERY}&height=-1", "height"),
        (f"{LON_LAT_QUERY}&clock=noon&date=2024-01-01", "clock"),
        (f"{LON_LAT_QUERY}&date=yesterday", "date"),
        (f"{LON_LAT_QUERY}&time=noon", "time"),
        (f"{LON_LAT_QUERY}&year=1", "year"),
        ("lat=47.5", "lon"),
        (f"{LON_LAT_QUERY}&azimuth=3", "azimuth"),
    ],
)
def test_point_names_wrong_parameters(client: Client, query: str, parameter: str):
    if query.startswith(LON_LAT_QUERY):
        query = query.replace(LON_LAT_QUERY, centre_query(client))
    answer = client.get(f"{POINT}?{query}")
    assert answer.status_code == 422 and answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["parameter"] == parameter and answer.json()["code"] == "invalid_parameter"


def test_point_refuses_excess_and_wrong_formats(client: Client):
    check_problem(client.get(f"{POINT}/horizon.csv?{centre_query(client)}&format=hor"), 422, "invalid_parameter", "format")
    body = {"points": [{"lon": 8.0, "lat": 47.0}] * 10_001}
    check_problem(client.post(POINT, json=body), 422, "invalid_parameter", "points")
    check_problem(client.post(POINT, json={"points": []}), 422, "invalid_parameter", "points")
    check_problem(client.get(f"/levels/nowhere/point?{LON_LAT_QUERY}"), 404, "not_found", "level")


def test_mask_tile_agrees_with_points(client: Client):
    """Pixels of a mask tile are compared with points at the same places.

    They agree but for the surface between the cells, which the tile samples at its own pixels.
    """
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    from morecantile import tms

    matrix = tms.get("WebMercatorQuad")
    zoom = 13
    tile = matrix.tile((west + east) / 2, (south + north) / 2, zoom)
    mask = client.get(f"/levels/hills/tiles/WebMercatorQuad/{zoom}/{tile.x}/{tile.y}.png?layer=mask")
    values = np.array(Image.open(io.BytesIO(mask.content)).convert("L"))
    bounds = matrix.xy_bounds(tile)
    step = (bounds.right - bounds.left) / 256
    rng = np.random.default_rng(0)
    picks = [(int(i), int(j)) for i, j in rng.integers(0, 256, (120, 2)) if values[i, j] in (0, 255)]
    points = []
    for i, j in picks:
        lon, lat = matrix.lnglat(bounds.left + (j + 0.5) * step, bounds.top - (i + 0.5) * step)
        points.append({"lon": lon, "lat": lat})
    rows = client.post(POINT, json={"points": points}).json()["points"]
    agreements = [row["now"]["lit"] == (values[i, j] == 255) for row, (i, j) in zip(rows, picks, strict=True)]
    assert len(agreements) > 60 and np.mean(agreements) > 0.9
