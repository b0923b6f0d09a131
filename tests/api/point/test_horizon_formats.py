"""Horizon files, read back by readers of their formats, such as pvlib."""

from __future__ import annotations

import io
import json

import numpy as np
import pandas
import pytest
from pyproj import CRS

from skugga.api.point.horizon_formats import HORIZON_FORMATS, azimuths_of_format, horizon_file
from skugga.shadows.point.horizon import PointHorizon
from skugga.shadows.point.place import PointPlace
from skugga.terrain.errors import InputError
from skugga.terrain.geo.world import World

WORLD = World(CRS.from_epsg(4326), False, 11.25, 47.5)
PLACE = PointPlace(0.0, 0.0, 11.25, 47.5, 0.0, 0.0, 600.0, 2.0, WORLD, np.zeros(3), np.array([0.0, 0.0, 1.0]))


def point_horizon(azimuth_deg: np.ndarray | None) -> PointHorizon:
    """Return a horizon that differs by direction: 40 degrees in the east, falling to -5 in the west."""
    azimuth = np.arange(720) / 2 if azimuth_deg is None else azimuth_deg
    height = 17.5 + 22.5 * np.sin(np.radians(azimuth))
    return PointHorizon(azimuth, height, np.full(len(azimuth), -90.0), np.full(len(azimuth), -90.0))


def file_text(name: str) -> str:
    """Return the text of a horizon file in the format ``name``."""
    return horizon_file(name, point_horizon(azimuths_of_format(name)), PLACE)


def expected_horizon_deg(azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the horizon angles of ``point_horizon``, degrees, at azimuths."""
    return np.maximum(17.5 + 22.5 * np.sin(np.radians(azimuth_deg)), 0.0)


def test_pvgis_csv_counts_azimuths_from_south():
    lines = file_text("pvgis-csv").splitlines()
    assert lines[0] == "Latitude (decimal degrees): 47.500000" and lines[2] == "Elevation (m): 602.0"
    table = np.array([line.split() for line in lines[lines.index("A_hor\t\tH_hor") + 1 :] if line[:1] in "-0123456789" and line])
    azimuth, height = table.astype(float).T
    assert azimuth[0] == -180.0 and azimuth[-1] == 180.0 and (np.diff(azimuth) > 0).all()
    assert height == pytest.approx(expected_horizon_deg(azimuth + 180.0), abs=0.006)
    assert height[np.flatnonzero(azimuth == -90.0)[0]] == pytest.approx(40.0)  # the east
    assert "0 = S, 90 = W" in lines[-2]


@pytest.mark.filterwarnings("ignore:The inplace keyword")  # pvlib's own
def test_pvgis_json_is_read_by_pvlib(monkeypatch):
    from pvlib.iotools import get_pvgis_horizon

    class Answer:
        ok = True

        @staticmethod
        def json():
            return json.loads(file_text("pvgis-json"))

    monkeypatch.setattr("requests.get", lambda *args, **kwargs: Answer)
    series, _ = get_pvgis_horizon(47.5, 11.25)
    assert len(series) == 720 and series.index[0] == 0.0
    assert series.to_numpy() == pytest.approx(expected_horizon_deg(series.index.to_numpy()), abs=1e-3)


def test_upload_formats_go_clockwise_from_north():
    upload = np.array(file_text("pvgis-upload").split(), float)
    assert len(upload) == 360 and upload == pytest.approx(expected_horizon_deg(np.arange(360.0)), abs=0.006)
    listed = np.array(file_text("forecast-solar").strip().split(","), float)
    assert len(listed) == 72 and listed == pytest.approx(expected_horizon_deg(np.arange(72) * 5.0), abs=0.06)


def test_pvlib_csv_is_a_series_by_azimuth():
    series = pandas.read_csv(io.StringIO(file_text("pvlib")), index_col=0)["horizon_elevation"]
    assert series.index.name == "horizon_azimuth" and series.index.is_monotonic_increasing
    assert series.to_numpy() == pytest.approx(expected_horizon_deg(series.index.to_numpy()), abs=1e-3)


def test_hor_has_one_line_per_degree_from_south():
    azimuth, height = np.array([line.split(" ") for line in file_text("hor").splitlines()], float).T
    assert azimuth.tolist() == list(range(-180, 180))
    assert height == pytest.approx(expected_horizon_deg(azimuth + 180.0), abs=0.006)


def test_an_unknown_format_is_refused():
    assert len(HORIZON_FORMATS) == 6
    with pytest.raises(InputError, match="format: 'xyz' is not allowed. Allowed: pvgis-csv, pvgis-json"):
        horizon_file("xyz", point_horizon(None), PLACE)
