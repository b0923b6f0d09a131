"""The report of irradiation at a point: its months and dates, its table and chart, and wrong requests."""

from __future__ import annotations

import csv
import io
from datetime import UTC, date, datetime

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from PIL import Image

from skugga.api.point.charts import PAPER_COLOR, RELIEF_COLOR
from skugga.api.point.irradiation import COLUMNS, csv_text, irradiation_with_remark, point_irradiation
from skugga.api.point.irradiation_chart import irradiation_chart
from skugga.api.point.irradiation_values import LossByCause, PointIrradiationOptions, PointIrradiationReport
from skugga.api.point.values import PointQuery
from skugga.terrain.errors import InputError
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop

LON, LAT = 15.0, 47.5


@pytest.fixture
def valley(write_raster, make_scene) -> Scene:
    """A valley from north to south, 1500 m deep, around 15 degrees east and 47.5 north."""
    _, cols = np.mgrid[0:101, 0:101]
    heights = 300.0 + 1500.0 * np.clip(np.abs(cols - 50) / 30.0 - 0.2, 0.0, 1.0)
    return make_scene(write_raster(heights.astype(np.float32), "EPSG:32633", 495_000.0, 5_266_000.0, 100.0))


def report_of(scene: Scene, year: int | None = None, date: date | None = None, clock: str | None = None, **options):
    """Return the report of the place in the middle of the valley."""
    query = PointQuery(lon=LON, lat=LAT, year=year, date=date, clock=clock)
    return point_irradiation(scene, query, PointIrradiationOptions(**options))


def test_a_year_has_twelve_months_that_add_up(valley):
    report = report_of(valley, 2023, tilt=35.0)
    assert isinstance(report, PointIrradiationReport) and report.months is not None and report.all_months is not None
    assert [month.month for month in report.months] == [f"2023-{n:02d}" for n in range(1, 13)]
    assert (report.first, report.last, report.tilt, report.azimuth) == (date(2023, 1, 1), date(2023, 12, 31), 35.0, 180.0)
    everything = report.all_months
    assert 1200.0 < everything.total < everything.open_sky < 2600.0
    assert everything.lost_beam.relief > 30.0 and everything.lost_beam.solids == everything.lost_beam.forest == 0.0
    for part in ("total", "beam", "circumsolar", "sky", "horizon_band", "reflected", "open_sky"):
        assert sum(getattr(month, part) for month in report.months) == pytest.approx(getattr(everything, part), abs=1e-3)
    for sums in (*report.months, everything):
        losses = sum(sums.lost(cause) for cause in ("relief", "solids", "forest"))
        assert sums.total + losses == pytest.approx(sums.open_sky, abs=1e-3)
        assert sums.total == pytest.approx(sums.beam + sums.circumsolar + sums.sky + sums.horizon_band + sums.reflected, abs=1e-3)
    assert report.remark is None and 0.7 < report.sky_view < (1.0 + np.cos(np.radians(35.0))) / 2.0


def test_dates_belong_to_the_months_of_their_clock(valley):
    """Whole months are those of the year, also by a clock a day ahead of UTC."""
    year = report_of(valley, 2023, clock="Pacific/Auckland")
    some = report_of(valley, date=date(2023, 2, 1), to=date(2023, 4, 15), clock="Pacific/Auckland")
    assert year.months is not None and some.months is not None
    assert [month.month for month in some.months] == ["2023-02", "2023-03", "2023-04"]
    assert some.months[0] == year.months[1] and some.months[1] == year.months[2]
    assert some.months[2].total < 0.6 * year.months[3].total
    solar = report_of(valley, date=date(2023, 3, 21))
    assert solar.months is not None and len(solar.months) == 1 and (solar.first, solar.last) == (date(2023, 3, 21),) * 2


def test_without_a_year_it_is_this_year(valley):
    query = PointQuery(lon=LON, lat=LAT, now=datetime(2031, 5, 1, tzinfo=UTC))
    report = point_irradiation(valley, query, PointIrradiationOptions())
    assert (report.first, report.last) == (date(2031, 1, 1), date(2031, 12, 31))


def test_planes_air_and_ground_count(valley):
    level, ground, snow, haze = (
        report_of(valley, date=date(2023, 6, 21), **options)
        for options in ({"plane": "level"}, {"plane": "ground"}, {"tilt": 90.0, "albedo": 0.8}, {"linke": 7.0})
    )
    wall = report_of(valley, date=date(2023, 6, 21), tilt=90.0)
    assert level.tilt == 0.0 and ground.tilt == pytest.approx(0.0, abs=0.1)
    assert snow.all_months.reflected == pytest.approx(4.0 * wall.all_months.reflected, rel=1e-4)
    assert haze.all_months.beam < 0.8 * level.all_months.beam and haze.all_months.sky > level.all_months.sky
    by_minutes = report_of(valley, date=date(2023, 6, 21), step_min=5.0)
    assert by_minutes.all_months.total == pytest.approx(level.all_months.total, rel=0.05)
    assert by_minutes.all_months.total != level.all_months.total


