"""``skugga overviews``: files written beside a raster, the mean of heights, and refused rasters."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window

from skugga.api import overviews as module
from skugga.terrain.errors import SourceError
from skugga.terrain.ground import overview
from skugga.terrain.ground.elevation import Elevation
from tests.rasters import write_geotiff

ROWS, COLS = 1101, 1300
SENTINEL = -32768


@pytest.fixture(autouse=True)
def lower_overview_limits(monkeypatch):
    """Lower the sizes from which rasters need overviews, so that small rasters need them."""
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 300_000)
    monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", 300_000)
    monkeypatch.setattr(overview, "OVERVIEW_SIDE_CELLS", 64)
    monkeypatch.setattr(overview, "MAX_CELLS_READ", 500_000)


def relief(dtype=np.int16) -> np.ndarray:
    """Return heights of hills in metres (rows, cols), of the data type ``dtype``."""
    row, col = np.mgrid[:ROWS, :COLS]
    return (700 + 500 * np.sin(col / 200) * np.cos(row / 300)).astype(dtype)


def raster_of(folder: Path, heights: np.ndarray, **options) -> Path:
    """Write heights as a tiled GeoTIFF and return its path. ``options`` are creation options."""
    options = {"tiled": True, **options}
    return write_geotiff(folder / "dem.tif", heights, "EPSG:32633", 500e3, 5200e3, 30.0, **options)


def mosaic_of(path: Path) -> Path:
    """Write a virtual raster of two parts, the west and the east of a raster."""
    with rasterio.open(path) as dataset:
        heights, transform, crs = dataset.read(1), dataset.transform, dataset.crs.to_wkt()
    for name, part in {"west.tif": heights[:, :700], "east.tif": heights[:, 700:]}.items():
        write_geotiff(path.with_name(name), part, "EPSG:32633", 0, 0, 30.0, tiled=True)
    sources = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="1">{name}</SourceFilename><SourceBand>1</SourceBand>'
        f'<SrcRect xOff="0" yOff="0" xSize="{width}" ySize="{ROWS}"/>'
        f'<DstRect xOff="{first}" yOff="0" xSize="{width}" ySize="{ROWS}"/></SimpleSource>'
        for name, first, width in (("west.tif", 0, 700), ("east.tif", 700, COLS - 700))
    )
    text = (
        f'<VRTDataset rasterXSize="{COLS}" rasterYSize="{ROWS}"><SRS>{crs}</SRS><GeoTransform>'
        f"{', '.join(map(str, transform.to_gdal()))}</GeoTransform>"
        f'<VRTRasterBand dataType="Int16" band="1">{sources}</VRTRasterBand></VRTDataset>'
    )
    (path.with_name("mosaic.vrt")).write_text(text, encoding="utf-8")
    return path.with_name("mosaic.vrt")


@pytest.mark.parametrize("suffix", ["tif", "vrt"])
def test_the_error_names_the_command_that_makes_overviews(run, tmp_path, suffix):
    path = raster_of(tmp_path, relief())
    path = mosaic_of(path) if suffix == "vrt" else path
    before = path.read_bytes()
    with pytest.raises(SourceError) as error_info:
        Elevation(str(path))
    assert f"'skugga overviews {path}'" in str(error_info.value) and "gdaladdo" in str(error_info.value)
    names = {file.name for file in tmp_path.iterdir()}
    assert run("overviews", str(path)) == (0, f"Wrote {path}.ovr\n", "")
    assert path.read_bytes() == before
    assert {file.name for file in tmp_path.iterdir()} == names | {f"{path.name}.ovr"}
    elevation = Elevation(str(path))
    with rasterio.open(path) as dataset:
        assert dataset.overviews(1) == [2, 4, 8, 16, 32]
    heights = relief().astype(float)
    means = heights[: 34 * 32, : 40 * 32].reshape(34, 32, 40, 32).mean((1, 3))
    error = np.abs(elevation.overview.mean_heights_m - means)
    # GDAL maps an overview's 41 columns to 1300 cells, not to 41 x 32: cells are shifted by a fraction of one.
    assert error.max() < 0.2 * np.abs(np.diff(means)).max() and error[:8, :8].max() < 2.0
    assert run("overviews", str(path)) == (
        0,
        f"{path.name} has overviews with the factors 2, 4, 8, 16, 32, and needs no others\n",
        "",
    )


def test_the_last_row_of_an_odd_number_is_a_mean_of_one_row(run, tmp_path):
    path = raster_of(tmp_path, relief())
    run("overviews", str(path))
    with rasterio.open(path, OVERVIEW_LEVEL=0) as dataset:
        coarse_heights = dataset.read(1)
    assert coarse_heights.shape == (551, 650)
    last = relief()[-1].astype(float)
    np.testing.assert_array_equal(coarse_heights[-1], np.rint((last[::2] + last[1::2]) / 2))
    first = relief()[:2].astype(float)
    np.testing.assert_array_equal(coarse_heights[0], np.rint((first[:, ::2] + first[:, 1::2]).sum(0) / 4))


@pytest.mark.parametrize("declares_nodata", [True, False])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_nodata_is_left_out_of_means(run, tmp_path, declares_nodata, dtype):
    heights = relief(dtype)
    heights[100:301, 200:401] = SENTINEL
    path = raster_of(tmp_path, heights, nodata=SENTINEL if declares_nodata else None)
    assert run("overviews", str(path))[0] == 0
    for level in range(5):
        with rasterio.open(path, OVERVIEW_LEVEL=level) as dataset:
            coarse_heights = dataset.read(1, masked=True).astype(float).filled(np.nan)
        valid = (coarse_heights >= 200) & (coarse_heights <= 1200)
        assert np.isnan(coarse_heights[~valid]).all() or (coarse_heights[~valid] == SENTINEL).all()
        side = 2 ** (level + 1)
        valid_count_range = max(200 / side - 2, 0) ** 2, (200 / side + 1) ** 2  # a coarse cell over at least one height is valid
        assert valid_count_range[0] <= (~valid).sum() <= valid_count_range[1]
    elevation = Elevation(str(path))
    assert np.nanmin(elevation.overview.mean_heights_m) >= 199.0


def test_a_nodata_value_given_as_an_option(run, tmp_path):
    heights = np.full((ROWS, COLS), 1000, np.int16)
    heights[100:301, 200:401] = 0
    heights[100:201, 200:401] = 7
    path = raster_of(tmp_path, heights, nodata=7)
    assert run("overviews", str(path), "--nodata", "0")[0] == 0
    with rasterio.open(path, OVERVIEW_LEVEL=2) as dataset:
        coarse_heights = dataset.read(1)
    assert set(np.unique(coarse_heights)) == {0, 1000}
    status, _, err = run("overviews", str(raster_of(tmp_path, relief())), "--nodata", "0.5")
    assert status == 2 and "--nodata" in err and "int16" in err


@pytest.mark.parametrize("case", ["named depths", "depths", "feet", "feet that are named"])
def test_means_respect_unit_and_direction_of_heights(run, tmp_path, case):
    """Depths of up to 10,900 m and heights of up to 14,400 ft are valid. Read as metres upwards they would be none."""
    values = relief(np.float32)
    depth = "depths" in case
    values = (9000 if depth else 6000) + (values - values.min()) * ((1900 if depth else 8400) / np.ptp(values))
    crs = "EPSG:32633+5715" if case == "named depths" else "EPSG:32633+8228" if "named" in case else "EPSG:32633"
    path = write_geotiff(tmp_path / "dem.tif", values, crs, 500e3, 5200e3, 30.0, tiled=True, geotiff_version="1.0")
    options = () if "named" in case else ("--positive", "down") if depth else ("--units", "ft")
    assert run("overviews", str(path), *options)[0] == 0
    with rasterio.open(path, OVERVIEW_LEVEL=0) as dataset:
        coarse_heights = dataset.read(1)[:550]
    np.testing.assert_allclose(coarse_heights, values[:1100].reshape(550, 2, 650, 2).mean((1, 3)), rtol=1e-6)


def test_a_small_raster_needs_no_overviews(run, tmp_path):
    path = raster_of(tmp_path, relief()[:300, :400])
    status, out, err = run("overviews", str(path))
    assert (status, err) == (0, "") and "needs no overviews: 400 x 300 cells" in out
    assert [file.name for file in tmp_path.iterdir()] == ["dem.tif"]


def test_unsuitable_rasters_are_refused_with_a_remedy(run, tmp_path):
    two_band_raster = write_geotiff(tmp_path / "two.tif", np.stack([relief(), relief()]), "EPSG:32633", 500e3, 5200e3, 30.0)
    raster_with_overviews = shutil.copy(raster_of(tmp_path, relief()), tmp_path / "inner.tif")
    with rasterio.open(raster_with_overviews, "r+") as dataset:
        dataset.build_overviews([2])
    masked = shutil.copy(tmp_path / "dem.tif", tmp_path / "masked.tif")
    with rasterio.open(masked, "r+") as dataset:
        dataset.write_mask(np.tri(ROWS, COLS) > 0)
    names = {file.name for file in tmp_path.iterdir()}
    for path, word in ((two_band_raster, "2 bands"), (raster_with_overviews, "overviews in the file itself"), (masked, "a mask")):
        status, out, err = run("overviews", str(path))
        assert status == 2 and out == "" and word in err and "gdaladdo" in err and err.count("\n") == 1
    text = tmp_path / "text.tif"
    text.write_text("no raster")
    assert run("overviews", str(text))[0] == 2
    assert {file.name for file in tmp_path.iterdir()} == names | {"text.tif"}


def test_too_few_old_overviews_are_replaced(run, tmp_path, tmp_path_factory, monkeypatch):
    path = raster_of(tmp_path, relief())
    half_size_raster = raster_of(tmp_path_factory.mktemp("half"), relief()[::2, ::2])
    shutil.copy(half_size_raster, f"{path}.ovr")
    with rasterio.open(path) as dataset:
        assert dataset.overviews(1) == [2]
    old_overview = Path(f"{path}.ovr").read_bytes()

    def fail_on_full_disk(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(module, "_build_coarser_overviews", fail_on_full_disk)
        status, _, err = run("overviews", str(path))
    assert status == 1 and "No space left" in err
    assert Path(f"{path}.ovr").read_bytes() == old_overview and len(list(tmp_path.iterdir())) == 2
    assert run("overviews", str(path))[0] == 0
    assert Path(f"{path}.ovr").read_bytes() != old_overview


def test_parts_cover_the_raster_once():
    visit_count = np.zeros((1300, 9000), int)
    for window in module._tile_windows(*visit_count.shape):
        assert isinstance(window, Window) and window.row_off % 512 == window.col_off % 512 == 0
        visit_count[window.toslices()] += 1
    assert (visit_count == 1).all()
