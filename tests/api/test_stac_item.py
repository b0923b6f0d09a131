"""STAC items of Sentinel-2 and Landsat: their time, sun and cells, and one line for an invalid item."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from skugga.api.products.mask import MASK_NO_SURFACE, MASK_SHADOW
from skugga.api.stac_item import read_stac_item
from skugga.terrain.errors import InputError
from tests.rasters import write_geotiff

WEST, NORTH = 499_980.0, 5_200_020.0


def sentinel_2(**changes: Any) -> dict[str, Any]:
    """Return an item with cells of 10, 20 and 60 m, and both angles."""
    item: dict[str, Any] = {
        "type": "Feature", "stac_version": "1.1.0", "id": "S2B_33TUN_20240115_0_L2A", "geometry": None,
        "properties": {
            "datetime": "2024-01-15T10:03:09.024000Z", "proj:code": "EPSG:32633", "view:sun_azimuth": 163.4,
            "view:sun_elevation": 19.6, "eo:cloud_cover": 1.2,
        },
        "assets": {
            "aot": {"href": "AOT.tif", "proj:shape": [40, 50], "proj:transform": [60, 0, WEST, 0, -60, NORTH]},
            "blue": {"href": "B02.tif", "proj:shape": [240, 300], "proj:transform": [10, 0, WEST, 0, -10, NORTH]},
            "rededge1": {"href": "B05.tif", "proj:shape": [120, 150], "proj:transform": [20, 0, WEST, 0, -20, NORTH]},
            "thumbnail": {"href": "preview.jpg", "type": "image/jpeg"},
        },
    }  # fmt: skip
    item["properties"] |= changes
    return item


def landsat(**changes: Any) -> dict[str, Any]:
    """Return an item with its own cells, finer ones in the panchromatic asset, and nine numbers in the transform."""
    item: dict[str, Any] = {
        "type": "Feature", "stac_version": "1.0.0", "id": "LC09_L1TP_191027", "geometry": None,
        "properties": {
            "datetime": "2024-01-15T09:45:31Z", "proj:epsg": 32633, "view:sun_azimuth": 160.2, "view:sun_elevation": 18.1,
            "proj:shape": [80, 100], "proj:transform": [30, 0, WEST, 0, -30, NORTH],
        },
        "assets": {
            "pan": {"href": "B8.TIF", "proj:shape": [160, 200], "proj:transform": [15, 0, WEST, 0, -15, NORTH, 0, 0, 1]},
            "red": {"href": "B4.TIF"},
        },
    }  # fmt: skip
    item["properties"] |= changes
    return item


@pytest.fixture
def write(tmp_path: Path):
    """A function that writes a STAC item (a JSON value, or a text) into a file and returns its path."""

    def write_item(item: Any) -> Path:
        path = tmp_path / "item.json"
        path.write_text(item if isinstance(item, str) else json.dumps(item), encoding="utf-8")
        return path

    return write_item


def test_an_item_gives_the_sun_and_its_finest_cells(write):
    for item, angles, cell, shape in (
        (sentinel_2(), (163.4, 19.6), 10.0, (240, 300)),
        (landsat(), (160.2, 18.1), 15.0, (160, 200)),
    ):
        stac_item = read_stac_item(write(item))
        assert (stac_item.sun.azimuth, stac_item.sun.altitude, stac_item.sun.time) == (*angles, None)
        assert stac_item.cells is not None and stac_item.cells.crs.to_epsg() == 32633
        assert (stac_item.cells.rows, stac_item.cells.cols) == shape
        assert tuple(stac_item.cells.transform)[:6] == (cell, 0.0, WEST, 0.0, -cell, NORTH)


def test_a_missing_angle_falls_back_to_the_time(write):
    stac_item = read_stac_item(write(sentinel_2(**{"view:sun_elevation": None})))
    assert stac_item.sun.azimuth is None and stac_item.sun.time == datetime(2024, 1, 15, 10, 3, 9, 24000, tzinfo=UTC)


def test_the_time_of_a_span_is_its_middle(write):
    span = {
        "datetime": None,
        "start_datetime": "2024-01-15T10:00:00Z",
        "end_datetime": "2024-01-15T10:10:00Z",
        "view:sun_azimuth": None,
    }
    assert read_stac_item(write(landsat(**span))).sun.time == datetime(2024, 1, 15, 10, 5, tzinfo=UTC)


def test_an_item_without_a_crs_has_no_cells(write):
    item = landsat()
    del item["properties"]["proj:epsg"]
    assert read_stac_item(write(item)).cells is None


@pytest.mark.parametrize(
    ("item", "expected_texts"),
    [
        ("{", ("not JSON",)),
        ("[1]", ("not a STAC item", "Feature")),
        ({"type": "Collection", "id": "sentinel-2-l2a"}, ("a Collection", "Feature")),
        ({"type": "FeatureCollection", "features": []}, ("a FeatureCollection",)),
        (
            sentinel_2(**{"datetime": None, "view:sun_azimuth": None}),
            ("neither a time nor the sun's angles", "start_datetime", "view:sun_elevation"),
        ),
        (sentinel_2(**{"datetime": "last week", "view:sun_azimuth": None}), ("datetime", "last week", "ISO 8601")),
        (sentinel_2(**{"view:sun_elevation": 170}), ("view:sun_elevation", "170", "-90 to 90")),
        (landsat(**{"proj:transform": [30, 0, "west"]}), ("proj:transform", "west")),
        (landsat(**{"proj:epsg": 999999}), ("proj:code", "999999")),
        (landsat(**{"proj:shape": [80]}), ("proj:shape", "[80]")),
    ],
)
def test_an_invalid_item_is_one_line(write, item, expected_texts):
    path = write(item)
    with pytest.raises(InputError) as caught:
        read_stac_item(path)
    message = str(caught.value)
    assert "item.json" in message and "\n" not in message
    for text in expected_texts:
        assert text in message, message


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    """File of a raster of hills round the item's place."""
    row, col = np.mgrid[:100, :120].astype(np.float32)
    heights = 700 + 250 * np.sin(col / 9) * np.cos(row / 11)
    return write_geotiff(tmp_path / "dem.tif", heights, "EPSG:32633", WEST - 300, NORTH + 300, 30.0)