def test_the_csv_has_the_values_of_the_report(valley):
    report = report_of(valley, date=date(2023, 1, 1), to=date(2023, 2, 28))
    rows = list(csv.DictReader(io.StringIO(csv_text(report))))
    assert [row["month"] for row in rows] == ["2023-01", "2023-02", "all"]
    assert set(rows[0]) == {"month", *(f"{column}_kwh_m2" for column in COLUMNS)}
    for row, sums in zip(rows, (*report.months, report.all_months), strict=True):
        assert float(row["total_kwh_m2"]) == sums.total and float(row["lost_beam_relief_kwh_m2"]) == sums.lost_beam.relief
        assert float(row["lost_sky_relief_kwh_m2"]) == sums.lost_sky.relief > 0.0


def test_the_chart_has_causes_months_and_the_unit(valley):
    report = report_of(valley, 2023)
    svg = irradiation_chart(report, "svg", "A valley").decode()
    assert svg.startswith("<?xml") and svg == irradiation_chart(report, "svg", "A valley").decode()
    for text in ("A valley", "kWh/m²", "Jun", "direct sun", "lost to surface", "level plane", "under an open sky"):
        assert f"<!-- {text}" in svg or text in svg, text
    assert "lost to trees" not in svg
    # a tint without a pattern shows the loss in programs that draw no patterns
    assert to_hex(0.25 * np.array(to_rgb(RELIEF_COLOR)) + 0.75 * np.array(to_rgb(PAPER_COLOR))) in svg
    png = Image.open(io.BytesIO(irradiation_chart(report, "png", "A valley")))
    assert min(png.size) > 600
    colors = {color for _, color in png.convert("RGB").getcolors(1 << 24)}
    assert {(0xE8, 0xA2, 0x00), (0x7F, 0x9F, 0xBF)} <= colors


def test_polar_night_is_told(write_raster, make_scene):
    scene = make_scene(write_raster(np.zeros((21, 21), np.float32), "EPSG:32633", 500_000.0, 8_700_000.0, 50.0))
    place = {"lon": 15.02, "lat": 78.37}
    night = point_irradiation(scene, PointQuery(**place, date=date(2024, 12, 21)), PointIrradiationOptions())
    assert night.all_months.total == night.all_months.open_sky == 0.0
    assert night.remark == "polar night: the sun stays below the level horizon on all dates"
    assert irradiation_chart(night, "svg", "Night").startswith(b"<?xml")
    year = point_irradiation(scene, PointQuery(**place, year=2024), PointIrradiationOptions())
    assert year.remark == "polar night in 2024-01, 2024-11, 2024-12" and year.all_months.total > 300.0


def test_a_point_off_the_data_is_null_with_a_remark(valley):
    query, options = PointQuery(lon=0.0, lat=0.0, year=2023), PointIrradiationOptions()
    report = irradiation_with_remark(valley, query, options)
    assert report.months is report.all_months is report.elevation_m is report.sky_view is None
    assert report.remark.startswith("no ground here. Use a place on the level's data: longitudes 14.")
    with pytest.raises(InputError, match="point: '0,0' is not allowed. Allowed: a place on the level's data"):
        point_irradiation(valley, query, options)


@pytest.mark.parametrize(
    ("request_values", "options", "expected_text"),
    [
        ({"year": 2023}, {"tilt": 20.0, "plane": "ground"}, "tilt: cannot be combined with plane. Use one of them"),
        ({"year": 2023}, {"azimuth": 90.0}, "azimuth: needs a tilted plane. Add a tilt, in degrees"),
        ({"year": 2023, "date": date(2023, 1, 1)}, {}, "date: cannot be combined with year. Use one of them"),
        ({}, {"to": date(2023, 1, 1)}, "to: needs a first date. Add a date"),
        ({"date": date(2023, 2, 1)}, {"to": date(2023, 1, 1)}, "to: '2023-01-01' is not allowed. Allowed: 2023-02-01 or later"),
        ({"date": date(1500, 2, 1)}, {}, "date: '1500-02-01' is not allowed. Allowed: years 1679 to 2260"),
        ({"date": date(2001, 1, 1)}, {"to": date(2023, 1, 1)}, "more than the limit of 3700"),
        ({"year": 2023, "clock": "noon"}, {}, "clock: 'noon' is not allowed"),
    ],
)
def test_wrong_requests_are_one_line(valley, request_values, options, expected_text):
    with pytest.raises(InputError) as error:
        point_irradiation(valley, PointQuery(lon=LON, lat=LAT, **request_values), PointIrradiationOptions(**options))
    assert expected_text in str(error.value) and "\n" not in str(error.value)


def test_a_flat_world_has_no_sun_of_dates(write_raster, make_scene):
    scene = make_scene(write_raster(np.zeros((9, 9), np.float32), ENGINEERING, 0.0, 0.0, 10.0))
    for request_values, name in (({"year": 2023}, "year"), ({"date": date(2023, 1, 1)}, "date")):
        with pytest.raises(InputError, match=f"{name}: .*an engineering CRS is not georeferenced.* Use a level on the earth"):
            point_irradiation(scene, PointQuery(lon=0.0, lat=0.0, **request_values), PointIrradiationOptions())


def test_sums_have_no_negative_zero():
    """Rounding a small loss of the opposite sign leaves 0, in JSON as in the table and the CSV."""
    loss = LossByCause(relief=-1e-7, solids=-0.0, forest=-3e-5)
    assert loss.model_dump_json() == '{"relief":0.0,"solids":0.0,"forest":0.0}'
