"""``skugga point``: its table, JSON, files, points, tracks and errors."""

from __future__ import annotations

import json
from datetime import date, datetime

import numpy as np
import pytest
from PIL import Image

from skugga.api.point.horizon_formats import HORIZON_FORMATS
from skugga.shadows.point.clock import clock_of
from tests.rasters import ENGINEERING, write_geotiff

LON_LAT = "15.0,47.5"
TIME = "2024-10-21T09:00:00+02:00"


@pytest.fixture
def valley(tmp_path):
    """Write a valley from north to south, 1500 m deep, around 15 degrees east and 47.5 north."""
    _, cols = np.mgrid[0:101, 0:101]
    heights = 300.0 + 1500.0 * np.clip(np.abs(cols - 50) / 30.0 - 0.2, 0.0, 1.0)
    return str(write_geotiff(tmp_path / "valley.tif", heights.astype(np.float32), "EPSG:32633", 495_000.0, 5_266_000.0, 100.0))


def test_the_table_reports_ground_sun_and_day(run, valley):
    status, out, err = run("point", valley, "--at", LON_LAT, "--time", TIME, "--height", "1.6")
    assert (status, err) == (0, "")
    for text in ("ground 300.0 m, 1.6 m above it", "in shadow, surface", "first sun", "last sun", "hidden", "2024-10-21"):
        assert text in out, out


def test_json_reports_the_day_and_the_year(run, valley):
    status, out, _ = run(
        "point", valley, "--at", LON_LAT, "--date", "2024-10-21", "--clock", "Europe/Vienna", "--year", "2024", "--json"
    )
    report = json.loads(out)
    assert status == 0 and report["elevation_m"] == 300.0
    day = report["day"]
    assert day["clock"] == "Europe/Vienna" and day["sunrise"].endswith("+02:00") and 2.0 < day["masked_h"] < 8.0
    assert len(report["year"]) == 366
    (october,) = (day_report for day_report in report["year"] if day_report["date"] == "2024-10-21")
    assert october["direct_h"] == pytest.approx(day["direct_h"], abs=0.1)


def test_coordinates_of_a_crs_and_west_of_greenwich(run, valley, tmp_path):
    _, degrees, _ = run("point", valley, "--at", LON_LAT, "--time", TIME, "--json")
    place = json.loads(degrees)
    status, metres, _ = run("point", valley, "--at", "500000,5260871.8", "--crs", "EPSG:32633", "--time", TIME, "--json")
    assert status == 0 and json.loads(metres)["lon"] == pytest.approx(place["lon"], abs=1e-4)
    west = write_geotiff(tmp_path / "west.tif", np.zeros((11, 11), np.float32), "EPSG:4326", -118.3, 34.3, 0.01)
    status, out, err = run("point", str(west), "--at", "-118.25,34.25", "--date", "2024-06-21")
    assert status == 0, err
    assert "polar" not in out and "14.40 h" in out


def test_horizon_and_picture_files_are_written(run, valley, tmp_path):
    horizon, chart, picture = tmp_path / "roof.hor", tmp_path / "sun.svg", tmp_path / "sun.png"
    arguments = ["point", valley, "--at", LON_LAT, "--date", "2024-10-21", "--horizon", "hor", "--output", str(horizon)]
    assert run(*arguments, "--picture", str(chart))[0] == 0
    rows = [line.split() for line in horizon.read_text().splitlines()]
    assert len(rows) == 360 and rows[0][0] == "-180" and float(rows[90][1]) > 15.0
    assert chart.read_text().lstrip().startswith("<?xml")
    assert run(*arguments, "--picture", str(picture))[0] == 0
    with Image.open(picture) as image:
        assert min(image.size) > 600


