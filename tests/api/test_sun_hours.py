"""Rasters of hours of sun: parts, blocks, other CRSs, objects on the ground, contours."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from rasterio.warp import transform as warped

from benchmarks.sweep_speed import fractal_heights_m
from skugga.api import contour_lines
from skugga.api.compute import write_rasters
from skugga.api.contour_lines import write_contours
from skugga.api.products import PRODUCTS
from skugga.api.products import sun_hours as module
from skugga.api.products.sun_hours import sun_blocks
from skugga.api.raster_view import raster_view
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.products import sun_hours_of
from tests.rasters import write_geotiff

CELL_M = 30.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    """Scene of fractal mountains."""
    raster = tmp_path_factory.mktemp("mountains") / "own.tif"
    built_scene = build_scene(load_level(write_geotiff(raster, fractal_heights_m(150), "EPSG:32632", 500e3, 5200e3, CELL_M)))
    yield built_scene
    built_scene.close()


@pytest.fixture(scope="module")
def whole_hours(scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, Path]:
    """Hours of the scene's raster, and their file."""
    return write_and_read(scene, tmp_path_factory.mktemp("hours"))


def write_and_read(scene: Scene, folder: Path, **extent) -> tuple[np.ndarray, Path]:
    """Write a raster of sun hours with steps of an hour. Return its values (rows, cols) and its path.

    ``extent`` are arguments of ``raster_view``.
    """
    path = folder / "hours.tif"
    progress: list[tuple[int, int]] = []
    request = sun_hours_of(date=date(2024, 3, 21), clock="utc", step_min=60.0)
    write_rasters(scene, raster_view(scene, **extent), [request], [path], on_step=lambda *update: progress.append(update))
    assert progress[-1][0] == progress[-1][1] and sorted(progress) == progress
    assert len(progress) >= 24  # of one date: its hours
    with rasterio.open(path) as dataset:
        return dataset.read(1), path


def test_a_part_equals_the_whole(scene, whole_hours, tmp_path):
    full_hours, path = whole_hours
    with rasterio.open(path) as dataset, rasterio.open(scene.loaded.path) as source_dataset:
        assert (dataset.transform, dataset.shape, dataset.crs) == (
            source_dataset.transform,
            source_dataset.shape,
            source_dataset.crs,
        )
        left, top = dataset.transform @ (20, 70)
    part, _ = write_and_read(scene, tmp_path, bounds=(left, top - 50 * CELL_M, left + 60 * CELL_M, top))
    np.testing.assert_array_equal(part, full_hours[70:120, 20:80])


def test_blocks_of_sun_hours_join(scene, whole_hours, tmp_path, monkeypatch):
    full_hours, _ = whole_hours
    monkeypatch.setattr(module, "BARE_BLOCK_SIDE_NODES", 64)
    assert len(sun_blocks(scene, raster_view(scene).view)) == 9
    block_hours, _ = write_and_read(scene, tmp_path)
    difference_min = 60.0 * np.abs(block_hours - full_hours)
    assert (
        difference_min.mean() < 0.2 and np.percentile(difference_min, 99) < 3.0
    )  # minutes: sweep lines run elsewhere between nodes


def test_cells_of_another_crs_and_shape_give_the_same_hours(scene, whole_hours, tmp_path):
    native_hours, path = whole_hours
    geographic_hours, other = write_and_read(scene, tmp_path, crs="EPSG:4326", resolution=0.0004)
    with rasterio.open(other) as other_file, rasterio.open(path) as native_dataset:
        rows, cols = (np.random.default_rng(1).integers(10, 90, 400) for _ in range(2))
        x, y = warped(other_file.crs, native_dataset.crs, *(other_file.transform @ (cols + 0.5, rows + 0.5)))
        col, row = ~native_dataset.transform @ (np.array(x), np.array(y))
    difference_h = np.abs(geographic_hours[rows, cols] - native_hours[row.astype(int), col.astype(int)])
    assert np.median(difference_h) < 0.2  # cells' centres lie up to half a cell apart
    tall_raster = write_geotiff(
        tmp_path / "tall.tif", fractal_heights_m(150)[::2], "EPSG:32632", 500e3, 5200e3, (CELL_M, 2 * CELL_M)
    )
    oblong_scene = build_scene(load_level(tall_raster))
    half, _ = write_and_read(oblong_scene, tmp_path)
    oblong_scene.close()
    assert np.corrcoef(half[5:-5, 5:-5].ravel(), native_hours[::2][5:-5, 5:-5].ravel())[0, 1] > 0.9


