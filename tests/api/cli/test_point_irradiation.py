"""``skugga point --irradiation``: its table, JSON, files and errors."""

from __future__ import annotations

import csv
import json

import pytest
from PIL import Image

from skugga.api.cli.point_irradiation import print_report
from skugga.api.point.irradiation import LOST_FIELDS
from skugga.api.point.irradiation_values import PointIrradiationReport
from tests.api.cli.test_point import LON_LAT, valley  # noqa: F401
from tests.rasters import ENGINEERING, write_geotiff

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop


def test_the_table_has_months_and_losses(run, valley):  # noqa: F811
    status, out, err = run("point", valley, "--at", LON_LAT, "--irradiation", "--year", "2023", "--tilt", "35", "--azimuth", "180")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    for text in ("ground 300.0 m", "plane tilted 35.0, facing 180.0 degrees", "2023-01-01 to 2023-12-31", "kWh/m2"):
        assert text in out, out
    assert "lost to surface" in out and "to trees" not in out
    months = [line.split() for line in lines if line.split()[:1] and line.split()[0].startswith("2023-")]
    assert [month[0] for month in months] == [f"2023-{n:02d}" for n in range(1, 13)]
    total, open_sky, lost = (sum(float(month[column]) for month in months) for column in (1, 7, 8))
    assert total + lost == pytest.approx(open_sky, abs=2.0) and lost > 30.0
    assert lines[-1].split()[0] == "all" and float(lines[-1].split()[1]) == pytest.approx(total, abs=1.0)


def test_the_table_has_no_negative_zero(run, valley, capsys):  # noqa: F811
    """A small loss below 0, such as light that a far hill reflects, is 0.0."""
    status, out, _ = run("point", valley, "--at", LON_LAT, "--irradiation", "--date", "2024-06-21", "--json")
    assert status == 0
    report = json.loads(out)
    losses = {light: {"relief": 0.0, "solids": 0.0, "forest": -0.04 * (light == "lost_sky")} for light in LOST_FIELDS}
    report["months"][0] |= losses
    print_report(PointIrradiationReport.model_validate(report))
    table = capsys.readouterr().out
    assert "to trees" in table and "-0.0" not in table


def test_files_are_written_in_the_format_of_their_suffix(run, valley, tmp_path):  # noqa: F811
    arguments = ["point", valley, "--at", LON_LAT, "--irradiation", "--date", "2024-03-01", "--to", "2024-04-30"]
    status, out, _ = run(*arguments, "--json", "-o", str(tmp_path / "table.csv"))
    report = json.loads(out)
    assert status == 0 and [month["month"] for month in report["months"]] == ["2024-03", "2024-04"]
    rows = (tmp_path / "table.csv").read_text().splitlines()
    assert rows[0].startswith("month,total_kwh_m2,beam_kwh_m2") and len(rows) == 4
    assert float(rows[-1].split(",")[1]) == report["all_months"]["total"]
    for name in ("report.json", "chart.svg", "chart.png"):
        assert run(*arguments, "-o", str(tmp_path / name))[0] == 0
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert (tmp_path / "chart.svg").read_text().startswith("<?xml")
    with Image.open(tmp_path / "chart.png") as image:
        assert min(image.size) > 600


def test_many_points_have_the_report_that_each_has_alone(run, valley, tmp_path):  # noqa: F811
    """By month in a CSV, as JSON, and as a table. A height of the file goes before that of the option."""
    points, output = tmp_path / "huts.csv", tmp_path / "months.csv"
    points.write_text("lon,lat,height\n15.0,47.5,2\n15.01,47.5,\n0,0,\n")
    dates = ["--irradiation", "--date", "2024-03-01", "--to", "2024-04-30", "--tilt", "30"]
    arguments = ["point", valley, "--points", str(points), *dates, "--height", "1"]
    status, out, error = run(*arguments, "--json", "-o", str(output))
    assert (status, error) == (0, "")
    reports = json.loads(out)
    alone = [
        json.loads(run("point", valley, "--at", at, "--height", high, *dates, "--json")[1])
        for at, high in (("15.0,47.5", "2"), ("15.01,47.5", "1"))
    ]
    assert reports[:2] == alone and alone[0]["all_months"] != alone[1]["all_months"]
    assert reports[2]["months"] is None and reports[2]["remark"].startswith("no ground here")
    rows = list(csv.DictReader(output.read_text().splitlines()))
    assert [row["month"] for row in rows] == ["2024-03", "2024-04", "all"] * 2 + ["all"]
    assert float(rows[5]["total_kwh_m2"]) == alone[1]["all_months"]["total"] and rows[6]["total_kwh_m2"] == ""
    assert (rows[3]["lon"], rows[3]["height_m"], rows[3]["elevation_m"]) == ("15.01", "1", f"{alone[1]['elevation_m']:.2f}")
    status, out, _ = run(*arguments)
    assert status == 0 and f"{alone[0]['all_months']['total']:.1f}" in out and "0.000000, 0.000000: no ground here" in out