@pytest.mark.parametrize("format", HORIZON_FORMATS)
def test_a_horizon_without_a_file_is_printed_alone(run, valley, tmp_path, format):
    """Standard output then equals the file, so that another program can read it."""
    file = tmp_path / "horizon"
    arguments = ["point", valley, "--at", LON_LAT, "--date", "2024-10-21", "--horizon", format]
    status, report, _ = run(*arguments, "-o", str(file))
    assert status == 0 and "ground 300.0 m" in report
    status, out, err = run(*arguments)
    assert (status, err) == (0, "") and out.encode() == file.read_bytes() and len(out) > 100


def test_horizons_of_many_points_are_one_table(run, valley, tmp_path):
    """The printed CSV equals the file and the archive, and a row is the horizon that its point has alone."""
    points, table, archive = tmp_path / "huts.csv", tmp_path / "horizons.csv", tmp_path / "horizons.npz"
    points.write_text("name,lon,lat,height\nhut,15.0,47.5,2\nslope,15.012,47.51,0\n", encoding="utf-8")
    arguments = ["point", valley, "--points", str(points), "--azimuths", "360"]
    status, out, err = run(*arguments)
    assert (status, err) == (0, "")
    assert run(*arguments, "-o", str(table)) == (0, "", "") and table.read_text() == out
    assert run(*arguments, "-o", str(archive)) == (0, "", "")
    rows = [line.split(",") for line in out.splitlines()]
    assert rows[0][:5] == ["lon", "lat", "height_m", "elevation_m", "0"] and len(rows) == 3
    angles = np.array([row[4:] for row in rows[1:]], float)
    with np.load(archive) as arrays:
        assert arrays["horizon_deg"] == pytest.approx(angles, abs=1e-4) and arrays["horizon_deg"].shape == (2, 360)
    for row, at, height in ((0, LON_LAT, "2"), (1, "15.012,47.51", "0")):
        _, alone, _ = run("point", valley, "--at", at, "--height", height, "--horizon", "pvgis-upload")
        assert np.maximum(angles[row], 0.0) == pytest.approx([float(line) for line in alone.split()], abs=0.006)
    assert np.ptp(angles[0]) > 10.0 and np.abs(angles[0] - angles[1]).max() > 1.0


@pytest.mark.parametrize(
    ("text", "arguments", "expected_text"),
    [
        ("lon,lat\n", [], "huts.csv: no points. Give at least one"),
        ("lon,lat\n15,47.5\n0,0\n", [], "huts.csv: '0,0 (point 2 of 2)' is not allowed. Allowed: a place on the level's data"),
        ("lon,lat\n15,47.5\n", ["--azimuths", "100000"], "--azimuths: '100000' is not allowed. Allowed: 1 to 3600 azimuths"),
        (
            "lon,lat\n15,47.5\n",
            ["--output", "horizons.xlsx"],
            "--output: 'horizons.xlsx' is not allowed. Allowed: with --azimuths: .csv",
        ),
        ("lon,lat\n15,47.5\n", ["--time", TIME], "--time: cannot be combined with --azimuths. Horizons do not depend on the sun"),
        ("lon,lat\n15,47.5\n", ["--json"], "--json: cannot be combined with --azimuths. Use one of them"),
    ],
)
def test_wrong_horizons_of_points_are_one_line(run, valley, tmp_path, text, arguments, expected_text):
    (tmp_path / "huts.csv").write_text(text, encoding="utf-8")
    status, out, err = run("point", valley, "--points", str(tmp_path / "huts.csv"), "--azimuths", "72", *arguments)
    assert status == 2 and out == "" and err.count("\n") == 1 and expected_text in err, err


def test_the_points_of_a_table_are_not_written_over(run, valley, tmp_path):
    points = tmp_path / "huts.csv"
    points.write_text("lon,lat\n15,47.5\n", encoding="utf-8")
    status, _, err = run("point", valley, "--points", str(points), "--azimuths", "72", "-o", str(points))
    assert status == 2 and "is the same file as the input" in err and points.read_text() == "lon,lat\n15,47.5\n"


