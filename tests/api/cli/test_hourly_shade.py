"""``skugga compute --product hourly_shade``: its bands, their names, and a wrong month."""

import numpy as np
import rasterio

from tests.rasters import write_geotiff


def test_a_file_has_bands_and_names(run, tmp_path):
    plain = write_geotiff(tmp_path / "plain.tif", np.zeros((9, 9), np.float32), "EPSG:32632", 500e3, 5.2e6, 30.0)
    output = tmp_path / "june.tif"
    status, _, error = run("compute", str(plain), "--product", "hourly_shade", "--month", "2023-06", "-o", str(output))
    assert status == 0, error
    with rasterio.open(output) as dataset:
        assert (dataset.count, dataset.dtypes[0], dataset.nodata) == (24, "int32", -9999.0)
        assert dataset.descriptions[5] == "days with sun in the hour from 05:00"
        assert (dataset.read(13) == 2**30 - 1).all()
    status, _, error = run("compute", str(plain), "--product", "hourly_shade", "--month", "2023-13", "-o", str(output))
    assert status == 2 and "--month: '2023-13' is not allowed. Allowed: a month, as 2023-06" in error
