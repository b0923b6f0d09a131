"""Rasters of shade: their values, the georeference of their cells, and atomic writes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from skugga.api.products.mask import MASK_LIT, MASK_NO_SURFACE, MASK_SHADOW
from skugga.api.raster_view import raster_view
from skugga.terrain.errors import InputError, SourceError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.products import write_shade
from tests.rasters import ENGINEERING, write_geotiff

LOW_SUN = SunSpec(azimuth=250.0, altitude=12.0)
CELL_M = 30.0


def hills(rows: int = 300, cols: int = 260, rough_m: float = 4.0) -> np.ndarray:
    """Return heights of hills in metres (rows, cols) with bumps of ``rough_m`` metres."""
    row, col = np.mgrid[:rows, :cols].astype(np.float32)
    return 900 + 300 * np.sin(col / 14) * np.cos(row / 23) + rough_m * np.sin(col * row / 97)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Scene of hills with a hole."""
    heights = hills()
    heights[40:60, 100:130] = -9999.0
    return open_scene(write_geotiff(tmp_path / "hills.tif", heights, "EPSG:32633", 500e3, 5200e3, CELL_M, nodata=-9999.0))


def open_scene(raster: Path) -> Scene:
    """Return the scene of a raster file."""
    return build_scene(load_level(raster))


def write_and_read(
    scene: Scene, folder: Path, layer: str = "mask", sun: SunSpec | None = LOW_SUN, **extent
) -> tuple[np.ndarray, Path]:
    """Write a raster of a layer under a sun. Return its values (rows, cols) or (bands, rows, cols), and its path.

    ``extent`` are arguments of ``raster_view``.
    """
    path = folder / f"{layer}.tif"
    write_shade(scene, raster_view(scene, **extent), layer, [sun], [path])
    with rasterio.open(path) as dataset:
        return dataset.read().squeeze(), path


def test_a_mask_has_the_raster_s_own_cells(scene, tmp_path):
    mask, path = write_and_read(scene, tmp_path)
    with rasterio.open(path) as output_dataset, rasterio.open(tmp_path / "hills.tif") as source_dataset:
        assert (output_dataset.transform, output_dataset.shape, output_dataset.crs) == (
            source_dataset.transform,
            source_dataset.shape,
            source_dataset.crs,
        )
        assert output_dataset.nodata == MASK_NO_SURFACE
        np.testing.assert_array_equal(mask == MASK_NO_SURFACE, source_dataset.read_masks(1) == 0)
    assert 0.1 < (mask == MASK_SHADOW).mean() < 0.6


def test_masks_equal_pictures_at_the_same_points(gl, scene, tmp_path, monkeypatch):
    quick, _ = write_and_read(scene, tmp_path)
    monkeypatch.setattr("skugga.shadows.draw.sunlit_picture", lambda *_: None)
    slow, _ = write_and_read(scene, tmp_path)
    assert 0.1 < (slow == MASK_SHADOW).mean() < 0.6
    np.testing.assert_array_equal(quick, slow)


def test_a_wall_shades_six_cells_of_a_raster(tmp_path):
    """In an engineering CRS, the wall is 90 m high and the sun in the west at a slope of 1:2. The shadow has 180 m, 6 cells
    of 30 m.
    """
    heights = np.zeros((40, 200), np.float32)
    heights[:, 100] = 90.0
    flat = open_scene(write_geotiff(tmp_path / "wall.tif", heights, ENGINEERING, 0, 0, CELL_M))
    mask, _ = write_and_read(flat, tmp_path, sun=SunSpec(azimuth=270.0, altitude=float(np.degrees(np.arctan(0.5)) - 0.01)))
    shaded = np.flatnonzero(mask[20] == MASK_SHADOW)
    np.testing.assert_array_equal(shaded, np.arange(101, 107))


def test_a_part_equals_the_whole(scene, tmp_path):
    full_mask, _ = write_and_read(scene, tmp_path)
    west, north = 500e3 + 50 * CELL_M, 5200e3 - 80 * CELL_M
    part, path = write_and_read(scene, tmp_path, bounds=(west, north - 100 * CELL_M, west + 120 * CELL_M, north))
    np.testing.assert_array_equal(part, full_mask[80:180, 50:170])
    with rasterio.open(path) as dataset:
        assert dataset.transform == Affine(CELL_M, 0, west, 0, -CELL_M, north)


def test_blocks_join_without_seams(scene, tmp_path, monkeypatch):
    """A raster of several blocks equals its parts drawn in one block."""
    wide_scene = open_scene(write_geotiff(tmp_path / "wide.tif", hills(200, 1500), "EPSG:32633", 500e3, 5200e3, CELL_M))
    mask, _ = write_and_read(wide_scene, tmp_path)
    bounds = 500e3 + 900 * CELL_M, 5200e3 - 200 * CELL_M, 500e3 + 1150 * CELL_M, 5200e3
    part, _ = write_and_read(wide_scene, tmp_path, bounds=bounds)
    np.testing.assert_array_equal(part, mask[:, 900:1150])
    assert 0.1 < (mask == MASK_SHADOW).mean() < 0.6


def test_like_uses_the_cells_of_another_raster(scene, tmp_path):
    like_raster = write_geotiff(tmp_path / "scene.tif", np.zeros((50, 70), np.uint8), "EPSG:3857", 1_672_000.0, 5_932_000.0, 60.0)
    mask, path = write_and_read(scene, tmp_path, like=like_raster)
    with rasterio.open(path) as output_dataset, rasterio.open(like_raster) as like_dataset:
        assert (output_dataset.transform, output_dataset.shape, output_dataset.crs) == (
            like_dataset.transform,
            like_dataset.shape,
            like_dataset.crs,
        )
    assert mask.shape == (50, 70) and 0.05 < (mask == MASK_SHADOW).mean() < 0.7