@pytest.fixture
def run_shade(monkeypatch, capsys, tmp_path, dem):
    """Return ``run_shade(*options)``, which returns the mask that ``skugga shade`` writes and its file's profile."""
    from skugga.api.cli import main as cli

    def run(*options: str) -> tuple[np.ndarray, dict[str, Any]]:
        monkeypatch.setattr("sys.argv", ["skugga", "shade", str(dem), *options, "-o", str(tmp_path / "mask.tif")])
        with pytest.raises(SystemExit) as exit_info:
            cli.main()
        assert (exit_info.value.code, capsys.readouterr().err) == (0, "")
        with rasterio.open(tmp_path / "mask.tif") as dataset:
            return dataset.read(1), dict(dataset.profile)

    return run


def test_a_mask_has_the_cells_of_the_item(run_shade, write):
    mask, profile = run_shade("--stac", str(write(landsat())))
    assert mask.shape == (160, 200) and tuple(profile["transform"])[:6] == (15.0, 0.0, WEST, 0.0, -15.0, NORTH)
    assert 0.1 < (mask == MASK_SHADOW).sum() / (mask != MASK_NO_SURFACE).sum() < 0.7


def test_the_sun_is_that_of_the_item(run_shade, write):
    item_mask, _ = run_shade("--stac", str(write(landsat())), "--resolution", "30", "--crs", "EPSG:32633")
    angles_mask, _ = run_shade("--azimuth", "160.2", "--altitude", "18.1", "--resolution", "30", "--crs", "EPSG:32633")
    np.testing.assert_array_equal(item_mask, angles_mask)
    item_mask, _ = run_shade("--stac", str(write(landsat(**{"view:sun_azimuth": None}))), "--resolution", "30")
    angles_mask, _ = run_shade("--time", "2024-01-15T09:45:31Z", "--resolution", "30")
    np.testing.assert_array_equal(item_mask, angles_mask)


def test_stac_and_time_conflict(monkeypatch, capsys, tmp_path, dem, write):
    from skugga.api.cli import main as cli

    monkeypatch.setattr("sys.argv", ["skugga", "shade", str(dem), "--stac", str(write(landsat())), "--time", "2024-01-15T09:45:31Z",
                                     "-o", str(tmp_path / "mask.tif")])  # fmt: skip
    with pytest.raises(SystemExit) as exit_info:
        cli.main()
    err = capsys.readouterr().err
    assert (
        exit_info.value.code == 2 and err.count("\n") == 1 and "--stac" in err and "--stac: cannot be combined with --time" in err
    )
