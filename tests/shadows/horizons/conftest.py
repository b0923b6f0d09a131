"""Heights of real rasters."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
RASTERS = {
    "bigtujunga": "mountain/bigtujunga_30m_utm11.tif",
    "essen": "urban/essen_dom1_32_356_5699_1_nw_2020.tif",
    "quebec": "forest/quebec_DSM.tif",
}


@pytest.fixture
def data_heights():
    """Return a function from a raster's name to its heights, float32 (rows, cols), and the side of a cell in metres."""

    def load(name):
        path = DATA / RASTERS[name]
        if not path.exists():
            pytest.skip(f"no sample data at {path}")
        with rasterio.open(path) as dataset:
            heights = dataset.read(1, masked=True).astype(np.float32)
            return heights.filled(float(heights.min())), float(dataset.transform.a)

    return load
