"""Rasters across the antimeridian, with longitudes beyond 180 degrees, work like other rasters."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.errors import InputError

CELL_DEG = 0.6 / 240


def hills(lon: float, lat: float, write_raster, make_scene, **keys):
    """Return a scene of hills round a longitude and latitude."""
    row, col = np.mgrid[:240, :240]
    heights = (3000 + 2500 * np.sin(col / 4) * np.cos(row / 6)).astype(np.float32)
    path = write_raster(heights, "EPSG:4326", lon - 0.3, lat + 0.3, CELL_DEG, name=f"at{lon:g}.tif")
    return make_scene(path, sun={"azimuth": 250, "altitude": 12}, **keys)


@pytest.mark.parametrize("west", [179.7, -180.3])
@pytest.mark.parametrize("lat", [-17.0, 66.0])
def test_map_across_the_antimeridian_is_in_its_utm_zone(write_raster, make_scene, west, lat):
    scene = hills(west + 0.3, lat, write_raster, make_scene)
    view = scene.view()
    zone = scene.map_crs.to_epsg()
    assert zone in ((32701, 32760) if lat < 0 else (32601, 32660))
    bounds = np.array(view.bounds)
    metres = np.array([111_300 * np.cos(np.radians(lat)), 111_300]) * 0.6
    np.testing.assert_allclose(bounds[2:] - bounds[:2], metres, rtol=0.15)


def test_shadows_across_the_antimeridian_equal_those_elsewhere(write_raster, make_scene):
    from skugga.selector.select import plan_of_view
    from skugga.shadows.render import render_frame

    shares = []
    for lon in (180.0, 6.0):  # both lie between two zones
        scene = hills(lon, -17.0, write_raster, make_scene)
        frame = render_frame(
            scene, scene.view(size=(96, 96)), plan_of_view(scene, scene.view(size=(96, 96)), "map", policy="rules")
        )
        assert 0.95 < frame.valid.mean() < 1.0
        shares.append((frame.visibility[frame.valid] < 0.5).mean())
    assert 0.05 < shares[1] < 0.95
    assert shares[0] == pytest.approx(shares[1], abs=0.01)


def test_crs_that_ends_at_the_antimeridian_gives_a_remedy(write_raster, make_scene):
    scene = hills(180.0, -17.0, write_raster, make_scene)
    with pytest.raises(InputError, match="crs: .*Pseudo-Mercator.*UTM zone, or give bounds"):
        scene.view(crs="EPSG:3857")
    scene.view(crs="EPSG:4326")
    scene.view(crs="EPSG:3460")  # the CRS of Fiji
    scene.view(crs="EPSG:3857", bounds=(20_005_000, -1_920_000, 20_035_000, -1_890_000))