def test_without_a_date_the_day_is_today(run, valley):
    """Today is a date by the requested clock: noon by one clock is not midnight by another."""
    for clock in ("solar", "Pacific/Auckland"):
        before = datetime.now(clock_of(clock, 15.0, date(2024, 1, 1))).date()
        status, out, _ = run("point", valley, "--at", LON_LAT, "--clock", clock, "--json")
        after = datetime.now(clock_of(clock, 15.0, date(2024, 1, 1))).date()
        report = json.loads(out)
        assert status == 0 and report["remark"] is None and report["day"]["clock"] == clock
        assert before <= date.fromisoformat(report["day"]["date"]) <= after and report["day"]["daylight_h"] > 8.0


def test_points_of_a_csv_are_reported_with_remarks(run, valley, tmp_path):
    file = tmp_path / "points.csv"
    file.write_text("name,lon,lat,height\nhut,15.0,47.5,2\nfar,0,0,\n", encoding="utf-8")
    status, out, _ = run("point", valley, "--points", str(file), "--time", TIME, "--json")
    hut, far = json.loads(out)
    assert status == 0 and hut["elevation_m"] == 300.0 and hut["height_m"] == 2.0 and hut["now"]["lit"] is False
    assert far["now"] is None and "a place on the level's data" in far["remark"]


def test_a_track_has_times_of_arrival(run, valley, tmp_path):
    """The track crosses the valley eastwards at 6 km/h from dawn on: shade at the bottom, sun on the ridge."""
    file = tmp_path / "track.geojson"
    line = {"type": "LineString", "coordinates": [[14.98, 47.5], [15.03, 47.5]]}
    file.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": line}), encoding="utf-8")
    arguments = ["point", valley, "--line", str(file), "--start", "2024-10-21T08:00:00+02:00", "--speed", "6", "--every", "500"]
    status, out, _ = run(*arguments, "--json")
    rows = json.loads(out)
    assert status == 0 and len(rows) == 9
    assert rows[0]["time"] == "2024-10-21T08:00:00+02:00" and rows[-1]["time"].startswith("2024-10-21T08:37")
    obstacle_kinds = {row["now"]["by"]["kind"] for row in rows if row["now"]["by"]}
    assert obstacle_kinds == {"relief"} and rows[-1]["elevation_m"] > 1000 and rows[3]["elevation_m"] < 500
    status, out, _ = run(*arguments)
    assert status == 0 and "in shadow, surface" in out


def test_a_gpx_is_a_track_and_its_points_have_times(run, valley, tmp_path):
    """The first layer of the file, waypoints, is empty."""
    file = tmp_path / "tour.gpx"
    steps = "".join(
        f'<trkpt lat="47.5" lon="{lon}"><time>2024-10-21T{hour}:00:00Z</time></trkpt>'
        for lon, hour in (("14.98", "06"), ("15.03", "10"))
    )
    head = '<?xml version="1.0"?><gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1">'
    file.write_text(f"{head}<trk><trkseg>{steps}</trkseg></trk></gpx>", encoding="utf-8")
    status, out, err = run("point", valley, "--line", str(file), "--start", TIME, "--every", "500", "--json")
    assert status == 0, err
    assert len(json.loads(out)) == 9
    status, out, err = run("point", valley, "--points", str(file), "--json")
    assert status == 0, err
    rows = json.loads(out)
    assert [row["time"] for row in rows] == ["2024-10-21T06:00:00+00:00", "2024-10-21T10:00:00+00:00"]
    assert [row["now"]["lit"] for row in rows] == [False, True]


