"""Levels that tests of several algorithms share."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

import skugga
from tests.rasters import write_geotiff


@pytest.fixture
def level_with_objects(tmp_path):
    """Return an open level: flat ground with a block of 20 x 20 x 10 m, and a wood of trees 8 m high."""
    write_geotiff(tmp_path / "flat.tif", np.full((200, 200), 100.0, np.float32), "EPSG:32633", 500_000.0, 5_200_200.0, 1.0)

    def polygon(west, south, east, north, **properties):
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        return {
            "type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}},
            "features": [{"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [ring]}}],
        }  # fmt: skip

    (tmp_path / "house.geojson").write_text(json.dumps(polygon(500_080.0, 5_200_090.0, 500_100.0, 5_200_110.0, height=10.0)))
    (tmp_path / "wood.geojson").write_text(json.dumps(polygon(500_140.0, 5_200_040.0, 500_180.0, 5_200_160.0)))
    level = {
        "version": 1,
        "terrain": {"source": "flat.tif"},
        "meshes": [{"source": "house.geojson", "height": "height"}],
        "forest": [
            {"source": "wood.geojson", "density": 900, "height": [8, 8], "crown": [5, 5], "species": "broadleaf", "seed": 1}
        ],
        "sun": {"azimuth": 200, "altitude": 30},
    }
    path = tmp_path / "village.yaml"
    path.write_text(yaml.safe_dump(level))
    with skugga.open_level(path) as opened:
        yield opened