def test_objects_reduce_hours_of_sun(gl, tmp_path):
    write_geotiff(tmp_path / "flat.tif", np.zeros((60, 60), np.float32), "EPSG:32632", 500e3, 5200e3, 5.0)
    house = shapely.transform(
        shapely.box(500140.0, 5199840.0, 500160.0, 5199860.0),
        lambda xy: np.stack(warped("EPSG:32632", "EPSG:4326", xy[:, 0], xy[:, 1]), axis=1),
    )
    collection = {"type": "Feature", "properties": {"high": 20.0}, "geometry": json.loads(shapely.to_geojson(house))}
    (tmp_path / "house.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [collection]}), encoding="utf-8")
    level = tmp_path / "level.yaml"
    text = "version: 1\nterrain: {source: flat.tif}\nmeshes: [{source: house.geojson, height: high}]\nsun: none\n"
    level.write_text(text, encoding="utf-8")
    with_house = build_scene(load_level(level))
    hours, _ = write_and_read(with_house, tmp_path)
    coarse_hours, _ = write_and_read(with_house, tmp_path, resolution=20.0)
    with pytest.raises(InputError, match="height"):
        request = sun_hours_of(date=date(2024, 3, 21), clock="utc", height=1.5)
        write_rasters(with_house, raster_view(with_house), [request], [tmp_path / "a.tif"])
    with_house.close()
    assert coarse_hours.shape == (15, 15)
    assert abs(coarse_hours - hours.reshape(15, 4, 15, 4).mean(axis=(1, 3))).mean() < 0.2  # coarse cells are drawn as pictures
    assert hours[50, 5] == pytest.approx(12.1, abs=0.3)  # far to the south: the whole day
    assert hours[26, 30] < 8.0  # just north of the house
    assert hours[40, 30] > 11.0  # south of it


def test_contours_join_across_windows(tmp_path, monkeypatch):
    row, col = np.mgrid[:90, :120]
    hours = np.hypot(row - 45, col - 60).astype(np.float32)
    raster = write_geotiff(tmp_path / "rings.tif", hours, "EPSG:32632", 500e3, 5200e3, 10.0)
    monkeypatch.setattr(contour_lines, "WINDOW_CELLS", 32)
    assert write_contours(raster, [20.0, 30.0], tmp_path / "lines.gpkg") == 2
    meta, _, wkb, (value,) = pyogrio.raw.read(tmp_path / "lines.gpkg")
    lines = shapely.from_wkb(wkb)
    assert meta["crs"] == "EPSG:32632" and sorted(value) == [20.0, 30.0]
    for line, radius in zip(lines, value, strict=True):
        assert shapely.is_closed(line)
        assert shapely.length(line) == pytest.approx(2.0 * np.pi * radius * 10.0, rel=0.01)
        assert shapely.centroid(line).x == pytest.approx(500e3 + 605.0, abs=0.5)
        assert shapely.centroid(line).y == pytest.approx(5200e3 - 455.0, abs=0.5)


def test_contours_end_at_holes_and_may_be_empty(tmp_path):
    hours = np.tile(np.arange(40, dtype=np.float32), (30, 1))
    hours[10:12] = np.nan
    raster = write_geotiff(tmp_path / "hole.tif", hours, "EPSG:32632", 500e3, 5200e3, 10.0)
    assert write_contours(raster, [20.5], tmp_path / "lines.gpkg") == 2
    assert write_contours(raster, [99.0], tmp_path / "none.gpkg") == 0


def test_an_unknown_quantity_is_refused():
    with pytest.raises(InputError, match="quantity: 'minutes'.*'hours', 'first', 'last', 'longest' or 'days'"):
        PRODUCTS["sunhours"].options_of({"date": "2024-03-21", "quantity": "minutes"})