@pytest.mark.parametrize(
    ("name", "text", "expected_text"),
    [
        (
            "p.csv", "lon,lat,time\n15.0,47.5,2024-10-21T08:00\n",
            "p.csv: line 2: the time '2024-10-21T08:00' is not allowed. Allowed: an ISO 8601",
        ),
        ("p.csv", "lon,lat\n15.0,47.5\n15.0,north\n", "p.csv: line 3: 15.0,north has no valid coordinates or height. Give numbers"),
        (
            "p.geojson",
            json.dumps({
                "type": "FeatureCollection", "features": [
                    {"type": "Feature", "properties": {"Time": time}, "geometry": {"type": "Point", "coordinates": [15.0, 47.5]}}
                    for time in ("2024-10-21T08:00:00Z", "soon")
                ],
            }),
            "p.geojson: feature 2 of 2: the time 'soon' is not allowed. Allowed: an ISO 8601 time",
        ),
    ],
)  # fmt: skip
def test_one_bad_point_among_many_is_named(run, valley, tmp_path, name, text, expected_text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    status, _, error = run("point", valley, "--points", str(tmp_path / name))
    assert status == 2 and expected_text in error and len(error.strip().splitlines()) == 1, error


@pytest.mark.parametrize(
    ("arguments", "expected_text"),
    [
        (["--at", "0,0"], "point: '0,0' is not allowed. Allowed: a place on the level's data: longitudes 14.9"),
        (["--at", "here"], "--at: 'here' is not allowed"),
        ([], "--at: missing. Give LON,LAT"),
        ([LON_LAT], "unexpected extra argument"),
        (["--at", LON_LAT, "--date", "monday"], "--date: 'monday' is not allowed. Allowed: a calendar date such as 2024-03-21"),
        (["--at", LON_LAT, "--clock", "Mars", "--date", "2024-01-01"], "--clock: 'Mars' is not allowed"),
        (["--at", LON_LAT, "--clock", "", "--date", "2024-01-01"], "--clock: '' is not allowed. Allowed: solar, utc, an offset"),
        (["--at", LON_LAT, "--clock", "Pacific/Apia", "--date", "2011-12-30"], "date: '2011-12-30' is not allowed"),
        (["--at", LON_LAT, "--height", "-3"], "--height: '-3.0' is not allowed"),
        (["--at", LON_LAT, "--horizon", "roof.hor"], "--horizon: 'roof.hor' is not allowed. Allowed: pvgis-csv, pvgis-json"),
        (["--at", LON_LAT, "--output", "roof.hor"], "--output: needs a horizon format. Add --horizon FORMAT: pvgis-csv"),
        (["--at", LON_LAT, "--azimuths", "72"], "--azimuths: needs many points. Add --points FILE, or use --horizon FORMAT"),
        (["--at", LON_LAT, "--horizon", "hor", "--json"], "--json: cannot be combined with --horizon. Add --output FILE"),
        (["--at", LON_LAT, "--start", TIME], "--start: needs a track. Add --line FILE"),
        (["--at", LON_LAT, "--points", "huts.csv"], "--at: cannot be combined with --points. Use one of them."),
        (["--line", "tour.gpkg", "--horizon", "hor"], "--horizon: cannot be combined with --line. Use one of them."),
        (["--line", "tour.gpkg", "--points", "huts.csv"], "--line: cannot be combined with --points. Use one of them."),
        (["--at", LON_LAT, "--picture", "x.gif"], "--picture: 'x.gif' is not allowed. Allowed: .svg or .png"),
        (["--at", LON_LAT, "--crs", "EPSG:0"], "--crs: 'EPSG:0' is not allowed"),
        (["--points", "nowhere.csv"], "nowhere.csv"),
    ],
)
def test_wrong_options_are_one_line(run, valley, arguments, expected_text):
    status, out, err = run("point", valley, *arguments)
    assert status == 2 and out == "" and err.count("\n") == 1 and expected_text in err


def test_a_flat_world_has_a_horizon_and_no_day(run, tmp_path):
    floor = write_geotiff(tmp_path / "floor.tif", np.zeros((21, 21), np.float32), ENGINEERING, 0.0, 0.0, 10.0)
    status, out, _ = run("point", str(floor), "--at", "0,0", "--horizon", "pvlib", "-o", str(tmp_path / "h.csv"), "--json")
    report = json.loads(out)
    assert status == 0 and report["day"] is None and "engineering CRS" in report["remark"] and report["lon"] is None
    status, _, err = run("point", str(floor), "--at", "0,0", "--date", "2024-01-01")
    assert status == 2 and "engineering CRS" in err