@pytest.mark.parametrize(
    ("arguments", "expected_text"),
    [
        (["--tilt", "190"], "--tilt: '190.0' is not allowed. Allowed: less than or equal to 180"),
        (["--tilt", "20", "--plane", "ground"], "--tilt: cannot be combined with --plane. Use one of them"),
        (["--azimuth", "90"], "--azimuth: needs a tilted plane. Add a tilt, in degrees"),
        (["--plane", "roof"], "--plane: 'roof' is not allowed"),
        (["--albedo", "-1"], "--albedo: '-1.0' is not allowed"),
        (["--linke", "99"], "--linke: '99.0' is not allowed"),
        (["--step", "2h"], "--step: '2h' is not allowed. Allowed: 1m to 1h"),
        (["--date", "2024-01-01"], "--date: cannot be combined with --year. Use one of them"),
        (["--time", "2024-01-01T10:00:00Z"], "--time: cannot be combined with --irradiation. Use one of them"),
        (["--horizon", "hor"], "--horizon: cannot be combined with --irradiation. Use one of them"),
        (["-o", "months.tif"], "--output: 'months.tif' is not allowed. Allowed: with --irradiation: .json, .csv, .svg, .png"),
    ],
)
def test_wrong_options_are_one_line(run, valley, arguments, expected_text):  # noqa: F811
    status, out, err = run("point", valley, "--at", LON_LAT, "--irradiation", "--year", "2023", *arguments)
    assert status == 2 and out == "" and err.count("\n") == 1 and expected_text in err, err


@pytest.mark.parametrize(
    ("arguments", "expected_text"),
    [
        (["--at", LON_LAT, "--tilt", "20"], "--tilt: needs irradiation. Add --irradiation"),
        (["--at", LON_LAT, "--irradiation", "--year", "1066"], "--year: '1066' is not allowed"),
        (["--at", LON_LAT, "--irradiation", "--date", "1066-10-14"], "1066-10-14' is not allowed. Allowed: years 1679 to 2260"),
        (["--at", LON_LAT, "--irradiation", "--to", "2024-01-01"], "--to: needs a first date. Add a date"),
        (["--at", LON_LAT, "--irradiation", "--date", "2024-02-01", "--to", "2024-01-01"], "'2024-01-01' is not allowed"),
        (["--at", "0,0", "--irradiation", "--year", "2023"], "'0,0' is not allowed. Allowed: a place on the level's data"),
        (["--line", "track.gpx", "--irradiation"], "--line: cannot be combined with --irradiation. Use one of them"),
        (["--points", "none.csv", "--irradiation"], "none.csv: No such file or directory. Give a CSV"),
        (["--points", "huts.csv", "--irradiation", "-o", "chart.svg"], "Allowed: with --irradiation: .csv, .json"),
        (["--points", "huts.csv", "--irradiation", "--at", LON_LAT], "--at: cannot be combined with --points"),
        (["--irradiation"], "--at: missing"),
    ],
)
def test_wrong_requests_are_one_line(run, valley, arguments, expected_text):  # noqa: F811
    status, out, err = run("point", valley, *arguments)
    assert status == 2 and out == "" and err.count("\n") == 1 and expected_text in err, err


def test_a_flat_world_is_refused(run, tmp_path):
    import numpy as np

    raster = write_geotiff(tmp_path / "flat.tif", np.zeros((9, 9), np.float32), ENGINEERING, 0.0, 0.0, 10.0)
    status, _, err = run("point", str(raster), "--at", "0,0", "--irradiation", "--year", "2023")
    assert status == 2 and err.count("\n") == 1 and "an engineering CRS is not georeferenced" in err, err