def test_crs_and_resolution_are_respected(tmp_path):
    smooth = open_scene(write_geotiff(tmp_path / "smooth.tif", hills(rough_m=0.0), "EPSG:32633", 500e3, 5200e3, CELL_M))
    native_visibility, _ = write_and_read(smooth, tmp_path, "visibility")
    for resolution in (20.0, 50.0):
        visibility, path = write_and_read(smooth, tmp_path, "visibility", crs="EPSG:3035", resolution=resolution)
        with rasterio.open(path) as dataset:
            assert dataset.crs.to_epsg() == 3035 and dataset.res == (resolution, resolution)
            assert dataset.bounds.left % resolution == 0 and dataset.bounds.top % resolution == 0
        assert 0.1 < np.nanmean(visibility) == pytest.approx(np.nanmean(native_visibility), abs=0.01)


def test_the_cosine_of_incidence_of_a_plane_is_exact(tmp_path):
    row, col = np.mgrid[:60, :60].astype(np.float32)
    rise = np.tan(np.radians(20.0))
    plane = open_scene(
        write_geotiff(tmp_path / "plane.tif", -col * CELL_M * rise, ENGINEERING, 0, 0, CELL_M)
    )  # descends to the east
    for azimuth, altitude in ((90.0, 35.0), (270.0, 35.0), (0.0, 50.0)):
        cosines, _ = write_and_read(plane, tmp_path, "cosi", SunSpec(azimuth=azimuth, altitude=altitude))
        east, up = np.sin(np.radians(20.0)), np.cos(np.radians(20.0))
        a, h = np.radians(azimuth), np.radians(altitude)
        np.testing.assert_allclose(cosines, east * np.sin(a) * np.cos(h) + up * np.sin(h), atol=1e-5)


def test_pictures_have_colours_and_opacity(scene, tmp_path):
    color, _ = write_and_read(scene, tmp_path, "color")
    shadow, _ = write_and_read(scene, tmp_path, "shadow")
    visibility, _ = write_and_read(scene, tmp_path, "visibility")
    valid = np.isfinite(visibility)
    np.testing.assert_array_equal(color[3] == 255, valid)
    assert color[:3][:, valid].std() > 5
    assert shadow[3][valid & (visibility == 0)].mean() > 180 > 60 > shadow[3][valid & (visibility == 1)].mean()


def test_many_times_in_one_run_equal_single_runs(scene, tmp_path):
    suns = [SunSpec(time=datetime(2024, 3, 21, hour, tzinfo=UTC)) for hour in (6, 9, 15, 23)]
    paths = [tmp_path / f"{n}.tif" for n in range(4)]
    progress: list[tuple[int, int]] = []
    write_shade(scene, raster_view(scene), "mask", suns, paths, lambda done, total: progress.append((done, total)))
    assert progress == [(n, 4) for n in range(1, 5)]
    for sun, path in zip(suns, paths, strict=True):
        single_mask, _ = write_and_read(scene, tmp_path, sun=sun)
        with rasterio.open(path) as dataset:
            np.testing.assert_array_equal(dataset.read(1), single_mask)
    assert (single_mask[single_mask != MASK_NO_SURFACE] == MASK_SHADOW).all()  # by night


def test_files_are_cloud_optimised(scene, tmp_path):
    large = open_scene(write_geotiff(tmp_path / "large.tif", hills(700, 1100), "EPSG:32633", 500e3, 5200e3, CELL_M))
    _, path = write_and_read(large, tmp_path)
    with rasterio.open(path) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.overviews(1) and dataset.block_shapes == [(512, 512)]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["hills.tif", "large.tif", "mask.tif"]


def test_a_failed_run_keeps_the_old_file(scene, tmp_path, monkeypatch):
    _, path = write_and_read(scene, tmp_path)
    before = path.read_bytes()

    def fail(*_):
        raise SourceError("hills.tif", "gone", "a raster")

    monkeypatch.setattr("skugga.shadows.draw.sunlit_picture", fail)
    with pytest.raises(SourceError):
        write_and_read(scene, tmp_path)
    assert path.read_bytes() == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["hills.tif", "mask.tif"]


def test_wrong_cells_are_refused(scene, tmp_path):
    rotated_raster = tmp_path / "turned.tif"
    with rasterio.open(
        rotated_raster, "w", driver="GTiff", width=4, height=4, count=1, dtype="uint8",
        crs="EPSG:32633", transform=Affine.rotation(30.0),
    ) as dataset:  # fmt: skip
        dataset.write(np.ones((1, 4, 4), np.uint8))
    for error, view_options in (
        (SourceError, {"like": rotated_raster}), (SourceError, {"like": tmp_path / "none.tif"}),
        (InputError, {"like": rotated_raster, "resolution": 5.0}),
        (InputError, {"resolution": -1.0}), (InputError, {"resolution": 1e-9}),
        (InputError, {"bounds": (0.0, 0.0, 1.0, 1.0)}),
    ):  # fmt: skip
        with pytest.raises(error):
            raster_view(scene, **view_options)


def test_a_high_sun_lights_all_ground(scene, tmp_path):
    mask, _ = write_and_read(scene, tmp_path, sun=SunSpec(azimuth=180.0, altitude=89.0))
    assert (mask[mask != MASK_NO_SURFACE] == MASK_LIT).mean() > 0.999
