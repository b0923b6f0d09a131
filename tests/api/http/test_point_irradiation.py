"""Irradiation at a point over HTTP: JSON, the table, the chart, and wrong parameters."""

from __future__ import annotations

import csv
import io
from datetime import UTC, datetime

import pytest
from PIL import Image

from tests.api.conftest import Client
from tests.api.http.test_point import centre_query
from tests.api.http.test_problems import check_problem

IRRADIATION = "/levels/hills/point/irradiation"


def test_json_has_the_months_of_a_year(client: Client):
    address = f"{IRRADIATION}?{centre_query(client)}&year=2023&tilt=35&azimuth=200&height=2"
    answer = client.get(address)
    assert answer.status_code == 200, answer.text
    report = answer.json()
    assert report["level"] == "hills" and 500 < report["elevation_m"] < 1300 and report["height_m"] == 2.0
    assert (report["tilt"], report["azimuth"], report["unit"], report["remark"]) == (35.0, 200.0, "kWh/m2", None)
    assert [month["month"] for month in report["months"]] == [f"2023-{n:02d}" for n in range(1, 13)]
    for sums in (*report["months"], report["all_months"]):
        losses = sum(sum(sums[name].values()) for name in ("lost_beam", "lost_sky", "lost_reflected"))
        assert sums["total"] + losses == pytest.approx(sums["open_sky"], abs=1e-2)
    assert report["all_months"]["lost_beam"]["relief"] > 0.0 == report["all_months"]["lost_beam"]["forest"]
    assert "max-age=86400" in answer.headers["cache-control"]
    assert client.get(address, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    steeper = client.get(address.replace("tilt=35", "tilt=36"))
    assert steeper.headers["etag"] != answer.headers["etag"] and steeper.json()["tilt"] == 36.0


def test_table_and_charts_are_those_of_the_report(client: Client):
    query = f"{centre_query(client)}&date=2024-02-01&to=2024-03-31&plane=ground"
    report = client.get(f"{IRRADIATION}?{query}").json()
    table = client.get(f"{IRRADIATION}.csv?{query}")
    assert table.headers["content-type"].startswith("text/csv")
    rows = {row["month"]: row for row in csv.DictReader(io.StringIO(table.text))}
    assert list(rows) == ["2024-02", "2024-03", "all"]
    assert float(rows["all"]["total_kwh_m2"]) == report["all_months"]["total"] > 0.0
    chart = client.get(f"{IRRADIATION}.svg?{query}")
    assert chart.headers["content-type"].startswith("image/svg+xml") and "The hills" in chart.text
    picture = client.get(f"{IRRADIATION}.png?{query}")
    assert picture.headers["content-type"] == "image/png" and min(Image.open(io.BytesIO(picture.content)).size) > 600
    check_problem(client.get(f"{IRRADIATION}.xlsx?{query}"), 422, "invalid_parameter", "format")


def test_without_a_year_it_is_this_year(client: Client):
    before = datetime.now(UTC).year
    answer = client.get(f"{IRRADIATION}?{centre_query(client)}")
    assert before <= int(answer.json()["first"][:4]) <= datetime.now(UTC).year
    assert 0 < int(answer.headers["cache-control"].partition("max-age=")[2]) <= 900


def test_off_the_data_json_is_null_and_files_are_refused(client: Client):
    report = client.get(f"{IRRADIATION}?lon=0&lat=0&year=2023").json()
    assert report["months"] is report["all_months"] is report["tilt"] is report["elevation_m"] is None
    assert report["remark"].startswith("no ground here. Use a place on the level's data: longitudes 8.")
    for suffix in ("csv", "svg", "png"):
        check_problem(client.get(f"{IRRADIATION}.{suffix}?lon=0&lat=0&year=2023"), 422, "invalid_parameter", "point")


@pytest.mark.parametrize(
    ("query", "parameter"),
    [
        ("year=2023&tilt=190", "tilt"),
        ("year=2023&tilt=-1", "tilt"),
        ("year=2023&tilt=30&azimuth=400", "azimuth"),
        ("year=2023&azimuth=90", "azimuth"),
        ("year=2023&tilt=30&plane=ground", "tilt"),
        ("year=2023&plane=wall", "plane"),
        ("year=2023&albedo=-1", "albedo"),
        ("year=2023&linke=0", "linke"),
        ("year=1500", "year"),
        ("year=2023&date=2023-01-01", "date"),
        ("date=1600-01-01", "date"),
        ("to=2023-01-01", "to"),
        ("date=2023-02-01&to=2023-01-01", "to"),
        ("date=2021-02-01&to=2023-01-01", "to"),
        ("year=2023&height=-1", "height"),
        ("year=2023&time=2024-12-01T09:00:00Z", "time"),
    ],
)
def test_wrong_parameters_are_named(client: Client, query: str, parameter: str):
    for suffix in ("", ".svg"):
        check_problem(client.get(f"{IRRADIATION}{suffix}?{centre_query(client)}&{query}"), 422, "invalid_parameter", parameter)
    check_problem(client.get("/levels/nowhere/point/irradiation?lon=8&lat=47"), 404, "not_found", "level")


def test_an_unknown_clock_is_named(client: Client):
    answer = client.get(f"{IRRADIATION}?{centre_query(client)}&year=2023&clock=noon")
    assert answer.status_code == 422 and answer.json()["parameter"] == "clock"
